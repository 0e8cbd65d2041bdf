"""The command line: `wfsobs run`, `observe`, `identify`, `loop`, `export`, `presets`, `bench`, `serve`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from typing import Any

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from threadpoolctl import threadpool_limits

from wfsobs import __version__, configfile
from wfsobs.control import tables as loop_tables
from wfsobs.control.closed_loop import closed_loop, design
from wfsobs.files import check_writable, write_whole
from wfsobs.formats.psd import load_psd
from wfsobs.identify import identify as identify_record
from wfsobs.identify import report as identified
from wfsobs.identify.identification import LEVEL
from wfsobs.identify.search import LOWEST
from wfsobs.intake import Stated
from wfsobs.loop import simulate
from wfsobs.pipeline import Result, as_stated
from wfsobs.pipeline import observe as observe_record
from wfsobs.pipeline import run as run_scenario
from wfsobs.presets import PRESETS
from wfsobs.record import DELAY, Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.settings import SettingError
from wfsobs.tables import TIME, Row, rows, score_table
from wfsobs.telemetry import load_record, save_arrays, save_record
from wfsobs.units import UNITS
from wfsobs.variations import MOST, parse_variation, scenarios
from wfsobs.watch import Watch


class _Commands(click.Group):
    """Turns the errors a user can cause into one line and exit status 2."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except (SettingError, RecordError) as error:
            click.echo(f"wfsobs: {error}", err=True)
        except OSError as error:
            click.echo(f"wfsobs: {error.filename or 'file'}: {error.strerror or error}", err=True)
        ctx.exit(2)


def scenario_options(command: Callable) -> Callable:
    """--preset, --config and --set."""
    for option in (
        click.option("--set", "assignments", multiple=True, metavar="NAME=VALUE",
                     help="Change one setting, such as turbulence.wind_speed=20; can be given many times."),
        click.option("--config", metavar="F.toml", help="Settings from a TOML file, on top of the preset."),
        click.option("--preset", metavar="NAME", help=f"Start from {', '.join(PRESETS)}; paper unless told."),
    ):
        command = option(command)
    return command


def record_options(command: Callable) -> Callable:
    """--unit, --command-sign, --command-delay and --rate: what a record does not say of itself."""
    for option in (
        click.option("--rate", type=click.FloatRange(0, min_open=True), metavar="HZ",
                     help="Rate of the rows where they have no time."),
        click.option("--command-delay", type=click.IntRange(1, 100), metavar="N",
                     help=f"Steps from a command to the first measurement that sees it; {DELAY} unless told."),
        click.option("--command-sign", type=click.Choice(["+1", "-1"]),
                     help="+1 where a command adds to what the sensor sees (the default), -1 where it is taken off."),
        click.option("--unit", type=click.Choice(UNITS), help="Unit of the record where it states none; um unless told."),
    ):
        command = option(command)
    return command


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="wfsobs")
def main() -> None:
    """Disturbance observers for adaptive optics: turbulence and vibration from wavefront-sensor data."""
    # One BLAS thread: at these sizes two are slower, and modes run side by side.
    threadpool_limits(1, user_api="blas")


@main.command()
@scenario_options
@click.option("--seeds", type=click.IntRange(1, 100_000), default=1, metavar="N",
              help="Repeat with seeds run.seed ... run.seed + N - 1.")
