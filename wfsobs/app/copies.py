"""What a page shows as a command line and as Python: the same record, the same settings, the same numbers."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from textwrap import indent
from typing import Any

from wfsobs.app.live_work import LiveOrder
from wfsobs.app.share import FILE, LONGEST, changes
from wfsobs.app.sources import LoadedRecord, SimulatedRecord, Source
from wfsobs.scenario import Scenario, configfile


def as_path(name: str) -> str:
    """Return the name of a file; one that starts with a dash would be read as an option."""
    return f"./{name}" if name.startswith("-") else name


def given_options(scenario: Scenario, preset: str, file: str) -> list[str]:
    """List the options that give the settings, or a file of them where they are long."""
    words = ["--preset", preset]
    for path, value in changes(scenario, preset).items():
        words += ["--set", f"{path}={configfile.format_value(value)}"]
    return words if len(shlex.join(words)) <= LONGEST else ["--config", file]


def stated_options(source: LoadedRecord) -> list[str]:
    """List what the user stated about a file, and what tells the file from others."""
    stated = source.declaration
    sign = None if stated.command_sign is None else f"{stated.command_sign:+d}"
    named = {
        "unit": stated.unit,
        "command-sign": sign,
        "command-delay": stated.command_delay,
        "rate": stated.rate,
        "sha256": source.sha256 or None,
    }
    words = [word for name, value in named.items() if value is not None for word in (f"--{name}", str(value))]
    words += ["--trust"] * stated.trust
    return words + [word for role, name in stated.columns.items() for word in ("--column", f"{role}={name}")]


RECORD_IMPORTS = {"from wfsobs.telemetry.intake import DeclaredFormat", "from wfsobs.telemetry.records import load_record"}
"""Of `record_code`."""


def record_code(source: LoadedRecord) -> str:
    """Write the line of Python that loads a record."""
    stated = "".join(f"{name}={value!r}, " for name, value in vars(source.declaration).items() if value not in (None, {}, False))
    check = f", sha256={source.sha256!r}" if source.sha256 else ""
    return f"record = load_record({source.name!r}, scenario, DeclaredFormat({stated.removesuffix(', ')}){check})"


def import_order(line: str) -> tuple[bool, str]:
    """Return the place of a line among the imports."""
    return line.startswith("from"), line


def scenario_code(scenario: Scenario, preset: str, file: str) -> str:
    """Write the settings as an expression of Python, or the loading of a file of them where they are long."""
    lines = [f"    {json.dumps(path)}: {value!r},\n" for path, value in changes(scenario, preset).items()]
    made = f'wfsobs.PRESETS["{preset}"]()' + (f".replace({{\n{''.join(lines)}}})" if lines else "")
    return made if len(made) <= LONGEST else f'configfile.load_scenario("{file}")'


LIVE_LOOP = """loop = LiveLoop(source, scenario, {observers!r}, speed={speed!r})
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
    lines.append(LIVE_LOOP.format(observers=list(order.observers), speed=order.speed, controllers=list(order.controllers)))
    main = 'if __name__ == "__main__":  # its processes import this file'
    return "\n".join([*sorted(imports, key=import_order), "", main, indent("\n".join(lines), "    ")])


RECORD, SIMULATION = "wfsobs-record.npz", "wfsobs-simulation.toml"
"""Files of a command: a simulation that is saved, and its settings where they are too long to be written out."""

OBSERVE, LOOP, IDENTIFY, TUNE, SWEEP, CAMPAIGN, LIVE = "observe", "loop", "identify", "tune", "sweep", "campaign", "live"


@dataclass(frozen=True)
class CopiedTask:
    """What a page does with the record: one of the above, and its arguments by name."""

    what: str = OBSERVE
    arguments: Mapping[str, Any] = field(default_factory=dict)


EXPLORED = CopiedTask()


# ---------------------------------------------------------------------- command lines


def to_command(scenario: Scenario, preset: str, source: Source | None = None, task: CopiedTask = EXPLORED) -> str:
    """Write the command that prints what a page shows; two where the record has to be simulated first."""
    if task.what == CAMPAIGN:  # its settings are in its folder
        words = [word for name in ("target", "mode", "only") for one in task.arguments[name] for word in (f"--{name}", one)]
        return shlex.join(["wfsobs", "campaign", "table", as_path(task.arguments["folder"]), "--together", *words])
    if task.what == LIVE:
        return live_command(scenario, preset, source, task.arguments["order"])
    given = given_options(scenario, preset, FILE)
    more = [word for name, value in task.arguments.items() for one in _as_list(value) for word in (f"--{name}", str(one))]
    if task.what == SWEEP:  # it simulates the settings, whatever is shown
        source = None
    if source is None and task.what != IDENTIFY:
        return shlex.join(["wfsobs", "run" if task.what == OBSERVE else task.what, *more, *given])
    file, said = (source.name, stated_options(source)) if isinstance(source, LoadedRecord) else (RECORD, [])
    file = as_path(file)
    positional = [file] if task.what in (OBSERVE, IDENTIFY) else ["--record", file]
    command = shlex.join(["wfsobs", task.what, *positional, *more, *given, *said])
    if isinstance(source, LoadedRecord):
        return command
    simulation = given_options(source.simulation, preset, SIMULATION) if source else given
    return f"{shlex.join(['wfsobs', 'run', *simulation, '--save', RECORD])} &&\n{command}"


