"""The Kalman filter of one mode: its model, its gains, and how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from wfsobs.observers.base import TARGETS
from wfsobs.signal.filter_covariance import lyapunov
from wfsobs.signal.gap_gains import GapGains
from wfsobs.signal.riccati import Step
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.signal.stepping import GainCycle
from wfsobs.typing import Array


class ModeFilter(NamedTuple):
    """The filter of one mode.

    model    : of the disturbance, the first states of the filter
    gains    : of the filter
    posterior : covariance after the measurement, of every step that repeats; empty where it is not known
    cycle    : (A, C, Q, R) of every step that repeats, C zero where nothing is measured
    """

    model: DisturbanceModel
    gains: GainCycle
    posterior: tuple[Array, ...] = ()
    cycle: tuple[Step, ...] = ()

    def rows(self, targets: Sequence[str]) -> Array:
        """Return rows of the whole state that give several targets, (len(targets), n)."""
        rows = self.model.output_rows(targets)
        return self._pad_rows(rows)

    def variance(self) -> Array:
        """Return the covariance of the state, (n, n), but for a running NGS frame."""
        return lyapunov(self.cycle[-1][0], self.cycle[-1][2])

    def steady_sd(self) -> Array:
        """Return `sd` of every step that repeats, (steps, 4) [um]."""
        S = self.variance()
        return np.array([self.sd(P, j, S) for j, P in enumerate(self.posterior)])

    def sd(self, P: Array, j: int, S: Array) -> Array:
        """Return the standard deviations after step j of the cycle of turbulence, vibration, their sum and the next z, (4,) [um].

        The next z is c A x + noise. From the estimate s x_hat of the sum it differs by c A (x - x_hat) + (c A - s) x_hat + noise,
        of which x_hat is independent of x - x_hat.

        P : covariance after the measurement, (n, n)
        S : `variance`
        """
        A, _, Q, R = self.cycle[j]
        targets, C = self.rows(TARGETS), self.cycle[(j + 1) % len(self.cycle)][1]
        rows = np.vstack([targets, targets.sum(axis=0), C[0] @ A])
        variances = np.sum((rows @ P) * rows, axis=1)
        other = rows[3] - rows[2]
        if np.abs(other).max() > 1e-9 * np.abs(rows[2]).max():
            variances[3] += other @ (S - P) @ other
        variances[3] += C[0] @ Q @ C[0] + R[0, 0]
        return np.sqrt(np.maximum(variances, 0.0))

    def gaps(self) -> GapGains:
        """Return the gains near gaps; steady again is what knows every process and the measurement as well as without one."""
        targets, (_, C, _, _) = self.rows(tuple(self.model.outputs)), self.cycle[-1]
        scale = np.mean([np.sum((targets @ P) * targets) for P in self.posterior])
        return GapGains(self.cycle, self.posterior, np.vstack([self._pad_rows(self.model.pairs), C]), float(scale))

    def digest(self) -> bytes:
        """Return what tells models apart."""
        return b"".join(x.tobytes() for step in self.cycle for x in step)

    def _pad_rows(self, rows: Array) -> Array:
        return np.pad(rows, ((0, 0), (0, len(self.gains.steps[0].A) - rows.shape[1])))
