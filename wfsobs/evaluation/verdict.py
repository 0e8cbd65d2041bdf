"""Verdict on a table of errors: the best with each kind of prior knowledge, the limit, and observers worse than assuming zero."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isnan
from typing import TYPE_CHECKING

import numpy as np

from wfsobs.evaluation.budget import NOISE, TERMS, Budget, error_budget
from wfsobs.evaluation.evidence import Evidence, gather_evidence
from wfsobs.evaluation.result import (
    BANDS,
    EQUAL,
    JOINT_BOUNDS,
    NOTHING,
    ONE_PEAK,
    PEAKS,
    TRAINED,
    TRUE_SPECTRA,
    above_bound,
    given_lines,
    is_near,
    prior_knowledge,
    row_label,
    target_title,
    uncertainty_text,
)
from wfsobs.evaluation.scores import (
    BOUND_ASTERISM,
    BOUND_BOTH,
    BOUND_BOTH_MODES,
    BOUND_MODES,
    BOUNDS,
    PREDICTION,
    Score,
)
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.prior import TRUE, PriorSource
from wfsobs.record import Estimate, Record
from wfsobs.scenario import Scenario
from wfsobs.signal.spectrum import psd
from wfsobs.simulation.disturbance import vibration_lines
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.evaluation.result import Result

HEADINGS = {
    NOTHING: "Without prior knowledge",
    PEAKS: "With known peak frequencies",
    ONE_PEAK: "With one known peak",
    TRAINED: "With training data",
    BANDS: "With known frequency bands",
    TRUE_SPECTRA: "With known spectra",
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

CAUSES = {name: label.lower() for name, label in TERMS.items()} | {NOISE: "sensor noise"}
"""Terms of an error budget, as causes."""


@dataclass(frozen=True)
class Contender:
    """An observer that can be the best.

    rms, interval : mean of its error over the seeds, or its error on the record, and the interval of that [um]
    is_tie        : whether the error is not significantly larger than the smallest, and by a share of EQUAL at most
    knowledge     : of `prior_knowledge`
    n_peaks       : peaks in its model: of those of the vibration where they are known
    limit         : the least error possible [um], and of which row of BOUNDS; None where it is not known
    label         : what it is called, where it is a controller
    """

    observer: str
    rms: float
    interval: tuple[float, float] | None
    is_tie: bool
    knowledge: str
    n_peaks: int
    limit: tuple[float, str] | None = None
    label: str = ""

    @property
    def above_limit(self) -> float | None:
        """By which share the error is above the limit: of `above_bound`."""
        return above_bound(self.rms, self.interval, self.limit[0] if self.limit else None)

    @property
    def name(self) -> str:
        """Label of the observer or controller."""
        return self.label or row_label(self.observer)

    def with_error(self, scale: float, unit: str) -> str:
        """Write the name and the error with its interval; scale : from micrometres to the unit.

        >>> Contender("kf-lgs", 0.0217, (0.002, 0.5), False, PEAKS, 1).with_error(1e3, "nm")
        'LGS KF 21.7 nm (interval unknown)'
        """
        text, ends = _format_number(self.rms * scale), ""
        if self.interval:
            ends = uncertainty_text(self.rms, self.interval, lambda x: f"{x * scale:.{len(text.partition('.')[2])}f}")
        after = (unit, ends) if "unknown" in ends else (ends, unit)
        return " ".join(filter(None, (self.name, text, *after)))

    def knowledge_clause(self, lines: int, several: bool = False) -> str:
        """Write what it knows before it measures; lines : of the vibration, 0 where that is not known."""
        they, know, have, model = (
            ("they", "know", "have", "their models have") if several else ("it", "knows", "has", "its model has")
        )
        n = self.n_peaks
        of = f" of {lines}" if lines > n else ""
        all_n = f"all {n}" if 1 < n == lines else f"{n}{of}"
        frequencies = f"{they} {know} {'the peak frequency' if n == 1 >= lines else f'{all_n} peak frequencies'}"
        return {
            PEAKS: frequencies if n or lines else f"{model} no peak",
            ONE_PEAK: f"{model} {'one' if n else 'none'}{of} peak{'s' * bool(of)}",
            TRAINED: f"{they} {have} training data",
            BANDS: f"{they} {know} the frequency bands",
            TRUE_SPECTRA: f"{they} {know} the spectra",
            NOTHING: f"{they} {have} no prior knowledge",
        }[self.knowledge]


@dataclass(frozen=True)
class Harm:
    """An observer whose error is as large as the disturbance itself, or larger.

    worse               : whether it is significantly larger
    at_known, at_others : shares of its error's variance at the lines that it is told, and at those that it is not
    cause, share        : largest term of its error budget, and its part of the whole; empty where the budget is not known
    """

    place: Contender
    worse: bool
    at_known: float
    at_others: float
    cause: str = ""
    share: float = 0.0

    @property
    def observer(self) -> str:
        """Whose it is."""
        return self.place.observer


@dataclass(frozen=True)
class Verdict:
    """What the scores of one target and mode amount to.

    places : observers that can be the best, the smallest error first
    lines  : how many lines the vibration has; 0 where that is not known
    harms  : observers that are worse than no estimate, the worst first
    seeds  : over how many records of the scenario
    source : where the prior of the observers comes from
    """

    target: str
    mode: str
    places: tuple[Contender, ...]
    lines: int
    harms: tuple[Harm, ...]
    seeds: int = 1
    source: PriorSource = TRUE

    @property
    def best(self) -> Contender:
        """The one with the smallest error."""
        return self.places[0]

    @property
    def ties(self) -> tuple[str, ...]:
        """Observers whose errors are equal to the smallest."""
        return tuple(place.observer for place in self.places[1:] if place.is_tie)

    @property
    def named_places(self) -> tuple[Contender, ...]:
        """Places named in the sentences, in order of increasing error."""
        return tuple(place for place in self.places if place.observer in (*self._best_places, *ALWAYS))

    @property
    def _best_places(self) -> dict[str, Contender]:
        """Best place for each kind of prior knowledge, and overall, by observer."""
        of_kind = (place for kind in (NOTHING, PEAKS) if (place := self.best_with(kind)))
        return {place.observer: place for place in (*of_kind, self.best)}

    def best_with(self, *knowledge: str) -> Contender | None:
        """Return the best of those with these kinds of prior knowledge (`prior_knowledge`); None where there is none."""
        return next((place for place in self.places if place.knowledge in knowledge), None)

    def sentences(self, scale: float = 1e3, unit: str = "nm") -> list[str]:
        """Write the best with each kind of prior knowledge and the limit, then the observers of the paper, then the harms.

        scale : from micrometres to the unit
        """
        chosen = self._best_places
        equal = [place.name for place in self.places[1:] if place.is_tie and place.observer not in chosen]
        parts = []
        for place in chosen.values():
            words, heading = [place.with_error(scale, unit)], HEADINGS[place.knowledge]
            if place.knowledge == PEAKS and place.n_peaks < self.lines:
                heading = f"With {place.n_peaks} of {self.lines} peak frequencies known"
            elif place.knowledge in (PEAKS, TRUE_SPECTRA) and self.source != TRUE:
                heading = heading.replace("known", self.source)
            if place is not self.best:
                words += ["statistically equal to the best"] * place.is_tie
            else:
                if place.above_limit is not None and place.limit is not None:
                    words.append(f"{_where(place.above_limit)} the theoretical limit using {USING[place.limit[1]]}")
                if equal:
                    shown = equal if len(equal) <= MOST + 1 else [*equal[:MOST], f"{len(equal) - MOST} others"]
                    words.append(f"statistically equal to {_join(shown)}")
            parts.append(f"{heading}: {', '.join(words)}.")
        over = f", over {self.seeds} seeds" if self.seeds > 1 else ""
        others = {place.observer: place for place in self.places if place.observer in ALWAYS and place.observer not in chosen}
        groups: dict[tuple[object, ...], list[Harm]] = {}
        for harm in self.harms:
            others.pop(harm.observer, None)
            groups.setdefault((harm.worse, harm.place.knowledge_clause(self.lines), harm.cause), []).append(harm)
        return [
            f"{target_title(self.target)}, {self.mode}{over}. {' '.join(parts)}",
            *([" ".join(f"{place.with_error(scale, unit)}." for place in others.values())] if others else []),
            *(self._harm_sentence(of, scale, unit) for of in groups.values()),
        ]

    def _harm_sentence(self, harms: Sequence[Harm], scale: float, unit: str) -> str:
        """Write a sentence for observers that know the same and fail for the same reason; shares are the mean of theirs."""
        several, first = len(harms) > 1, harms[0]
        be, their, models = ("are", "their", "models") if several else ("is", "its", "model")
        names = _join([h.place.with_error(scale, unit) if h.observer in ALWAYS else row_label(h.observer) for h in harms])
        known, others, share = np.mean([(h.at_known, h.at_others, h.share) for h in harms], axis=0).tolist()
        reason = ""
        if first.cause:
            percent = round(100.0 * share)
            reason = f"; {f'{percent} %' if percent < 100 else 'all'} of {their} error comes from {CAUSES[first.cause]}"
        elif self.lines:
            shares = {"at the peaks": known + others}
            if first.place.knowledge in (PEAKS, ONE_PEAK):
                shares = {f"at peaks that are not in {their} {models}": others, f"at peaks in {their} {models}": known}
            shares["away from the peaks"] = 1.0 - known - others
            where, share = max(shares.items(), key=lambda item: item[1])
            reason = f"; {100.0 * share:.0f} % of {their} error lies {where}"
        knowledge = first.place.knowledge_clause(self.lines, several)
        return f"{names} {be} {'worse' if first.worse else 'no better'} than assuming no {self.target}: {knowledge}{reason}."


def verdict(
    scenario: Scenario,
    record: Record,
    estimates: Sequence[Estimate],
    scores: Sequence[Score],
    target: str,
    mode: str,
    *,
    simulation: Scenario | None = None,
    evidence: Evidence | None = None,
    budgets: Sequence[Budget] = (),
    source: PriorSource = TRUE,
) -> Verdict | None:
    """Return the verdict on one target and mode, None where nothing can be compared or there is no truth.

    Of a record without truth the target PREDICTION has one: on errors of predicting the next measurement.

    scenario   : what the observers' priors were made from
    simulation : what the record was made from, so that the lines of the vibration are known
    evidence   : errors over several seeds, on which the verdict then rests; where the errors lie is that of the record
    budgets    : error budgets of the record, from which it is said why an observer does harm (`explain_harm`)
    source     : where the prior of the observers comes from
    """
    found, truth = evidence or gather_evidence([scores]), None if target == PREDICTION else record.truth(target)
    ranked = found.ranking(target, mode)
    if not ranked or (truth is None and target != PREDICTION) or not found.truths[ranked[0], target, mode].mean() > 0:
        return None
    column = [m.name for m in scenario.modes].index(mode)
    lines = () if simulation is None else tuple(line[0] for line in vibration_lines(simulation, column))
    of = {s.observer: s for s in scores if (s.target, s.mode) == (target, mode)}
    places = {place.observer: place for place in contenders(scenario, found, scores, target, mode, lines)}
    explained = {b.observer: b for b in budgets if (b.target, b.mode) == (target, mode) and b.terms}
    values = {e.observer: e.values[:, column] for e in estimates if e.target == target}
    harms = []
    for name, worse in found.harmful(target, mode).items() if truth is not None else ():
        start, stop = of[name].start, of[name].stop
        assert truth is not None and start is not None and stop is not None
        error = (values[name] - truth[:, column])[round(start / record.dt) : round(stop / record.dt)]
        shares = _shares(error, record.dt, lines, given_lines(scenario, name, column))
        parts = explained[name].shares if name in explained else {"": 0.0}
        cause = max(parts, key=parts.__getitem__)
        harms.append(Harm(places[name], worse, *shares, cause, parts[cause]))
    return Verdict(target, mode, tuple(places.values()), len(lines), tuple(harms), found.n_seeds, source)


def contenders(
    scenario: Scenario, evidence: Evidence, scores: Iterable[Score], target: str, mode: str, lines: Sequence[float] = ()
) -> tuple[Contender, ...]:
    """Return the observers that can be the best, the smallest error first.

    scores : of one record, which have the bounds;  lines : frequencies of the vibration [Hz], empty where they are not known
    """
    column = [m.name for m in scenario.modes].index(mode)
    bounds = {s.observer: s.rms for s in scores if (s.target, s.mode) == (target, mode) and s.observer in BOUNDS}
    ranked, leaders, out = evidence.ranking(target, mode), evidence.leaders(target, mode), []
    smallest = min((float(evidence.errors[name, target, mode].mean()) for name in ranked), default=0.0)
    for name in ranked:
        given, bound = given_lines(scenario, name, column), JOINT_BOUNDS.get(name, BOUND_BOTH)
        n_peaks = min(int(is_near(np.array(lines), given).sum()), len(given)) if lines else len(given)
        mean, interval = float(evidence.errors[name, target, mode].mean()), evidence.interval((name, target, mode))
        limit = (bounds[bound], bound) if bound in bounds else None
        is_tie = name in leaders and mean <= (1.0 + EQUAL) * smallest
        out.append(Contender(name, mean, interval, is_tie, prior_knowledge(name), n_peaks, limit))
    return tuple(out)


def explain_harm(result: Result, mode: str | None = None) -> list[Budget]:
    """Return the error budgets of the observers that do harm, of those that are as fast as a Kalman filter.

    result : of a record that was simulated from its scenario; mode : by default all
    """
    of = [s for s in result.scores if s.target in TARGETS and mode in (None, s.mode)]
    harmful = {s.observer for s in of if s.rms >= s.truth_rms}
    chosen = [o.id for o in OBSERVERS.values() if o.id in harmful and o.linear and o.seconds is None]
    try:
        return error_budget(result, observers=chosen, mode=mode)
    except ValueError:
        return []


def _shares(error: Array, dt: float, lines: Sequence[float], given_lines: Sequence[float]) -> tuple[float, float]:
    """Shares of an error's variance at the lines [Hz] that an observer is given, and at the others."""
    frequency, density = psd(error[~np.isnan(error)][:, None], dt)
    total = density.sum()
    if not total > 0:
        return 0.0, 0.0
    at_lines, known = is_near(frequency, lines), is_near(frequency, given_lines)
    return float(density[at_lines & known].sum() / total), float(density[at_lines & ~known].sum() / total)


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
            n_equal = sum(place.is_tie and place.above_limit == 0.0 for place, _ in best)
            parts.append(
                f"{HEADINGS[kind]}: smallest error of "
                f"{', '.join(f'{name} in {n}' for name, n in counts)} of {len(best)} scenarios"
                f", {_format_number(min(errors))} to {_format_number(max(errors))} {unit}"
                f"{f', at the theoretical limit in {n_equal}' if n_equal else ''}."
            )
    return " ".join(parts)


