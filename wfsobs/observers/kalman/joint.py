"""Filters of all modes together on the LGS and on the NGS frames, frame by frame and over a record (`joint_model`).

`kf-asterism` takes every mode from each LGS by itself in all modes. LGS beside the axis see different turbulence, and each tells
something that their mean does not. The prior `Asterism` has the spectra between the target, all modes in every beam and the NGS.

`multirate-coupled` has the mean of the LGS, or what `sensors.lgs_combination` makes of them, in the place of a single star: for
LGS that see the same, and where a record or a loop has them together alone. Where modes tell nothing of one another there is
nothing to couple, and the observer refuses. A measurement of which a mode is missing is none, and so is an NGS frame.

`kf-coupled`, without an NGS, and `multirate-coupled`, with one, are the same filter on one star. Every mode of frozen flow is
estimated from the measurements of all modes: the wind carries what one mode measures into another, and the LGS see through their
narrower beams as one mode what is several.

The weights are those of the LGS that are there, of the NGS alone where none is, and what is stated of the errors is by them. They
are made when a set of LGS, or a number of them in their mean (`LgsStars`), first occurs. The states of one that is out go on with
the measurements that the others predict for it, so that it can come back at any time. One of which a mode is missing is out.
While an NGS frame is lost the weights are those of the frames before it; when the next comes, or after several, the filter of the
frames takes for it what all states told of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from wfsobs.observers.base import TARGETS, Look, Observer
from wfsobs.observers.kalman.filters import PEAKS, TUNABLE_PEAKS, MultiPeak, filter_of_both, vibration_used
from wfsobs.observers.kalman.joint_model import AsterismModel, Beginning, coupled_model, flow_model
from wfsobs.observers.kalman.step import carry_state
from wfsobs.observers.step import Estimator, StepError, run_frames
from wfsobs.prior import Asterism, Flow, FlowOfBoth, LgsStars, Lines, Prior
from wfsobs.progress import Watch
from wfsobs.record import NEXT_Z, TOTAL, Estimates, Measurements, Sampling, by_name
from wfsobs.signal.joint_states import Present
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.typing import Array

PLANS = 64
"""Weights that are kept, of a target, a horizon and a set of LGS each; others are computed anew."""

AWAITED = 4
"""NGS frames that may be lost in a row until what was told of the first of them is taken for it."""

FIRST, WITHOUT = -2, -1
"""Phases of the filter before its first step, and before its first NGS frame."""


class _Bank:
    """Filters of several modes, padded to the longest: F (n_modes, n, n), G, first and is_state (n_modes, n)."""

    def __init__(self, modes: Sequence[Beginning]):
        self.modes, sizes = modes, np.array([len(one.first) for one in modes])
        n = int(sizes.max())
        self.is_state = np.arange(n) < sizes[:, None]
        self.F, (self.G, self.first) = np.zeros((len(modes), n, n)), np.zeros((2, len(modes), n))
        for i, ((F, G), first, _) in enumerate(modes):
            m = len(first)
            self.F[i, :m, :m], self.G[i, :m], self.first[i, :m] = F, G, first

    def begin(self, y: Array) -> Array:
        """Return the state after a first measurement (..., n_modes), (..., n_modes, n)."""
        x = self.first * y[..., None]
        return x + np.where(self.first == 0.0, self.G * y[..., None], 0.0)

    def advance(self, x: Array, y: Array) -> Array:
        """Return the state after a measurement."""
        return (self.F @ x[..., None])[..., 0] + self.G * y[..., None]

    def carry(self, old: _Bank, x: Array) -> Array:
        """Return the states in which disturbances and means are what they are in the states x (..., n_modes, n) of another."""
        out = np.zeros((*x.shape[:-1], self.first.shape[1]))
        for mode, (new, was) in enumerate(zip(self.modes, old.modes, strict=True)):
            if new.model is not None and was.model is not None:
                m, mine = len(was.model.A), x[..., mode, : len(was.first)]
                is_same = np.array_equal(new.model.pairs, was.model.pairs)
                states = mine[..., :m] if is_same else carry_state(new.model, was.model, mine[..., :m].T).T
                out[..., mode, : len(new.first)] = np.concatenate([states, mine[..., m:]], axis=-1)
        return out


class JointEstimator(Estimator):
    """The filter one frame at a time.

    Attributes
    ----------
    x : Array
        States of the LGS: of their mean, then of each difference, (n_lgs, n_modes, n).
    frames : Array
        States of the NGS, (n_modes, n).
    present : tuple of bool
        Which LGS are in the last measurement, (n_lgs,).
    stand_in_frames : Array
        What the states tell of the last NGS frames, where these are lost, the first of them first, (AWAITED, n_modes) [um].
    phase : int
        Steps since the last NGS frame, or what stands for one; WITHOUT before the first that came, FIRST before the first step.
    stars : int
        LGS that the last measurement is the mean over; 0 for all.
    """

    frames: Array
    stand_in_frames: Array
    phase: int
    stars: int = 0

    state_names: tuple[str, ...] = ("x", "frames", "stand_in_frames", "phase", "present", "stars")

    def __init__(self, model: AsterismModel):
        self.model = model
        self._fast, self._slow = _Bank(model.fast), _Bank(model.slow)
        self.x = np.zeros((model.n_stars, *self._slow.first.shape[:1], self._fast.first.shape[1]))
        self.frames, self.stand_in_frames = np.zeros(self._slow.first.shape), np.zeros((AWAITED, len(self._slow.first)))
        late = lru_cache(AWAITED)(model.late)

        def compute(n_lost: int, stars: int, name: str, *details: Any) -> Any:
            return getattr(late(n_lost, stars) if n_lost or stars else model, name)(*details)

        self._of_model = lru_cache(PLANS)(compute)
        self.present: Present = (True,) * model.n_stars
        self.phase = FIRST
        self.mark_start()

    def see_stars(self, count: int | None) -> None:
        """Take the LGS measurement of the next frame for the mean over so many stars; None for all."""
        self.stars = count if count and count < self.model.all_stars else 0

    def advance_each(self, each: Array, ngs: Array | None) -> None:
        """Take the measurement of every LGS, (n_lgs, n_modes) [um], and the NGS frame that is due; NaN is missing."""
        missing = np.isnan(each)
        each = self._complete(each, missing) if missing.any() else each
        self.present = tuple(not any(one) for one in missing)  # of which no mode is missing
        seen = self.model.basis @ each
        if self.phase == FIRST:
            self.x, self.phase = self._fast.begin(seen), WITHOUT
        else:
            self.x: Array = self._fast.advance(self.x, seen)
        if ngs is not None:
            self._take_frame(ngs)
        elif self.phase >= 0:
            self.phase += 1

    def _take_frame(self, ngs: Array) -> None:
        """Take the NGS frame that is due, (n_modes,) [um]."""
        is_lost = bool(np.isnan(ngs).any())
        if self.phase < 0:
            if not is_lost:
                self.frames, self.phase = self._slow.begin(ngs), 0
            return
        given_up = max(self.n_lost - AWAITED + 1, 0) if is_lost else self.n_lost
        for one in self.stand_in_frames[:given_up]:
            self.frames = self._slow.advance(self.frames, one)
        if is_lost:
            n, self.stand_in_frames = self.n_lost - given_up, np.roll(self.stand_in_frames, -given_up, axis=0)
            self.stand_in_frames[n] = self._of_model(n + 1, self.stars, "frame", self.present) @ self.state()
            self.phase = (n + 1) * self.model.ratio
        else:
            self.frames, self.phase = self._slow.advance(self.frames, ngs), 0

    @property
    def n_lost(self) -> int:
        """Number of NGS frames that were due last and did not come, and for which nothing has been taken yet."""
        return max(self.phase, 0) // self.model.ratio

    def _now(self, name: str, *details: Any) -> Any:
        """Return what the model has of that name in this step, for the LGS that are there."""
        found = self._of_model(self.n_lost, self.stars, name, *details, self.present)
        at = self.phase - self.n_lost * self.model.ratio
        return (found[0][at], found[1][at]) if isinstance(found, tuple) else found[at]

    def _complete(self, each: Array, missing: Array) -> Array:
        """Return the measurements with what the last frame predicts in the place of those that are missing.

        In the first frame that is the mean of the other LGS, or zero.
        """
        if self.phase == FIRST:
            there = np.maximum(np.count_nonzero(~missing, axis=0), 1)
            return np.where(missing, np.where(missing, 0.0, each).sum(axis=0) / there, each)
        return np.where(missing, self._now("stand_ins") @ self.state(), each)

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return (mean, sd) of the target."""
        weights, sd = self._now("plan", frames, target)
        return weights @ self.state(), sd

    def estimate(self) -> tuple[Array, Array]:
        """Return the estimates of the last frame, (2, n_modes), and deviations of these, of TOTAL and NEXT_Z, (4, n_modes)."""
        *values, (_, total) = (self.predict(0.0, name) for name in (*TARGETS, TOTAL))
        return np.array([mean for mean, _ in values]), np.array([*(sd for _, sd in values), total, self._now("next_z_sd")])

    def run(self, measurements: Measurements, watch: Watch) -> Estimates:
        """Run the filter over a record from rest: all steps at once where nothing is missing."""
        each, n = self._each_of(measurements), self.model.ratio
        frames = measurements.z_ngs[n::n] if self.model.has_frames else None
        stars = measurements.lgs_stars
        is_fewer = stars is not None and bool((stars < self.model.all_stars).any())
        if is_fewer or np.isnan(each).any() or (frames is not None and np.isnan(frames).any()):
            return run_frames(self, TARGETS, measurements, watch)
        return _run_at_once(self.model, each, frames, watch)

    def _each_of(self, measurements: Measurements) -> Array:
        """Return what it takes of the LGS, (n_steps, n_lgs, n_modes) [um]: all of them together."""
        return measurements.z[:, None]

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        self.advance_each(z[None], ngs)

    def state(self) -> Array:
        """Return all states in the order of the weights, (n_states,)."""
        return np.concatenate([self.x[:, self._fast.is_state].ravel(), self.frames[self._slow.is_state]])

    def take_over(self, old: Any) -> None:
        """Go on from another design. Raises StepError where that has other states."""
        if old.x.shape[:2] != self.x.shape[:2] or old.model.has_frames != self.model.has_frames:
            raise StepError("its states are not those of the other design")
        self.x, self.frames = self._fast.carry(old._fast, old.x), self._slow.carry(old._slow, old.frames)
        self.stand_in_frames[...], self.phase, self.present, self.stars = old.stand_in_frames, old.phase, old.present, old.stars


