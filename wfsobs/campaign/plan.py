"""What a campaign runs: its scenarios, seeds, observers and controllers, from a TOML file.

Some of its scenarios are chosen by the values of what they differ in: NAME=VALUE, of numbers also NAME=LOW..HIGH.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wfsobs.campaign.compare import LEVEL, Comparison
from wfsobs.campaign.sweep import Changes, check_keys, conditions, grid, product, sample
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.observers import OBSERVERS
from wfsobs.priors_from.scenario import common_observers
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import format_value, load_scenario, parse_toml, preset, read_text
from wfsobs.settings.values import SettingError, errors_of, leaves
from wfsobs.typing import Array


@dataclass(frozen=True)
class Stop:
    """A rule of when to stop.

    Attributes
    ----------
    half_width : float
        Wanted half-width of the intervals of the differences from the best, over the rms of the best.
    looks : tuple of int
        Numbers of seeds at which is decided.
    """

    half_width: float
    looks: tuple[int, ...]

    @property
    def level(self) -> float:
        """Level of the interval at one look: the looks share the error of all (Bonferroni), which no order of them exceeds."""
        return 1.0 - (1.0 - LEVEL) / len(self.looks)

    def is_decided(self, comparisons: Sequence[Comparison]) -> bool:
        """Return whether a scenario needs no further seed.

        Each difference from the best is significant, or known to the wanted half-width.

        Parameters
        ----------
        comparisons : sequence of Comparison
            All rows of one scenario, target and mode, with intervals at `level`.
        """
        rivals = [c for c in comparisons if c.difference is not None]
        best = next((c.rms for c in comparisons if c.is_best), None)
        if best is None:
            return True
        wanted = self.half_width * best
        return all(c.half_width is not None and (not c.is_tie or c.half_width <= wanted) for c in rivals)


def parse_stop(table: Mapping[str, Any], seeds: int) -> Stop | None:
    """Return the rule of a plan, None for an empty table. Raises SettingError."""
    if not table:
        return None
    check_keys(table, "stop", "half_width", "first")
    width, first = table.get("half_width", 0.05), table.get("first", 10)
    if not isinstance(width, (int, float)) or not 0 < width < 1:
        raise SettingError(f"stop.half_width = {width!r}: takes a number between 0 and 1, in units of the best rms")
    if not isinstance(first, int) or not 2 <= first <= seeds:
        raise SettingError(f"stop.first = {first!r}: takes a whole number from 2 to seeds = {seeds}")
    return Stop(float(width), looks(first, seeds))


def looks(first: int, last: int) -> tuple[int, ...]:
    """Return the numbers of seeds at which is decided, each twice the one before.

    >>> looks(10, 100)
    (10, 20, 40, 80, 100)
    """
    out = [first]
    while out[-1] < last:
        out.append(min(2 * out[-1], last))
    return tuple(out)


KEYS = (
    "name",
    "seeds",
    "first_seed",
    "observers",
    "controllers",
    "preset",
    "scenario",
    "settings",
    "grid",
    "sample",
    "conditions",
    "stop",
)
"""What a plan may contain."""


@dataclass(frozen=True)
class Cell:
    """One scenario of a campaign, to be run with several seeds.

    Attributes
    ----------
    index : int
        Number in the plan.
    name : str
        Name of the scenario that it is made from.
    base : mapping
        Settings of that scenario that differ from the defaults, nested.
    changes : mapping
        Dotted path -> value of what the axes of the plan set.
    """

    index: int
    name: str
    base: Mapping[str, Any]
    changes: Changes

    def scenario(self) -> Scenario:
        """Return the scenario. Raises SettingError."""
        made = Scenario.from_dict(self.base)
        made = made.replace(self.changes) if self.changes else made
        made.validate()
        return made


@dataclass(frozen=True)
class Campaign:
    """A campaign.

    Attributes
    ----------
    name : str
        Title.
    cells : tuple of Cell
        Scenarios.
    seeds : range
        Seeds of each.
    observers, controllers : tuple of str
        Ids.
    stop : Stop or None
        When a scenario has enough seeds; None for all of them.
    """

    name: str
    cells: tuple[Cell, ...]
    seeds: range
    observers: tuple[str, ...]
    controllers: tuple[str, ...]
    stop: Stop | None = None

    @property
    def n_runs(self) -> int:
        """Number of runs: scenarios times seeds."""
        return len(self.cells) * len(self.seeds)

    @property
    def level(self) -> float:
        """Level of tests and intervals of differences: that of one look where there are several."""
        return self.stop.level if self.stop else LEVEL

    @property
    def axes(self) -> tuple[str, ...]:
        """Dotted paths of the settings that the cells differ in."""
        return tuple(dict.fromkeys(path for cell in self.cells for path in cell.changes))

    def identity(self) -> str:
        """Return a digest of all but the number of seeds and the title: results of plans with the same one belong together."""
        content = {k: v for k, v in self.to_dict().items() if k not in ("name", "seeds", "stop")}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as plain values, with the contents of the files that it names."""
        return {
            "name": self.name,
            "first_seed": self.seeds.start,
            "seeds": len(self.seeds),
            "observers": list(self.observers),
            "controllers": list(self.controllers),
            "scenarios": {cell.name: cell.base for cell in self.cells},
            "cells": [[cell.name, cell.changes] for cell in self.cells],
            "stop": self.stop and asdict(self.stop),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Campaign:
        """Return the plan of `to_dict`. Raises AttributeError, KeyError, TypeError or ValueError of other values."""
        bases, first = {name: {**base} for name, base in values["scenarios"].items()}, values["first_seed"]
        return cls(
            values["name"],
            tuple(Cell(i, name, bases[name], {**changes}) for i, (name, changes) in enumerate(values["cells"])),
            range(first, first + values["seeds"]),
            tuple(values["observers"]),
            tuple(values["controllers"]),
            values["stop"] and Stop(values["stop"]["half_width"], tuple(values["stop"]["looks"])),
        )


def load_plan(path: str | Path) -> Campaign:
    """Read a plan.

    Parameters
    ----------
    path : str or Path
        TOML file; files that it names are looked for beside it.

    Returns
    -------
    Campaign
        The plan.

    Raises
    ------
    SettingError
        The file cannot be read, or a value cannot be used; the line starts with the path.
    """
    text = read_text(path)
    with errors_of(str(path)):
        return parse_plan(text, Path(path).parent)


def parse_plan(text: str, folder: Path) -> Campaign:
    """Return the plan of a TOML text. Raises SettingError.

    folder : where the files that it names are looked for
    """
    values = parse_toml(text)
    for key in values:
        if key not in KEYS:
            raise SettingError(f"{key}: not part of a plan; takes {', '.join(KEYS)}")
    count, first = _whole(values, "seeds", 1, 1, 10_000_000), _whole(values, "first_seed", 1, 0, 2**31 - 1)
    observers = _ids(values, "observers", list(OBSERVERS), list(OBSERVERS))
    controllers = _ids(values, "controllers", [], list(CONTROLLERS))
    if not observers and not controllers:
        raise SettingError("observers = []: without controllers there is nothing to run")
    varied = dict(leaves(_table(values, "grid")))
    axes = [conditions(_table(values, "conditions"), folder), sample(_table(values, "sample")), grid(varied)]
    cells: list[Cell] = []
    for name, base in _scenarios(values, folder):
        cells += [Cell(len(cells) + i, name, base, changes) for i, changes in enumerate(product(axes))]
    checked: list[Scenario] = []
    for cell in _corners(cells, axes):
        with errors_of(f"scenario {cell.index} ({cell.name})"):
            checked.append(cell.scenario())
    observers = observers if "observers" in values else common_observers(checked)
    stop = parse_stop(_table(values, "stop"), count)
    return Campaign(str(values.get("name", "Campaign")), tuple(cells), range(first, first + count), observers, controllers, stop)


def _corners(cells: Sequence[Cell], axes: Sequence[Sequence[Changes]]) -> Iterator[Cell]:
    """Yield cells in which every value of every setting occurs: all cells are checked when they run."""
    known: set[tuple[str, str, str]] = set()
    for cell in cells:
        fresh = {(cell.name, path, repr(value)) for path, value in cell.changes.items()} or {(cell.name, "", "")}
        if not fresh <= known:
            known |= fresh
            yield cell


def _scenarios(values: Mapping[str, Any], folder: Path) -> list[tuple[str, Mapping[str, Any]]]:
    """Return (name, settings that differ from the defaults) of the scenarios."""
    entries = values.get("scenario", [{"preset": values.get("preset", "paper")}])
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise SettingError("scenario: takes tables, [[scenario]]")
    if "scenario" in values and "preset" in values:
        raise SettingError("preset: belongs into each [[scenario]]")
    out: dict[str, Mapping[str, Any]] = {}
    for i, entry in enumerate(entries):
        where = f"scenario.{i}"
        check_keys(entry, where, "name", "preset", "config", "settings")
        name = str(entry.get("name", entry.get("preset", entry.get("config", f"scenario {i}"))))
        if name in out:
            raise SettingError(f"{where}.name = {name!r}: there are two")
        base = preset(entry["preset"]) if "preset" in entry else None
        made = load_scenario(folder / str(entry["config"]), base) if "config" in entry else base or preset("paper")
        made.update(_table(values, "settings"))
        made.update(_table(entry, "settings"))
        out[name] = made.difference(Scenario())
    return list(out.items())


def _table(values: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    table = values.get(key, {})
    if not isinstance(table, dict):
        raise SettingError(f"{key}: takes a table, [{key}]")
    return table


def _whole(values: Mapping[str, Any], key: str, default: int, low: int, high: int) -> int:
    value = values.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        raise SettingError(f"{key} = {value!r}: takes a whole number from {low} to {high}")
    return value


def _ids(values: Mapping[str, Any], key: str, default: list[str], choices: list[str]) -> tuple[str, ...]:
    chosen = values.get(key, default)
    if not isinstance(chosen, list):
        raise SettingError(f"{key} = {chosen!r}: takes a list of ids")
    for name in chosen:
        if name not in choices:
            raise SettingError(f"{key}: {name!r} is not one of {', '.join(choices)}")
    return tuple(name for name in choices if name in chosen)


MOST_VALUES = 16
"""Values of an axis; more numbers than that, as samples have, are put into as many bins."""
SCENARIO = "scenario"
"""Axis of plans with several scenarios."""


@dataclass(frozen=True)
class PlanAxis:
    """One condition.

    Attributes
    ----------
    path : str
        Dotted path of the setting, or SCENARIO.
    values : tuple
        Values, numbers in rising order; of bins (lowest, highest).
    is_binned : bool
        Whether they are bins.
    of_cell : Array
        Position in `values` of each scenario, int (n_cells,).
    """

    path: str
    values: tuple[Any, ...]
    is_binned: bool
    of_cell: Array

    @property
    def positions(self) -> Array:
        """Where the values lie on a figure: numbers and the middles of bins by their size, others by their order."""
        numbers = [sum(v) / 2 for v in self.values] if self.is_binned else self.values
        return np.array(numbers if self.is_numeric else range(len(self.values)), dtype=float)

    @property
    def is_numeric(self) -> bool:
        """Whether the values are numbers."""
        return self.is_binned or all(_is_number(v) for v in self.values)


def plan_axes(plan: Campaign) -> list[PlanAxis]:
    """Return what the scenarios of a plan differ in, what is constant left out."""
    axes = [_axis(path, _values(plan, path)) for path in (SCENARIO, *plan.axes)]
    return [axis for axis in axes if len(axis.values) > 1]


def _axis(path: str, of_cell: Sequence[Any]) -> PlanAxis:
    values = list({repr(value): value for value in of_cell}.values())
    is_numeric = all(map(_is_number, values))
    if not is_numeric or len(values) <= MOST_VALUES:
        values = sorted(values) if is_numeric else values
        order = {repr(value): i for i, value in enumerate(values)}
        return PlanAxis(path, tuple(values), False, np.array([order[repr(value)] for value in of_cell]))
    x = np.array(of_cell, dtype=float)
    edges = np.quantile(x, np.linspace(0.0, 1.0, MOST_VALUES + 1)[1:-1])
    _, bins = np.unique(np.searchsorted(edges, x), return_inverse=True)
    spans = tuple((float(x[bins == i].min()), float(x[bins == i].max())) for i in range(bins.max() + 1))
    return PlanAxis(path, spans, True, bins)


NOT_SET = "-"
"""Stands for the value of a setting that only other scenarios set."""
MOST_LISTED = 16
"""Values that are listed where another one is refused."""
RANGE = ".."


def cells_where(plan: Campaign, only: Iterable[str]) -> Array:
    """Return the numbers of some scenarios of a plan, int (n,), all of them without a condition.

    Parameters
    ----------
    plan : Campaign
        The plan.
    only : iterable of str
        NAME=VALUE or NAME=LOW..HIGH with the path of a setting, or "scenario". One name several times: any of the values.

    Raises
    ------
    SettingError
        A name or a value is none of the plan, or no scenario has all of them; the line says what is allowed.
    """
    only = list(only)
    axes = {axis.path: axis for axis in plan_axes(plan)}
    chosen: dict[str, Array] = {}
    for text in only:
        path, equals, named = text.partition("=")
        if not equals or path not in axes:
            names = f"NAME=VALUE with one of {', '.join(axes)}" if axes else "nothing: there is a single scenario"
            raise SettingError(f"{text}: takes {names}")
        values = _values(plan, path)
        found = _has_value(values, named)
        if not found.any():
            raise SettingError(f"{text}: takes {_list_values(values)}")
        chosen[path] = chosen.get(path, False) | found
    cells = np.flatnonzero(np.logical_and.reduce([np.ones(len(plan.cells), dtype=bool), *chosen.values()]))
    if not len(cells):
        raise SettingError(f"{', '.join(only)}: no scenario has all of these")
    return cells


def condition(axis: PlanAxis, index: int) -> str:
    """Write one value of an axis, or the range of a bin, as `cells_where` takes it."""
    value = axis.values[index]
    if axis.is_binned and value[0] < value[1]:
        return f"{axis.path}={value[0]!r}{RANGE}{value[1]!r}"
    return f"{axis.path}={_text(value[0] if axis.is_binned else value)}"


def _values(plan: Campaign, path: str) -> list[Any]:
    return [cell.name if path == SCENARIO else cell.changes.get(path) for cell in plan.cells]


def _text(value: Any) -> str:
    return NOT_SET if value is None else format_value(value)


def _has_value(values: list[Any], name: str) -> Array:
    """Return which values a text names, bool (n,)."""
    low, _, high = name.partition(RANGE)
    span = _number(low), _number(high if RANGE in name else low)
    if None in span:
        return np.array([_text(value) == name for value in values])
    return np.array([(_is_number(value) and span[0] <= value <= span[1]) or _text(value) == name for value in values])


def _list_values(values: list[Any]) -> str:
    """Say what values there are."""
    numbers = sorted({value for value in values if _is_number(value)})
    texts = list(dict.fromkeys(map(_text, [*numbers, *values])))
    if len(texts) <= MOST_LISTED:
        listed = f"one of {', '.join(texts)}"
    elif numbers:
        listed = f"one of {len(numbers)} numbers from {_text(numbers[0])} to {_text(numbers[-1])}"
    else:
        listed = f"one of {', '.join(texts[:MOST_LISTED])}, ... ({len(texts)} values)"
    return f"{listed}, or a range LOW{RANGE}HIGH that has some" if numbers else listed


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
