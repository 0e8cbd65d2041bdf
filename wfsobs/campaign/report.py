"""The report of a campaign: one HTML file with maps of winners, ranks and all comparisons, that opens without a network.

Ranks over many scenarios: mean ranks, the critical difference, and how stable the first place is.

The test is Friedman's with Nemenyi's critical difference (J. Demsar, J. Mach. Learn. Res. 7 (2006) 1). Scenarios are the blocks:
seeds of one scenario are no independent evidence about others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import rankdata, studentized_range

from wfsobs.campaign.compare import LEVEL, Comparison, compare, comparison_groups, each_group
from wfsobs.campaign.plan import Campaign
from wfsobs.campaign.store import finished_runs, folder_plan, present_rows, read_results
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.result import NOT_OBSERVERS
from wfsobs.files import write_text
from wfsobs.observers import OBSERVERS
from wfsobs.scenario.names import setting_label

if TYPE_CHECKING:
    import pyarrow

RESAMPLES = 500
"""Bootstrap samples of the seeds."""


@dataclass(frozen=True)
class Ranking:
    """Ranks of what can be the best, for one target and mode.

    Attributes
    ----------
    target, mode : str
        What was ranked.
    names : tuple of str
        Ids, the best mean rank first.
    mean_ranks : tuple of float
        Mean over the scenarios, 1 for the best.
    scenarios : int
        Number of scenarios.
    critical : float or None
        Difference of mean ranks that is significant; None for fewer than two scenarios or names.
    ties : tuple of (int, int)
        First and last position of names whose mean ranks do not differ significantly, the longest runs alone.
    """

    target: str
    mode: str
    names: tuple[str, ...]
    mean_ranks: tuple[float, ...]
    scenarios: int
    critical: float | None
    ties: tuple[tuple[int, int], ...] = ()


def critical_difference(names: int, blocks: int) -> float:
    """Return Nemenyi's critical difference of mean ranks.

    Parameters
    ----------
    names : int
        Number of what is compared.
    blocks : int
        Number of scenarios.

    Returns
    -------
    float
        Difference.

    Examples
    --------
    >>> round(critical_difference(5, 6) / (5 * 6 / (6 * 6)) ** 0.5, 3)  # Demsar's table 5: 2.728
    2.728
    """
    q = float(studentized_range.ppf(LEVEL, names, np.inf)) / np.sqrt(2.0)
    return float(q * np.sqrt(names * (names + 1) / (6.0 * blocks)))


def rank(comparisons: Sequence[Comparison]) -> list[Ranking]:
    """Rank by the rms over the seeds, scenario by scenario.

    Parameters
    ----------
    comparisons : sequence of Comparison
        Of all scenarios; a name takes part that can be the best in every one of them.

    Returns
    -------
    list of Ranking
        One per target and mode.
    """
    groups: dict[tuple[str, str], dict[int, dict[str, float]]] = {}
    for c in comparisons:
        if c.is_best or c.difference is not None:
            groups.setdefault((c.target, c.mode), {}).setdefault(c.cell, {})[c.name] = c.rms
    return [_rank_one(*key, list(cells.values())) for key, cells in sorted(groups.items())]


def _rank_one(target: str, mode: str, cells: Sequence[dict[str, float]]) -> Ranking:
    names = [name for name in cells[0] if all(name in cell for cell in cells)]
    mean = np.mean([rankdata([cell[name] for name in names]) for cell in cells], axis=0)
    order = np.argsort(mean, kind="stable")
    ordered = [float(mean[i]) for i in order]
    critical = critical_difference(len(names), len(cells)) if len(names) > 1 and len(cells) > 1 else None
    ties = () if critical is None else _runs(ordered, critical)
    return Ranking(target, mode, tuple(names[i] for i in order), tuple(ordered), len(cells), critical, ties)


def _runs(mean_ranks: Sequence[float], critical: float) -> tuple[tuple[int, int], ...]:
    """Return the longest runs of positions within the critical difference.

    >>> _runs([1.0, 1.4, 2.0, 4.0], 1.1)
    ((0, 2),)
    """
    runs = [(i, max(j for j, r in enumerate(mean_ranks) if r - first < critical)) for i, first in enumerate(mean_ranks)]
    longest = runs[:1] + [b for a, b in pairwise(runs) if b[1] > a[1]]
    return tuple(run for run in longest if run[1] > run[0])


def first_places(table: pyarrow.Table, rng: np.random.Generator) -> dict[tuple[int, str, str], dict[str, float]]:
    """Return how often each name is the best when the seeds are drawn again.

    Parameters
    ----------
    table : pyarrow.Table
        Rows of a campaign.
    rng : numpy.random.Generator
        Draws the seeds.

    Returns
    -------
    dict
        (cell, target, mode) -> name -> share of RESAMPLES samples in which its rms is the smallest.
    """
    out: dict[tuple[int, str, str], dict[str, float]] = {}
    for (cell, _, target, mode), errors in each_group(table):
        values = errors.values[0]
        columns = np.flatnonzero(errors.eligible[0] & ~np.isnan(values).any(axis=0))
        if not len(columns):
            continue
        weights = rng.multinomial(len(values), np.full(len(values), 1 / len(values)), size=RESAMPLES)
        best = np.argmin(weights @ values[:, columns] ** 2, axis=1)
        shares = np.bincount(best, minlength=len(columns)) / RESAMPLES
        out[cell, target, mode] = {errors.names[i]: float(share) for i, share in zip(columns, shares, strict=True) if share}
    return out


MOST_ROWS = 4000
"""Maximum number of scenarios, targets and modes in the table of comparisons; the maps have all."""
FULL_MARGIN = 0.3
"""Margin of the winner from which its colour is full: the second is 30 % worse."""


WIDTH, HEIGHT, LEFT, TOP = 520.0, 260.0, 90.0, 10.0
"""Size of a map, and the room for its labels [px]."""


def write_report(folder: Path, path: Path) -> None:
    """Write the report of a campaign.

    Parameters
    ----------
    folder : Path
        Folder of the campaign.
    path : Path
        HTML file.

    Raises
    ------
    SettingError
        The folder holds no campaign.
    OSError
        The file cannot be written.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    plan = folder_plan(folder)
    table = present_rows(plan, read_results(folder))
    comparisons = compare(table, plan.level)
    groups = comparison_groups(comparisons)
    stable = first_places(table, np.random.default_rng(0))
    environment = Environment(
        loader=PackageLoader("wfsobs.campaign"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    text = environment.get_template("report.html").render(
        plan=plan,
        done=int(finished_runs(plan, folder).sum()),
        maps=_maps(plan, groups),
        rankings=[(r, _lines(r)) for r in rank(comparisons)],
        groups=list(groups.items())[:MOST_ROWS],
        left_out=max(0, len(groups) - MOST_ROWS),
        stable=stable,
        label=name_label,
        colour=colour,
        settings=lambda cell: ", ".join(f"{path} = {_short(v)}" for path, v in plan.cells[cell].changes.items()),
        size=(WIDTH, HEIGHT, LEFT, TOP),
    )
    write_text(path, text)


def name_label(name: str) -> str:
    """Return the label of an observer, a controller or a bound."""
    return NOT_OBSERVERS.get(name) or getattr(OBSERVERS.get(name) or CONTROLLERS.get(name), "label", name)


def colour(name: str) -> str:
    """Return the colour of an observer or a controller."""
    entry = OBSERVERS.get(name) or CONTROLLERS.get(name)
    return entry.look.light if entry is not None else "#555577"


def _maps(plan: Campaign, groups: Mapping[tuple[int, str, str], Sequence[Comparison]]) -> list[dict[str, Any]]:
    """Return a map of winners for each scenario of a plan that is varied: over its first two settings that are numbers."""
    out, names = [], dict.fromkeys(cell.name for cell in plan.cells)
    for (target, mode), name in product(dict.fromkeys(key[1:] for key in groups), names):
        of = f"{target}, {mode}"
        cells = {key[0]: rows for key, rows in groups.items() if key[1:] == (target, mode) and rows[0].scenario == name}
        changes = {cell: plan.cells[cell].changes for cell in cells}
        paths = [p for p in plan.axes if all(isinstance(c.get(p), (int, float)) for c in changes.values())][:2]
        paths = [p for p in paths if len({c[p] for c in changes.values()}) > 1]
        if paths:
            out.append(_map(plan, of, name, cells, changes, paths))
    return out


def _map(
    plan: Campaign,
    of: str,
    name: str,
    cells: Mapping[int, Sequence[Comparison]],
    changes: Mapping[int, Mapping[str, Any]],
    paths: Sequence[str],
) -> dict[str, Any]:
    """Return the map of one scenario; where a third setting varies, points share a square and the last one is seen."""
    xs, ys, *_ = [*(sorted({c[path] for c in changes.values()}) for path in paths), [None]]
    wide, high = (WIDTH - LEFT - 10) / len(xs), (HEIGHT - TOP - 40) / len(ys)
    squares, winners = [], dict[str, str]()
    first = plan.cells[next(iter(changes))].scenario()
    x_name, y_name, *_ = labels = [*(setting_label(first, path) for path in paths), ""]
    for cell, rows in cells.items():
        best = next((r for r in rows if r.is_best), None)
        if best is None:
            continue
        above = [r.difference for r in rows if r.difference is not None]
        margin = max(min(above), 0.0) / best.rms if above and best.rms > 0 else FULL_MARGIN  # as `CampaignErrors.verdict` has it
        tie = any(r.is_tie for r in rows)
        values = [changes[cell][path] for path in paths]
        x, y, *_ = [*values, None]
        winners[best.name] = name_label(best.name)
        text = f"{winners[best.name]}, {best.rms:.1f} nm, {100.0 * margin:.0f} % before the next"
        text += ", another is not significantly worse" if tie else ""
        text += f"; {', '.join(f'{label} = {_short(v)}' for label, v in zip(labels, values, strict=False))}; {of}"
        squares.append(
            {
                "x": LEFT + xs.index(x) * wide,
                "y": TOP + (len(ys) - 1 - ys.index(y)) * high,
                "colour": colour(best.name),
                "opacity": 0.15 if tie else 0.25 + 0.75 * min(1.0, margin / FULL_MARGIN),
                "text": text,
            }
        )
    some_y = range(0, len(ys), max(1, len(ys) // 8)) if y_name else ()
    return {
        "title": f"{of}: {name}",
        "x_name": x_name,
        "y_name": y_name,
        "x_labels": [(LEFT + (i + 0.5) * wide, _short(xs[i])) for i in range(0, len(xs), max(1, len(xs) // 8))],
        "y_labels": [(TOP + (len(ys) - 0.5 - j) * high, _short(ys[j])) for j in some_y],
        "width": wide - 1,
        "height": high - 1,
        "squares": squares,
        "winners": [(colour(n), text) for n, text in winners.items()],
    }


def _lines(ranking: Ranking) -> dict[str, Any]:
    """Return positions of the critical-difference diagram [px]."""
    last = max(2, len(ranking.names))

    def x(value: float) -> float:
        return 30.0 + (value - 1.0) / (last - 1.0) * 440.0

    return {
        "ticks": [(x(i), str(i)) for i in range(1, last + 1)],
        "names": [(x(r), name) for r, name in zip(ranking.mean_ranks, ranking.names, strict=True)],
        "ties": [(x(ranking.mean_ranks[a]), x(ranking.mean_ranks[b])) for a, b in ranking.ties],
        "critical": None if ranking.critical is None else (x(1.0), x(1.0 + ranking.critical)),
    }


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, (int, float)) and not isinstance(value, bool) else str(value)