def _run_at_once(model: AsterismModel, each: Array, frames: Array | None, watch: Watch) -> Estimates:
    """Return the estimates of a record without gaps; frames : None where there are none of an NGS."""
    n, (steps, _, m) = model.ratio, each.shape
    plans = {name: model.plan(0.0, name) for name in (*TARGETS, TOTAL)}
    weights = np.concatenate([plans[name][0] for name in TARGETS], axis=1)
    out, seen, at = np.zeros((steps, 2 * m)), np.einsum("ab,kbi->kai", model.basis, each), 0
    for star in range(model.n_stars):
        for mode, one in enumerate(model.fast):
            watch.step((star * m + mode) / (model.n_stars * m))
            own, y = weights[:, :, at : at + len(one.first)], seen[:, star, mode]
            out[:n] += _outputs(one, y[:n], own[n:])
            out[n:] += _outputs(one, y, own[:n], since=n)
            at += len(one.first)
    for late, y in zip(model.slow, [] if frames is None else frames.T, strict=False):
        own = weights[:n, :, at : at + len(late.first)].reshape(1, n * 2 * m, -1)  # of all steps until the next frame
        out[n:] += _outputs(late, y, own).reshape(-1, 2 * m)[: max(steps - n, 0)]
        at += len(late.first)
    phase = np.where(np.arange(steps) < n, n, np.arange(steps) % n)
    sd = {name: spread[phase] for name, (_, spread) in plans.items()}
    values = by_name(out.reshape(steps, 2, m))
    return Estimates(values, sd | {NEXT_Z: model.next_z_sd((True,) * model.n_stars)[phase]})


