"""Settings as links, files, command lines and Python.

A link holds only what differs from the preset, each field in its own words.

A link's query is `preset=ut4&turbulence.wind_speed=20&vibration.peaks=45,0.03,0.01,0.01;...`: lists with commas, a
peak as frequency, damping and its rms per mode, a layer likewise, peaks and layers with semicolons. A simulation
that is kept has its settings after `simulation.`, on top of the same preset, a record that was loaded its name after `record.`.
Whatever of a query cannot be used is named, and the rest is used. Nothing of it is ever opened or evaluated.
"""

from __future__ import annotations

import json
import shlex
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qsl, quote

import param

from wfsobs.app.controls.fields import parse_number
from wfsobs.app.render import render
from wfsobs.app.session_file import SHA256, SessionError, read_declaration
from wfsobs.app.sources import LoadedRecord, NamedRecord, Source
from wfsobs.app.store import FIRST_PRESET
from wfsobs.live.loop import LiveOrder
from wfsobs.live.source import STREAM
from wfsobs.scenario import Scenario, configfile
from wfsobs.scenario.configfile import from_toml, parse_toml, reference_preset, to_toml
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.group import holds_groups, settings_of
from wfsobs.settings.values import SettingError
from wfsobs.telemetry.columns import ROLES, SIGNALS
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.preview import safe_name
from wfsobs.units import UNITS

PREFIX, COLUMN = "record.", "column."

STATEMENTS: Mapping[str, tuple[str, str]] = {
    "unit": ("unit", f"takes one of {', '.join(UNITS)}"),
    "sign": ("command_sign", "takes 1 or -1"),
    "delay": ("command_delay", "takes a number of steps from 1"),
    "gain": ("command_gain", "takes a number above 0, or one per mode"),
    "rail": ("rail", "takes a number above 0"),
    "open_loop": ("open_loop", "takes True"),
    "rate": ("rate", "takes a rate above 0 Hz"),
    "trust": ("trust", "takes True"),
}
"""Field -> part of the declaration, what it takes."""

FLAGS = {"True": True, "False": False}


def name_record(source: Source | None) -> NamedRecord | None:
    """Name a record that was loaded; None for a simulation, and for a record whose file is not known."""
    if not isinstance(source, LoadedRecord) or not source.sha256:
        return None
    return NamedRecord(source.name, source.sha256, source.declaration)


def record_fields(record: NamedRecord) -> dict[str, str]:
    """Write a record as fields of a link."""
    said = {key: getattr(record.declaration, part) for key, (part, _) in STATEMENTS.items()}
    fields = {"name": record.name, "sha256": record.sha256}
    fields |= {
        key: str(value) if value is True else value_text(value) for key, value in said.items() if value not in (None, False)
    }
    fields |= {COLUMN + role: name for role, name in record.declaration.columns.items()}
    return {PREFIX + key: text for key, text in fields.items()}


def read_record_fields(fields: Mapping[str, str]) -> tuple[NamedRecord | None, dict[str, str]]:
    """Read the record of a link; field -> why it cannot be used. Without a SHA-256 there is no record."""
    refused: dict[str, str] = {}
    given = {key.removeprefix(PREFIX): text for key, text in fields.items()}
    name, digits, declaration = given.pop("name", ""), given.pop("sha256", ""), DeclaredFormat()
    if not SHA256.fullmatch(digits):
        return None, {f"{PREFIX}sha256": "takes 64 hexadecimal digits"}
    if name != safe_name(name):
        refused[f"{PREFIX}name"] = "takes the name of a file"
    for key, text in given.items():
        try:
            declaration = _with(declaration, key, text)
        except SessionError as error:
            refused[PREFIX + key] = str(error)
    return NamedRecord(safe_name(name), digits, declaration), refused


def _with(declaration: DeclaredFormat, key: str, text: str) -> DeclaredFormat:
    """Add what one field says. Raises SessionError."""
    role, takes = key.removeprefix(COLUMN), "takes the name of a column"
    if key.startswith(COLUMN) and role in ROLES | SIGNALS:
        part, value = "columns", {**declaration.columns, role: text}
    elif key in STATEMENTS:
        part, takes = STATEMENTS[key]
        value = [parse_number(one) for one in text.split(",")] if key == "gain" else FLAGS.get(text, parse_number(text))
    else:
        raise SessionError("there is no such part of a record")
    try:
        return read_declaration(vars(declaration) | {part: value})
    except SessionError:
        raise SessionError(takes) from None


Check = Callable[[Scenario], None]

LONGEST = 8000
"""Characters of a query, or of a command line; what is longer travels as a file."""

ROUNDS = 3
MOST = 200
"""Fields of a query that are read."""

