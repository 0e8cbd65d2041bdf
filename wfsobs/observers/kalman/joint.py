"""Filters of all modes together on the LGS and on the NGS frames: their states, frame by frame and over a record.

`kf-asterism` takes every mode from each LGS by itself in all modes. LGS beside the axis see different turbulence, and each tells
something that their mean does not. The prior `Asterism` has the spectra between the target, all modes in every beam and the NGS.
The LGS are taken as their mean and orthonormal differences, whose noise is independent; vibration is in the mean and in the NGS
alone. The states of the independent filters of `kf-multi` on the mean, running means of every measurement, and running means of
the NGS frames are put together by the weights of least variance (`signal.joint_states`); they repeat with the frames.

`multirate-coupled` has the mean of the LGS, or what `sensors.lgs_combination` makes of them, in the place of a single star: for
LGS that see the same, and where a record or a loop has them together alone. Where modes tell nothing of one another there is
nothing to couple, and the observer refuses. A measurement of which a mode is missing is none, and so is an NGS frame.

The weights are those of the LGS that are there, of the NGS alone where none is, and what is stated of the errors is by them. They
are made when a set of LGS, or a number of them in their mean (`LgsStars`), first occurs. The states of one that is out go on with
the measurements that the others predict for it, so that it can come back at any time. One of which a mode is missing is out.
While an NGS frame is lost the weights are those of the frames before it; when the next comes, or after several, the filter of the
frames takes for it what all states told of it.

The states are those of the independent filter of a mode and running means, of the mean of the LGS in all modes, then of each
difference; and those of the filter and the means of the NGS frames, mode after mode.

`kf-coupled`, without an NGS, and `multirate-coupled`, with one, are the same filter on one star. Every mode of frozen flow is
estimated from the measurements of all modes: the wind carries what one mode measures into another, and the LGS see through their
narrower beams as one mode what is several.
The states of the independent filters of `kf-multi`, one per mode, and running means of every measurement over 0, 3, 9, ...
243 steps are put together by the weights of least variance under the matrix of spectra in the prior (`signal.joint_states`).
Longer means gain a little in an endless record, and lose more in its first seconds. Since the estimates of the independent
filters are among what is weighed, it is no worse than they are where it is told the truth. Where modes tell nothing of one
another, the prior has no such matrix: there is nothing to couple, and the observer refuses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag

from wfsobs.observers.base import TARGETS, TURBULENCE, VIBRATION, Look, Observer
from wfsobs.observers.kalman.filters import (
    PEAKS,
    TUNABLE_PEAKS,
    MultiPeak,
    every_peak_filter,
    filter_of_both,
    steady_mode,
    vibration_used,
)
from wfsobs.observers.kalman.step import ModeFilter, carry_state, lgs_mean, matrix_power
from wfsobs.observers.step import Estimator, StepError, run_frames
from wfsobs.prior import Asterism, Flow, FlowOfBoth, LgsStars, Lines, Prior
from wfsobs.progress import Watch
from wfsobs.record import NEXT_Z, TOTAL, Estimates, Measurements, Sampling, by_name
from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.signal.gains import SensorMean, lyapunov
from wfsobs.signal.joint_states import (
    Present,
    PresentInputs,
    StateFilter,
    frame_mean_response,
    frame_shares,
    real_product,
    responses,
    running_means,
    shared_covariance,
)
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.signal.statespace import DisturbanceModel, disturbance_model
from wfsobs.signal.wiener import Complex, in_two_threads
from wfsobs.typing import Array

MEANS = running_means((0.0, 3.0, 9.0, 27.0, 81.0, 243.0))
"""The running means of each measurement, the first of them the measurement itself."""

FRAME_MEANS = running_means((0.0, 1.0, 3.0, 9.0, 27.0, 81.0))
"""Of the NGS: over these frames."""

ALIKE = "all LGS see the same: `multirate-multi` takes their mean and the NGS"
"""Why there is no filter of the asterism."""


class AsterismModel:
    """Covariances of states and targets, and weights.

    Attributes
    ----------
    fast, slow : list of Beginning
        Of every LGS measurement in each mode, and of the NGS frames.
    basis : Array
        Weights of the LGS in their mean and their differences, (n_lgs, n_lgs).

    Parameters
    ----------
    prior : Prior
        With lines and asterism.
    settings : MultiPeak
        Of the independent filters.
    ratio : int or None
        Steps per NGS frame.
    means, frame_means : StateFilter
        Running means of every LGS measurement, and of every NGS frame.
    age : int
        Steps between the last NGS frame and the first for which there are weights: so many frames, which are lost.
    stars : int
        LGS that a measurement is the mean over, where the prior tells of fewer; 0 for all.

    Raises
    ------
    ValueError
        The prior has no asterism, or another ratio.
    """

    basis: Array
    ratio: int
    n_states: int
    slow: list[Beginning]

    def __init__(
        self,
        prior: Prior,
        settings: MultiPeak,
        ratio: int | None,
        means: StateFilter = MEANS,
        frame_means: StateFilter = FRAME_MEANS,
        *,
        age: int = 0,
        stars: int = 0,
    ):
        asterism = prior.asterism
        if asterism is None:
            raise ValueError(ALIKE)
        if ratio != asterism.ratio:
            raise ValueError(f"the prior has an NGS frame every {asterism.ratio} steps, the loop every {ratio}")
        self._again = partial(AsterismModel, prior, settings, ratio, means, frame_means)
        sees = [lgs_mean(prior, mode, has_slow_error=True) for mode in range(len(prior.lines))]
        self.all_stars: int = len(sees[0].noise)
        white = asterism.noise * [one.noise[stars - 1] for one in sees]
        self.basis, self.ratio, self._asterism = asterism.basis, asterism.ratio, replace(asterism, noise=white)
        self._age, self._steps = age, range(age, age + asterism.ratio)
        independent = (every_peak_filter(settings, prior, mode) for mode in range(len(prior.lines)))
        self.fast: list[Beginning] = [begin_with_means(one, means) for one in independent]
        self._slow_errors = [_slow_error(one.filter, mean, stars) for one, mean in zip(self.fast, sees, strict=True)]
        self._peaks = line_models(prior, settings)
        self.has_frames: bool = len(asterism.measurement) > self.n_stars
        if self.has_frames:
            self.slow = [begin_with_means(one, frame_means) for one in frame_filters(prior, settings, asterism)]
        else:
            self.slow = [NO_STATES] * len(self._peaks)
        omega = asterism.omega
        self._responses = responses([one.filter for one in self.fast], means, omega) * self.n_stars
        frames = [one.filter for one in self.slow] if self.has_frames else []
        of_frames = responses(frames, frame_means, asterism.ratio * omega)
        self._of_frames = [one * frame_mean_response(asterism.ratio, omega) for one in of_frames]
        n_inputs = len(asterism.measurement) * len(self._peaks)
        self._powers = asterism.measurement.reshape(n_inputs, n_inputs, -1)
        self._estimates = self._add_states()

    @property
    def n_stars(self) -> int:
        """Number of LGS."""
        return len(self.basis)

    def late(self, n_lost: int, stars: int = 0) -> AsterismModel:
        """Return the model of the same states while the last so many NGS frames are lost, and the LGS are so many."""
        return self._again(age=n_lost * self.ratio, stars=stars)

    def plan(self, frames: float, target: str, present: Present | None = None) -> tuple[Array, Array]:
        """Return weights and standard deviations of a target, or TOTAL, so many frames ahead.

        present : LGS that are there, by default all; with none, the weights are of the NGS alone

        Returns
        -------
        weights : Array
            0, 1, ... steps after an NGS frame was due, and at last before the first, (ratio + 1, n_modes, n_states).
        sd : Array
            (ratio + 1, n_modes) [um].
        """
        found = self._target(frames, target)
        return self._estimates.estimate([*found, found[-1]], present or (True,) * self.n_stars)

    def stand_ins(self, present: Present) -> Array:
        """Return weights that predict the next measurement of every LGS, in all modes, (ratio + 1, n_lgs, n_modes, n_states)."""
        variance = np.diag(self._measurement_covariance())
        found = [(cross, variance) for cross in self._next_measurement()]
        weights = self._estimates.estimate([*found, found[-1]], present)[0]
        stars = weights.reshape(self.ratio + 1, self.n_stars, -1)
        return (np.linalg.inv(self.basis) @ stars).reshape(self.ratio + 1, self.n_stars, len(self._peaks), -1)

    def frame(self, present: Present) -> Array:
        """Return weights that tell the NGS frame that is due in the first of the steps, and lost, (n_modes, n_states)."""
        n = self.n_stars * len(self._peaks)
        cross = self._with_states(self._powers[n:] * frame_mean_response(self.ratio, self._asterism.omega))[0]
        for row, places, exposure in zip(cross, self._places, self._exposures, strict=True):
            row[places] += exposure
        found = (cross, np.zeros(len(cross)))
        return self._estimates.estimate([found], present)[0][0]

    def next_z_sd(self, present: Present) -> Array:
        """Return the standard deviations of the next z less the sum of both estimates, (ratio + 1, n_modes) [um].

        present : as in `plan`; z is the mean of those that are there, or of all where none is
        """
        combination, noise = self._combination(present), self._asterism.noise
        rows = np.einsum("isk,sb->ibk", combination, np.linalg.inv(self.basis)).reshape(len(noise), -1)
        seen = np.sum((rows @ self._measurement_covariance()) * rows, axis=1) + np.sum((combination * noise) ** 2, axis=(1, 2))
        weights, sd = self.plan(0.0, TOTAL, present)
        ahead = [rows @ cross for cross in self._next_measurement()]
        told = self._target(0.0, TOTAL)[0][1] - sd**2  # the variance of the estimate
        variance = seen + told - 2.0 * np.sum(weights * np.array([*ahead, ahead[-1]]), axis=2)
        return np.sqrt(np.maximum(variance, 0.0))

    def _add_states(self) -> PresentInputs:
        """Compute covariances of the lines and the states in every phase, and return estimates from the latter."""
        asterism, m, stars = self._asterism, len(self._peaks), self.n_stars
        powers, n = self._powers, stars * m
        fast, slow = shared_covariance(powers[:n, :n], self._responses), shared_covariance(powers[n:, n:], self._of_frames)
        n_fast, self.n_states = len(fast), len(fast) + len(slow)
        sizes = [*(one.filter.G.size for one in self.fast)] * stars + [one.filter.G.size for one in self.slow]
        starts = np.cumsum([0, *sizes])
        self._places = [np.r_[starts[i] : starts[i + 1], starts[n + i] : starts[n + i + 1]] for i in range(m)]
        own = zip(asterism.noise / np.sqrt(stars), asterism.ngs_noise, asterism.line_gain, strict=True)
        known = zip(self.fast, self.slow, self._peaks, own, strict=True)
        shares = in_two_threads(
            lambda of: frame_shares(of[0].filter, of[1].filter, self.ratio, of[2], *of[3], age=self._age), known
        )
        self._of_lines = [[share.disturbance for share in one] for one in shares]
        self._exposures = [one[0].exposure for one in shares]
        of_noise = [
            lyapunov(one.filter.F, np.outer(one.filter.G, noise**2 * one.filter.G))
            for one, noise in zip(self.fast, asterism.noise, strict=True)
        ]
        first = starts[m]
        fast[first:, first:] += block_diag(*of_noise * (stars - 1))
        fast[:first, :first] += block_diag(*(one.states for one in self._slow_errors))
        covariances = []
        for phase, between in enumerate(self._between(powers[:n, n:])):
            covariance = np.block([[fast, between], [between.T, slow]])
            for places, one in zip(self._places, shares, strict=True):
                covariance[np.ix_(places, places)] += one[phase].states
            covariances.append(covariance)
        return PresentInputs(covariances, self.basis, n_fast)

    def _between(self, powers: Complex) -> list[Array]:
        """Return the covariances of the states of the LGS and of the NGS in every step after a frame."""
        if not self.has_frames:
            return [np.zeros((sum(map(len, self._responses)), 0))]
        late = [np.concatenate(parts) for parts in zip(*(self._late(phase) for phase in self._steps), strict=True)]

        def row(i: int) -> list[Array]:
            found = [real_product(self._responses[i] * powers[i, j], each) for j, each in enumerate(late)]
            return [np.hstack(parts) for parts in zip(*(np.split(one, self.ratio, axis=1) for one in found), strict=True)]

        return [np.vstack(parts) for parts in zip(*in_two_threads(row, range(len(powers))), strict=True)]

    def _late(self, phase: int) -> list[Complex]:
        """Return the responses of the states of the NGS so many steps after a frame."""
        return [one * np.exp(-1j * phase * self._asterism.omega) for one in self._of_frames]

    def _target(self, frames: float, target: str) -> list[tuple[Array, Array]]:
        """Return covariances of the target and the states, and its variance, in every step after a frame."""
        if target == TOTAL:
            parts = zip(*(self._target(frames, part) for part in TARGETS), strict=True)
            return [(one + other, own + more) for (one, own), (other, more) in parts]
        return self._of_turbulence(frames) if target == TURBULENCE else self._of_vibration(frames)

    def _of_turbulence(self, frames: float) -> list[tuple[Array, Array]]:
        asterism = self._asterism
        ahead = (asterism.cross * np.exp(1j * asterism.omega * (1.0 + frames))).reshape(-1, *self._powers.shape[1:])
        return [(cross, asterism.own.sum(axis=1)) for cross in self._with_states(ahead)]

    def _next_measurement(self) -> list[Array]:
        """Return those of the next measurement and the states: of the mean of the LGS, then each difference, in all modes."""
        n = self.n_stars * len(self._peaks)
        found = self._with_states(self._powers[:n] * np.exp(1j * self._asterism.omega))
        for i, (model, of_lines) in enumerate(zip(self._peaks, self._of_lines, strict=True)):
            for cross, seen in zip(found, of_lines, strict=True):
                cross[i, self._places[i]] += self._asterism.line_gain[i] * np.ravel(model.C @ model.A @ seen)
                cross[i, self._places[i][: len(self.fast[i].first)]] += self._slow_errors[i].ahead
        return found

    def _measurement_covariance(self) -> Array:
        """Return that of the measurements of `_next_measurement`, without noise, (n_lgs * n_modes, n_lgs * n_modes)."""
        n = self.n_stars * len(self._peaks)
        lines = self._asterism.line_gain**2 * [(model.C @ model.C.T).item() for model in self._peaks]
        own = lines + [one.variance for one in self._slow_errors]
        return np.real(self._powers[:n, :n].sum(axis=2)) + np.diag(np.pad(own, (0, n - len(own))))

    def _combination(self, present: Present) -> Array:
        """Return the weights of the LGS in z, of these alone where it is their mean; NaN where a z of some is not known."""
        there, own = np.array(present), self._asterism.combination
        if there.all() or not there.any():
            return own
        is_mean = np.allclose(own, np.eye(len(own))[:, None] / self.n_stars)
        return own * (there * self.n_stars / there.sum())[:, None] if is_mean else np.full_like(own, np.nan)

    def _with_states(self, powers: Complex) -> list[Array]:
        """Return covariances of signals and the states in every step, from the cross powers of the signals and all inputs."""
        n = len(self._responses)
        fast = [real_product(powers[:, i], one) for i, one in enumerate(self._responses)]
        late = [[real_product(powers[:, i], one) for i, one in enumerate(self._late(phase), n)] for phase in self._steps]
        return [np.hstack([*fast, *slow]) for slow in late]

    def _of_vibration(self, frames: float) -> list[tuple[Array, Array]]:
        targets = [model.outputs[VIBRATION] for model in self._peaks]
        rows = [now @ matrix_power(model.A, frames) for now, model in zip(targets, self._peaks, strict=True)]
        crosses = np.zeros((self.ratio, len(rows), self.n_states))
        for i, (row, of_lines) in enumerate(zip(rows, self._of_lines, strict=True)):
            crosses[:, i, self._places[i]] = [row @ cross for cross in of_lines]
        variances = np.array([now @ now for now in targets])  # the states have unit variance
        return [(cross, variances) for cross in crosses]


class Beginning(NamedTuple):
    """A filter, its state where the first measurement is 1: (n,), and the model of which its first states are."""

    filter: StateFilter
    first: Array
    model: DisturbanceModel | None = None


class _SlowError(NamedTuple):
    """What a mean over fewer LGS has beside that of all: variance, covariance of the states, and of the next one and these."""

    variance: float
    states: Array
    ahead: Array


def _slow_error(one: StateFilter, mean: SensorMean, stars: int) -> _SlowError:
    """Return it, of the mean over so many."""
    row = mean.C[stars - 1]
    seen, n = np.vstack([np.eye(len(row)), np.outer(one.G, row)]), len(row)
    step = np.hstack([seen @ mean.A, np.vstack([np.zeros((n, len(one.F))), one.F])])
    covariance = lyapunov(step, seen @ mean.Q @ seen.T)
    return _SlowError(row @ covariance[:n, :n] @ row, covariance[n:, n:], row @ mean.A @ covariance[:n, n:])


NO_STATES = Beginning(StateFilter(np.zeros((0, 0)), np.zeros(0)), np.zeros(0))
"""Of the NGS, where there is none."""


def line_models(prior: Prior, settings: MultiPeak) -> list[DisturbanceModel]:
    """Return the models of the lines of each mode; of a mode without any, of a line that is zero."""
    silent = Ar2(1.0, 1.0, 0.0, prior.lines[0].dt)
    return [disturbance_model((), one.vibration(settings.line_width) or [silent]) for one in prior.lines]


def frame_filters(prior: Prior, settings: MultiPeak, asterism: Asterism) -> list[ModeFilter]:
    """Return a filter of the NGS frames of each mode, with its lines, as if frames were samples."""

    def slow(processes: Sequence[Ar2 | Ar3]) -> list[Ar2 | Ar3]:
        return [replace(process, dt=asterism.ratio * process.dt) for process in processes]

    models = [disturbance_model(slow(one.turbulence), slow(one.vibration(settings.line_width))) for one in prior.lines]
    return [steady_mode(model, float(noise)) for model, noise in zip(models, asterism.ngs_noise, strict=True)]


def begin_with_means(one: ModeFilter, means: StateFilter) -> Beginning:
    """Return a filter and means of the same measurement, of which the means begin as if it had always been what it is first."""
    step, at_rest = one.gains.steps[0], np.linalg.solve(np.eye(len(means.F)) - means.F, means.G)
    reduced = (np.eye(len(step.A)) - step.L @ step.C) @ step.A
    both = StateFilter(block_diag(reduced, means.F), np.concatenate([step.L[:, 0], means.G]))
    return Beginning(both, np.concatenate([np.zeros(len(step.A)), at_rest]), one.model)


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


INDEPENDENT = "the modes tell nothing of one another: `kf-multi` estimates each by itself"
INDEPENDENT_ON_BOTH = INDEPENDENT.replace("kf-multi", "multirate-multi")
"""Why there is no coupled filter."""


def flow_model(prior: Prior, settings: MultiPeak, means: StateFilter = MEANS) -> AsterismModel:
    """Return the weights of the LGS in all modes; means : of each measurement. Raises ValueError where the prior has no flow."""
    if prior.flow is None:
        raise ValueError(INDEPENDENT)
    star = replace(prior.flow, noise=np.array([one.noise for one in prior.lines]))
    return AsterismModel(replace(prior, asterism=star), settings, 1, means)


def kf_coupled(prior: Prior, settings: MultiPeak, _sampling: Sampling, _horizon: float) -> JointEstimator:
    """Return the filter on the LGS in all modes. Raises ValueError where the prior has no flow."""
    return JointEstimator(flow_model(prior, settings))


def coupled_model(prior: Prior, settings: MultiPeak, ratio: int | None) -> AsterismModel:
    """Return the weights. Raises ValueError where the prior has no flow."""
    if prior.asterism is None:
        raise ValueError(INDEPENDENT_ON_BOTH)
    return AsterismModel(prior, settings, ratio)


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