def _outputs(one: Beginning, y: Array, weights: Array, *, since: int = 0) -> Array:
    """Return weighted states after every measurement of y (n,), (n - since, p); weights : repeat, (cycle, p, n_states)."""
    if not len(y):
        return np.empty((0, weights.shape[1]))
    F, G = one.filter.F, one.filter.G[:, None]
    steps = [(F, G, W @ F, W @ G) for W in weights]
    return PeriodicFilter(steps).run(y[:, None], one.first * y[0], since=since)


class AsterismEstimator(JointEstimator):
    """The filter on every LGS by itself."""

    _each: Array | None = None

    @property
    def each_shape(self) -> tuple[int, int]:
        """Return (n_lgs, n_modes)."""
        return self.x.shape[0], self.x.shape[1]

    def see_each(self, each: Array) -> None:
        """Take the measurement of every LGS in the next frame, (n_lgs, n_modes) [um]."""
        self._each = each

    def _each_of(self, measurements: Measurements) -> Array:
        return measurements.z_stars

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        assert self._each is not None
        self.advance_each(self._each, ngs)


def kf_asterism(prior: Prior, settings: MultiPeak, sampling: Sampling, _horizon: float) -> AsterismEstimator:
    """Return the filter on every LGS by itself."""
    return AsterismEstimator(AsterismModel(prior, settings, sampling.ratio))