def _where(above: float) -> str:
    """Say where an error is that is above the limit by a share, NaN where that is not known.

    >>> _where(0.123), _where(-0.5), _where(0.001), _where(float("nan"))
    ('12 % above', '50 % below', 'at', 'possibly at')
    """
    if isnan(above):
        return "possibly at"
    percent = round(100.0 * above)
    return f"{abs(percent)} % {'above' if percent > 0 else 'below'}" if percent else "at"


def _join(names: Sequence[str]) -> str:
    """Write names as a list in a sentence.

    >>> _join(["LGS KF", "Ridge", "Multi-peak KF"])
    'LGS KF, Ridge and Multi-peak KF'
    >>> _join(["LQG, multi-rate KF", "LQG, LGS KF", "4 others"])
    'LQG, multi-rate KF; LQG, LGS KF and 4 others'
    """
    between = "; " if any("," in name for name in names) else ", "
    return " and ".join(filter(None, (between.join(names[:-1]), names[-1])))


def _format_number(x: float) -> str:
    """Return three digits of a number.

    >>> _format_number(14.96), _format_number(0.5), _format_number(120.4), _format_number(1234.0)
    ('15.0', '0.500', '120', '1234')
    """
    return f"{x:#.3g}".rstrip(".") if x < 999.5 else f"{x:.0f}"
