"""A run that others are compared with: its scores, its spectra, and its traces as finely as they are ever looked at."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wfsobs.app.sources import LoadedRecord, Step, give_same_record
from wfsobs.app.style import observers_of
from wfsobs.app.work import TRUTH, Key, RunResults, SignalAndError
from wfsobs.evaluation.evidence import Evidence
from wfsobs.evaluation.result import Result, row_label, target_title
from wfsobs.evaluation.scores import Score
from wfsobs.observers.base import TARGETS
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import changed_settings, reference_preset
from wfsobs.scenario.names import preset_title, setting_name, value_of
from wfsobs.signal.envelope import envelope, envelope_times
from wfsobs.typing import Array
from wfsobs.units import unit_text

NAMED = 3
"""How many differing settings are written out."""

SAME = "the same settings"


def name_of_change(before: Step | None, now: Step) -> str:
    """Name a result by what changed against the one before; the first by its preset."""
    scenario, preset, source = now
    words: list[str] = []
    if before is None or preset != before[1]:
        words.append(f"Preset {preset_title(preset)}")
        base = reference_preset(preset)
    else:
        base = before[0]
    if not give_same_record(source, before[2] if before else None):
        named = f"Record {source.name}" if isinstance(source, LoadedRecord) else "Simulation kept"
        words.append("Simulation of the settings" if source is None else named)
    if isinstance(source, LoadedRecord) and before is not None and words:  # it brings its rate and length with it
        return ", ".join(words)
    changed = differences(base, scenario)
    return ", ".join([*words, *([join_differences(changed)] if changed else [])]) or SAME


def differences(before: Scenario, now: Scenario) -> list[str]:
    """List the differences between two scenarios, one setting each, in words.

    >>> differences(Scenario(), Scenario().replace({"turbulence.wind_speed": 20}))
    ['Wind speed V₀ 15 → 20 m/s']
    >>> peaks = Scenario().vibration.peaks
    >>> differences(Scenario(), Scenario().replace({"vibration.peaks": peaks[1:]}))
    ['Peak 1 removed']
    """
    lists = dict(now.lists())
    return [
        line
        for path in changed_settings(now, before)
        for line in (_item_changes(before, now, path) if path in lists else [_change(before, now, path)])
    ]


def _item_changes(before: Scenario, now: Scenario, path: str) -> list[str]:
    """Name the one item of a list that came, went or changed, and its settings that did; else only that the list changed."""
    old, new = items = [[item.to_dict() for item in of.lookup(path)] for of in (before, now)]
    longer, shorter = sorted(items, key=len, reverse=True)
    if len(longer) == len(shorter) + 1:
        for at in range(len(longer)):
            if [*longer[:at], *longer[at + 1 :]] == shorter:
                return [f"{setting_name(f'{path}.{at}')} {'added' if longer is new else 'removed'}"]
    changed = [at for at, (a, b) in enumerate(zip(old, new, strict=False)) if a != b]
    if len(old) != len(new) or len(changed) != 1:
        return [f"{setting_name(path)} changed"]
    was, is_now = (_flat(items[changed[0]]) for items in (old, new))
    return [_change(before, now, f"{path}.{changed[0]}.{key}") for key in was if key in is_now and was[key] != is_now[key]]


def _flat(item: Mapping[str, Any]) -> dict[str, Any]:
    """Spread lists of numbers over keys of their own, rms.0 and so on."""
    return {
        (f"{key}.{i}" if isinstance(value, list) else key): part
        for key, value in item.items()
        for i, part in enumerate(value if isinstance(value, list) else [value])
    }


def _change(before: Scenario, now: Scenario, path: str) -> str:
    """Write a setting and its two values; of lists only that they differ."""
    name, old, new = setting_name(path), before.lookup(path), now.lookup(path)
    if isinstance(new, list):
        return f"{name} changed"
    unit = unit_text(now.unit(path))
    return f"{name} {value_of(old)} → {value_of(new)} {unit}".rstrip()


def name_of_difference(before: Scenario, now: Scenario) -> str:
    """Name what has changed since a run by the settings in which the present one differs."""
    return join_differences(differences(before, now)) or SAME


def join_differences(words: Sequence[str]) -> str:
    """Write the first few differences out and count the others.

    >>> join_differences(["a", "b", "c", "d"])
    'a, b, c and 1 more'
    """
    more = f" and {len(words) - NAMED} more" if len(words) > NAMED else ""
    return ", ".join(words[:NAMED]) + more


KEPT = 10_000
"""Pairs of extremes kept of a line: every sample of a record of 20 s."""

LETTERS = "ABCDE"
"""As many runs can be compared with the one shown."""


@dataclass(frozen=True)
class DrawnLines:
    """What is drawn of a run. times [s]; signals, errors: (times, modes) [um]."""

    spectra: Mapping[Key, SignalAndError]
    times: Array
    signals: Mapping[Key, NDArray[np.float32]]
    errors: Mapping[Key, NDArray[np.float32]]


@dataclass(frozen=True)
class ComparedRun:
    """A run beside the one shown.

    key   : of its entry in the history;  letter : what it is called in cards, figures and the table
    lines : what is drawn; None while its traces are being made again
    evidence : its errors over several seeds, where they are known
    """

    key: str
    letter: str
    name: str
    scenario: Scenario
    scores: tuple[Score, ...]
    lines: DrawnLines | None = None
    evidence: Evidence | None = None

    def beside(
        self, scores: Iterable[Score], evidence: Evidence | None, key: tuple[str, str, str], of: str = "rms"
    ) -> tuple[float | None, float | None]:
        """Return the error here and in the result of these scores [um], None where there is none.

        Both are means over the seeds that both have, so that one can be compared with the other.

        evidence : errors of that result over its seeds;  key : observer, target, mode;  of : "rms" or "truth_rms" of a score
        """
        old, new = ((it.errors if of == "rms" else it.truths).get(key) if it else None for it in (self.evidence, evidence))
        if old is not None and new is not None:
            n = min(old.size, new.size)
            return float(old[:n].mean()), float(new[:n].mean())
        here, there = (find_score(it, *key) for it in (self.scores, scores))
        return here and getattr(here, of), there and getattr(there, of)


def find_score(scores: Iterable[Score], observer: str, target: str, mode: str) -> Score | None:
    """Find the score of one observer, target and mode; None if there is none."""
    return next((s for s in scores if (s.observer, s.target, s.mode) == (observer, target, mode)), None)


def thin_lines(results: RunResults) -> DrawnLines:
    """Select what is drawn of results, thinned."""
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
    return DrawnLines(dict(results.spectra), times, signals, errors)


def _thin(values: Array) -> NDArray[np.float32]:
    return np.column_stack([envelope(column, KEPT) for column in values.T]).astype(np.float32)


def comparison_of(runs: Sequence[ComparedRun], result: Result, evidence: Evidence | None) -> dict[str, Any] | None:
    """Return what a report has of compared runs; None where there are none.

    These are the runs, and by the title of a target and mode the rows: what they are of, the error, and the one of every run
    with that of this result over the same seeds [um].

    evidence : errors of the result over several seeds
    """
    if not runs:
        return None
    groups: dict[str, list[tuple[str, float, Any]]] = {}
    for now in result.scores:
        pairs = [run.beside(result.scores, evidence, (now.observer, now.target, now.mode)) for run in runs]
        if any(before is not None for before, _ in pairs):
            rms = (evidence.over_seeds(now) if evidence else now).rms
            groups.setdefault(f"{target_title(now.target)}, {now.mode}", []).append((row_label(now.observer), rms, pairs))
    return {"runs": runs, "groups": groups}
