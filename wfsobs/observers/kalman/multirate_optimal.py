"""The optimal multi-rate Kalman filter: periodic gains, and the NGS frame modelled as the mean that it is.

To the state of the disturbance model come the mean of what the running NGS frame has seen so far,

    frame[k+1] = (frame[k], or 0 if a frame has just been read) + phi_dist[k] / n,

so that z_ngs[k] = frame[k] + noise at k = n, 2n, ..., and (an option) the slow AR(2) error of the LGS mean. The gains solve
the periodic Riccati equation of the n steps. Optimal for its model only; the paper's two gains are `multirate`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from wfsobs.observers.base import TARGETS, Look, Observer
from wfsobs.observers.estimates import Estimates
from wfsobs.observers.kalman.mode_filter import ModeFilter, lgs_mean
from wfsobs.observers.kalman.multirate import (
    RATES,
    TUNABLE,
    MultiRate,
    MultiRateFilter,
    filter_of_gains,
    matched_noise,
    multirate_noise,
    run_modes,
)
from wfsobs.observers.kalman.single import NGS
from wfsobs.observers.kalman.step import KalmanEstimator
from wfsobs.prior import LgsError, LgsStars, NoiselessModel, Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Sampling
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.signal.filter_covariance import Step
from wfsobs.signal.riccati import SteadyState, periodic_steady_state
from wfsobs.signal.statespace import DisturbanceModel, blocks_along_diagonal, disturbance_model
from wfsobs.signal.stepping import Gain, GainCycle
from wfsobs.typing import Array


def optimal_cycle(
    model: DisturbanceModel, ratio: int, lgs_noise: float, ngs_noise: float, lgs_error: Sequence[Ar2 | Ar3] = ()
) -> list[Step]:
    """Return (A, C, Q, R) of the steps k = 1 ... n, the NGS frame at the last; noises as standard deviations [um].

    State (disturbance model, slow LGS errors if any, frame). C has two rows at every step, LGS and NGS; where there is no
    frame the second is zero. Steps without a frame are one and the same.
    """
    A0, C0, Q0 = model.A, model.C, model.Q
    now = sum(model.outputs.values()) / ratio
    if lgs_error:
        error = disturbance_model(lgs_error, ())
        A0, Q0 = blocks_along_diagonal([A0, error.A]), blocks_along_diagonal([Q0, error.Q])
        C0, now = np.append(C0, error.C), np.append(now, np.zeros(len(error.A)))
    n = len(A0)
    R = np.diag([lgs_noise**2, ngs_noise**2])
    Q = np.zeros((n + 1, n + 1))
    Q[:n, :n] = Q0

    def step(frame: bool) -> Step:
        A, C = np.zeros((n + 1, n + 1)), np.zeros((2, n + 1))
        A[:n, :n], A[n, :n], A[n, n] = A0, now, float(not frame)
        C[0, :n], C[1, n] = C0, float(frame)
        return A, C, Q, R

    return [*([step(False)] * (ratio - 1)), step(True)]


def optimal_gains(cycle: list[Step]) -> tuple[GainCycle, list[SteadyState]]:
    """Return the gains of a cycle, and its covariances at steps 1 ... n.

    Step 0, before the first frame, measures the LGS alone and starts the frame anew.
    """
    states = periodic_steady_state(cycle)
    A, C, _, R = cycle[-1]
    alone = C * [[1.0], [0.0]]
    L = np.linalg.solve(alone @ states[-1].P @ alone.T + R, alone @ states[-1].P).T
    steps = [Gain(A, C, s.L) for (A, C, _, _), s in zip(cycle, states, strict=True)]
    return GainCycle(steps, Gain(A, alone, L)), states


def optimal_filter(cycle: list[Step], outputs: Array) -> tuple[MultiRateFilter, list[SteadyState]]:
    """Return the filter of `optimal_gains` and the covariances; outputs (p, n_states) rows of the state."""
    gains, states = optimal_gains(cycle)
    return filter_of_gains(gains, outputs), states


class Cycle(NamedTuple):
    """What is estimated in one mode.

    steps : (A, C, Q, R) of the steps;  rows : of the state per target
    model : of the disturbance alone;  has_lgs_error : whether the slow error of the LGS is among the states
    """

    steps: list[Step]
    rows: Array
    model: DisturbanceModel
    has_lgs_error: bool = False

    def filter(self) -> ModeFilter:
        """Return the optimal filter."""
        gains, states = optimal_gains(self.steps)
        return ModeFilter(self.model, gains, tuple(state.posterior for state in states), tuple(self.steps))


def optimal_model(settings: MultiRate, prior: Prior, mode: int, ratio: int, model: DisturbanceModel | None = None) -> Cycle:
    """Return the cycle of one mode; model: of the disturbance, by default that of one peak."""
    model = model or prior.model[mode].disturbance()
    error = [prior.lgs_error[mode].process] if settings.model_lgs_error else []
    return estimated_cycle(model, ratio, *multirate_noise(settings, prior.noise_of(mode)), error)


def estimated_cycle(
    model: DisturbanceModel, ratio: int, lgs_noise: float, ngs_noise: float, lgs_error: Sequence[Ar2 | Ar3]
) -> Cycle:
    """Return `optimal_cycle` with the rows of all targets."""
    steps = optimal_cycle(model, ratio, lgs_noise, ngs_noise, lgs_error)
    rows = model.output_rows(TARGETS)
    return Cycle(steps, np.hstack([rows, np.zeros((len(rows), len(steps[0][0]) - rows.shape[1]))]), model, bool(lgs_error))


class OptimalFilters(NamedTuple):
    """The optimal filters of all modes. cycle_of : (settings, prior, mode, ratio) -> what is estimated in that mode."""

    cycle_of: Callable[[Any, Prior, int, int], Cycle]

    def run(self, measurements: Measurements, prior: Prior, settings: Any, watch: Watch) -> Estimates:
        """Run them over a record."""
        return run_modes(measurements, self._filters(prior, settings, measurements.sampling), watch)

    def step(self, prior: Prior, settings: Any, sampling: Sampling, _horizon: float) -> KalmanEstimator:
        """Return them one frame at a time."""
        return KalmanEstimator(self._filters(prior, settings, sampling))

    def _filters(self, prior: Prior, settings: Any, sampling: Sampling) -> list[ModeFilter]:
        assert sampling.ratio is not None
        found = [self.cycle_of(settings, prior, mode, sampling.ratio) for mode in range(sampling.n_modes)]
        return [one.filter()._replace(mean=lgs_mean(prior, mode, one.has_lgs_error)) for mode, one in enumerate(found)]


_FILTERS = OptimalFilters(optimal_model)

MULTIRATE_OPTIMAL = Observer(
    "multirate-optimal",
    "Optimal multi-rate KF",
    TARGETS,
    _FILTERS.run,
    help="Kalman filter on both sensors with periodic gains, NGS frames as means; not in the paper",
    prior=(NoiselessModel, LgsError, LgsStars),
    asks=matched_noise,
    settings=RATES,
    needs=NGS,
    linear=True,
    takes_missing=True,
    sensors=("lgs", "ngs"),
    tunable=TUNABLE,
    look=Look("Opt. multi-rate", "#5718C1", "#B848F9", (3, 2)),
    step=_FILTERS.step,
)
