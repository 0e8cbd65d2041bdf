"""When a scenario has enough seeds: decisions at fixed numbers of seeds, whatever arrives when."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from wfsobs.campaign.compare import LEVEL, Comparison, compare
from wfsobs.settings.errors import SettingError

if TYPE_CHECKING:
    import pyarrow

    from wfsobs.campaign.plan import Campaign
    from wfsobs.typing import Array

HELD = 20_000
"""Rows that are held at a time, but for a scenario that has more."""


class CampaignRows(Protocol):
    """Rows of a campaign, such as `wfsobs.campaign.store.BatchIndex`."""

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        ...

    def read(self, cells: range) -> pyarrow.Table:
        """Return the rows of some scenarios."""
        ...


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


def wanted_seeds(plan: Campaign, complete: Array, rows: CampaignRows) -> Array:
    """Return how many seeds each scenario is to have by what is known, (n_cells,).

    At each look the first seeds alone count, so that the order of arrival does not matter. Some scenarios are decided at a time,
    so that as many rows are held whatever the number of scenarios.

    Parameters
    ----------
    plan : Campaign
        The campaign.
    complete : Array
        Runs that are finished, bool (n_cells, n_seeds).
    rows : CampaignRows
        Their rows.
    """
    import numpy as np

    if plan.stop is None:
        return np.full(len(plan.cells), len(plan.seeds))
    wanted = np.full(len(plan.cells), plan.stop.looks[0])
    size = max(1, int(HELD / max(1.0, rows.n_rows / max(1, complete.sum()) * complete.sum(axis=1).max())))
    for start in range(0, len(wanted), size):
        cells = range(start, min(start + size, len(wanted)))
        if complete[cells, : plan.stop.looks[0]].all(axis=1).any():
            wanted[cells] = _wanted_of(plan, plan.stop, cells, complete[cells], rows.read(cells))
    return wanted


def _wanted_of(plan: Campaign, stop: Stop, cells: range, complete: Array, table: pyarrow.Table) -> Array:
    """Return how many seeds some scenarios are to have, (n,); complete : (n, n_seeds)."""
    import numpy as np
    import pyarrow as pa

    wanted, undecided = np.full(len(cells), stop.looks[0]), np.ones(len(cells), dtype=bool)
    for count in stop.looks:
        wanted[undecided] = count
        undecided &= complete[:, :count].all(axis=1)  # the others wait for their seeds
        if not undecided.any():
            break
        table = table.filter(pa.array(undecided[table["cell"].to_numpy() - cells.start]))
        first = table.filter(pa.array(table["seed"].to_numpy() < plan.seeds.start + count))
        groups: dict[tuple[int, str, str], list[Comparison]] = {}
        for one in compare(first, stop.level):
            groups.setdefault((one.cell, one.target, one.mode), []).append(one)
        open_cells = {key[0] for key, compared in groups.items() if not stop.is_decided(compared)}
        undecided &= np.isin(cells, list(open_cells))
    return wanted
