"""The records of a tuning: training, validation and test, which share nothing.

From a scenario they are simulated. Training and test are what `wfsobs run` has, from `run.seed`; the validation record has a
stream of its own, SeedSequence([run.seed, 1]), from which nothing else is drawn. From telemetry they are pieces of the
record in the order of time, with a gap between.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from wfsobs.evaluation.scores import PREDICTION
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS, VIBRATION
from wfsobs.observers.baselines import open_loop_reference
from wfsobs.observers.missing import fill_missing
from wfsobs.prior import Model
from wfsobs.priors_from.scenario import bands_of, observer_settings, prior_of
from wfsobs.progress import Watch
from wfsobs.record import Record, RecordError, Training, delay_signal, frame_mean
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import TRAINING_MARGIN, simulate
from wfsobs.tuning.space import Space
from wfsobs.typing import Array

VALIDATION, DESIGN = 1, 2
"""Beside `run.seed`, the streams of the validation record and of the search."""

SHARES = {True: (0.4, 0.3, 0.3), False: (0.0, 0.5, 0.5)}
"""Parts of telemetry for training, validation and test, where a training record is needed and where not."""
GAP = 1.0
"""Left out between them [s]: the slowest vibrations are forgotten, and more than a window of the paper's."""
SHORTEST = 1.0
"""What is left of validation and test after the warm-up, at least [s]."""

TRUTH, NEXT, REFERENCE = "the truth", "the next measurement of the LGS", "the zero-phase Butterworth reference"
"""What an estimate is compared with."""
WORST, P95 = "the worst plant", "95 % of the plants"
"""Where a controller is scored."""

MEASURES = {
    TRUTH: "RMS error",
    NEXT: "RMS one-step prediction error of z",
    REFERENCE: "RMS distance to the zero-phase Butterworth reference",
    WORST: "Largest RMS of the plants",
    P95: "RMS that 95 % of the plants do not exceed",
}
"""What the numbers of a tuning are, by what an estimate is compared with or where a controller is scored."""

LENGTHS = ("gpr_offline.training_size", "gpr_offline.depth")
"""Settings of which a training record is longer."""


@dataclass(frozen=True)
class Records:
    """The records of a tuning.

    Attributes
    ----------
    validation : Record
        The record of the search, training record included.
    test : callable
        Scenario -> the record that it is scored on, once before and once after.
    target : str
        Target of the errors: "turbulence", "vibration" or PREDICTION.
    against : str
        What stands for the truth, in words.
    """

    validation: Record
    test: Callable[[Scenario], Record]
    target: str
    against: str = TRUTH


def stream(scenario: Scenario, purpose: int) -> np.random.Generator:
    """Return a random stream of a tuning, independent of those of the scenario's own record."""
    return np.random.default_rng([scenario.run.seed, purpose])


def simulate_records(scenario: Scenario, space: Space, target: str, duration: float | None, watch: Watch) -> Records:
    """Simulate the records of a tuning; duration: of the validation record [s], by default that of the scenario.

    Where the search changes the lengths of windows or training set, its training record is as long as the largest
    need. Those of the test are as long as in `wfsobs run`.
    """
    made: dict[tuple[int, int], Record] = {}

    def record_of(s: Scenario) -> Record:
        key = (s.gpr_offline.training_size, s.gpr_offline.depth)
        if key not in made:
            made[key] = simulate(s, watch=watch)
        return made[key]

    largest = scenario.replace({a.path: int(a.high) for a in space.axes if a.path in LENGTHS})
    short = scenario if duration is None else scenario.replace({"run.duration": duration})
    short.validate()
    validation = simulate(short, rng=stream(scenario, VALIDATION), watch=watch)
    return Records(replace(validation, training=record_of(largest).training), record_of, target)


