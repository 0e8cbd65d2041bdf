"""What an observer knows before it measures, and which lines of the vibration."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from wfsobs.evaluation.scores import BOUNDS, LOOP
from wfsobs.observers import OBSERVERS
from wfsobs.prior import TRUE, Bands, Lines, Model, Part, PriorSource, Training, asks_for
from wfsobs.priors_from.scenario import modelled_peak
from wfsobs.scenario import Scenario
from wfsobs.simulation.disturbance import vibration_lines
from wfsobs.typing import Array

HALF_WIDTH = 1.5
"""What counts as at a line [Hz] to either side, three bins of a spectrum with 0.5 Hz."""


PEAKS, ONE_PEAK, TRAINED, BANDS, SPECTRA, NOTHING = "peaks", "one peak", "training data", "bands", "spectra", "nothing"
"""Kinds of prior knowledge: the frequencies of peaks, a model with one, training data, frequency bands, the spectra, and none."""

_KINDS: tuple[tuple[Part, str], ...] = ((Lines, PEAKS), (Model, ONE_PEAK), (Training, TRAINED), (Bands, BANDS))


def prior_knowledge(observer: str) -> str:
    """Return which kind of prior knowledge an observer has.

    >>> prior_knowledge("kf-multi"), prior_knowledge("kf-lgs"), prior_knowledge("kf-adaptive")
    ('peaks', 'one peak', 'nothing')
    """
    return knowledge_of(OBSERVERS[observer].prior)


def knowledge_of(prior: Iterable[Part]) -> str:
    """Return which kind of prior knowledge these parts of a prior are."""
    return next((kind for part, kind in _KINDS if asks_for(part, prior)), NOTHING)


def group_by_knowledge(names: Iterable[str], source: PriorSource = TRUE) -> dict[str, list[str]]:
    """Group rows of a table by what they know before they measure: title -> rows, which keep their order.

    source : where the prior of the observers comes from

    >>> group_by_knowledge(["bound", "multirate-multi", "kf-multi", "kf-adaptive"])
    {'Prior knowledge: none': ['kf-adaptive'], 'Prior knowledge: peak frequencies': ['multirate-multi', 'kf-multi'], \
'Theoretical limit, from the true spectra': ['bound']}
    """
    peaks = "peak frequencies" if source == TRUE else f"{source} peak frequencies"
    known = {NOTHING: "none", PEAKS: peaks, ONE_PEAK: "one peak", BANDS: "frequency bands", TRAINED: "training data"}
    titles = {LOOP: "Recorded loop", **dict.fromkeys(BOUNDS, "Theoretical limit, from the true spectra")}
    groups: dict[str, list[str]] = {f"Prior knowledge: {words}": [] for words in known.values()}
    for name in names:
        title = titles.get(name) or f"Prior knowledge: {known[prior_knowledge(name)]}"
        groups.setdefault(title, []).append(name)
    return {title: of for title, of in groups.items() if of}


def given_lines(scenario: Scenario, observer: str, column: int) -> Sequence[float]:
    """Return the frequencies [Hz] of what an observer is given in one mode; scenario : what its prior is made from."""
    kind = prior_knowledge(observer)
    if kind == PEAKS:
        return [line[0] for line in vibration_lines(scenario, column)]
    if kind == ONE_PEAK:
        return [modelled_peak(scenario, column)[0]]
    return scenario.butterworth.frequencies if asks_for(Bands, OBSERVERS[observer].prior) else ()


def is_near(frequency: Array, lines: Sequence[float]) -> Array:
    """Return which frequencies [Hz] are at one of the lines, bool, of the same shape."""
    apart = np.abs(np.asarray(frequency)[:, None] - np.asarray(lines, dtype=float))
    return np.any(apart <= HALF_WIDTH, axis=1)
