"""A verdict in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from wfsobs.evaluation.budget import CONE, LAG, LINES, MISMATCH, NOISE
from wfsobs.evaluation.rows import JOINT_BOUNDS, row_label
from wfsobs.evaluation.scores import BOUND_ASTERISM, BOUND_BOTH, BOUND_BOTH_MODES, BOUND_MODES
from wfsobs.observers import OBSERVERS
from wfsobs.prior import Bands, Lines, Model, Part, Training, asks_for

if TYPE_CHECKING:
    from wfsobs.evaluation.verdict import Harm, Verdict

TOLD: tuple[tuple[Part, str], ...] = (
    (Lines, "all {n} lines"),
    (Model, "a model with one line"),
    (Training, "training data"),
    (Bands, "where the bands are"),
)
"""What is said of an observer by the first part of its prior that is found here."""

OF_BOUND = {
    BOUND_BOTH: "LGS and NGS",
    BOUND_MODES: "the LGS in all modes",
    BOUND_BOTH_MODES: "LGS and NGS in all modes",
    BOUND_ASTERISM: "every LGS in all modes, and NGS",
}
"""Bounds that an error is compared with, and whose they are."""

CAUSES = {
    NOISE: "noise of the sensors",
    LAG: "lag",
    LINES: "lines that {they_do} not model",
    MISMATCH: "model mismatch",
    CONE: "cone effect and aliasing",
}
"""Terms of an error budget, as they are said."""


def told_of(observer: str, lines: int) -> str:
    """Return what an observer is told, as a phrase."""
    prior = OBSERVERS[observer].prior
    words = next((words for part, words in TOLD if asks_for(part, prior)), "nothing")
    return words.format(n=lines).replace("all 1 lines", "the one line").replace("all 0 lines", "a model")


def best_sentence(it: Verdict, scale: float, unit: str) -> str:
    """Write who is best, by how much, and what it is given; scale: from micrometres to the unit."""
    target, mode, name = it.best.target.capitalize(), it.best.mode, row_label(it.best.observer)
    size = f"{_format_number(it.best.rms * scale)} {unit}"
    seeds = f" over {it.seeds} seeds" if it.seeds > 1 else ""
    if it.ties:
        start = f"{name} has the smallest error, {size}, tied with {_join_labels(it.ties)}{seeds or ' on this record'}"
    else:
        start = f"{name} is best{seeds}, {size}"
    return f"{target}, {mode}: {start}{_to_bound(it)}; it is given {told_of(it.best.observer, it.lines)}."


def _to_bound(it: Verdict) -> str:
    """Say how far the best error is from the least possible. It is a mean over records, so that one may lie below."""
    own = JOINT_BOUNDS.get(it.best.observer, BOUND_BOTH)
    bound, words = it.bounds.get(own, 0.0), OF_BOUND[own]
    if not bound:
        return ""
    percent = round(100.0 * (it.best.rms / bound - 1.0))
    if percent < 0:
        return f", {-percent} % below the bound of {words}, which is a mean over records"
    return f", {f'{percent} % above' if percent else 'at'} the bound of {words}"


def harm_sentences(it: Verdict) -> list[str]:
    """Write a sentence for all observers that are told the same and fail for the same reason."""
    groups: dict[tuple[object, ...], list[Harm]] = {}
    for harm in it.harms:
        groups.setdefault((harm.worse, told_of(harm.observer, it.lines), harm.cause), []).append(harm)
    return [_harm_sentence(it, of, str(told)) for (_, told, _), of in groups.items()]


def _harm_sentence(it: Verdict, harms: Sequence[Harm], prior: str) -> str:
    """Observers that are told the same, together; shares are the mean of theirs."""
    names = _join_labels([harm.observer for harm in harms])
    be, they, their = ("is", "it", "its") if len(harms) == 1 else ("are", "they", "their")
    tell = "is" if len(harms) == 1 else "are"
    reason = _cause(harms, their, f"{they} {'does' if len(harms) == 1 else 'do'}") or _place(it, harms, their, f"{they} {tell}")
    return f"{names} {be} {'worse' if harms[0].worse else 'no better'} than no estimate: {they} {tell} given {prior}{reason}."


def _cause(harms: Sequence[Harm], their: str, they_do: str) -> str:
    """Name the largest term of their error budgets, as a clause; empty where these are not known."""
    if not harms[0].cause:
        return ""
    percent = round(100.0 * float(np.mean([harm.share for harm in harms])))
    much = f"{percent} %" if percent < 100 else "all"
    return f"; {much} of {their} error is {CAUSES[harms[0].cause].format(they_do=they_do)}"


def _place(it: Verdict, harms: Sequence[Harm], their: str, they_are: str) -> str:
    """Say where in the spectrum most of their error lies, as a clause; empty where the lines are not known."""
    known, others = (float(np.mean([getattr(harm, name) for harm in harms])) for name in ("at_known", "at_others"))
    shares = {
        f"at lines that {they_are} not given": others,
        f"at lines that {they_are} given": known,
        "away from the lines": 1.0 - known - others,
    }
    where, share = max(shares.items(), key=lambda item: item[1])
    return f"; {100.0 * share:.0f} % of {their} error lies {where}" if it.lines else ""


def _join_labels(observers: Sequence[str]) -> str:
    """Labels as a person lists them.

    >>> _join_labels(["kf-lgs", "ridge", "kf-multi"])
    'LGS KF, Ridge and Multi-peak KF'
    """
    names = [row_label(observer) for observer in observers]
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _format_number(x: float) -> str:
    """Three digits, as a person would say them.

    >>> _format_number(14.96), _format_number(0.5), _format_number(120.4), _format_number(1234.0)
    ('15.0', '0.500', '120', '1234')
    """
    return f"{x:#.3g}".rstrip(".") if x < 999.5 else f"{x:.0f}"
