"""What a page shows as a command line and as Python: the same record, the same settings, the same numbers."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from wfsobs.app.render import render
from wfsobs.app.share import FILE, LONGEST, changes
from wfsobs.app.sources import LoadedRecord, SimulatedRecord, Source
from wfsobs.live.loop import LiveOrder
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
    return source.declaration.options({"sha256": source.sha256} if source.sha256 else {})


def record_code(source: LoadedRecord) -> str:
    """Write the line of Python that loads a record."""
    stated = "".join(f"{name}={value!r}, " for name, value in vars(source.declaration).items() if value not in (None, {}, False))
    check = f", sha256={source.sha256!r}" if source.sha256 else ""
    return f"record = load_record({source.name!r}, scenario, DeclaredFormat({stated.removesuffix(', ')}){check})"


def scenario_code(scenario: Scenario, preset: str, file: str) -> str:
    """Write the settings as an expression of Python, or the loading of a file of them where they are long."""
    lines = [f"    {json.dumps(path)}: {value!r},\n" for path, value in changes(scenario, preset).items()]
    made = f'wfsobs.PRESETS["{preset}"]()' + (f".replace({{\n{''.join(lines)}}})" if lines else "")
    return made if len(made) <= LONGEST else f'configfile.load_scenario("{file}")'


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
        return _live_command(scenario, preset, source, task.arguments["order"])
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


def _live_command(scenario: Scenario, preset: str, source: Source | None, order: LiveOrder) -> str:
    """Write the command that runs the loop and shows it on its page."""
    record = isinstance(source, LoadedRecord)
    words = ["--replay", as_path(source.name), *stated_options(source)] if record else [*order.options]
    words += [word for name in order.observers for word in ("--observer", name)]
    words += [word for name in order.controllers for word in ("--controller", name)] or ["--no-controllers"]
    words += [] if order.speed == 1.0 else ["--speed", f"{order.speed:g}"]
    return shlex.join(["wfsobs", "live", *words, *given_options(scenario, preset, FILE)])


def to_python(scenario: Scenario, preset: str, source: Source | None = None, task: CopiedTask = EXPLORED) -> str:
    """Write a script that computes and prints what a page shows."""
    if task.what == SWEEP or (task.what == LIVE and not isinstance(source, LoadedRecord)):  # they simulate the settings
        source = None
    return render(
        "script.txt",
        what=task.what,
        scenario=scenario_code(scenario, preset, FILE),
        record=record_code(source) if isinstance(source, LoadedRecord) else "",
        simulation=scenario_code(source.simulation, preset, SIMULATION) if isinstance(source, SimulatedRecord) else "",
        **task.arguments,
    )