PASSED_OVER = ("theme", "view.")
"""Starts of the keys of a query that are not settings."""

KEPT = "simulation"
"""The field, and before a dot the prefix, of a simulation that is kept."""

FILE = "wfsobs.toml"


@dataclass(frozen=True)
class Link:
    """What a query asks for.

    errors : a line for every field that could not be used;  simulation : of other settings, which is kept
    record : the one that the results are of, whose file is asked for
    """

    scenario: Scenario
    preset: str
    errors: tuple[str, ...] = ()
    simulation: Scenario | None = None
    record: NamedRecord | None = None


def changes(scenario: Scenario, preset: str) -> dict[str, Any]:
    """Dotted path -> plain value of the settings that differ from the preset's."""
    return configfile.changed_settings(scenario, reference_preset(preset))


# ---------------------------------------------------------------------- links


def to_query(
    scenario: Scenario, preset: str, simulation: Scenario | None = None, record: NamedRecord | None = None
) -> str | None:
    """Write the query of a link to these settings, without "?"; None where it would be too long.

    simulation : of other settings, which is kept;  record : one that was loaded
    """
    changed = changes(scenario, preset)
    parts = [f"preset={preset}"] if preset != FIRST_PRESET or changed or simulation or record else []
    parts += _fields(changed)
    if simulation is not None:
        parts += [KEPT, *_fields(changes(simulation, preset), f"{KEPT}.")]
    if record is not None:
        parts += [f"{key}={quote(text, safe=',:-./')}" for key, text in record_fields(record).items()]
    query = "&".join(parts)
    return query if len(query) <= LONGEST else None


def _fields(values: Mapping[str, Any], prefix: str = "") -> list[str]:
    return [f"{prefix}{path}={quote(value_text(value), safe=',;:+-.')}" for path, value in values.items()]


def from_query(query: str, check: Check = Scenario.validate) -> Link:
    """Read the settings of a query, and a line for every field of it that was refused.

    check : raises SettingError where settings do not go together
    """
    if len(query) > LONGEST:
        return Link(
            PRESETS[FIRST_PRESET](),
            FIRST_PRESET,
            (f"The link has {len(query)} characters, at most {LONGEST} are allowed: the link is ignored.",),
        )
    pairs = parse_qsl(query.removeprefix("?").replace("+", "%2B"), keep_blank_values=True)
    own = [pair for pair in pairs if not pair[0].startswith(PASSED_OVER)]
    rejected = [f"The link has {len(own)} fields: the first {MOST} are read."] if len(own) > MOST else []
    fields = dict(own[:MOST])
    times = Counter(key for key, _ in own[:MOST])
    rejected += [_line(key, text, "given more than once, the last counts") for key, text in fields.items() if times[key] > 1]
    name = fields.pop("preset", FIRST_PRESET)
    if name not in PRESETS:
        rejected.append(_line("preset", name, f"takes one of {', '.join(PRESETS)}"))
        name = FIRST_PRESET
    kept, named = ({key: fields.pop(key) for key in [*fields] if key.startswith(start)} for start in (KEPT, PREFIX))
    of_simulation = {key.removeprefix(f"{KEPT}."): text for key, text in kept.items() if key != KEPT}
    scenario, refused = _apply(PRESETS[name](), fields, check)
    simulation, more = _apply(PRESETS[name](), of_simulation, check) if kept else (None, [])
    record, why = read_record_fields(named) if named else (None, {})
    unread = [_line(key, named.get(key, ""), reason) for key, reason in why.items()]
    more = [f"{KEPT}.{line}" for line in more]
    return Link(scenario, name, (*rejected, *refused, *more, *unread), simulation, record)


def has_settings(query: str) -> bool:
    """Return whether a query has settings, and not the view alone.

    >>> has_settings("?view.page=live&theme=dark"), has_settings("?preset=ut4&view.page=live")
    (False, True)
    """
    return any(not key.startswith(PASSED_OVER) for key, _ in parse_qsl(query.removeprefix("?"), keep_blank_values=True))


def value_text(value: Any) -> str:
    """Write a setting's plain value as a link has it."""
    if isinstance(value, (list, tuple)):
        return (";" if value and isinstance(value[0], dict) else ",").join(map(value_text, value))
    if isinstance(value, dict):
        return ",".join(map(value_text, value.values()))
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value).removesuffix(".0") if isinstance(value, float) else str(value)


