"""Error budgets as a table for people."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

from rich.table import Table

from wfsobs.evaluation.budget import TERMS, Budget
from wfsobs.evaluation.rows import row_label
from wfsobs.evaluation.scores import SCORED


def budget_table(budgets: Sequence[Budget]) -> Table:
    """Return the table of terms, their shares of the total, and the bound; the smallest error of a target and mode first."""
    out = Table(title="Error budget: parts of the mean square error, nm^2, and their shares", caption=_caption(budgets))
    for name in ("Target", "Mode", "Observer"):
        out.add_column(name, no_wrap=True)
    for name in ("error, nm", "nm^2", *TERMS.values(), "limit, nm^2"):
        out.add_column(name, justify="right")
    last = None
    for it in sorted((b for b in budgets if b.terms), key=lambda b: (SCORED.index(b.target), _mode_order(budgets, b), b.total)):
        if last not in (None, (it.target, it.mode)):
            out.add_section()
        last = (it.target, it.mode)
        cells = (f"{_number(it.terms[name] * 1e6)} {round(100.0 * it.terms[name] / it.total):4d} %" for name in TERMS)
        bound = "-" if it.bound is None else f"{it.bound * 1e6:.1f}"
        out.add_row(*last, row_label(it.observer), f"{sqrt(it.total) * 1e3:.2f}", f"{it.total * 1e6:.1f}", *cells, bound)
    return out


def _mode_order(budgets: Sequence[Budget], budget: Budget) -> int:
    return list(dict.fromkeys(b.mode for b in budgets)).index(budget.mode)


def _caption(budgets: Sequence[Budget]) -> str:
    """Return which observers have no budget, and why."""
    missing = dict.fromkeys((row_label(b.observer), b.reason) for b in budgets if b.reason)
    return "; ".join(f"{label}: none, {reason}" for label, reason in missing)


def _number(x: float) -> str:
    """One digit, without the sign of what rounds to zero."""
    return f"{round(x, 1) + 0.0:.1f}"
