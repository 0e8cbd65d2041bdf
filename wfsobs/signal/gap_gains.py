"""Gains of a Kalman filter near missing measurements: the covariance as it is there, step by step, until it is steady again.

    P = A P[k-1] A' + Q,    S = C P C' + R,    L = P C' S^-1,    P[k] = P - L S L',

row by row of C, those that were measured.

The covariance does not depend on what is measured, only on which measurements there are. So the steps are kept, and a gap of the
same length costs nothing the second time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wfsobs.signal.riccati import Step
from wfsobs.typing import Array

STEADY = 3e-3
"""Variance above that of the steady state, over that of the targets, from which on the filter is steady again."""

KEPT = 16e6
"""Memory for steps that are kept, per model [bytes]."""

Pattern = tuple[bool, ...]
"""Which measurements of a step there are."""


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
    """

    def __init__(self, cycle: Sequence[Step], posteriors: Sequence[Array], rows: Array, scale: float):
        self.cycle, self.posteriors = tuple(cycle), tuple(posteriors)
        self.weights, self.most = rows.T @ rows, STEADY * scale
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
        pattern : tuple of bool
            Which of its measurements there are.
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
        for i, is_there in enumerate(pattern):  # one after the other, as their noises are independent
            if is_there and C[i].any():
                ahead = P @ C[i]
                gain = ahead / (C[i] @ ahead + R[i, i])
                P = P - np.outer(gain, ahead)
                update -= np.outer(gain, C[i] @ update)
                update[:, len(A) + i] += gain
        P = 0.5 * (P + P.T)
        is_last = all(pattern) and np.vdot(self.weights, P - self.posteriors[j]) <= self.most
        return GapStep(P, update, bool(is_last))
