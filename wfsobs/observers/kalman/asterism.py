"""The filter of an asterism: every mode from each LGS by itself in all modes, and from the NGS frames.

LGS beside the axis see different turbulence, and each tells something that their mean does not. Of what is told of the layers
follow the spectra between the target, all modes in every beam and the NGS (prior `Asterism`). The LGS are taken as their mean and
orthonormal differences, whose noise is independent; vibration is in the mean and in the NGS alone. The states of the independent
filters of `kalman.multi` on the mean, running means of every measurement, and running means of the NGS frames are put together by
the weights of least variance (`signal.joint_states`, `signal.frame_shares`); they repeat with the NGS frames.

The weights are those of the stars that are there, of the NGS alone where none is, and what is stated of the errors is by them.
They are made when a set of stars first occurs. The states of a star that is out go on with the measurements that the others
predict for it, so that it can come back at any time. A star of which a mode is missing is out. An NGS frame that is lost is the
one before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from wfsobs.observers.base import TARGETS, Look, Observer, Tunable
from wfsobs.observers.estimates import NEXT_Z, TOTAL, Estimates
from wfsobs.observers.kalman.asterism_model import AsterismModel, Beginning
from wfsobs.observers.kalman.multi import PEAKS, MultiPeak
from wfsobs.observers.step_checks import StepError
from wfsobs.prior import Asterism, Lines, Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Sampling
from wfsobs.signal.present_inputs import Present
from wfsobs.signal.stepping import Saved
from wfsobs.typing import Array

EVERY = 1000
"""Frames between two looks at whether to stop."""

PLANS = 64
"""Weights that are kept, of a target, a horizon and a set of LGS each; others are computed anew."""

FIRST, WITHOUT = -2, -1
"""Phases of the filter before its first step, and before its first NGS frame."""


class _Bank:
    """Filters of several modes, padded to the longest: F (n_modes, n, n), G, first and is_state (n_modes, n)."""

    def __init__(self, modes: Sequence[Beginning]):
        sizes = np.array([len(one.first) for one in modes])
        n = int(sizes.max())
        self.is_state = np.arange(n) < sizes[:, None]
        self.F, self.G, self.first = np.zeros((len(modes), n, n)), np.zeros((len(modes), n)), np.zeros((len(modes), n))
        for i, (one, first) in enumerate(modes):
            self.F[i, : sizes[i], : sizes[i]], self.G[i, : sizes[i]], self.first[i, : sizes[i]] = *one, first

    def begin(self, y: Array) -> Array:
        """Return the state after a first measurement (..., n_modes), (..., n_modes, n)."""
        x = self.first * y[..., None]
        return x + np.where(self.first == 0.0, self.G * y[..., None], 0.0)

    def advance(self, x: Array, y: Array) -> Array:
        """Return the state after a measurement."""
        return (self.F @ x[..., None])[..., 0] + self.G * y[..., None]


class AsterismEstimator:
    """The filter one frame at a time.

    Attributes
    ----------
    x : Array
        States of the LGS: of their mean, then of each difference, (n_lgs, n_modes, n).
    frames : Array
        States of the NGS, (n_modes, n).
    present : tuple of bool
        Which LGS are in the last measurement, (n_lgs,).
    phase : int
        Steps since an NGS frame; WITHOUT before the first of them, FIRST before the first step.
    """

    horizon: float | None = None
    needs_command = False

    def __init__(self, model: AsterismModel):
        self.model = model
        self._fast, self._slow = _Bank(model.fast), _Bank(model.slow)
        self.x = np.zeros((model.n_stars, *self._slow.first.shape[:1], self._fast.first.shape[1]))
        self.frames = np.zeros(self._slow.first.shape)
        self._each: Array | None = None
        self._plan, self._stand_ins = lru_cache(PLANS)(model.plan), lru_cache(PLANS)(model.stand_ins)
        self._next_z_sd = lru_cache(PLANS)(model.next_z_sd)
        self.present: Present = ()
        self.reset()

    @property
    def each_shape(self) -> tuple[int, int]:
        """Return (n_lgs, n_modes)."""
        return self.x.shape[0], self.x.shape[1]

    def see_each(self, each: Array) -> None:
        """Take the measurement of every LGS in the next frame, (n_lgs, n_modes) [um]."""
        self._each = each

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        assert self._each is not None
        missing = np.isnan(self._each)
        each = self._complete(self._each, missing) if missing.any() else self._each
        self.present = _as_set(missing)
        seen = self.model.basis @ each
        if self.phase == FIRST:
            self.x, self.phase = self._fast.begin(seen), WITHOUT
        else:
            self.x = self._fast.advance(self.x, seen)
        if ngs is not None:
            self.frames, self.phase = self._slow.begin(ngs) if self.phase < 0 else self._slow.advance(self.frames, ngs), 0
        elif self.phase >= 0:
            self.phase = (self.phase + 1) % self.model.ratio

    def _complete(self, each: Array, missing: Array) -> Array:
        """Return the measurements with what the last frame predicts in the place of those that are missing.

        In the first frame that is the mean of the other LGS, or zero.
        """
        if self.phase == FIRST:
            there = np.maximum(np.count_nonzero(~missing, axis=0), 1)
            return np.where(missing, np.where(missing, 0.0, each).sum(axis=0) / there, each)
        weights = self._stand_ins(self.present)[self.phase]
        return np.where(missing, weights @ self.state(), each)

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return (mean, sd) of the target."""
        weights, sd = self._plan(frames, target, self.present)
        return weights[self.phase] @ self.state(), sd[self.phase]

    def next_z_sd(self) -> Array:
        """Return the standard deviation of the next z less the sum of both estimates, (n_modes,) [um]."""
        return self._next_z_sd(self.present)[self.phase]

    def state(self) -> Array:
        """Return all states in the order of the weights, (n_states,)."""
        return np.concatenate([self.x[:, self._fast.is_state].ravel(), self.frames[self._slow.is_state]])

    def settle(self) -> None:
        """Have nothing left to do."""

    def reset(self) -> None:
        """Set the state back to rest."""
        self.x[...], self.frames[...], self.phase = 0.0, 0.0, FIRST
        self.present = (True,) * self.model.n_stars

    def save(self) -> Saved:
        """Return a copy of the state."""
        return {
            "x": self.x.copy(),
            "frames": self.frames.copy(),
            "phase": np.array(self.phase),
            "present": np.array(self.present, dtype=float),
        }

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        self.x[...], self.frames[...] = state["x"], state["frames"]
        self.phase, self.present = int(state["phase"]), _as_set(state["present"][:, None] == 0.0)

    def take_over(self, old: Any) -> None:
        """Go on from another design. Raises StepError where that has other states."""
        if old.x.shape != self.x.shape or old.frames.shape != self.frames.shape:
            raise StepError("its states are not those of the other design")
        self.load(old.save())


