"""When a scenario has enough seeds: decisions at fixed numbers of seeds, whatever arrives when."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from wfsobs.campaign.compare import LEVEL, Comparison, compare
from wfsobs.settings.errors import SettingError

if TYPE_CHECKING:
    import pyarrow

    from wfsobs.campaign.plan import Campaign
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
    for key in table:
        if key not in ("half_width", "first"):
            raise SettingError(f"stop.{key}: takes half_width, first")
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


def wanted_seeds(plan: Campaign, complete: Array, table: pyarrow.Table) -> Array:
    """Return how many seeds each scenario is to have by what is known, (n_cells,).

    At each look the first seeds alone count, so that the order of arrival does not matter.

    Parameters
    ----------
    plan : Campaign
        The campaign.
    complete : Array
        Runs that are finished, bool (n_cells, n_seeds).
    table : pyarrow.Table
        Their rows.
    """
    import numpy as np

    if plan.stop is None:
        return np.full(len(plan.cells), len(plan.seeds))
    wanted = np.full(len(plan.cells), plan.stop.looks[0])
    undecided = np.ones(len(plan.cells), dtype=bool)
    for count in plan.stop.looks:
        wanted[undecided] = count
        undecided &= complete[:, :count].all(axis=1)  # the others wait for their seeds
        if not undecided.any():
            break
        first = table["seed"].to_numpy() < plan.seeds.start + count
        mask = _mask(first & np.isin(table["cell"].to_numpy(), np.flatnonzero(undecided)))
        groups: dict[tuple[int, str, str], list[Comparison]] = {}
        for one in compare(table.filter(mask), plan.stop.level):
            groups.setdefault((one.cell, one.target, one.mode), []).append(one)
        open_cells = {key[0] for key, compared in groups.items() if not plan.stop.is_decided(compared)}
        undecided &= np.isin(np.arange(len(plan.cells)), list(open_cells))
    return wanted


def _mask(values: Array) -> pyarrow.BooleanArray:
    import pyarrow as pa

    return pa.array(values)
