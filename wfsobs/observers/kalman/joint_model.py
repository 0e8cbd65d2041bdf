"""Weights of least variance of the filters of all modes together: covariances of their states and of what they estimate.

The LGS are taken as their mean and orthonormal differences, whose noise is independent; vibration is in the mean and in the NGS
alone. The states of the independent filters of `kf-multi` on the mean, running means of every measurement, and running means of
the NGS frames are put together by the weights of least variance (`signal.joint_states`) under the spectra in the prior; they
repeat with the frames.

The states are those of the independent filter of a mode and running means, of the mean of the LGS in all modes, then of each
difference; and those of the filter and the means of the NGS frames, mode after mode.

The running means of a measurement are over 0, 3, 9, ... 243 steps. Longer means gain a little in an endless record, and lose
more in its first seconds. Since the estimates of the independent filters are among what is weighed, the whole is no worse than
they are where it is told the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from wfsobs.observers.base import TARGETS, TURBULENCE, VIBRATION
from wfsobs.observers.kalman.filters import MultiPeak, every_peak_filter, steady_mode
from wfsobs.observers.kalman.step import ModeFilter, lgs_mean, matrix_power
from wfsobs.prior import Asterism, Prior
from wfsobs.record import TOTAL
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


INDEPENDENT = "the modes tell nothing of one another: `kf-multi` estimates each by itself"
INDEPENDENT_ON_BOTH = INDEPENDENT.replace("kf-multi", "multirate-multi")
"""Why there is no coupled filter."""


def flow_model(prior: Prior, settings: MultiPeak, means: StateFilter = MEANS) -> AsterismModel:
    """Return the weights of the LGS in all modes; means : of each measurement. Raises ValueError where the prior has no flow."""
    if prior.flow is None:
        raise ValueError(INDEPENDENT)
    star = replace(prior.flow, noise=np.array([one.noise for one in prior.lines]))
    return AsterismModel(replace(prior, asterism=star), settings, 1, means)


def coupled_model(prior: Prior, settings: MultiPeak, ratio: int | None) -> AsterismModel:
    """Return the weights. Raises ValueError where the prior has no flow."""
    if prior.asterism is None:
        raise ValueError(INDEPENDENT_ON_BOTH)
    return AsterismModel(prior, settings, ratio)
