"""The records and the search space of a tuning.

Training, validation and test records share nothing. From a scenario they are simulated. Training and test are what `wfsobs run`
has, from `run.seed`; the validation record has a stream of its own, SeedSequence([run.seed, 1]), from which nothing else is
drawn. From telemetry they are pieces of the record in the order of time, with a gap between.

The search space has the tuned settings of an observer or controller, their ranges and scales. The world (turbulence, vibration,
sensors, loop) is not tuned.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import param

from wfsobs.control.base import Controller
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.laws import best_gain
from wfsobs.evaluation.scores import PREDICTION
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS, VIBRATION, Observer, Tunable
from wfsobs.observers.baselines import open_loop_reference
from wfsobs.observers.missing import fill_missing
from wfsobs.prior import Model
from wfsobs.priors_from.controllers import plant_of
from wfsobs.priors_from.scenario import bands_of, measurement_noise, observer_settings, prior_of, told_spectra
from wfsobs.progress import Watch
from wfsobs.record import Record, RecordError, Training, delay_signal, frame_mean
from wfsobs.registry import name_list
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError
from wfsobs.simulation.disturbance import turbulence_process, vibration_lines, vibration_variance
from wfsobs.simulation.layers import relative_rms
from wfsobs.simulation.loop import TRAINING_MARGIN, simulate
from wfsobs.simulation.true_spectra import true_spectra
from wfsobs.typing import Array

FROM_ZERO = 1e-3
"""A range that begins at 0 is searched from this part of its end."""
DIGITS = 6
"""Digits of a number that is tried, more than matter."""


@dataclass(frozen=True)
class Axis:
    """One setting that is tuned: its dotted path, its range, and whether it takes whole numbers.

    A range above 0 is searched by the logarithm, one of whole numbers from 0 evenly; 0 and 1 are its ends.
    """

    path: str
    low: float
    high: float
    whole: bool

    def value(self, x: float) -> float:
        """Return the number at x, from 0 to 1."""
        low, high = self._to_scale(self.low), self._to_scale(self.high)
        value = low + (high - low) * x
        value = float(f"{np.exp(value) if self.low > 0 else value:.{DIGITS}g}")
        return min(max(round(value) if self.whole else value, self.low), self.high)

    def place(self, value: float) -> float:
        """Where a number is, from 0 to 1; what lies outside is at an end."""
        low, high = self._to_scale(self.low), self._to_scale(self.high)
        inside = self._to_scale(min(max(value, self.low), self.high))
        return (inside - low) / (high - low) if high > low else 0.0

    def _to_scale(self, value: float) -> float:
        return float(np.log(value)) if self.low > 0 else value


@dataclass(frozen=True)
class Space:
    """The axes, and the settings that go with them: what has to be set by hand so that they count, numbers as they were."""

    axes: tuple[Axis, ...]
    by_hand: dict[str, Any]

    def changes(self, point: Array) -> dict[str, Any]:
        """Return the settings (dotted path -> value) at a point (len(axes),) of the unit cube."""
        return {**self.by_hand, **{a.path: a.value(float(x)) for a, x in zip(self.axes, point, strict=True)}}

    def values(self, scenario: Scenario) -> dict[str, float]:
        """Dotted path -> number that a scenario has for every axis."""
        return {a.path: self.by_hand.get(a.path, scenario.lookup(a.path)) for a in self.axes}

    def start(self, scenario: Scenario) -> Array:
        """Where a scenario is in the unit cube."""
        now = self.values(scenario)
        return np.array([a.place(now[a.path]) for a in self.axes])


def space(
    scenario: Scenario, name: str, names: Sequence[str] | None = None, of: Mapping[str, Observer | Controller] = OBSERVERS
) -> Space:
    """Return the search space of an observer, or of a controller: its usual settings, or those named.

    A range is that of the sliders (soft bounds), wide enough for the scenario's own number.
    Raises SettingError for a name that is no setting, is not one number, or is not used by the observer.
    """
    kind = "controller" if of is CONTROLLERS else "observer"
    if name not in of:
        raise SettingError(f"{kind} {name!r}: no such {kind}; there are {', '.join(of)}")
    known = of[name].tunable
    if not known.usual:
        raise SettingError(f"{kind} {name!r}: has no settings to tune")
    chosen = tuple(known.usual if names is None else name_list(names) or ())
    if not chosen:
        raise SettingError("names: takes one setting or more")
    for i, path in enumerate(chosen):
        _check(scenario, name, known, path)
        if path in chosen[:i]:
            raise SettingError(f"{path}: is given twice")
    by_hand = {}
    for switch, (paths, matched) in BY_HAND.items():
        if set(paths) & set(chosen) and scenario.lookup(switch) != "manual":
            by_hand |= {
                switch: "manual",
                **{p: _clip_to_limits(scenario, p, v) for p, v in zip(paths, matched(scenario), strict=True)},
            }
    gain_from = by_hand.get("control.integrator", scenario.control.integrator)
    if name == "integrator" and "control.caution" in chosen and gain_from == "manual":
        raise SettingError("control.caution: has no effect on an integrator while control.integrator = manual")
    return Space(tuple(_axis(scenario, path, by_hand.get(path, scenario.lookup(path))) for path in chosen), by_hand)


def _check(scenario: Scenario, of: str, tunable: Tunable, path: str) -> None:
    usual, others = tunable
    settings = {name: p for name, _, p in scenario.walk()} | dict(scenario.lists())
    if path not in settings:
        raise SettingError(f"{path}: no such setting")
    if not isinstance(settings[path], param.Number):
        raise SettingError(f"{path}: cannot be tuned, it is not a single number")
    if path not in (*usual, *others):
        raise SettingError(f"{path}: not a setting of {of} that can be tuned; there are {', '.join((*usual, *others))}")
    group, _, name = path.rpartition(".")
    if name == "highpass" and (way := scenario.lookup(f"{group}.inputs_filter")) != "high-pass":
        raise SettingError(f"{path}: has no effect while {group}.inputs_filter = {way}")


def _clip_to_limits(scenario: Scenario, path: str, value: float) -> float:
    p: Any = scenario.parameter(path)
    low, high = map(float, p.bounds)
    return min(max(float(f"{value:.{DIGITS}g}"), low), high)


def _axis(scenario: Scenario, path: str, start: float) -> Axis:
    p: Any = scenario.parameter(path)
    low, high = map(float, p.get_soft_bounds())
    if low == 0 and not isinstance(p, param.Integer):
        low = FROM_ZERO * high
    return Axis(path, min(low, start) if start > 0 else low, max(high, start), isinstance(p, param.Integer))


def _process(scenario: Scenario) -> tuple[float, float]:
    """Strength of turbulence and of vibration in tip and tilt that "matched" gives, rms [um]."""
    tip_tilt = [i for i, mode in enumerate(scenario.modes) if mode.radial_order == 1]
    variance = np.mean([vibration_variance(scenario, mode) for mode in tip_tilt])
    return turbulence_process(scenario, 0, scenario.dt).rms / relative_rms(scenario, 0), float(np.sqrt(variance))


def _peak(scenario: Scenario) -> tuple[float, float]:
    """Frequency and damping of the line that is the strongest of all modes: set by hand it is one for all of them."""
    lines = [line for mode in range(len(scenario.modes)) for line in vibration_lines(scenario, mode)]
    default = (scenario.kalman.frequency, scenario.kalman.damping, 0.0)
    frequency, damping, _ = max(lines, key=lambda line: line[2], default=default)
    return frequency, damping


def _noise(scenario: Scenario) -> tuple[float, float]:
    """Noise of LGS and NGS that "matched" gives, rms over the modes [um]: set by hand it is one number for all of them."""
    each = np.array([measurement_noise(scenario, mode) for mode in range(len(scenario.modes))])
    lgs, ngs = np.sqrt(np.mean(each**2, axis=0)).tolist()
    return lgs, ngs


def _gain(scenario: Scenario) -> tuple[float]:
    """Optimal gain of the integrator, less its caution, mean over the modes: set by hand it is one for all of them."""
    mirror, c = plant_of(scenario).mirror, scenario.control
    spectra = (told_spectra(true_spectra(scenario, mode)) for mode in range(len(scenario.modes)))
    return (float(np.mean([best_gain(one, mirror, c.leak) for one in spectra])) / c.caution,)


BY_HAND: dict[str, tuple[tuple[str, ...], Callable[[Scenario], tuple[float, ...]]]] = {
    "control.integrator": (("control.gain",), _gain),
    "kalman.peak": (("kalman.frequency", "kalman.damping"), _peak),
    "kalman.process_noise": (("kalman.turbulence_rms", "kalman.vibration_rms"), _process),
    "kalman.measurement_noise": (("kalman.lgs_noise", "kalman.ngs_noise"), _noise),
    "multirate.measurement_noise": (("multirate.lgs_noise", "multirate.ngs_noise"), _noise),
}
"""Settings that say "matched" or "optimised", the numbers that count once they say "manual", and what those are until then."""


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
    try:
        short = scenario if duration is None else scenario.replace({"run.duration": duration})
        short.validate()
    except SettingError as error:
        raise SettingError(f"validation = {duration:g}: {error}") from None
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

    seen = delay_signal(u, record.delay)
    y_stars = None if record.y_stars is None else record.z_stars[start:stop] + seen[:, None]
    others = ("turbulence", "vibration", "open_loop_y", "lgs_stars")
    parts = {name: x[start:stop] for name in others if (x := getattr(record, name)) is not None}
    return replace(record, y_lgs=record.z[start:stop] + seen, u=u, y_ngs=y_ngs, y_stars=y_stars, **parts)


def reference(record: Record, scenario: Scenario) -> Array:
    """Return the zero-phase Butterworth reference of a record, (n_steps, n_modes) [um], NaN where its measurement is missing."""
    seen = record.without_outliers
    whole = fill_missing(seen, prior_of(scenario, record, (Model,)))
    gaps, twin = (x.z if x.open_loop_y is None else x.open_loop_y for x in (seen, whole))
    out = open_loop_reference(bands_of(scenario), twin, record.dt)
    out[:-1][np.isnan(gaps[1:])] = np.nan  # the measurement of step k + 1 sees step k
    return out
