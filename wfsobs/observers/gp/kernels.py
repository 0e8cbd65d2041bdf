"""Kernels of Gaussian processes in time that are linear state spaces, and their sums.

A stationary process whose spectrum is a rational function of the frequency is the output of a linear stochastic equation,

    dx = F x dt + B dw,    f = h x,    F P + P F' + B B' = 0,

and regression on it is a Kalman filter: exact, and linear in the number of samples (Hartikainen and Sarkka, MLSP 2010; Sarkka and
Solin, Applied Stochastic Differential Equations, 2019, chapter 12). States are scaled so that they are of the order of one.

Every number may be complex with a tiny imaginary part: its effect on a result is then the derivative, to rounding
(`wfsobs.observers.gp.likelihood`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import Field, dataclass
from functools import cache
from math import factorial, pi
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from scipy.linalg import block_diag, expm
from scipy.special import iv

from wfsobs.typing import Array

Number = Any
"""A float, or a complex one whose imaginary part carries a derivative."""

NODES, WEIGHTS = np.polynomial.legendre.leggauss(10)


class StateSpace(NamedTuple):
    """Stochastic equation of a kernel: F (n, n), B (n, m), h (n,) and the stationary covariance P (n, n)."""

    F: Array
    B: Array
    h: Array
    P: Array

    def discretise(self, dt: float) -> tuple[Array, Array]:
        """Return transition A and covariance Q of the drive over a step dt [s], both (n, n).

        Q is an integral of squares, by quadrature over so short a time that ten nodes are exact to rounding, and doubled:
        P - A P A' would lose the digits of a slow process.
        """
        size = float(np.abs(self.F).sum(axis=1).max()) * dt
        doublings = max(int(np.ceil(np.log2(max(size, 1e-300)))) + 1, 0)
        short = dt / 2**doublings
        A, *within = expm(self.F * (short * np.append(1.0, 0.5 + 0.5 * NODES))[:, None, None])
        drives = np.array(within) @ self.B
        Q = 0.5 * short * np.sum(WEIGHTS[:, None, None] * (drives @ drives.swapaxes(1, 2)), axis=0)
        for _ in range(doublings):
            Q, A = Q + A @ Q @ A.T, A @ A
        return A, Q

    def covariance(self, lags: Array) -> Array:
        """Return the kernel at lags >= 0 [s], (n,)."""
        return np.array([self.h @ expm(self.F * lag) @ self.P @ self.h for lag in lags])


class Kernel(Protocol):
    """A kernel of time, a dataclass of its numbers, and the state space that it is."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def state_space(self) -> StateSpace:
        """Return its stochastic equation."""
        ...


def _chain(rate: Number, rms: Number, coefficients: Sequence[Number], P: Array) -> StateSpace:
    """Return f and its derivatives over rate, rate^2, ...: a chain whose last row is - coefficients."""
    n = len(coefficients)
    F = np.diag(np.ones(n - 1), 1).astype(np.result_type(rate, *coefficients, 1.0))
    F[-1] = -np.asarray(coefficients)
    last = np.sqrt(-2.0 * (F[-1] @ P[:, -1]) * rate)
    B = np.zeros((n, 1), dtype=np.result_type(F, last))
    B[-1, 0] = last
    return StateSpace(F * rate, B, np.concatenate([[rms], np.zeros(n - 1)]), P)


@dataclass(frozen=True)
class Matern:
    """Matern kernel of order 1/2, 3/2 or 5/2.

    rms : standard deviation [any unit];  scale : length scale [s];  order : twice nu, 1, 3 or 5
    """

    rms: Number
    scale: Number
    order: int = 3

    def state_space(self) -> StateSpace:
        """Return its stochastic equation: a chain of poles at - sqrt(2 nu) / scale."""
        rate = np.sqrt(float(self.order)) / self.scale
        if self.order == 1:
            return _chain(rate, self.rms, [1.0], np.eye(1))
        if self.order == 3:
            return _chain(rate, self.rms, [1.0, 2.0], np.eye(2))
        third = 1.0 / 3.0
        return _chain(rate, self.rms, [1.0, 3.0, 3.0], np.array([[1.0, 0.0, -third], [0.0, third, 0.0], [-third, 0.0, 1.0]]))


@dataclass(frozen=True)
class Sho:
    """Damped oscillator driven by white noise.

    rms : standard deviation [any unit];  omega : natural frequency [rad/s];  damping : ratio, above 0
    """

    rms: Number
    omega: Number
    damping: Number

    def state_space(self) -> StateSpace:
        """Return its stochastic equation."""
        return _chain(self.omega, self.rms, [1.0, 2.0 * self.damping], np.eye(2))


