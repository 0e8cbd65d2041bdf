"""Scenarios as TOML files, settings in the syntax of the command line, and scenarios of every combination of values."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

from wfsobs.files import write_text
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.values import Plain, SettingError, errors_of, leaves

DEEPEST = 8
"""Maximum depth of nested tables and lists; settings have four levels."""

LONG_NAME = re.compile(rf"(?<![\w\"'-])(?:[\w\"'-]++[ \t]*+\.[ \t]*+){{{DEEPEST + 1}}}")
"""Refused before it is parsed, which takes the cube of its length."""


class NotToml(SettingError):
    """Error: a text that is not TOML."""


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text, from a file, a command line or a link.

    A quoted name with dots, "run.duration", is taken as the unquoted one.

    Raises NotToml, and SettingError where values are nested more than DEEPEST deep, or one is set twice.
    """
    too_deep = SettingError(f"tables or lists nested more than {DEEPEST} deep")
    if LONG_NAME.search(text):
        raise too_deep
    try:
        values = tomllib.loads(text)
    except RecursionError:
        raise too_deep from None
    except ValueError as error:  # TOMLDecodeError, and whole numbers of thousands of digits
        raise NotToml(f"not TOML: {error}") from None
    level: list[Any] = [values]
    for _ in range(DEEPEST + 1):  # level by level: a recursion would end where the parser's did
        level = [
            child
            for node in level
            if isinstance(node, (dict, list))
            for child in (node.values() if isinstance(node, dict) else node)
        ]
    if level:
        raise too_deep
    return _without_quotes(values)


def _without_quotes(node: Any) -> Any:
    """Return tables and lists in which a quoted name with dots, "run.duration", is what it is without the quotes."""
    if isinstance(node, list):
        return [_without_quotes(one) for one in node]
    if not isinstance(node, dict):
        return node
    out: dict[str, Any] = {}
    for name, value in node.items():
        inner = _without_quotes(value)
        for part in reversed(name.split(".")):
            inner = {part: inner}
        _merge(out, inner)
    return out


def _merge(into: dict[str, Any], table: dict[str, Any], where: str = "") -> None:
    for name, value in table.items():
        if isinstance(value, dict) and isinstance(into.get(name), dict):
            _merge(into[name], value, f"{where}{name}.")
        elif name in into:
            raise SettingError(f"{where}{name}: is set twice")
        else:
            into[name] = value


def to_toml(scenario: Scenario) -> str:
    """Return every setting as TOML, peaks as [[vibration.peaks]] tables; `from_toml` returns an equal scenario."""
    import tomli_w  # here: identification and tuning work without it

    return tomli_w.dumps(scenario.to_dict())


def add_comments(text: str, notes: Mapping[str, str]) -> str:
    """Return TOML with a comment after some settings, by dotted path."""
    out, where, counts = [], "", dict[str, int]()
    for line in text.splitlines():
        if head := re.fullmatch(r"\[\[([\w.]+)\]\]", line):
            name = head.group(1)
            counts[name] = counts.get(name, -1) + 1
            where = f"{name}.{counts[name]}."
        elif head := re.fullmatch(r"\[([\w.]+)\]", line):
            where = head.group(1) + "."
        note = notes.get(where + line.split(" = ")[0]) if " = " in line else None
        out.append(f"{line}  # {note}" if note else line)
    return "\n".join(out) + "\n"


def from_toml(text: str, base: Scenario | None = None, where: str = "TOML") -> Scenario:
    """Return a scenario with the settings of a (partial) TOML text on top of `base`.

    A table [columns], which is of a record's file, is left alone. Without `base`, a top-level `preset = "name"` gives the base,
    else the defaults. Lists are replaced as a whole. Raises SettingError, its line starting with `where`.
    """
    with errors_of(where):
        values = parse_toml(text)
        name, _ = values.pop("preset", None), values.pop("columns", None)
        scenario = base.copy() if base is not None else preset(name) if name is not None else Scenario()
        scenario.update(values)
    return scenario


def load_scenario(path: str | Path, base: Scenario | None = None) -> Scenario:
    """Return the scenario of a TOML file (see `from_toml`). Raises SettingError, also where it cannot be read."""
    return from_toml(read_text(path), base, str(path))


def load_columns(path: str | Path) -> dict[str, str]:
    """Return the table [columns] of a TOML file, {role: name in a record's file}. Raises SettingError."""
    try:
        columns = parse_toml(read_text(path)).get("columns", {})
        if not isinstance(columns, dict) or not all(isinstance(name, str) for name in columns.values()):
            raise SettingError(f'{path}: columns: takes a table such as "y_lgs/tip" = "slope_x"')
    except NotToml as error:
        raise SettingError(f"{path}: {error}") from None
    return columns


def read_text(path: str | Path) -> str:
    """Return the text of a file, also of one that begins with a mark of UTF-8. Raises SettingError."""
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SettingError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or 'not UTF-8 text'}") from None


def save_scenario(scenario: Scenario, path: str | Path) -> None:
    """Write every setting to a TOML file. Raises OSError."""
    write_text(path, to_toml(scenario))


@cache
def reference_preset(name: str) -> Scenario:
    """Return a preset to compare with, from a cache; not to be changed."""
    return PRESETS[name]()