def _as_list(value: Any) -> Sequence[Any]:
    return value if isinstance(value, (list, tuple)) else [value]


# ---------------------------------------------------------------------- Python


def to_python(scenario: Scenario, preset: str, source: Source | None = None, task: CopiedTask = EXPLORED) -> str:
    """Write a script that computes and prints what a page shows."""
    if task.what == CAMPAIGN:
        return _campaign_script(**task.arguments)
    if task.what == LIVE:
        return live_script(scenario, preset, source, task.arguments["order"])
    source = None if task.what == SWEEP else source
    imports, lines = {"import wfsobs"}, [f"scenario = {scenario_code(scenario, preset, FILE)}"]
    if isinstance(source, LoadedRecord):
        imports |= RECORD_IMPORTS
        lines.append(record_code(source))
    elif isinstance(source, SimulatedRecord):
        lines += [f"simulation = {scenario_code(source.simulation, preset, SIMULATION)}", "record = wfsobs.simulate(simulation)"]
    elif task.what in (LOOP, IDENTIFY):
        lines.append("record = wfsobs.simulate(scenario)")
    more_imports, more_lines = _DOES[task.what](source is not None, task.arguments)
    if any("configfile." in line for line in lines):
        imports.add("from wfsobs.scenario import configfile")
    return "\n".join([*sorted(imports | more_imports, key=import_order), "", *lines, *more_lines, ""])


def _campaign_script(folder: str, target: Sequence[str], mode: Sequence[str], only: Sequence[str]) -> str:
    """Write the script; target, mode : one each, or none where there are no results yet."""
    keys = f"[({target[0]!r}, {mode[0]!r})]" if target else "state.errors"
    return f"""from pathlib import Path

from wfsobs.campaign.follow import CampaignFolder
from wfsobs.campaign.selection import cells_where
from wfsobs.campaign.standings import standings

state = CampaignFolder(Path({folder!r})).read()
cells = cells_where(state.plan, {[*only]!r})
for target, mode in {keys}:
    for row in standings(state, target, mode, cells):
        print(row.name, row.rms_nm, "nm", row.over_bound, row.above, row.rank, row.wins, row.records, row.failures)
"""


Lines = tuple[set[str], list[str]]
"""Imports, and lines of a script."""


def _observe(has_record: bool, _arguments: Mapping[str, Any]) -> Lines:
    return set(), [
        f"result = {'wfsobs.observe(record, scenario)' if has_record else 'wfsobs.run(scenario)'}",
        "for s in result.scores:",
        '    print(f"{s.target:10} {s.mode:4} {s.observer:17} {1e3 * s.rms:8.2f} nm")',
    ]


def _loop(_has_record: bool, _arguments: Mapping[str, Any]) -> Lines:
    modules = {"design": "design", "run": "closed_loop", "rows": "rows"}
    return {f"from wfsobs.closed_loop.{module} import {name}" for module, name in modules.items()}, [
        "result = closed_loop(record, design(scenario))",
        "for row in rows(result, None):",
        '    print(row["controller"], row["mode"], row["residual_rms_nm"], "nm")',
    ]


def _identify(_has_record: bool, arguments: Mapping[str, Any]) -> Lines:
    return {"from wfsobs.identification import identify, report"}, [
        f"found = identify(record, {_arguments(arguments)})",
        "for mode in found.modes:",
        "    for what, frequency, damping, rms in report.mode_rows(mode):",
        "        print(mode.name, what, *(n.value for n in (frequency, damping, rms) if n is not None))",
        'print("\\n".join(report.whiteness_lines(found)))',
    ]


def _tune(has_record: bool, arguments: Mapping[str, Any]) -> Lines:
    named = {k: v for k, v in arguments.items() if k != "observer"}
    record = ", record=record" if has_record else ""
    return {"from wfsobs.tuning import report, tune"}, [
        f"tuned = tune(scenario, {arguments['observer']!r}, {_arguments(named)}{record})",
        "for path, before, after in report.settings(tuned):",
        "    print(path, before, after)",
        'print("validation rms [um]", *(s.validation.rms if s.validation else None for s in (tuned.before, tuned.after)))',
    ]


def _arguments(arguments: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value!r}" for name, value in arguments.items())


def _sweep(_has_record: bool, arguments: Mapping[str, Any]) -> Lines:
    axes = ", ".join(f"parse_axis({text!r})" for text in arguments["over"])
    observers = f", {arguments['observer']!r}" if arguments["observer"] else ""
    modules = {"sweep": "parse_axis, plan_sweep", "sweep_results": "run_sweep"}
    return {f"from wfsobs.campaign.{module} import {names}" for module, names in modules.items()}, [
        f"results = run_sweep(plan_sweep(scenario, [{axes}], {arguments['seeds']}{observers}))",
        "for row in results.rows():",
        "    print(*row.values())",
    ]


_DOES = {OBSERVE: _observe, LOOP: _loop, IDENTIFY: _identify, TUNE: _tune, SWEEP: _sweep}
