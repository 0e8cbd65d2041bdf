"""A verdict in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from wfsobs.evaluation.budget import CONE, LAG, LINES, MISMATCH, NOISE
from wfsobs.evaluation.known_lines import BANDS, NOTHING, ONE_PEAK, PEAKS, SPECTRA, TRAINED
from wfsobs.evaluation.rows import row_label, target_title
from wfsobs.evaluation.scores import BOUND_ASTERISM, BOUND_BOTH, BOUND_BOTH_MODES, BOUND_MODES

if TYPE_CHECKING:
    from wfsobs.evaluation.verdict import Contender, Harm, Verdict

HEADINGS = {
    NOTHING: "Without prior knowledge",
    PEAKS: "With known peak frequencies",
    ONE_PEAK: "With one known peak",
    TRAINED: "With training data",
    BANDS: "With known frequency bands",
    SPECTRA: "With known spectra",
}
"""Kinds of prior knowledge, as the beginning of a sentence."""

ALWAYS = ("gpr-online", "kf-lgs", "integrator", "integrator+gpr-online", "lqg-kf-lgs")
"""Observers and controllers that are named whatever their error: the subject of the paper, and what it is compared with."""

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
        SPECTRA: f"{they} {know} the spectra",
        NOTHING: f"{they} {have} no prior knowledge",
    }[place.knowledge]


def verdict_sentences(it: Verdict, scale: float, unit: str) -> list[str]:
    """Write the best with each kind of prior knowledge and the limit, then the observers of the paper, then those that do harm.

    scale : from micrometres to the unit
    """
    chosen = {place.observer: place for kind in HEADINGS if (place := it.best_with(kind)) and kind in (NOTHING, PEAKS)}
    chosen.setdefault(it.best.observer, it.best)
    named = [place for place in it.places if place.observer in ALWAYS and place.observer not in chosen]
    harmful = {harm.observer for harm in it.harms}
    equal = [_label(place) for place in it.places[1:] if place.is_tie and place.observer not in chosen]
    parts = []
    for place in chosen.values():
        notes = [_to_limit(place)] if place is it.best else ["statistically equal to the best"] if place.is_tie else []
        if place is it.best and equal:
            notes.append(f"statistically equal to {_join_labels(equal, MOST)}")
        parts.append(f"{_heading(place, it.lines)}: {', '.join(filter(None, (_with_size(place, scale, unit), *notes)))}.")
    over = f", over {it.seeds} seeds" if it.seeds > 1 else ""
    others = [f"{_with_size(place, scale, unit)}." for place in named if place.observer not in harmful]
    lead = f"{target_title(it.target)}, {it.mode}{over}. {' '.join(parts)}"
    return [lead, *([" ".join(others)] if others else []), *harm_sentences(it, scale, unit)]


def sentence_of_several(verdicts: Sequence[Verdict], scales: Sequence[float], unit: str) -> str:
    """Write who is best in how many of several scenarios, without prior knowledge and with known peak frequencies.

    scales : from micrometres to the unit, of every verdict
    """
    parts = []
    for kind in (NOTHING, PEAKS):
        best = [(place, scale) for it, scale in zip(verdicts, scales, strict=True) if (place := it.best_with(kind))]
        if best:
            counts = Counter(row_label(place.observer) for place, _ in best).most_common()
            errors = [place.rms * scale for place, scale in best]
            n_equal = sum(place.above_limit == 0.0 for place, _ in best)
            parts.append(
                f"{HEADINGS[kind]}: smallest error of "
                f"{', '.join(f'{name} in {n}' for name, n in counts)} of {len(best)} scenarios"
                f", {_format_number(min(errors))} to {_format_number(max(errors))} {unit}"
                f"{f', at the theoretical limit in {n_equal}' if n_equal else ''}."
            )
    return " ".join(parts)


def _heading(place: Contender, lines: int) -> str:
    """Name a kind of prior knowledge; lines : of the vibration, 0 where that is not known."""
    if place.knowledge == PEAKS and place.n_peaks < lines:
        return f"With {place.n_peaks} of {lines} peak frequencies known"
    return HEADINGS[place.knowledge]


def _with_size(place: Contender, scale: float, unit: str) -> str:
    """Write an observer and its error with the interval of that."""
    half = 0.5 * (place.interval[1] - place.interval[0]) * scale if place.interval else None
    return f"{_label(place)} {_format_number(place.rms * scale, half)} {unit}"


def _label(place: Contender) -> str:
    return place.label or row_label(place.observer)


def _to_limit(place: Contender) -> str:
    """Say how far an error is from the least possible."""
    above = place.above_limit
    if above is None or place.limit is None:
        return ""
    percent = round(100.0 * above)
    where = f"{abs(percent)} % {'above' if percent > 0 else 'below'}" if percent else "at"
    return f"{where} the theoretical limit using {USING[place.limit[1]]}"


def harm_sentences(it: Verdict, scale: float, unit: str) -> list[str]:
    """Write a sentence for all observers that know the same and fail for the same reason."""
    groups: dict[tuple[object, ...], list[Harm]] = {}
    for harm in it.harms:
        groups.setdefault((harm.worse, knowledge_clause(harm.place, it.lines), harm.cause), []).append(harm)
    return [_harm_sentence(it, of, scale, unit) for of in groups.values()]


def _harm_sentence(it: Verdict, harms: Sequence[Harm], scale: float, unit: str) -> str:
    """Observers that know the same, together; shares are the mean of theirs."""
    several = len(harms) > 1
    be = "are" if several else "is"
    names = _join([_with_size(h.place, scale, unit) if h.observer in ALWAYS else row_label(h.observer) for h in harms])
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


def _join_labels(labels: Sequence[str], most: int) -> str:
    """Labels as a person lists them, the first of more than `most`.

    >>> _join_labels(["LGS KF", "Ridge", "Multi-peak KF"], 3), _join_labels(["LGS KF", "Ridge", "Multi-peak KF"], 1)
    ('LGS KF, Ridge and Multi-peak KF', 'LGS KF and 2 others')
    """
    names = list(labels)
    if len(names) > most + 1:
        names[most:] = [f"{len(names) - most} others"]
    return _join(names)


def _join(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def _format_number(x: float, half_width: float | None = None) -> str:
    """Return three digits of a number, and its interval to the last of them.

    >>> _format_number(14.96), _format_number(0.5), _format_number(120.4), _format_number(1234.0), _format_number(9.63, 0.418)
    ('15.0', '0.500', '120', '1234', '9.63 ± 0.42')
    """
    text = f"{x:#.3g}".rstrip(".") if x < 999.5 else f"{x:.0f}"
    return text if half_width is None else f"{text} ± {half_width:.{len(text.partition('.')[2])}f}"
