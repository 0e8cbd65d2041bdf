"""The coupled filter: every mode of frozen flow is estimated from the measurements of all modes.

The wind carries what one mode measures into another, and the LGS see through their narrower beams as one mode what is several.
The states of the independent filters of `kf-multi`, one per mode, and running means of every measurement over 0, 3, 9, ...
243 steps are put together by the weights of least variance under the matrix of spectra in the prior (`signal.joint_states`).
Longer means gain a little in an endless record, and lose more in its first seconds. Since the estimates of the independent
filters are among what is weighed, it is no worse than they are where it is told the truth.

Where modes tell nothing of one another, the prior has no such matrix: there is nothing to couple, and the observer refuses.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import block_diag

from wfsobs.observers.base import TARGETS, TURBULENCE, VIBRATION, Look, Observer
from wfsobs.observers.estimates import NEXT_Z, TOTAL, Estimates, by_name
from wfsobs.observers.kalman.mode_filter import ModeFilter
from wfsobs.observers.kalman.single import PEAKS, TUNABLE_PEAKS, MultiPeak, independent_filters, vibration_used
from wfsobs.observers.kalman.step import KalmanEstimator, matrix_power
from wfsobs.observers.step import PromptEstimator
from wfsobs.prior import Flow, Lines, Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Sampling
from wfsobs.signal import joint_states as joint
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.joint_states import LeastVariance, StateFilter, real_product, running_means, shared_covariance
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.signal.statespace import DisturbanceModel, disturbance_model
from wfsobs.typing import Array

MEANS = running_means((0.0, 3.0, 9.0, 27.0, 81.0, 243.0))
"""The running means of each measurement, the first of them the measurement itself."""


INDEPENDENT = "the modes tell nothing of one another: `kf-multi` estimates each by itself"
"""Why there is no coupled filter."""


class CoupledModel:
    """Weights of the states of all modes in every estimate.

    The states are those of the independent filters, mode after mode, then the means, span after span with all modes of each.

    Attributes
    ----------
    filters : list of ModeFilter
        The independent filters.
    means : StateFilter
        The running means of each measurement.

    Parameters
    ----------
    prior : Prior
        With lines and flow.
    settings : MultiPeak
        Of the independent filters.
    means : StateFilter
        As the attribute.

    Raises
    ------
    ValueError
        The prior has no flow.
    """

    filters: list[ModeFilter]

    def __init__(self, prior: Prior, settings: MultiPeak, means: StateFilter = MEANS):
        if prior.flow is None:
            raise ValueError(INDEPENDENT)
        self.means = means
        self.filters, self._flow = independent_filters(prior, settings), prior.flow
        self._peaks = line_models(prior, settings)
        self._noise = np.array([one.noise for one in prior.lines])
        states = [with_means(one, means) for one in self.filters]
        known = zip(states, self._peaks, self._flow.line_gain, self._noise, strict=True)
        own = joint.in_two_threads(lambda parts: joint.own_share(*parts), known)
        self._responses = joint.responses(states, means, self._flow.omega)
        self._of_lines = [share.disturbance for share in own]
        covariance = shared_covariance(self._flow.measurement, self._responses) + block_diag(*(share.states for share in own))
        self._order = self._order_of_states()
        self._least = LeastVariance(covariance)
        self._covariance = covariance

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return len(self.filters)

    def _order_of_states(self) -> Array:
        """Return the places of the states in the order of the class, from one in which every mode has its own together."""
        sizes = [len(one.model.A) for one in self.filters]
        n_means = self.means.G.size
        starts = np.cumsum([0, *(n + n_means for n in sizes)])
        of_filters = [start + np.arange(n) for start, n in zip(starts, sizes, strict=False)]
        of_means = np.array([start + n + np.arange(n_means) for start, n in zip(starts, sizes, strict=False)])
        return np.concatenate([*of_filters, of_means.T.ravel()])

    def plan(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return weights (n_modes, n_states) of the target, or TOTAL, so many frames ahead, and standard deviations [um]."""
        cross, variance = self._target(frames, target)
        weights = self._least.weights(cross)
        return weights[:, self._order], np.sqrt(np.maximum(variance - np.sum(weights * cross, axis=1), 0.0))

    def _target(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return covariances of the target and the states, and its variance."""
        if target == TOTAL:
            (one, own), (other, more) = (self._target(frames, part) for part in TARGETS)
            return one + other, own + more
        return self._of_turbulence(frames) if target == TURBULENCE else self._of_vibration(frames)

    def _of_turbulence(self, frames: float) -> tuple[Array, Array]:
        ahead = self._flow.cross * np.exp(1j * self._flow.omega * (1.0 + frames))
        return self._cross_covariance(ahead), self._flow.own.sum(axis=1)

    def _cross_covariance(self, powers: Array) -> Array:
        return np.hstack([real_product(powers[:, j], one) for j, one in enumerate(self._responses)])

    def _of_vibration(self, frames: float) -> tuple[Array, Array]:
        rows, variances = [], []
        for model, cross in zip(self._peaks, self._of_lines, strict=True):
            now = model.outputs[VIBRATION]
            rows.append((now @ matrix_power(model.A, frames) @ cross)[None])
            variances.append(now @ now)  # the states have unit variance
        return block_diag(*rows), np.array(variances)

    def next_z_sd(self) -> Array:
        """Return the standard deviations of the next z less the sum of both estimates, (n_modes,) [um]."""
        vibration, of_lines = self._of_vibration(0.0)
        weights, gain = self._least.weights(self._target(0.0, TOTAL)[0]), self._flow.line_gain
        seen = np.real(np.einsum("iif->i", self._flow.measurement)) + gain**2 * of_lines + self._noise**2
        ahead = self._cross_covariance(self._flow.measurement * np.exp(1j * self._flow.omega)) + gain[:, None] * vibration
        variance = seen + np.sum((weights @ self._covariance) * weights, axis=1) - 2.0 * np.sum(weights * ahead, axis=1)
        return np.sqrt(np.maximum(variance, 0.0))


def line_models(prior: Prior, settings: MultiPeak) -> list[DisturbanceModel]:
    """Return the models of the lines of each mode; of a mode without any, of a line that is zero."""
    silent = Ar2(1.0, 1.0, 0.0, prior.lines[0].dt)
    return [disturbance_model((), one.vibration(settings.line_width) or [silent]) for one in prior.lines]


def with_means(one: ModeFilter, means: StateFilter) -> StateFilter:
    """Return an independent filter and the means of its measurement, as one filter."""
    step = one.gains.steps[0]
    reduced = (np.eye(len(step.A)) - step.L @ step.C) @ step.A
    return StateFilter(block_diag(reduced, means.F), np.concatenate([step.L[:, 0], means.G]))


class CoupledEstimator(PromptEstimator):
    """The filter one frame at a time: the independent filters, the means, and the weights of both.

    Attributes
    ----------
    kalman : KalmanEstimator
        The independent filters.
    means : Array
        The running means, (n_spans, n_modes) [um].
    """

    model: CoupledModel
    kalman: KalmanEstimator
    means: Array

    state_names: tuple[str, ...] = ("kalman", "means", "_is_first")

    def __init__(self, model: CoupledModel):
        self.model, self.kalman = model, KalmanEstimator(model.filters)
        self.means, self._into = np.zeros((model.means.G.size, model.n_modes)), model.means.G[:, None]
        sizes = np.array([len(one.model.A) for one in model.filters])
        self._is_first = True
        self._is_state = np.arange(self.kalman.bank.x.shape[1]) < sizes[:, None]
        self._plans: dict[tuple[float, str], tuple[Array, Array]] = {}
        self.mark_start()

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        self.kalman.advance(z, None, None)
        if self._is_first:
            self.means[...], self._is_first = z, False
        self.means = self.model.means.F @ self.means + self._into * z

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return (mean, sd) of the target."""
        if (frames, target) not in self._plans:
            self._plans[frames, target] = self.model.plan(frames, target)
        weights, sd = self._plans[frames, target]
        return weights @ np.concatenate([self.kalman.bank.x[self._is_state], self.means.ravel()]), sd

    def run(self, measurements: Measurements, watch: Watch) -> Estimates:
        """Run the filter over a record without gaps from rest, all steps at once."""
        model, z = self.model, measurements.z
        weights = np.vstack([model.plan(0.0, target)[0] for target in TARGETS])
        out, start = np.zeros((len(z), len(weights))), 0
        for mode, one in enumerate(model.filters):
            watch.step(mode / model.n_modes)
            rows = weights[:, start : start + len(one.model.A)]
            out += one.gains.run(rows, z[:, mode, None])
            start += rows.shape[1]
        F, G = model.means.F, model.means.G[:, None]
        means = PeriodicFilter([(F, G, F, G)]).run(z[:, None], np.repeat(z[:1], len(F), axis=0))  # z was always what it is first
        out += means.reshape(len(z), -1) @ weights[:, start:].T
        sd = {name: model.plan(0.0, name)[1] for name in (*TARGETS, TOTAL)} | {NEXT_Z: model.next_z_sd()}
        values = by_name(out.reshape(len(z), 2, -1))
        return Estimates(values, {name: np.broadcast_to(spread, z.shape) for name, spread in sd.items()})

    def take_over(self, old: Any) -> None:
        """Go on from another design."""
        self.kalman.take_over(old.kalman)
        self.means[...], self._is_first = old.means, old._is_first


def kf_coupled(prior: Prior, settings: MultiPeak, _sampling: Sampling, _horizon: float) -> CoupledEstimator:
    """Return the filter one frame at a time."""
    return CoupledEstimator(CoupledModel(prior, settings))


KF_COUPLED = Observer(
    "kf-coupled",
    "Coupled KF",
    TARGETS,
    help="Kalman filter on the LGS of all modes together, for frozen flow; not in the paper",
    prior=(Lines, Flow),
    settings=PEAKS,
    linear=True,
    couples_modes=True,
    weight=2.0,
    tunable=TUNABLE_PEAKS,
    look=Look("Coupled", "#D35312", "#D48F4D", (10, 2, 2, 2)),
    step=kf_coupled,
    counts=vibration_used,
)
