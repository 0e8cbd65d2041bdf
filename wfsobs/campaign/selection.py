"""Some scenarios of a campaign, by the values of what they differ in: NAME=VALUE, of numbers also NAME=LOW..HIGH."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wfsobs.campaign.plan import Campaign
from wfsobs.scenario.configfile import format_value
from wfsobs.settings.errors import SettingError
from wfsobs.typing import Array

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
        found = _has_value(_values(plan, path), named)
        if not found.any():
            raise SettingError(f"{text}: takes {_list_values(_values(plan, path))}")
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
    texts = list(dict.fromkeys(map(_text, values)))
    numbers = sorted({value for value in values if _is_number(value)})
    if len(texts) <= MOST_LISTED:
        texts = [*map(_text, numbers), *(text for text in texts if text not in {_text(n) for n in numbers})]
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
