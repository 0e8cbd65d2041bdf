"""The Kalman filter of one mode: its model, its gains, and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from wfsobs.observers.stepping import GainCycle
from wfsobs.prior import Prior
from wfsobs.record import TARGETS
from wfsobs.signal.gains import ONE, GapGains, SensorMean, Step, lyapunov
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.typing import Array


class ModeFilter(NamedTuple):
    """The filter of one mode.

    model    : of the disturbance, the first states of the filter
    gains    : of the filter
    posterior : covariance after the measurement, of every step that repeats; empty where it is not known
    cycle    : (A, C, Q, R) of every step that repeats, C zero where nothing is measured
    mean     : the LGS whose mean it measures
    """

    model: DisturbanceModel
    gains: GainCycle
    posterior: tuple[Array, ...] = ()
    cycle: tuple[Step, ...] = ()
    mean: SensorMean = ONE

    def rows(self, targets: Sequence[str]) -> Array:
        """Return rows of the whole state that give several targets, (len(targets), n)."""
        rows = self.model.output_rows(targets)
        return self._pad_rows(rows)

    def variance(self) -> Array:
        """Return the covariance of the state, (n, n), but for a running NGS frame."""
        return lyapunov(self.cycle[-1][0], self.cycle[-1][2])

    def innovation_variances(self) -> list[float]:
        """Return the variance of z less its prediction at every step that repeats [um^2]."""
        before = zip(self.posterior[-1:] + self.posterior[:-1], self.cycle[-1:] + self.cycle[:-1], self.cycle, strict=True)
        rows = [(C[0] @ A, C[0], P, Q, R[0, 0]) for P, (A, _, Q, _), (_, C, _, R) in before]
        return [float(ahead @ P[: len(c), : len(c)] @ ahead + c @ Q @ c + r) for ahead, c, P, Q, r in rows]

    def steady_sd(self) -> Array:
        """Return `StatedErrors.sd` of every step that repeats, (steps, 4) [um]."""
        stated = StatedErrors(self)
        return np.array([stated.sd(P, j) for j, P in enumerate(self.posterior)])

    def gaps(self) -> GapGains:
        """Return the gains near gaps; steady again is what knows every process and the measurement as well as without one."""
        targets, (_, C, _, _) = self.rows(tuple(self.model.outputs)), self.cycle[-1]
        scale = np.mean([np.sum((targets @ P) * targets) for P in self.posterior])
        rows = np.vstack([self._pad_rows(self.model.pairs), C])
        return GapGains(self.cycle, self.posterior, rows, float(scale), self.mean)

    def digest(self) -> bytes:
        """Return what tells models apart."""
        return b"".join(x.tobytes() for step in (*self.cycle, (self.rows(TARGETS),), self.mean) for x in step)

    def _pad_rows(self, rows: Array) -> Array:
        return np.pad(rows, ((0, 0), (0, len(self.gains.steps[0].A) - rows.shape[1])))


def lgs_mean(prior: Prior, mode: int, has_slow_error: bool = False) -> SensorMean:
    """Return the LGS whose mean a filter measures, one where it is not told.

    has_slow_error : whether the slow error of all is in its model
    """
    return prior.stars[mode].sensor_mean(has_slow_error) if prior.stars else ONE


class StatedErrors:
    """Standard deviations [um] that a filter states after a step: of turbulence, vibration, their sum and the next z.

    The next z is c A x + noise. From the estimate s x_hat of the sum it differs by c A (x - x_hat) + (c A - s) x_hat + noise,
    of which x_hat is independent of x - x_hat.

    Parameters
    ----------
    mode : ModeFilter
        The filter.
    """

    def __init__(self, mode: ModeFilter):
        targets, S, repeat = mode.rows(TARGETS), mode.variance(), len(mode.cycle)
        total = targets.sum(axis=0)
        self._rows, self._least = [], []
        for j, (A, _, Q, R) in enumerate(mode.cycle):
            c = mode.cycle[(j + 1) % repeat][1][0]
            ahead = c @ A
            other = ahead - total
            if np.abs(other).max() <= 1e-9 * np.abs(total).max():
                other = np.zeros_like(other)
            rows = np.vstack([targets, total, ahead, other])
            self._rows.append(rows)
            self._least.append(np.array([0.0, 0.0, 0.0, other @ S @ other + c @ Q @ c + R[0, 0]]))

    def sd(self, P: Array, j: int) -> Array:
        """Return them after step j of the cycle, (4,); P : covariance after the measurement, (n, n) or of more states."""
        rows = self._rows[j]
        P = P[: rows.shape[1], : rows.shape[1]]
        variances = np.einsum("ij,ij->i", rows @ P, rows)
        variances[3] -= variances[4]
        return np.sqrt(np.maximum(variances[:4] + self._least[j], 0.0))