@click.option("--json", "as_json", is_flag=True, help="Print a list of rows instead of a table.")
@click.option("--save", metavar="RECORD", help="Also save the record of the (one) run: .npz, .csv, .fits or .aot.fits.")
@click.option("--vibration-psd", metavar="FILE", help="Vibration with the spectrum of a CSV or FITS file (docs/data.md).")
@click.option("--psd-unit", type=click.Choice(UNITS), help="Its unit, squared per Hz, where it states none.")
def run(
    preset: str | None, config: str | None, assignments: tuple[str, ...], seeds: int, as_json: bool, save: str | None,
    vibration_psd: str | None, psd_unit: str | None,
) -> None:
    """Simulate the loop, run every observer and print the RMS table."""
    if save and seeds > 1:
        raise SettingError("--save: saves one record; leave --seeds at 1")
    scenario = configfile.scenario_from(preset, config, assignments)
    if vibration_psd is not None:
        table = load_psd(vibration_psd, psd_unit, scenario.telescope.diameter)
        scenario = scenario.replace({"vibration.source": "psd", "vibration.psd": table})
    all_rows: list[Row] = []
    with progress_bar() as update:
        for i in range(seeds):
            one = scenario.replace({"run.seed": scenario.run.seed + i})
            record = simulate(one)
            if save:
                save_record(save, record, configfile.to_toml(one))
            result = observe_record(record, one, Watch(progress=lambda f, i=i: update((i + f) / seeds)), simulated=True)
            _warn(result)
            all_rows += rows(result.scores, one.run.seed)
    show(all_rows, as_json)


@main.command()
@click.argument("record_file", metavar="RECORD")
@scenario_options
@record_options
@click.option("--out", metavar="ESTIMATES.npz", help="Save every estimate under the key observer/target.")
@click.option("--json", "as_json", is_flag=True, help="Print a list of rows instead of a table.")
def observe(
    record_file: str, preset: str | None, config: str | None, assignments: tuple[str, ...], unit: str | None,
    command_sign: str | None, command_delay: int | None, rate: float | None, out: str | None, as_json: bool,
) -> None:
    """Run the observers on a record: .npz, .csv, .fits or AOT (preset paper unless told)."""
    scenario = configfile.scenario_from(preset, config, assignments)
    record = _loaded(record_file, scenario, Stated(unit, int(command_sign) if command_sign else None, command_delay, rate))
    with progress_bar() as update:
        result = observe_record(record, scenario, Watch(progress=update))
    _warn(result)
    if out:
        save_arrays(out, {f"{e.observer}/{e.target}": e.values for e in result.estimates})
    if not result.scores and not as_json:
        click.echo(f"wfsobs: {record_file}: {len(result.estimates)} estimates, no scores: nothing after the warm-up", err=True)
        return
    show(rows(result.scores, None), as_json)


@main.command()
@click.argument("record_file", metavar="RECORD")
@scenario_options
@record_options
@click.option("--level", type=click.FloatRange(0, 0.5, min_open=True), default=LEVEL, show_default=True, metavar="P",
              help="Probability of finding any peak where there is none.")
@click.option("--lowest", type=click.FloatRange(0, min_open=True), default=LOWEST, show_default=True, metavar="HZ",
              help="Frequency from which peaks are looked for.")
@click.option("--out", metavar="F.toml", help="Save what was found as settings, on top of the preset.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of a table.")
def identify(
    record_file: str, preset: str | None, config: str | None, assignments: tuple[str, ...], unit: str | None,
    command_sign: str | None, command_delay: int | None, rate: float | None, level: float, lowest: float, out: str | None,
    as_json: bool,
) -> None:
    """Find noise, turbulence and vibration peaks in a record (docs/identification.md)."""
    scenario = configfile.scenario_from(preset, config, assignments)
    record = _loaded(record_file, scenario, Stated(unit, int(command_sign) if command_sign else None, command_delay, rate))
    if out:
        check_writable(out)
    with progress_bar("sweeps") as update:
        result = identify_record(record, scenario, level, lowest, Watch(progress=update))
    if out:
        text = identified.toml(result, result.scenario(as_stated(record, scenario)))
        write_whole(out, lambda file: file.write(text.encode()))
    if as_json:
        click.echo(json.dumps(identified.plain(result), allow_nan=False))
        return
    show_table(identified.table(result))
    for line in identified.verdict(result):
        click.echo(line)


@main.command()
@scenario_options
@click.option("--controller", "controllers", multiple=True, metavar="NAME",
              help="Run this controller alone; can be given many times.")
