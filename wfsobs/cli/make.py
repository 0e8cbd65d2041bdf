"""`wfsobs export`, `presets`, `bench` and `serve`."""

from __future__ import annotations

import json
from datetime import datetime
from typing import Any

import click
from rich.console import Console

from wfsobs.cli.bench_table import bench_table
from wfsobs.cli.options import scenario_options
from wfsobs.cli.show import progress_bar, warn
from wfsobs.files import check_writable, write_whole
from wfsobs.pipeline import run as run_scenario
from wfsobs.progress import Watch
from wfsobs.scenario import configfile
from wfsobs.scenario.grid import MOST, parse_variation, scenarios
from wfsobs.scenario.presets import PRESETS
from wfsobs.scenario.settings import SettingError


@click.command()
@click.argument("out", metavar="OUT.html")
@scenario_options
@click.option("--vary", multiple=True, metavar="NAME=VALUE,VALUE,...",
              help=f"Run for each of these values as well; several make every combination, at most {MOST}.")
def export(out: str, preset: str | None, config: str | None, assignments: tuple[str, ...], vary: tuple[str, ...]) -> None:
    """Write a report: one HTML file with figures and numbers that opens without a network."""
    base = configfile.scenario_from(preset, config, assignments)
    variations = [parse_variation(text) for text in vary]
    states = scenarios(base, variations)
    check_writable(out)
    try:
        from wfsobs.app.report.page import page
    except ModuleNotFoundError as error:
        raise SettingError(f"export: a report needs {error.name}; install wfsobs with its extra: wfsobs[app]") from None
    from wfsobs.app.report.data import Report, state_of

    kept = []
    with progress_bar("runs") as update:
        for i, scenario in enumerate(states):
            result = run_scenario(scenario, Watch(progress=lambda f, i=i: update((i + f) / len(states))))
            warn(result)
            kept.append(state_of(result, len(states)))
    report = Report(configfile.preset_name(preset, config), base, tuple(variations), tuple(kept))
    content = page(report, datetime.now().astimezone()).encode()
    write_whole(out, lambda file: file.write(content))


@click.command()
@click.argument("name", required=False)
def presets(name: str | None) -> None:
    """List the presets, or print one as TOML."""
    if name is not None:
        click.echo(configfile.to_toml(configfile.preset(name)), nl=False)
        return
    for key, make in PRESETS.items():
        click.echo(f"{key:{max(map(len, PRESETS))}} {(make.__doc__ or '').splitlines()[0]}")


@click.command()
@click.option("--full", is_flag=True, help="Also m up to 2048, d up to 1000 and a run of 60 s.")
@click.option("--json", "as_json", is_flag=True, help="Print a list of rows instead of a table.")
def bench(full: bool, as_json: bool) -> None:
    """Time the observers beside textbook versions, and other libraries if installed (wfsobs[bench])."""
    from wfsobs import bench as benches

    with progress_bar("benchmarks") as update:
        measured = benches.measure_all(benches.FULL if full else benches.QUICK, update)
    missing = [name for name in benches.LIBRARIES if name not in benches.installed()]
    if missing:
        click.echo(f"wfsobs: bench: without {', '.join(missing)}; the extra wfsobs[bench] installs them", err=True)
    if as_json:
        click.echo(json.dumps(measured, allow_nan=False))
        return
    console = Console()
    table = bench_table(measured, markdown=not console.is_terminal)
    (console if console.is_terminal else Console(width=200)).print(table)
    click.echo(benches.machine(benches.LIBRARIES))


@click.command()
@click.option("--port", type=click.IntRange(0, 65535), default=5006, show_default=True,
              help="Port to listen on; 0 for a free one.")
@click.option("--address", default="localhost", show_default=True, help="Address to listen on; 0.0.0.0 for all of the machine.")
@click.option("--open", "open_browser", is_flag=True, help="Open a browser.")
@click.option("--origin", "origins", multiple=True, metavar="HOST[:PORT]",
              help="Name that browsers reach the page by, behind a proxy; can be given many times.")
@click.option("--prefix", default="", metavar="PATH", help="Path of the page, behind a proxy that serves other things too.")
@click.option("--public/--local", default=None,
              help="Limit what a visitor may ask for, or do not; limits are on unless only this machine reaches the page.")
@click.option("--max-duration", type=click.FloatRange(0, min_open=True), metavar="S", help="Longest record.")
@click.option("--max-training-size", type=click.IntRange(2), metavar="M", help="Largest training set of a GPR.")
@click.option("--max-depth", type=click.IntRange(1), metavar="D", help="Deepest windows of a GPR.")
@click.option("--max-seconds", type=click.FloatRange(0, min_open=True), metavar="S",
              help="Longest run, as estimated.")
@click.option("--max-memory", type=click.FloatRange(0, min_open=True), metavar="MB", help="Memory of a run, as estimated.")
@click.option("--max-sessions", type=click.IntRange(1), metavar="N", help="Open pages.")
@click.option("--runs", type=click.IntRange(1), metavar="N", help="Jobs at once, as many as processors unless told.")
@click.option("--cache-mb", type=click.IntRange(0), default=256, show_default=True, metavar="MB", help="Results kept.")
@click.option("--lifetime", type=click.FloatRange(0.1), default=60.0, show_default=True, metavar="S",
              help="How long the settings are kept of a page that has lost its connection.")
@click.option("--log-level", type=click.Choice(["debug", "info", "warning", "error"]), default="info", show_default=True,
              help="What is written to standard error.")
@click.option("--log-requests", is_flag=True, help="Also a line per request, with address and query.")
def serve(**options: Any) -> None:
    """Serve the dashboard (docs/serving.md)."""
    try:
        from wfsobs.app import serve as server
    except ModuleNotFoundError as error:
        raise SettingError(f"serve: the dashboard needs {error.name}; install wfsobs with its extra: wfsobs[app]") from None
    server.serve(server.options(**options))
