"""`wfsobs live`: observers on a loop that runs by the clock."""

from __future__ import annotations

import json

import click
import numpy as np
from rich.table import Table

from wfsobs.cli.options import scenario_options
from wfsobs.cli.show import progress_bar, show_table
from wfsobs.files import check_writable
from wfsobs.live.follow import follow
from wfsobs.live.recording import record_of
from wfsobs.live.ring import LiveFrame
from wfsobs.scenario import configfile
from wfsobs.settings.group import SettingError
from wfsobs.telemetry.records import save_record


@click.command()
@scenario_options
@click.option("--headless", is_flag=True, help="Run without a page; needed, there is no page yet.")
@click.option("--seconds", type=click.FloatRange(0.01, 86_400), default=10.0, metavar="N", help="How long; 10 unless told.")
@click.option("--observer", "observers", multiple=True, metavar="NAME", help="Run this observer alone; can be given many times.")
@click.option("--speed", type=click.FloatRange(0.1, 20), default=1.0, metavar="X", help="1 is real time, the default.")
@click.option("--record", "record_file", metavar="RECORD", help="Also save what was sent: .npz, .csv, .fits or .aot.fits.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of a table.")
def live(
    preset: str | None,
    config: str | None,
    assignments: tuple[str, ...],
    headless: bool,
    seconds: float,
    observers: tuple[str, ...],
    speed: float,
    record_file: str | None,
    as_json: bool,
) -> None:
    """Run the simulated loop by the clock, every observer beside it, frame by frame (docs/live.md)."""
    if not headless:
        raise SettingError("live: there is no page yet, take --headless")
    if record_file:
        check_writable(record_file)
    scenario = configfile.scenario_from(preset, config, assignments)
    kept: list[LiveFrame] = []
    with progress_bar("frames") as update:
        result = follow(
            scenario,
            max(1, round(seconds * scenario.sensors.lgs_rate * speed)),
            observers or None,
            speed=speed,
            keep=kept.append if record_file else None,
            report=update,
        )
    if record_file:
        frames = LiveFrame(*(np.array(part) for part in zip(*kept, strict=True)))
        save_record(record_file, record_of(frames, scenario), configfile.to_toml(scenario))
    if as_json:
        click.echo(json.dumps(result, allow_nan=False))
        return
    table = Table(title=f"{result['frames']} frames, {result['lost']} lost, {result['late_share']:.2%} more than 1 ms late")
    for name in ("Observer", "rms, nm", "step p50, us", "p99.9, us", "longer than a frame"):
        table.add_column(name, justify="left" if name == "Observer" else "right")
    for name, row in result["observers"].items():
        rms = "-" if row["rms_nm"] is None else f"{row['rms_nm']:.2f}"
        table.add_row(name, rms, f"{row['p50_us']:.0f}", f"{row['p99_9_us']:.0f}", str(row["late"]))
    show_table(table)
