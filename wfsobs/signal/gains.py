"""Kalman gains: the steady ones by structured doubling, and those near missing measurements.

The steady ones follow from discrete algebraic Riccati equations,

    P = A P A' - A P C' (C P C' + R)^-1 C P A' + Q        (paper, eq. 8b)

and the periodic one, where (A, C, Q, R) repeat every few steps. One step maps a covariance to the next as

    P -> H + A_' P (I + G P)^-1 A_,    A_ = A', G = C' R^-1 C, H = Q,

and two such maps in a row are one of the same kind. Composing a cycle, then the cycle with itself repeatedly, doubles
the steps in every pass: about twelve passes are enough, even for lightly damped lines, and H is then the solution.

Kleinman steps remove the rounding errors: the true covariance of the present gains is the solution of a
Lyapunov equation, a sum of positive terms that loses nothing, and its gains are better, quadratically. Where the noise
is so small that rounding spoils the doubling, they start from the covariance without measurements.

Near a gap the covariance is followed step by step until it is steady again,

    P = A P[k-1] A' + Q,    S = C P C' + R,    L = P C' S^-1,    P[k] = P - L S L',

row by row of C, those that were measured. The first row may be the mean over several sensors of which some are out
(`SensorMean`): its noise is then greater, and it sees states beside those of the filter, which the mean over all does not see.

The covariance does not depend on what is measured, only on which measurements there are. So the steps are kept, and a gap of the
same length costs nothing the second time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import groupby
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from wfsobs.typing import Array

RESIDUAL = 1e-9
"""Maximum residual of an accepted solution, relative to the covariance."""

Step = tuple[Array, Array, Array, Array]
"""(A, C, Q, R) of one step: measure with C and R, then predict with A and Q."""


class RiccatiError(ValueError):
    """Error: no usable steady-state filter for the given model; one line with the reason."""


def posteriors_of_gains(cycle: Sequence[Step], gains: Sequence[Array]) -> list[Array]:
    """Return the covariances of a filter whose gains need not be optimal, in its steady state.

    Parameters
    ----------
    cycle : sequence of Step
        (A, C, Q, R) of every step of the cycle, as for `steady_state`.
    gains : sequence of Array
        Filter gain of every step, (n, m).

    Returns
    -------
    list of Array
        Covariance after the measurement of every step, (n, n).

    Raises
    ------
    RiccatiError
        The filter is not stable.
    """
    F, W = np.eye(len(cycle[0][0])), np.zeros_like(cycle[0][0])
    for (A, C, Q, R), L in zip(cycle, gains, strict=True):
        reduced = np.eye(len(A)) - L @ C
        W = A @ (reduced @ W @ reduced.T + L @ R @ L.T) @ A.T + Q
        F = A @ reduced @ F
    P, out = lyapunov(F, W), []
    for (A, C, Q, R), L in zip(cycle, gains, strict=True):
        reduced = np.eye(len(A)) - L @ C
        out.append(reduced @ P @ reduced.T + L @ R @ L.T)
        P = A @ out[-1] @ A.T + Q
    return out


def lyapunov(F: Array, W: Array) -> Array:
    """Solve S = F S F' + W by doubling the number of terms of its series in every pass.

    Parameters
    ----------
    F, W : Array
        Transition matrix, stable, and covariance of the drive, both (n, n).

    Returns
    -------
    Array
        S, (n, n).

    Raises
    ------
    RiccatiError
        F is not stable.
    """
    S = W
    for _ in range(60):
        with np.errstate(over="ignore", invalid="ignore"):
            step = F @ S @ F.T
            S = S + step
            F = F @ F
        if not np.isfinite(S).all():
            break
        if np.abs(step).max() <= 1e-17 * np.abs(S).max():
            return 0.5 * (S + S.T)
    raise RiccatiError("the filter is not stable: its error would grow without bound")


@dataclass(frozen=True)
class SteadyState:
    """Steady state of a Kalman filter with state (n,) and measurements (m,).

    Attributes
    ----------
    P : Array
        Prediction covariance, (n, n).
    L : Array
        Filter gain, (n, m).
    K : Array
        Predictor gain A L, (n, m).
    posterior : Array
        Covariance after the measurement, (n, n).
    residual : float
        Residual of the Riccati equation, relative to P.
    """

    P: Array
    L: Array
    K: Array
    posterior: Array
    residual: float


def steady_state(A: Array, C: Array, Q: Array, R: Array) -> SteadyState:
    """Solve the Riccati equation of a filter that is the same at every step.

    The result does not depend on the unit.

    Parameters
    ----------
    A : Array
        Transition matrix, (n, n), stable.
    C : Array
        Measurement matrix, (m, n) or (n,).
    Q : Array
        Process-noise covariance, (n, n).
    R : Array or float
        Measurement-noise covariance, (m, m) or scalar, positive definite.

    Returns
    -------
    SteadyState
        Gains and covariances.

    Raises
    ------
    RiccatiError
        R is not positive definite, or no stable solution is reached.
    """
    return periodic_steady_state([(A, np.atleast_2d(C), Q, np.atleast_2d(np.asarray(R, dtype=float)))])[0]


def periodic_steady_state(cycle: Sequence[Step]) -> list[SteadyState]:
    """Solve the Riccati equation of a filter whose steps repeat.

    Parameters
    ----------
    cycle : sequence of Step
        (A, C, Q, R) of every step of the cycle, as for `steady_state`.

    Returns
    -------
    list of SteadyState
        One solution per step of the cycle.

    Raises
    ------
    RiccatiError
        As `steady_state`.
    """
    found = _refine(cycle, _double_cycle(cycle))
    if found[0].residual > RESIDUAL:
        # From the covariance of the model itself Kleinman steps converge as surely, but more slowly.
        blind = _around([(A, np.zeros_like(C), Q, R) for A, C, Q, R in cycle], np.zeros_like(cycle[0][2]))
        found = _refine(cycle, lyapunov(*_carry_around(cycle, blind)))
    residual = found[0].residual
    if not residual <= RESIDUAL:
        raise RiccatiError(
            f"no accurate steady-state filter: the Riccati equation is met to {residual:.1e} only; "
            "measurement noise and process noise are too far apart"
        )
    radius = np.abs(np.linalg.eigvals(_carry_around(cycle, found)[0])).max()
    if radius >= 1.0:
        raise RiccatiError(f"the steady-state filter is not stable: spectral radius {radius:.6f}")
    return found


def _refine(cycle: Sequence[Step], P: Array) -> list[SteadyState]:
    """Improve P by Kleinman steps, until only rounding is left or three steps bring nothing."""
    best = _around(cycle, P)
    states, idle = best, 0
    while idle < 3 and best[0].residual > 1e-14:
        try:
            states = _around(cycle, lyapunov(*_carry_around(cycle, states)))
        except RiccatiError:  # gains from a poor start need not be stable
            break
        idle = 0 if states[0].residual < 0.5 * best[0].residual else idle + 1
        best = min(best, states, key=lambda s: s[0].residual)
    return best


Map = tuple[Array, Array, Array]
"""(A_, G, H) of P -> H + A_' P (I + G P)^-1 A_."""


