"""`wfsobs live`: observers on a loop that runs by the clock."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterable
from dataclasses import replace
from os import cpu_count
from types import FrameType
from typing import Any

import click
import numpy as np
from rich.table import Table

from wfsobs.cli.options import (
    RECORD_OPTIONS,
    DeclaredFile,
    FiniteRange,
    check_output,
    controller_option,
    json_option,
    load_declared,
    needing,
    ngs_options,
    ngs_wiring,
    observer_option,
    preset_of_command,
    record_options,
    refuse_options,
    scenario_options,
    stream_elements,
)
from wfsobs.cli.show import new_table, print_json, print_note, progress_bar, show_table
from wfsobs.live.attached import StreamSource
from wfsobs.live.checks import can_control, check_slot, observers_on
from wfsobs.live.crew import USUAL
from wfsobs.live.follow import follow
from wfsobs.live.loop import LiveOrder
from wfsobs.live.ring import LiveFrame, open_loop_record, record_of
from wfsobs.live.simulated import SimulatedLoop, acts_of
from wfsobs.live.source import LiveSource, Replay
from wfsobs.scenario import Scenario, configfile
from wfsobs.settings.group import SettingError
from wfsobs.streams.network import is_address
from wfsobs.streams.shared_image import stream_path
from wfsobs.telemetry.formats import WRITTEN
from wfsobs.telemetry.records import save_record
from wfsobs.units import micrometres_per


@click.command()
@scenario_options
@click.option("--replay", "replay_file", metavar="RECORD", help="Frames of a record of any format, once.")
@click.option(
    "--in",
    "stream",
    metavar="STREAM",
    help="Frames of a running loop, in shadow; or tcp://host:port (docs/streams.md).",
)
@click.option("--modes", metavar="I,J,...", help="Elements of a frame of the stream, from 0, that are its modes.")
@ngs_options
@record_options
@observer_option
@controller_option("Run this controller alone beside it; can be repeated.")
@click.option("--no-controllers", is_flag=True, help="Run no controller beside it.")
@click.option("--speed", type=FiniteRange(0.1, 20), default=1.0, metavar="X", help="1 is real time.")
@click.option("--record", "record_file", metavar="RECORD", help="Also save what was sent, in the format of its ending.")
@click.option("--log", "log_file", metavar="FILE", help="Append what happens and alarms, a line each.")
@click.option("--port", type=click.IntRange(0, 65535), default=5006, help="Port of the page; 0 for a free one.")
@click.option("--open", "open_browser", is_flag=True, help="Open a browser.")
@click.option("--headless", is_flag=True, help="Run without a page, for --seconds, and print a table.")
@click.option("--seconds", type=FiniteRange(0.01, 86_400), default=10.0, metavar="N", help="Duration.")
@json_option("Print one JSON object instead of a table.")
def live(
    scenario: Scenario,
    replay_file: str | None,
    stream: str | None,
    modes: str | None,
    ngs: str | None,
    ngs_modes: str | None,
    ngs_lag: int,
    declaration: DeclaredFile,
    observers: tuple[str, ...],
    controllers: tuple[str, ...],
    no_controllers: bool,
    speed: float,
    record_file: str | None,
    log_file: str | None,
    port: int,
    open_browser: bool,
    headless: bool,
    seconds: float,
    as_json: bool,
) -> None:
    """Run a loop by the clock, every observer beside it, frame by frame, and show it on a page (docs/live.md)."""
    if replay_file and stream:
        raise SettingError("live: --replay and --in are two sources, take one")
    _check_options(replay_file, stream, ngs, headless)
    for file, endings in ((record_file, WRITTEN), (log_file, ())):
        if file:
            check_output(file, endings)
    source = _source(scenario, replay_file, stream, modes, declaration)
    if not isinstance(source, SimulatedLoop):
        scenario = scenario.before_events
    acts_of(scenario)
    if ngs is not None:
        source = _with_ngs(source, scenario, ngs, ngs_modes, declaration.unit or "um", ngs_lag)
    usual = tuple(name for name in USUAL if can_control(name, source))
    beside = () if no_controllers else controllers or usual
    addresses = {
        "in": stream,
        "modes": modes,
        "ngs": ngs,
        "ngs-modes": ngs_modes,
        "ngs-lag": ngs_lag or None,
        "unit": declaration.unit,
    }
    order = LiveOrder(
        source,
        scenario,
        tuple(observers or observers_on(source, scenario)),
        speed,
        beside,
        key="live",
        record_file=record_file or "",
        log_file=log_file or "",
        preset=preset_of_command(),
        options=tuple(word for name, value in addresses.items() if stream and value for word in (f"--{name}", str(value))),
    )
    if headless:
        _run_headless(order, seconds, as_json)
        return
    for name in (*order.observers, *beside):
        check_slot(name)
    with needing("live: the page needs", "app"):
        from wfsobs.app import serve as server
    server.serve(server.Options(port=port, open_browser=open_browser, runs=max(2, cpu_count() or 1)), order)


def _check_options(replay_file: str | None, stream: str | None, ngs: str | None, headless: bool) -> None:
    """Raise SettingError for an option that needs another one, or does nothing beside another one."""
    if headless:
        refuse_options(("port", "open_browser"), "there is no page with --headless")
        refuse_options(("controllers", "no_controllers"), "only with a page")
    else:
        refuse_options(("seconds", "as_json"), "only with --headless")
    if not replay_file:
        refuse_options([name for name in RECORD_OPTIONS if name != "unit"], "only with --replay")
    if stream:
        refuse_options(("speed",), "only of a simulation or a record")
    else:
        refuse_options(("modes",), "only with --in")
    if not replay_file and not stream:
        refuse_options(("unit",), "only with --replay or --in")
    if ngs is None:
        refuse_options(("ngs_modes", "ngs_lag"), "only with --ngs")


def _source(
    scenario: Scenario,
    replay_file: str | None,
    stream: str | None,
    modes: str | None,
    declaration: DeclaredFile,
) -> LiveSource:
    """Return the source that the options name. Raises SettingError, RecordError."""
    if replay_file:
        return Replay(load_declared(replay_file, scenario, declaration))
    if not stream:
        return SimulatedLoop(scenario)
    elements = stream_elements(modes, len(scenario.modes))
    unit = micrometres_per(declaration.unit or "um", scenario.telescope.diameter)
    return StreamSource(_place(stream), elements, unit, scenario.dt, gate=scenario.gate)


def _with_ngs(source: LiveSource, scenario: Scenario, ngs: str, modes: str | None, unit: str, lag: int) -> StreamSource:
    """Return a stream with that of an NGS. Raises SettingError where the source is none."""
    if not isinstance(source, StreamSource):
        raise SettingError("live: --ngs is a stream beside that of --in")
    wiring = ngs_wiring(scenario, len(source.elements), modes, unit, lag)
    return replace(source, ngs_path=_place(ngs), ngs=wiring)


def _place(stream: str) -> str:
    """Return the address of a stream, or its file."""
    return stream if is_address(stream) else str(stream_path(stream))


def _say(line: str) -> None:
    print_note(f"live: {line}")


def _end(number: int, _frame: FrameType | None) -> None:
    sys.exit(128 + number)


def _run_headless(order: LiveOrder, seconds: float, as_json: bool) -> None:
    kept: list[LiveFrame] = []
    source, scenario = order.source, order.scenario
    n_frames = max(1, round(seconds / source.sampling.dt * order.speed))
    if isinstance(source, Replay):
        n_frames = min(n_frames, source.record.n_steps)
    complaints: list[str] = []

    def complain(line: str) -> None:
        complaints.append(line)
        _say(line)

    before = signal.signal(signal.SIGTERM, _end)
    try:
        with progress_bar("frames") as watch:
            result = follow(
                scenario,
                n_frames,
                order.observers,
                source=source,
                speed=order.speed,
                keep=kept.append if order.record_file else None,
                report=watch.progress,
                say=_say if isinstance(source, StreamSource) else lambda _: None,
                log_file=order.log_file,
                complain=complain,
            )
    finally:  # what has been sent is there, whatever has ended it
        signal.signal(signal.SIGTERM, before)
        if kept:
            frames = LiveFrame(*(np.array(part) for part in zip(*kept, strict=True)))
            is_simulated = isinstance(source, SimulatedLoop)
            record = record_of(frames, scenario) if is_simulated else open_loop_record(frames, source.sampling)
            if lost := save_record(order.record_file, record, configfile.to_toml(scenario.before_events)):
                print_note(lost)
    if as_json:
        print_json(result)
    else:
        show_table(_table(result, source))
    if complaints:
        sys.exit(2)


def _table(result: dict[str, Any], source: LiveSource) -> Table:
    """Return what `follow` tells of every observer."""
    error = ("rms" if source.has_truth else "next") + ", nm"
    title = f"{result['frames']} frames, {result['lost']} lost, {100.0 * result['late_share']:.2f} % more than 1 ms late"
    table = new_table(("Observer",), (error, "step p50, us", "p99.9, us", "longer than a frame"), no_wrap=False, title=title)
    for name, row in result["observers"].items():
        rms = row["rms_nm"] if source.has_truth else _rms(row["next_nm"].values())
        cells = ("-" if x is None else f"{x:.{digits}f}" for x, digits in ((rms, 2), (row["p50_us"], 0), (row["p99_9_us"], 0)))
        table.add_row(name, *cells, str(row["late"]))
    return table


def _rms(values: Iterable[float | None]) -> float | None:
    """Return the rms over the values that are known; None without one."""
    known = [x for x in values if x is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None
