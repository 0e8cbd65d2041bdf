"""What the scenarios of a campaign differ in, and which of them have which value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from wfsobs.campaign.plan import Campaign
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
    columns: dict[str, list[Any]] = {SCENARIO: [cell.name for cell in plan.cells]}
    columns |= {path: [cell.changes.get(path) for cell in plan.cells] for path in plan.axes}
    axes = [_axis(path, values) for path, values in columns.items()]
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


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
