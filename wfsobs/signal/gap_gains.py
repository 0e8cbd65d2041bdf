"""Gains of a Kalman filter near missing measurements: the covariance as it is there, step by step, until it is steady again.

    P = A P[k-1] A' + Q,    S = C P C' + R,    L = P C' S^-1,    P[k] = P - L S L',

row by row of C, those that were measured. The first row may be the mean over several sensors of which some are out
(`SensorMean`): its noise is then greater, and it sees states beside those of the filter, which the mean over all does not see.

The covariance does not depend on what is measured, only on which measurements there are. So the steps are kept, and a gap of the
same length costs nothing the second time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from wfsobs.signal.riccati import Step, lyapunov
from wfsobs.typing import Array

STEADY = 3e-3
"""Variance above that of the steady state, over that of the targets, from which on the filter is steady again."""

KEPT = 16e6
"""Memory for steps that are kept, per model [bytes]."""

Pattern = tuple[int, ...]
"""How many sensors each measurement of a step is the mean over, 0 where it is missing."""


class SensorMean(NamedTuple):
    """A measurement that is the mean over 1, 2, ... N sensors.

    noise : rms of its noise over that of the mean over all, (N,)
    A, Q  : of what it sees beside the states of the filter, (e, e)
    C     : how, (N, e); its last row is zero
    """

    noise: Array
    A: Array
    Q: Array
    C: Array


ONE = SensorMean(np.ones(1), np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((1, 0)))
"""A measurement by one sensor."""


class GapStep:
    """A step near a gap.

    Attributes
    ----------
    posterior : Array
        Covariance after the measurement, (n, n).
    update : Array
        Gives x_hat[k] from (x_hat[k-1], v[k]), (n, n + m).
    is_last : bool
        Whether the filter is steady after it.
    sd : Array or None
        What its owner states of the errors after it, once asked for; kept with it.
    """

    is_last: bool
    posterior: Array
    update: Array

    __slots__ = ("following", "is_last", "posterior", "sd", "update")

    def __init__(self, posterior: Array, update: Array, is_last: bool):
        self.posterior, self.update, self.is_last = posterior, update, is_last
        self.sd: Array | None = None
        self.following: dict[Pattern, GapStep] = {}


class GapGains:
    """The steps of a filter near its gaps.

    Attributes
    ----------
    weights, most : Array, float
        The filter is steady where all is measured and the sum of `weights` times the covariance above the steady one is at most
        `most`.

    Parameters
    ----------
    cycle : sequence of Step
        (A, C, Q, R) of the steps that repeat, R diagonal; a row of C is zero where nothing is measured.
    posteriors : sequence of Array
        Covariance after the measurement in the steady state, of the same steps.
    rows : Array
        Rows of the state whose variances say whether the filter is steady, (p, n).
    scale : float
        Variance that theirs are compared with.
    mean : SensorMean
        The sensors of the first measurement.
    """

    weights: Array
    most: float

    def __init__(self, cycle: Sequence[Step], posteriors: Sequence[Array], rows: Array, scale: float, mean: SensorMean = ONE):
        e = len(mean.A)
        beside = lyapunov(mean.A, mean.Q) if e else mean.A
        self.cycle: tuple[Step, ...] = tuple(
            (block_diag(A, mean.A), np.pad(C, ((0, 0), (0, e))), block_diag(Q, mean.Q), R) for A, C, Q, R in cycle
        )
        self.posteriors: tuple[Array, ...] = tuple(block_diag(P, beside) for P in posteriors)
        rows = np.pad(rows, ((0, 0), (0, e)))
        self.weights, self.most, self._mean = rows.T @ rows, STEADY * scale, mean
        self._first: dict[tuple[int, Pattern], GapStep] = {}
        n = len(rows[0])
        self._room = self._free = max(int(KEPT / (8 * n * (2 * n + 2))), 1)

    def after(self, before: GapStep | None, j: int, pattern: Pattern) -> GapStep:
        """Return step j of the cycle.

        Parameters
        ----------
        before : GapStep or None
            The step before; None where the filter was steady.
        j : int
            Which step of the cycle.
        pattern : tuple of int
            Its measurements.
        """
        known = self._first.get((j, pattern)) if before is None else before.following.get(pattern)
        if known is None:
            known = self._make(self.posteriors[j - 1] if before is None else before.posterior, j, pattern)
            if self._free == 0:
                self._first.clear()
                self._free = self._room
            self._free -= 1
            if before is None:
                self._first[j, pattern] = known
            else:
                before.following[pattern] = known
        return known

    def _make(self, P: Array, j: int, pattern: Pattern) -> GapStep:
        A, _, Q, _ = self.cycle[j - 1]
        _, C, _, R = self.cycle[j]
        P = A @ P @ A.T + Q
        update = np.hstack([A, np.zeros((len(A), len(C)))])
        for i, sensors in enumerate(pattern):  # one after the other, as their noises are independent
            if sensors and C[i].any():
                row, variance = (C[i], R[i, i]) if i else self._first_row(C, R, sensors)
                ahead = P @ row
                gain = ahead / (row @ ahead + variance)
                P = P - np.outer(gain, ahead)
                update -= np.outer(gain, row @ update)
                update[:, len(A) + i] += gain
        P = 0.5 * (P + P.T)
        is_last = (
            all(pattern) and pattern[0] == len(self._mean.noise) and np.vdot(self.weights, P - self.posteriors[j]) <= self.most
        )
        return GapStep(P, update, bool(is_last))

    def _first_row(self, C: Array, R: Array, sensors: int) -> tuple[Array, float]:
        """Return row and variance of the noise of the mean over so many sensors."""
        row, beside, factor = C[0].copy(), self._mean.C[sensors - 1], self._mean.noise[sensors - 1]
        row[len(row) - len(beside) :] = beside
        return row, R[0, 0] * factor**2
