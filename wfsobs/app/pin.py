"""A run kept for comparison: its scores, its spectra, and its traces as finely as they are ever looked at."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import param
from numpy.typing import NDArray

from wfsobs.app.style import observers_of
from wfsobs.app.views.envelope import envelope, envelope_times
from wfsobs.app.work import TRUTH, Key, RunResults, SignalAndError
from wfsobs.evaluation.scores import Score
from wfsobs.observers.base import TARGETS
from wfsobs.scenario import Scenario
from wfsobs.settings.group import Group
from wfsobs.settings.parameters import unit_of

Array = NDArray[np.float64]

KEPT = 10_000
"""Pairs of extremes kept of a line: every sample of a record of 20 s."""

NAMED = 3
"""How many differing settings are written out."""


@dataclass(frozen=True)
class Pin:
    """What is kept of a run. times [s]; signals, errors: (times, modes) [um]."""

    scenario: Scenario
    scores: tuple[Score, ...]
    spectra: Mapping[Key, SignalAndError]
    times: Array
    signals: Mapping[Key, NDArray[np.float32]]
    errors: Mapping[Key, NDArray[np.float32]]

    def score(self, observer: str, target: str, mode: str) -> Score | None:
        """Find the score of one observer, target and mode; None if there is none."""
        return next((s for s in self.scores if (s.observer, s.target, s.mode) == (observer, target, mode)), None)


def pin(results: RunResults) -> Pin:
    """Keep what is compared of the results shown."""
    signals: dict[Key, NDArray[np.float32]] = {}
    errors: dict[Key, NDArray[np.float32]] = {}
    for target in TARGETS:
        truth = results.values(TRUTH, target)
        for name in (TRUTH, *observers_of(target)):
            values = results.values(name, target)
            if values is not None:
                signals[name, target] = _thin(values)
                if truth is not None and name != TRUTH:
                    errors[name, target] = _thin(values - truth)
    record = results.result.record
    times = envelope_times(0, record.n_steps, KEPT, record.dt)
    return Pin(results.scenario, results.result.scores, dict(results.spectra), times, signals, errors)


def _thin(values: Array) -> NDArray[np.float32]:
    return np.column_stack([envelope(column, KEPT) for column in values.T]).astype(np.float32)


def differences(before: Scenario, now: Scenario) -> list[str]:
    """List the differences between two scenarios, one setting each, in words.

    >>> differences(Scenario(), Scenario().replace({"turbulence.wind_speed": 20}))
    ['Wind speed V₀ 15 → 20 m/s']
    """
    tree = now.difference(before)
    labels = Counter(str(p.label) for _, _, p in now.walk())
    return _differences(before, now, tree, labels, "")


def _differences(before: Group, now: Group, tree: Mapping[str, Any], labels: Counter[str], above: str) -> list[str]:
    out: list[str] = []
    for name in tree:
        p, old, new = now.settings()[name], getattr(before, name), getattr(now, name)
        if isinstance(new, Group):
            out += _differences(old, new, tree[name], labels, str(p.label))
            continue
        label = f"{above}: {p.label}" if labels[str(p.label)] > 1 else str(p.label)
        out.append(f"{label} {_change(p, old, new)}")
    return out


def _change(p: param.Parameter, old: Any, new: Any) -> str:
    """Two values of a setting; of lists only that they differ."""
    if isinstance(new, list):
        return "changed"
    if isinstance(new, bool) or not isinstance(new, (int, float)):
        return f"{_word(old)} → {_word(new)}"
    unit = unit_of(p).replace("um", "µm")
    return f"{old:.6g} → {new:.6g} {unit}".rstrip()


def _word(value: Any) -> str:
    return {True: "on", False: "off"}[value] if isinstance(value, bool) else str(value)


def name_of_difference(before: Scenario, now: Scenario) -> str:
    """Name a pinned run by the settings in which the present one differs."""
    words = differences(before, now)
    if not words:
        return "the same settings"
    more = f" and {len(words) - NAMED} more" if len(words) > NAMED else ""
    return ", ".join(words[:NAMED]) + more
