"""The table of a campaign: all observers, controllers and bounds over some scenarios, for one target and mode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from wfsobs.campaign.compare import CampaignPlace
from wfsobs.campaign.follow import CampaignState
from wfsobs.typing import Array

BEST, TIED, UNTESTED = "best", "tied", "not tested"


@dataclass(frozen=True)
class TogetherRow:
    """One row of the table.

    Attributes
    ----------
    target, mode, name : str
        What it is.
    rms_nm : float
        Root mean square over the seeds, of several scenarios the geometric mean [nm].
    over_bound, over_bound_low, over_bound_high : float
        Geometric mean over the scenarios of the error over the smallest bound, and its interval; NaN where there is none.
    above, above_low, above_high : float
        Mean error over that of the best, less 1, and its interval; NaN where it is not compared, or not tested.
    rank : str
        BEST where all others differ significantly, TIED where a test finds no difference, UNTESTED where there is too little to
        test, else empty.
    wins, decided_wins : int or None
        Scenarios in which it is the best, and how many of these are significant; None where it cannot be.
    records : int
        Records with a result.
    failures : int or None
        Runs without an estimate; None for bounds.
    """

    target: str
    mode: str
    name: str
    rms_nm: float
    over_bound: float
    over_bound_low: float
    over_bound_high: float
    above: float
    above_low: float
    above_high: float
    rank: str
    wins: int | None
    decided_wins: int | None
    records: int
    failures: int | None


def standings(state: CampaignState, target: str, mode: str, cells: Sequence[int] | Array) -> list[TogetherRow]:
    """Return the table over some scenarios, the smallest error first.

    state : of `wfsobs.campaign.follow.CampaignFolder`;  cells : of `wfsobs.campaign.selection.cells_where`
    """
    errors = state.errors[target, mode]
    ratio, low, high = errors.over_bound(cells)
    places = errors.standings(cells)
    out = []
    for s in places:
        i = errors.names.index(s.name)
        won = [v for cell in cells if (v := errors.winners.get(int(cell))) is not None and v.best.name == s.name]
        can_win, failed = errors.eligible[cells, i].any(), state.failures.get(s.name)
        out.append(
            TogetherRow(
                target,
                mode,
                s.name,
                s.rms,
                over_bound=float(ratio[i]),
                over_bound_low=float(low[i]),
                over_bound_high=float(high[i]),
                above=s.above,
                above_low=s.low,
                above_high=s.high,
                rank=_rank(s, places),
                wins=len(won) if can_win else None,
                decided_wins=sum(v.is_decided for v in won) if can_win else None,
                records=int(errors.count[cells, i].sum()),
                failures=None if failed is None else int(failed[cells].sum()),
            )
        )
    return out


def _rank(s: CampaignPlace, places: Sequence[CampaignPlace]) -> str:
    rivals = [other for other in places if other.is_rival]
    of = rivals if s.is_best else [s]
    if any(one.is_tie for one in of):
        return TIED
    if any(one.is_untested for one in of):
        return UNTESTED
    return BEST if s.is_best and rivals else ""