KF_ASTERISM = Observer(
    "kf-asterism",
    "Asterism KF",
    TARGETS,
    help="Kalman filter on each LGS by itself in all modes and the NGS, for frozen flow; not in the paper",
    prior=(Lines, Asterism),
    settings=PEAKS,
    needs=("y_stars", "y_ngs", "ratio"),
    linear=True,
    couples_modes=True,
    sensors=("lgs", "ngs"),
    weight=5.0,
    tunable=TUNABLE_PEAKS,
    look=Look("Asterism", "#923222", "#F5B022", (8, 2, 2, 2)),
    step=kf_asterism,
    counts=vibration_used,
)


def kf_coupled(prior: Prior, settings: MultiPeak, _sampling: Sampling, _horizon: float) -> JointEstimator:
    """Return the filter on the LGS in all modes. Raises ValueError where the prior has no flow."""
    return JointEstimator(flow_model(prior, settings))


def multirate_coupled(prior: Prior, settings: MultiPeak, sampling: Sampling, _horizon: float) -> JointEstimator:
    """Return the filter on all LGS together. Raises ValueError where the prior has no flow."""
    return JointEstimator(coupled_model(prior, settings, sampling.ratio))


KF_COUPLED = Observer(
    "kf-coupled",
    "Coupled KF",
    TARGETS,
    help="Kalman filter on the LGS of all modes together, for frozen flow; not in the paper",
    prior=(Lines, Flow, LgsStars),
    settings=PEAKS,
    linear=True,
    couples_modes=True,
    weight=2.0,
    tunable=TUNABLE_PEAKS,
    look=Look("Coupled", "#D35312", "#D48F4D", (10, 2, 2, 2)),
    step=kf_coupled,
    counts=vibration_used,
)

MULTIRATE_COUPLED = filter_of_both(
    "multirate-coupled",
    "Coupled multi-rate KF",
    TARGETS,
    help="Kalman filter on both sensors in all modes together, for frozen flow; not in the paper",
    prior=(Lines, FlowOfBoth, LgsStars),
    settings=PEAKS,
    couples_modes=True,
    weight=3.0,
    tunable=TUNABLE_PEAKS,
    look=Look("Coupled, both", "#3806FF", "#2C49F5", (10, 2, 4, 2)),
    step=multirate_coupled,
    counts=vibration_used,
)
