"""`wfsobs rt-check`."""

from __future__ import annotations

import click
import numpy as np
from rich import box
from threadpoolctl import threadpool_limits

from wfsobs.bench.measure import SHARE, RealTime, machine, measure_realtime
from wfsobs.cli.options import json_option, scenario_options
from wfsobs.cli.show import new_table, print_json, show_table
from wfsobs.observers.step import StepError
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError


@click.command(name="rt-check")
@scenario_options
@click.option("--observer", "name", default="kf-multi", show_default=True, metavar="ID", help="Observer or controller that runs.")
@click.option("--seconds", type=click.FloatRange(0.01, 3600), default=5.0, show_default=True, metavar="S", help="Duration.")
@json_option()
def rt_check(scenario: Scenario, name: str, seconds: float, as_json: bool) -> None:
    """Tell what this machine can hold: how late a loop at the LGS rate wakes, and what a step takes in it."""
    rate = scenario.sensors.lgs_rate
    try:
        with threadpool_limits(1, user_api="blas"):
            found = measure_realtime(name, scenario, rate, seconds)
    except StepError as error:
        raise SettingError(str(error)) from None
    rows = _rows(found)
    if as_json:
        summary = {"observer": name, "rate_hz": rate, "late_share": found.late_share, "highest_rate_hz": found.highest_rate}
        print_json({**summary, "microseconds": dict(rows)})
        return
    table = new_table(("us",), ("p50", "p99", "p99.9", "max"), no_wrap=False, box=box.HEAVY_HEAD)
    for what, values in rows:
        table.add_row(what, *(f"{value:.1f}" for value in values))
    show_table(table)
    click.echo(machine())
    click.echo(_verdict(found))


def _rows(timing: RealTime) -> list[tuple[str, list[float]]]:
    """Percentiles [us] by what was timed."""
    named = {
        f"{timing.name}, step back to back": timing.alone.seconds,
        f"{timing.name}, step at {timing.rate:g} Hz": timing.step.seconds,
        "reference step at that rate": timing.reference.seconds,
        "wake-up after the frame was due": np.concatenate([timing.step.late, timing.reference.late]),
    }
    return [(what, (np.percentile(x, [50.0, 99.0, 99.9, 100.0]) * 1e6).tolist()) for what, x in named.items()]


def _verdict(timing: RealTime) -> str:
    """Return one line: what is held."""
    in_time = f"{100 * (1 - timing.late_share):.2f} % of the frames at {timing.rate:g} Hz are done before the next is due"
    if not timing.highest_rate:
        return f"{timing.name}: {in_time}; this machine holds no rate in {100 * SHARE:g} % of the frames"
    return f"{timing.name}: {in_time}; this machine holds {timing.highest_rate:g} Hz in {100 * SHARE:g} % of the frames"