def _map(A: Array, C: Array, Q: Array, R: Array) -> Map:
    try:
        whitened = np.linalg.solve(np.linalg.cholesky(R), C)
    except np.linalg.LinAlgError:
        raise RiccatiError("the measurement noise must be above zero") from None
    return A.T, whitened.T @ whitened, Q


def _compose(first: Map, then: Map) -> Map:
    """Return the map of two steps in a row."""
    A1, G1, H1 = first
    A2, G2, H2 = then
    n = A1.shape[0]
    W = np.linalg.solve(np.eye(n) + G2 @ H1, np.hstack([A2, G2]))
    G = G1 + A1 @ W[:, n:] @ A1.T
    H = H2 + A2.T @ H1 @ W[:, :n]
    return A1 @ W[:, :n], 0.5 * (G + G.T), 0.5 * (H + H.T)


def _double_cycle(cycle: Sequence[Step]) -> Array:
    """Return the covariance after very many cycles, by doubling until it is constant or only rounding changes it."""
    runs = [list(run) for _, run in groupby(cycle, key=id)]  # steps that come in a row as the same object
    m = reduce(_compose, (_power_of_map(_map(*run[0]), len(run)) for run in runs))
    last = np.inf
    for _ in range(60):
        before = m
        m = _compose(m, m)
        if not np.isfinite(m[2]).all():
            return before[2]
        moved = np.abs(m[2] - before[2]).max() / max(np.abs(m[2]).max(), np.finfo(float).tiny)
        if moved <= 1e-15 or (moved < 1e-9 and moved >= last):
            break
        last = moved
    return m[2]


def _power_of_map(m: Map, times: int) -> Map:
    """Return the map of `times` equal steps, by halves."""
    if times == 1:
        return m
    half = _power_of_map(m, times // 2)
    both = _compose(half, half)
    return _compose(both, m) if times % 2 else both


def _around(cycle: Sequence[Step], P: Array) -> list[SteadyState]:
    """Return gains and covariances around one cycle from the prediction covariance P, and the residual after it."""
    found: list[tuple[Array, Array, Array, Array]] = []
    start = P
    for A, C, Q, R in cycle:
        L = np.linalg.solve(C @ P @ C.T + R, C @ P).T
        # Joseph form: a sum of squares, so the covariance stays symmetric and non-negative.
        reduced = np.eye(len(A)) - L @ C
        filtered = reduced @ P @ reduced.T + L @ R @ L.T
        found.append((P, L, A @ L, filtered))
        P = A @ filtered @ A.T + Q
    with np.errstate(over="ignore", invalid="ignore"):  # a start that doubling has spoiled is far off, and is then dropped
        residual = float(np.abs(P - start).max() / max(np.abs(start).max(), np.finfo(float).tiny))
    residual = residual if np.isfinite(residual) else np.inf
    return [SteadyState(*one, residual) for one in found]


def _carry_around(cycle: Sequence[Step], states: Sequence[SteadyState]) -> tuple[Array, Array]:
    """Return the map of the error of a prediction over the cycle, and the covariance that it adds, for the given gains."""
    F = np.eye(len(cycle[0][0]))
    W = np.zeros_like(F)
    for (A, C, Q, R), state in zip(cycle, states, strict=True):
        Fj = A - state.K @ C
        W = Fj @ W @ Fj.T + state.K @ R @ state.K.T + Q
        F = Fj @ F
    return F, W


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
    sd : dict of int to Array
        What its owner states of the errors after it, by the sensors of the next measurement; kept with it.
    """

    is_last: bool
    posterior: Array
    update: Array

    __slots__ = ("following", "is_last", "posterior", "sd", "update")

    def __init__(self, posterior: Array, update: Array, is_last: bool):
        self.posterior, self.update, self.is_last = posterior, update, is_last
        self.sd: dict[int, Array] = {}
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
