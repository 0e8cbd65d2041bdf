"""The live loop of a page as a command line and as Python: the same source, observers, controllers, speed and settings."""

from __future__ import annotations

import shlex
from textwrap import indent

from wfsobs.app.copied_parts import (
    RECORD_IMPORTS,
    as_path,
    given_options,
    import_order,
    record_code,
    scenario_code,
    stated_options,
)
from wfsobs.app.live_order import LiveOrder
from wfsobs.app.share import FILE
from wfsobs.app.sources import LoadedRecord, Source
from wfsobs.scenario import Scenario

LOOP = """loop = LiveLoop(source, scenario, {observers!r}, speed={speed!r})
for controller in {controllers!r}:
    loop.control(controller, True)
loop.play()
while not loop.failure() and loop.count < n:
    time.sleep(0.1)
for observer in loop.board.active():
    for target in OBSERVERS[observer].targets:
        print(observer, target, *(1e3 * loop.board[observer].rms(target)), "nm")
loop.stop()
"""
"""Lines of a script."""


def live_command(scenario: Scenario, preset: str, source: Source | None, order: LiveOrder) -> str:
    """Write the command that runs the loop and shows it on its page."""
    words = [*_source_options(source, order), *_loop_options(order), *given_options(scenario, preset, FILE)]
    return shlex.join(["wfsobs", "live", *words])


def _source_options(source: Source | None, order: LiveOrder) -> list[str]:
    """Name what a live loop runs on, where it is not the simulation of the settings."""
    if isinstance(source, LoadedRecord):
        return ["--replay", as_path(source.name), *stated_options(source)]
    return list(order.options)


def _loop_options(order: LiveOrder) -> list[str]:
    words = [word for name in order.observers for word in ("--observer", name)]
    words += [word for name in order.controllers for word in ("--controller", name)] or ["--no-controllers"]
    return words if order.speed == 1.0 else [*words, "--speed", f"{order.speed:g}"]


def live_script(scenario: Scenario, preset: str, source: Source | None, order: LiveOrder) -> str:
    """Write a script that runs the loop for 10,000 frames, or a record to its end, and prints the errors."""
    imports = {"import time", "import wfsobs", "from wfsobs.live.loop import LiveLoop", "from wfsobs.observers import OBSERVERS"}
    lines = [f"scenario = {scenario_code(scenario, preset, FILE)}"]
    if "configfile." in lines[0]:
        imports.add("from wfsobs.scenario import configfile")
    if isinstance(source, LoadedRecord):
        imports |= {*RECORD_IMPORTS, "from wfsobs.live.replay import Replay"}
        lines += [record_code(source), "source, n = Replay(record), record.n_steps"]
    elif order.options:
        imports |= {"from wfsobs.live.attached import StreamSource", "from wfsobs.streams.wiring import NgsWiring"}
        lines.append(f"source, n = {order.source!r}, 10_000")
    else:
        imports.add("from wfsobs.live.simulated import SimulatedLoop")
        lines.append("source, n = SimulatedLoop(scenario), 10_000")
    lines.append(LOOP.format(observers=list(order.observers), speed=order.speed, controllers=list(order.controllers)))
    main = 'if __name__ == "__main__":  # its processes import this file'
    return "\n".join([*sorted(imports, key=import_order), "", main, indent("\n".join(lines), "    ")])