@click.option("--seeds", type=click.IntRange(1, 100_000), default=1, metavar="N",
              help="Repeat with seeds run.seed ... run.seed + N - 1.")
@click.option("--json", "as_json", is_flag=True, help="Print a list of rows instead of a table.")
def loop(
    preset: str | None, config: str | None, assignments: tuple[str, ...], controllers: tuple[str, ...], seeds: int, as_json: bool,
) -> None:
    """Close the loop with every controller on the same disturbance and print what is left of it (docs/closed_loop.md)."""
    scenario = configfile.scenario_from(preset, config, assignments)
    all_rows: list[Row] = []
    with progress_bar("controllers") as update:
        plan = design(scenario, controllers or None)
        for i in range(seeds):
            one = scenario.replace({"run.seed": scenario.run.seed + i})
            result = closed_loop(simulate(one), plan, Watch(progress=lambda f, i=i: update((i + f) / seeds)))
            all_rows += loop_tables.rows(result, one.run.seed)
    if as_json:
        click.echo(json.dumps(all_rows, allow_nan=False))
    else:
        show_table(loop_tables.table(all_rows))


@main.command()
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
            _warn(result)
            kept.append(state_of(result, len(states)))
    report = Report(configfile.preset_name(preset, config), base, tuple(variations), tuple(kept))
    content = page(report, datetime.now().astimezone()).encode()
    write_whole(out, lambda file: file.write(content))


@main.command()
@click.argument("name", required=False)
def presets(name: str | None) -> None:
    """List the presets, or print one as TOML."""
    if name is not None:
        click.echo(configfile.to_toml(configfile.preset(name)), nl=False)
        return
    for key, make in PRESETS.items():
        click.echo(f"{key:{max(map(len, PRESETS))}} {(make.__doc__ or '').splitlines()[0]}")


@main.command()
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
    table = benches.bench_table(measured, markdown=not console.is_terminal)
    (console if console.is_terminal else Console(width=200)).print(table)
    click.echo(benches.machine(benches.LIBRARIES))


@main.command()
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
@click.option("--runs", type=click.IntRange(1), metavar="N", help="Runs at once, as many as there are processors unless told.")
@click.option("--cache-mb", type=click.IntRange(0), default=256, show_default=True, metavar="MB", help="Results kept.")
@click.option("--lifetime", type=click.FloatRange(0.1), default=15.0, show_default=True, metavar="S",
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


def _loaded(record_file: str, scenario: Scenario, stated: Stated) -> Record:
    """The record of a file; what was understood of it is said on standard error."""
    record = load_record(record_file, scenario, stated)
    if record.origin:
        click.echo(f"wfsobs: {record_file}: read as {record.origin}", err=True)
    if record.missing:
        click.echo(f"wfsobs: {record_file}: {record.missing} of {record.n_steps} frames are missing; they are bridged by "
                   "prediction and count in no score of one", err=True)
    return record


def show(all_rows: list[Row], as_json: bool) -> None:
    """Print rows to standard output, as JSON or as a table."""
    if as_json:
        click.echo(json.dumps([{k: v for k, v in row.items() if k != TIME} for row in all_rows], allow_nan=False))
    else:
        show_table(score_table(all_rows))


def show_table(table: Table) -> None:
    """Print a table as wide as the terminal, or where there is none as wide as a page."""
    console = Console()
    (console if console.is_terminal else Console(width=160)).print(table)


def _warn(result: Result) -> None:
    for failure in result.failures:
        click.echo(f"wfsobs: {failure.reason}", err=True)


@contextmanager
def progress_bar(what: str = "observers") -> Iterator[Callable[[float], None]]:
    """A progress bar on standard error where that is a terminal; gives the function that moves it."""
    console = Console(stderr=True)
    columns = (TextColumn(what), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task("", total=1.0)
        yield lambda fraction: progress.update(task, completed=fraction)