def preset(name: Any) -> Scenario:
    """Return the preset `name`. Raises SettingError for an unknown one."""
    if not isinstance(name, str) or name not in PRESETS:
        raise SettingError(f"preset = {name!r}: takes one of {', '.join(PRESETS)}")
    return PRESETS[name]()


def preset_name(name: str | None, config: str | Path | None) -> str:
    """Return the preset that `scenario_from` starts from. Raises SettingError where the file cannot be read."""
    if name is not None or config is None:
        return name or "paper"
    with errors_of(str(config)):
        return parse_toml(read_text(config)).get("preset", "paper")


def parse_assignment(text: str) -> tuple[str, Any]:
    """Return ("a.b", value) of "a.b=value"; the value in TOML's syntax, or a bare word.

    >>> parse_assignment("turbulence.wind_speed=20")
    ('turbulence.wind_speed', 20)
    >>> parse_assignment("vibration.source=ar2")
    ('vibration.source', 'ar2')
    """
    path, equals, value = text.partition("=")
    if not equals or not path.strip():
        raise SettingError(f"--set {text}: takes name=value, such as turbulence.wind_speed=20")
    return path.strip(), parse_value(value.strip(), f"--set {path.strip()}")


def parse_value(text: str, where: str) -> Any:
    """Return a value in TOML's syntax, or the text itself. Raises SettingError, its line starting with `where`."""
    try:
        parsed = parse_toml(f"value = {text}")
    except NotToml:
        return text
    except SettingError as error:
        raise SettingError(f"{where}: {error}") from None
    return parsed["value"] if set(parsed) == {"value"} else text


def changed_settings(scenario: Scenario, base: Scenario) -> dict[str, Any]:
    """Return dotted path -> plain value of the settings that differ from those of `base`; lists as a whole."""
    return dict(leaves(scenario.difference(base)))


def format_value(value: Any) -> str:
    """Format a plain value for `parse_assignment`: TOML on one line, words bare.

    >>> format_value([{"frequency": 18.1, "rms": [0.02, 0.01]}]), format_value("ar2")
    ('[{frequency = 18.1, rms = [0.02, 0.01]}]', 'ar2')
    """
    return value if isinstance(value, str) else _inline(value)


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_inline(v)}" for key, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_inline, value)) + "]"
    return json.dumps(value)


def scenario_from(preset_name: str | None, config: str | Path | None, assignments: tuple[str, ...]) -> Scenario:
    """Return the scenario of a command line.

    The preset (or the file's own, or paper), then the file, then each assignment. Raises SettingError.
    """
    base = preset(preset_name) if preset_name is not None else None
    scenario = load_scenario(config, base) if config is not None else base or preset("paper")
    for path, value in map(parse_assignment, assignments):
        scenario.set(path, value)
    scenario.validate()
    return scenario


MOST = 60
"""Maximum number of combinations of one run."""


@dataclass(frozen=True)
class Variation:
    """A setting by its dotted path, and its plain values in order."""

    path: str
    values: tuple[Any, ...]

    def __str__(self) -> str:
        """Format the variation for `parse_variation`."""
        return f"{self.path}={','.join(map(format_value, self.values))}"


def parse_variation(text: str, option: str = "--vary") -> Variation:
    """Return the Variation of "a.b=v1,v2,v3"; values in TOML's syntax, or bare words. Raises SettingError.

    >>> parse_variation("turbulence.wind_speed=5,10,15")
    Variation(path='turbulence.wind_speed', values=(5, 10, 15))
    >>> parse_variation("butterworth.frequencies=[18.1],[18.1,48.3]").values
    ([18.1], [18.1, 48.3])
    >>> parse_variation("vibration.source=peaks,ar2").values
    ('peaks', 'ar2')
    """
    path, equals, listed = (part.strip() for part in text.partition("="))
    if not (path and equals and listed):
        raise SettingError(f"{option} {text}: takes name=value,value, such as turbulence.wind_speed=5,10,15")
    where = f"{option} {path}"
    values = parse_value(f"[{listed}]", where)
    if not isinstance(values, list):
        values = [parse_value(part.strip(), where) for part in listed.split(",")]
    for i, value in enumerate(values):
        if value in values[:i]:
            raise SettingError(f"{where}: has {value!r} twice")
    return Variation(path, tuple(values))


def scenarios(base: Scenario, variations: Sequence[Variation]) -> list[Scenario]:
    """Return the scenario of every combination, the last variation running fastest; the base alone without variations.

    Raises SettingError where there are more than MOST, where two are the same, and for a value that a setting refuses.
    """
    paths, counts = [v.path for v in variations], [len(v.values) for v in variations]
    for i, path in enumerate(paths):
        if path in paths[:i]:
            raise SettingError(f"--vary {path}: is given twice; put all its values into one list")
    if prod(counts) > MOST:
        raise SettingError(f"--vary: {' x '.join(map(str, counts))} = {prod(counts)} combinations, at most {MOST} can be run")
    out: list[Scenario] = []
    seen: list[Plain] = []
    for values in product(*(v.values for v in variations)):
        changes = dict(zip(paths, values, strict=True))
        one = base.replace(changes)
        one.validate()
        plain = one.to_dict()
        if plain in seen:
            listed = ", ".join(f"{path} = {value}" for path, value in changes.items())
            raise SettingError(f"--vary: {listed} gives the same settings as another combination")
        seen.append(plain)
        out.append(one)
    return out
