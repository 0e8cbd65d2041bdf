"""A verdict in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from wfsobs.evaluation.budget import CONE, LAG, LINES, MISMATCH, NOISE
from wfsobs.evaluation.known_lines import BANDS, NOTHING, ONE_PEAK, PEAKS, TRAINED
from wfsobs.evaluation.rows import row_label
from wfsobs.evaluation.scores import BOUND_ASTERISM, BOUND_BOTH, BOUND_BOTH_MODES, BOUND_MODES

if TYPE_CHECKING:
    from wfsobs.evaluation.verdict import Contender, Harm, Verdict

MOST = 3
"""Observers that are named as equal to the best; the table has all."""

USING = {
    BOUND_BOTH: "LGS and NGS",
    BOUND_MODES: "the LGS in all modes",
    BOUND_BOTH_MODES: "LGS and NGS in all modes",
    BOUND_ASTERISM: "every LGS in all modes, and NGS",
}
"""Bounds that an error is compared with, and what they use."""

CAUSES = {
    NOISE: "sensor noise",
    LAG: "lag",
    LINES: "unmodelled peaks",
    MISMATCH: "model mismatch",
    CONE: "cone effect and aliasing",
}
"""Terms of an error budget, as causes."""


def knowledge_clause(place: Contender, lines: int, several: bool = False) -> str:
    """Write what an observer knows before it measures; lines : of the vibration, 0 where that is not known."""
    they, know, have, model = (
        ("they", "know", "have", "their models have") if several else ("it", "knows", "has", "its model has")
    )
    n = place.n_peaks
    of = f" of {lines}" if lines > n else ""
    all_n = f"all {n}" if 1 < n == lines else f"{n}{of}"
    frequencies = f"{they} {know} {'the peak frequency' if n == 1 >= lines else f'{all_n} peak frequencies'}"
    return {
        PEAKS: frequencies if n or lines else f"{model} no peak",
        ONE_PEAK: f"{model} {'one' if n else 'none'}{of} peak{'s' * bool(of)}",
        TRAINED: f"{they} {have} training data",
        BANDS: f"{they} {know} the frequency bands",
        NOTHING: f"{they} {have} no prior knowledge",
    }[place.knowledge]


def best_sentence(it: Verdict, scale: float, unit: str) -> str:
    """Write who is best, by how much, and what it knows; scale: from micrometres to the unit."""
    name, low_high = row_label(it.best.observer), it.best.interval
    half = 0.5 * (low_high[1] - low_high[0]) * scale if low_high else None
    size = f"{_format_number(it.best.rms * scale, half)} {unit}"
    over = f"over {it.seeds} seeds" if it.seeds > 1 else ""
    if it.ties:
        equal = f"statistically equal to {_join_labels(it.ties, MOST)} {over or 'on this record'}"
        start = f"{name} has the smallest error, {size}, {equal}"
    else:
        start = f"{name} is best{f' {over}' * bool(over)}, {size}"
    return f"{it.target.capitalize()}, {it.mode}: {start}{_to_limit(it.best)}; {knowledge_clause(it.best, it.lines)}."


def _to_limit(place: Contender) -> str:
    """Say how far an error is from the least possible."""
    above = place.above_limit
    if above is None or place.limit is None:
        return ""
    percent = round(100.0 * above)
    where = f"{abs(percent)} % {'above' if percent > 0 else 'below'}" if percent else "at"
    return f", {where} the theoretical limit using {USING[place.limit[1]]}"


def harm_sentences(it: Verdict) -> list[str]:
    """Write a sentence for all observers that know the same and fail for the same reason."""
    groups: dict[tuple[object, ...], list[Harm]] = {}
    for harm in it.harms:
        groups.setdefault((harm.worse, knowledge_clause(harm.place, it.lines), harm.cause), []).append(harm)
    return [_harm_sentence(it, of) for of in groups.values()]


def _harm_sentence(it: Verdict, harms: Sequence[Harm]) -> str:
    """Observers that know the same, together; shares are the mean of theirs."""
    several = len(harms) > 1
    names, be = _join_labels([harm.observer for harm in harms]), "are" if several else "is"
    reason = _reason(it, harms, "their" if several else "its", "models" if several else "model")
    knowledge = knowledge_clause(harms[0].place, it.lines, several)
    return f"{names} {be} {'worse' if harms[0].worse else 'no better'} than assuming no {it.target}: {knowledge}{reason}."


def _reason(it: Verdict, harms: Sequence[Harm], their: str, models: str) -> str:
    """Name the largest term of their error budgets, or where in the spectrum most of their error lies, as a clause."""
    known, others, share = (
        float(np.mean([getattr(harm, name) for harm in harms])) for name in ("at_known", "at_others", "share")
    )
    if harms[0].cause:
        percent = round(100.0 * share)
        return f"; {f'{percent} %' if percent < 100 else 'all'} of {their} error comes from {CAUSES[harms[0].cause]}"
    shares = {
        f"at peaks that are not in {their} {models}": others,
        f"at peaks in {their} {models}": known,
        "away from the peaks": 1.0 - known - others,
    }
    where, share = max(shares.items(), key=lambda item: item[1])
    return f"; {100.0 * share:.0f} % of {their} error lies {where}" if it.lines else ""


def _join_labels(observers: Sequence[str], most: int | None = None) -> str:
    """Labels as a person lists them, the first of more than `most`.

    >>> _join_labels(["kf-lgs", "ridge", "kf-multi"]), _join_labels(["kf-lgs", "ridge", "kf-multi"], 1)
    ('LGS KF, Ridge and Multi-peak KF', 'LGS KF and 2 others')
    """
    names = [row_label(observer) for observer in observers]
    if most is not None and len(names) > most + 1:
        names[most:] = [f"{len(names) - most} others"]
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _format_number(x: float, half_width: float | None = None) -> str:
    """Return three digits of a number, and its interval to the last of them.

    >>> _format_number(14.96), _format_number(0.5), _format_number(120.4), _format_number(1234.0), _format_number(9.63, 0.418)
    ('15.0', '0.500', '120', '1234', '9.63 ± 0.42')
    """
    text = f"{x:#.3g}".rstrip(".") if x < 999.5 else f"{x:.0f}"
    return text if half_width is None else f"{text} ± {half_width:.{len(text.partition('.')[2])}f}"