def _as_set(missing: Array) -> Present:
    """Return the LGS of which no mode is missing, from (n_lgs, n_modes)."""
    return tuple(not any(one) for one in missing)


def kf_asterism(measurements: Measurements, prior: Prior, settings: MultiPeak, watch: Watch) -> Estimates:
    """Run the filter over a record, frame by frame."""
    estimator = AsterismEstimator(AsterismModel(prior, settings, measurements.ratio))
    z, z_stars, z_ngs, n = measurements.z, measurements.z_stars, measurements.z_ngs, measurements.ratio
    assert n is not None
    values = {name: np.empty_like(z) for name in (*TARGETS, TOTAL)}
    sd = {name: np.empty_like(z) for name in (*values, NEXT_Z)}
    for k in range(len(z)):
        if k % EVERY == 0:
            watch.step(k / len(z))
        estimator.see_each(z_stars[k])
        estimator.advance(z[k], z_ngs[k] if k > 0 and k % n == 0 else None, None)
        for name, found in values.items():
            found[k], sd[name][k] = estimator.predict(0.0, name)
        sd[NEXT_Z][k] = estimator.next_z_sd()
    return Estimates({name: values[name] for name in TARGETS}, sd)


def step_kf_asterism(prior: Prior, settings: MultiPeak, sampling: Sampling, _horizon: float) -> AsterismEstimator:
    """Return the filter one frame at a time."""
    return AsterismEstimator(AsterismModel(prior, settings, sampling.ratio))


KF_ASTERISM = Observer(
    "kf-asterism",
    "Asterism KF",
    TARGETS,
    kf_asterism,
    help="every mode from each LGS by itself in all modes and the NGS, for frozen flow; not in the paper",
    prior=(Lines, Asterism),
    settings=PEAKS,
    needs=("y_stars", "y_ngs", "ratio"),
    linear=True,
    couples_modes=True,
    sensors=("lgs", "ngs"),
    weight=5.0,
    tunable=Tunable(("multipeak.line_width", "kalman.lgs_noise"), ("multipeak.turbulence_order", "kalman.turbulence_rms")),
    look=Look("Asterism", "#4E342E", "#BCAAA4", (8, 2, 2, 2), in_figures=False),
    step=step_kf_asterism,
)