@dataclass(frozen=True)
class QuasiPeriodic:
    """exp(-2 sin^2(pi t / period) / width^2) exp(-t / scale), its Fourier series cut after some harmonics.

    rms : standard deviation [any unit];  period, scale : [s];  width : of a feature, over the period;  harmonics : kept
    """

    rms: Number
    period: Number
    scale: Number
    width: Number
    harmonics: int = 6

    def state_space(self) -> StateSpace:
        """Return its stochastic equation: a rotation per harmonic, all with the decay (Solin and Sarkka, AISTATS 2014)."""
        order = np.arange(self.harmonics + 1)
        weights = iv(order, self.width**-2) * np.exp(-(self.width**-2)) * np.where(order > 0, 2.0, 1.0)
        blocks = [np.array([[0.0, -1.0], [1.0, 0.0]]) * (2.0 * pi * j / self.period) for j in order[1:]]
        F = block_diag(np.zeros((1, 1)), *blocks) - np.eye(2 * self.harmonics + 1) / self.scale
        h = np.zeros(len(F), dtype=np.result_type(self.rms, weights))
        h[0], h[1::2] = self.rms * np.sqrt(weights[0]), self.rms * np.sqrt(weights[1:])
        return StateSpace(F, np.eye(len(F)) * np.sqrt(2.0 / self.scale), h, np.eye(len(F)))

    def exact(self, lags: Array) -> Array:
        """Return the kernel with all its harmonics, (n,)."""
        periodic = np.exp(-2.0 * np.sin(pi * lags / self.period) ** 2 / self.width**2)
        return self.rms**2 * periodic * np.exp(-lags / self.scale)


@dataclass(frozen=True)
class SquaredExponentialInTime:
    """exp(-t^2 / 2 scale^2), its spectrum over a Taylor polynomial.

    rms : standard deviation [any unit];  scale : length scale [s];  order : number of poles, even
    """

    rms: Number
    scale: Number
    order: int = 6

    def state_space(self) -> StateSpace:
        """Return its stochastic equation; the variance is that of the kernel (Hartikainen and Sarkka, MLSP 2010)."""
        coefficients, P = _rational(self.order)
        return _chain(1.0 / self.scale, self.rms, coefficients, P)

    def exact(self, lags: Array) -> Array:
        """Return the kernel itself, (n,)."""
        return self.rms**2 * np.exp(-0.5 * (lags / self.scale) ** 2)


@cache
def _rational(order: int) -> tuple[tuple[float, ...], Array]:
    """Coefficients of the chain of the spectrum 1 / sum (w^2 / 2)^n / n!, n <= order, and its covariance, of variance one."""
    even = [(-0.5) ** n / factorial(n) for n in range(order, -1, -1)]  # of s^2, w = -i s
    squares = np.roots(even)
    poles = -np.sqrt(squares.astype(complex))
    coefficients = np.poly(poles).real[:0:-1]
    return tuple(coefficients.tolist()), _chain_covariance(coefficients)


def _chain_covariance(coefficients: Array) -> Array:
    """Return the covariance of a chain of this last row, of variance one, (n, n)."""
    n = len(coefficients)
    F = np.diag(np.ones(n - 1), 1)
    F[-1] = -coefficients
    drive = np.zeros((n, n))
    drive[-1, -1] = 1.0
    P = np.linalg.solve(np.kron(F, np.eye(n)) + np.kron(np.eye(n), F), -drive.ravel()).reshape(n, n)
    return 0.5 * (P + P.T) / P[0, 0]


@dataclass(frozen=True)
class Poles:
    """Process of some poles and no zeros, driven by white noise.

    rms : standard deviation [any unit];  poles : in conjugate pairs, real parts below 0 [rad/s]
    """

    rms: float
    poles: tuple[complex, ...]

    def state_space(self) -> StateSpace:
        """Return its stochastic equation."""
        rate = float(np.exp(np.mean(np.log(np.abs(self.poles)))))
        coefficients = np.poly(np.array(self.poles) / rate).real[:0:-1]
        return _chain(rate, self.rms, coefficients.tolist(), _chain_covariance(coefficients))


@dataclass(frozen=True)
class Sum:
    """Sum of independent kernels."""

    parts: tuple[Kernel, ...]

    def state_space(self) -> StateSpace:
        """Return the stochastic equations side by side."""
        spaces = [part.state_space() for part in self.parts]
        F, B, P = (block_diag(*(getattr(one, name) for one in spaces)) for name in ("F", "B", "P"))
        return StateSpace(F, B, np.concatenate([one.h for one in spaces]), P)