def judged_by(record: Record, observer: str, target: str) -> tuple[str, str]:
    """Return the target of the errors on a record, and what stands for the truth where the record has none.

    An observer of turbulence and vibration together is scored by its prediction of the next z of the LGS, which has all their
    errors; one of vibration alone by the zero-phase Butterworth reference of the piece. Raises RecordError for one that is
    better than the LGS, and for one of turbulence alone.
    """
    if record.truth(target) is not None:
        return target, TRUTH
    of_both = set(OBSERVERS[observer].targets) == set(TARGETS)
    if "y_ngs" in OBSERVERS[observer].needs or not (of_both or target == VIBRATION):
        raise RecordError(f"{observer}: cannot be tuned on a record without truth, which holds no reference for it")
    return (PREDICTION, NEXT) if of_both else (target, REFERENCE)


def cut_record(record: Record, scenario: Scenario, observer: str, target: str) -> Records:
    """Cut telemetry into pieces for training, validation and test.

    Raises RecordError where there is nothing to compare with, and where the record is too short.
    """
    target, against = judged_by(record, observer, target)
    entry = OBSERVERS[observer]
    learns = Training in entry.parts(observer_settings(entry, scenario))
    cuts = _cuts(record, scenario, learns and record.training is None)
    training, validation, test = (piece(record, start, stop) for start, stop in cuts)
    known = record.training or (Training(training.y_lgs, training.u, training.open_loop_y) if learns else None)
    validation, test = (replace(r, training=known) for r in (validation, test))
    if against == REFERENCE:
        validation, test = (replace(r, vibration=reference(r, scenario)) for r in (validation, test))
    return Records(validation, lambda _: test, target, against)


def _cuts(record: Record, scenario: Scenario, learns: bool) -> list[tuple[int, int]]:
    """(first step, step after the last) of training, validation and test; every piece begins where an NGS frame could."""
    n, per = record.n_steps, record.ratio or 1
    gap = round(GAP / record.dt)
    ends = np.cumsum(SHARES[learns]) * n
    out, start = [], 0
    for end in ends:
        out.append((start, int(end)))
        start = -(-(int(end) + gap * (end > 0)) // per) * per
    g = scenario.gpr_offline
    needed = g.training_size + g.depth + round(TRAINING_MARGIN / record.dt) if learns else 0
    scored = round((scenario.run.warm_up + SHORTEST) / record.dt)
    if out[0][1] < needed or min(stop - start for start, stop in out[1:]) < scored:
        least = max(needed / SHARES[learns][0] if learns else 0, (scored + gap + per) / SHARES[learns][2])
        raise RecordError(f"the record has {n * record.dt:.1f} s; tuning needs {least * record.dt:.1f} s or more")
    return out


def piece(record: Record, start: int, stop: int) -> Record:
    """Return steps start ... stop - 1 as a record of its own, with the same z. `start` must be a multiple of the ratio.

    A record begins with the mirror at rest; so the effect of older commands is subtracted from the measurements.
    """
    u = record.u[start:stop]
    y_ngs = None
    if record.y_ngs is not None and record.ratio is not None:
        y_ngs = record.z_ngs[start:stop] + frame_mean(delay_signal(u, record.delay - 1), record.ratio)
        y_ngs[:1] = np.nan  # a frame that began before the piece

    def part(x: Array | None) -> Array | None:
        return None if x is None else x[start:stop]

    return replace(
        record,
        y_lgs=record.z[start:stop] + delay_signal(u, record.delay),
        u=u,
        y_ngs=y_ngs,
        turbulence=part(record.turbulence),
        vibration=part(record.vibration),
        open_loop_y=part(record.open_loop_y),
        lgs_stars=part(record.lgs_stars),
        y_stars=None if record.y_stars is None else record.z_stars[start:stop] + delay_signal(u, record.delay)[:, None],
    )


def reference(record: Record, scenario: Scenario) -> Array:
    """Return the zero-phase Butterworth reference of a record, (n_steps, n_modes) [um], NaN where a measurement is missing."""
    whole = fill_missing(record.without_outliers, prior_of(scenario, record, (Model,)))
    twin = whole.z if whole.open_loop_y is None else whole.open_loop_y
    return np.where(np.isnan(record.z), np.nan, open_loop_reference(bands_of(scenario), twin, record.dt))
