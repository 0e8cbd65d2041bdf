"""Settings varied over lists of values, and the scenarios of every combination: `wfsobs export --vary`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from math import prod
from typing import Any

from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import format_value, parse_value
from wfsobs.settings.errors import SettingError
from wfsobs.settings.tree import Plain

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
    _check_number(variations)
    out: list[Scenario] = []
    seen: list[Plain] = []
    for values in product(*(v.values for v in variations)):
        changes = {v.path: value for v, value in zip(variations, values, strict=True)}
        one = base.replace(changes)
        one.validate()
        plain = one.to_dict()
        if plain in seen:
            raise SettingError(f"--vary: {_join_changes(changes.items())} gives the same settings as another combination")
        seen.append(plain)
        out.append(one)
    return out


def _check_number(variations: Sequence[Variation]) -> None:
    paths = [v.path for v in variations]
    for i, path in enumerate(paths):
        if path in paths[:i]:
            raise SettingError(f"--vary {path}: is given twice; put all its values into one list")
    counts = [len(v.values) for v in variations]
    if prod(counts) > MOST:
        raise SettingError(f"--vary: {' x '.join(map(str, counts))} = {prod(counts)} combinations, at most {MOST} can be run")


def _join_changes(changes: Iterable[tuple[str, Any]]) -> str:
    return ", ".join(f"{path} = {value}" for path, value in changes)