def read_value(path: str, text: str, settings: Mapping[str, param.Parameter[Any]]) -> Any:
    """Read a value of a link; what makes no sense stays text, for the setting itself to refuse."""
    p = settings.get(path)
    if isinstance(p, param.List) and holds_groups(p):
        return [_item(part, settings_of(p)) for part in text.split(";")] if text else []
    if isinstance(p, param.List):
        return [parse_number(part) for part in text.split(",")] if text else []
    if isinstance(p, param.Boolean):
        return {"true": True, "false": False}.get(text, text)
    return parse_number(text) if isinstance(p, param.Number) else text


def _item(text: str, settings: Mapping[str, param.Parameter[Any]]) -> Any:
    """One group of a list: its numbers in the order of its settings, a list of numbers at the end."""
    numbers = [parse_number(part) for part in text.split(",")]
    *names, last = settings
    rest = numbers[len(names) :]
    if not rest or (len(rest) > 1 and not isinstance(settings[last], param.List)):
        return text
    return {**dict(zip(names, numbers, strict=False)), last: rest if isinstance(settings[last], param.List) else rest[0]}


def _apply(base: Scenario, fields: Mapping[str, str], check: Check) -> tuple[Scenario, list[str]]:
    """Every field that can be applied, whatever their order, and a line for every other."""
    known = {path: p for path, _, p in base.walk()} | dict(base.lists())
    values, refused = {path: read_value(path, text, known) for path, text in fields.items()}, {}
    scenario = base.copy()
    for path, value in values.items():
        try:
            _set(scenario, path, value)
        except SettingError as error:
            refused[path] = str(error)
    if _clash(scenario, check):
        scenario = base.copy()
        waiting = {path: value for path, value in values.items() if path not in refused}
        for _ in range(ROUNDS):  # what one field needs, a later one may bring
            for path, value in list(waiting.items()):
                before = scenario.lookup(path)
                _set(scenario, path, value)
                refused[path] = _clash(scenario, check)
                if refused[path]:
                    _set(scenario, path, before)
                else:
                    del waiting[path], refused[path]
    return scenario, [_line(path, fields[path], refused[path]) for path in fields if path in refused]


def _set(scenario: Scenario, path: str, value: Any) -> None:
    """Set one setting in place; items of lists have no path here. Raises SettingError."""
    for key in reversed(path.split(".")):
        value = {key: value}
    scenario.update(value)


def _clash(scenario: Scenario, check: Check) -> str:
    """Why settings do not go together, or nothing."""
    try:
        check(scenario)
    except SettingError as error:
        return str(error)
    return ""


def _line(path: str, text: str, reason: str) -> str:
    """Write the line of a field that was refused, with its name in front if the reason lacks it."""
    line = reason if reason.startswith(path) else f"{path} = {text}: {reason}"
    return line if len(line) <= 200 else f"{line[:197]}..."


# ---------------------------------------------------------------------- files


def to_file(scenario: Scenario, preset: str) -> str:
    """Every setting as TOML, with the preset that they are compared with."""
    return f'preset = "{preset}"\n{to_toml(scenario)}'


def from_file(text: str) -> Link:
    """Read the settings of a TOML file; preset "" where it names none. Raises SettingError with one line."""
    try:
        scenario = from_toml(text, where="file")
        preset = parse_toml(text).get("preset", "")
        scenario.validate()
    except SettingError as error:
        raise SettingError(str(error).partition("\n")[0]) from None
    return Link(scenario, preset)


# ---------------------------------------------------------------------- copies


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
    given_lists = {name: value if isinstance(value, list) else [value] for name, value in task.arguments.items()}
    more = [word for name, values in given_lists.items() for one in values for word in (f"--{name}", str(one))]
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


def _live_command(scenario: Scenario, preset: str, source: Source | None, order: LiveOrder) -> str:
    """Write the command that runs the loop and shows it on its page."""
    record = isinstance(source, LoadedRecord)
    words = ["--replay", as_path(source.name), *stated_options(source)] if record else [*order.options]
    words += [word for name in order.observers for word in ("--observer", name)]
    words += [word for name in order.controllers for word in ("--controller", name)] or ["--no-controllers"]
    words += [] if order.speed == 1.0 or order.source.name == STREAM else ["--speed", f"{order.speed:g}"]
    return shlex.join(["wfsobs", "live", *words, *given_options(scenario, preset, FILE)])


def to_python(scenario: Scenario, preset: str, source: Source | None = None, task: CopiedTask = EXPLORED) -> str:
    """Write a script that computes and prints what a page shows."""
    simulation = source.simulation if source and task.what not in (SWEEP, LIVE) else None  # these simulate the settings
    return render(
        "script.txt",
        what=task.what,
        scenario=scenario_code(scenario, preset, FILE),
        record=source if isinstance(source, LoadedRecord) and task.what != SWEEP else None,
        simulation=scenario_code(simulation, preset, SIMULATION) if simulation else "",
        **task.arguments,
    )
