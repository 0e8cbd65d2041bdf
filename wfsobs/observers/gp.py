"""Gaussian process regression in time by Kalman filters: kernels that are linear state spaces, and the observers with them.

A stationary process whose spectrum is a rational function of the frequency is the output of a linear stochastic equation,

    dx = F x dt + B dw,    f = h x,    F P + P F' + B B' = 0,

and regression on it is a Kalman filter: exact, and linear in the number of samples (Hartikainen and Sarkka, MLSP 2010; Sarkka and
Solin, Applied Stochastic Differential Equations, 2019, chapter 12). States are scaled so that they are of the order of one.

On evenly spaced samples that is, with the gradient of its likelihood,

    z[k] = f(k dt) + noise,    f ~ GP(0, kernel)

The filter starts from the prior, so that its predictions and its likelihood are those of the dense regression, sample by sample.
Derivatives are those of the complex step: with one hyper-parameter at x + i e, e = 1e-30, the imaginary part of the result over
e is its derivative, to rounding, as nothing is subtracted (Squire and Trapp, SIAM Review 40, 110, 1998).

In the observers turbulence is one kernel, every line of the vibration an oscillator, and the sensor's error may have a colour: a
Matern 1/2 background of its own, part of the measurement and of no target. The state has one element more, the sum one step ago,
which is what a measurement sees:

    z[k] = f[k-1] + noise,    (x, f)[k+1] = (A x[k] + v, h x[k]).

On both sensors the slow error of the LGS and the NGS frame as the mean that it is are states, as in `kalman.filters`; a
coloured background is an error of the LGS, and no part of what a frame is the mean of.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import Field, dataclass
from functools import cache, partial
from math import comb, factorial, pi, sqrt
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from scipy.linalg import block_diag, expm
from scipy.special import iv

from wfsobs.observers.base import TARGETS, Look, Tunable
from wfsobs.observers.kalman.filters import MultiRate, filter_of_both, linear_filter, optimal_model, steady_mode
from wfsobs.observers.kalman.step import ModeFilter, kalman_filters, lgs_mean
from wfsobs.observers.missing import LINE_WIDTH
from wfsobs.prior import LgsError, LgsStars, Lines, Noise, Prior
from wfsobs.settings import Group, Real, Section
from wfsobs.settings.values import Choice
from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.signal.statespace import DisturbanceModel
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
        n = (self.order + 1) // 2
        P = np.array([[3.0, 0.0, -1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 3.0]]) / 3.0 if n == 3 else np.eye(n)
        return _chain(rate, self.rms, [float(comb(n, i)) for i in range(n)], P)


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


TINY = 1e-30
"""Imaginary step of a derivative."""

STILL = 1e-14
"""Move in a step, over the largest element, below which a covariance is at rest: the gain then stays as it is."""

CHECKED = 16
"""Steps from one check for that to the next."""


class Regression(NamedTuple):
    """What the samples before say of each sample, and what it adds.

    mean, variance   : of f, given the samples before and including each, (n,)
    ahead, innovation : prediction of each sample by those before, and its variance, noise and all, (n,)
    log_likelihood   : of all samples
    """

    mean: Array
    variance: Array
    ahead: Array
    innovation: Array
    log_likelihood: float


def regress(kernel: Kernel, noise: float, dt: float, z: Array) -> Regression:
    """Run the regression over samples.

    Parameters
    ----------
    kernel : Kernel
        Covariance of f.
    noise : float
        Standard deviation of the noise [unit of z].
    dt : float
        Step [s].
    z : Array
        Samples, (n,); NaN is missing.

    Returns
    -------
    Regression
        Means, variances and likelihood.
    """
    found = _regressions([(kernel, noise)], dt, z)
    mean, variance, ahead, innovation = (x[:, 0] for x in found[:4])
    return Regression(mean, variance, ahead, innovation, float(found[4][0]))


def log_likelihood(make: Callable[[Array], tuple[Kernel, Number]], parameters: Array, dt: float, z: Array) -> tuple[float, Array]:
    """Return the log-likelihood of samples, and its gradient by the parameters.

    Parameters
    ----------
    make : callable
        Parameters (p,) -> kernel and standard deviation of the noise, analytic: it is called with complex numbers.
    parameters : Array
        Hyper-parameters, (p,).
    dt : float
        Step [s].
    z : Array
        Samples, (n,); NaN is missing.

    Returns
    -------
    float, Array
        Log-likelihood and its gradient (p,).
    """
    moved = np.asarray(parameters) + 1j * TINY * np.eye(len(parameters))
    total = _regressions([make(one) for one in moved], dt, z)[4]
    return float(np.real(total[0])), np.imag(total) / TINY


def _regressions(models: Sequence[tuple[Kernel, Number]], dt: float, z: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Run m regressions (kernel, noise) side by side; results (steps, m), and the log-likelihoods (m,)."""
    spaces = [kernel.state_space() for kernel, _ in models]
    A, Q = (np.array(parts) for parts in zip(*(space.discretise(dt) for space in spaces), strict=True))
    h, P = np.array([space.h for space in spaces]), np.array([space.P for space in spaces])
    r = np.array([noise**2 for _, noise in models])
    kind = np.result_type(A, Q, h, P, r)
    mean, variance, ahead, innovation = np.empty((4, len(z), len(r)), dtype=kind)
    x, turned = np.zeros(h.shape, dtype=kind), A.swapaxes(1, 2)
    P, is_still, k = P.astype(kind), False, 0
    missing = np.isnan(z)
    known = np.where(missing, 0.0, z)
    gaps = np.append(np.flatnonzero(missing), len(z))
    while k < len(z):
        Ph = np.einsum("mij,mj->mi", P, h)
        spread = np.sum(h * Ph, axis=1)
        S = spread + r
        gain = Ph / S[:, None] * (not missing[k])
        stop = int(gaps[np.searchsorted(gaps, k)]) if is_still and not missing[k] else k + 1
        variance[k:stop], innovation[k:stop] = spread, S
        x = _predict(A, h, gain, x, known[k:stop], ahead[k:stop])
        following = A @ (P - gain[:, :, None] * Ph[:, None, :]) @ turned + Q
        following = 0.5 * (following + following.swapaxes(1, 2))
        is_still = not missing[k] and k % CHECKED == 0 and _is_still(P, following)
        P, k = following, stop
    there = ~missing
    v, S = z[there, None] - ahead[there], innovation[there]
    mean[:] = ahead
    mean[there] += variance[there] / S * v
    variance[there] *= r / S
    return mean, variance, ahead, innovation, -0.5 * np.sum(np.log(2.0 * np.pi * S) + v * v / S, axis=0)


def _predict(A: Array, h: Array, gain: Array, x: Array, z: Array, ahead: Array) -> Array:
    """Write the predictions of samples, with a gain that stays as it is, and return the states after them, (m, n)."""
    driven = (A @ gain[:, :, None])[:, :, 0]
    step = np.concatenate([h[:, None], A - driven[:, :, None] * h[:, None]], axis=1)  # to the sample, and to the next state
    for i, sample in enumerate(z):
        found = (step @ x[:, :, None])[:, :, 0]
        ahead[i], x = found[:, 0], found[:, 1:] + driven * sample
    return x


def _is_still(P: Array, following: Array) -> bool:
    """Return whether the covariances, and their derivatives, have come to rest."""
    moved = following - P
    parts = ((np.real(moved), np.real(P)), (np.imag(moved), np.imag(P)))
    return all(bool((np.abs(m).max(axis=(1, 2)) <= STILL * np.abs(of).max(axis=(1, 2))).all()) for m, of in parts)


POLES, MATERN, SMOOTH = "as told", {"matern-1/2": 1, "matern-3/2": 3, "matern-5/2": 5}, "squared-exponential"


NOTHING = (Matern(0.0, 1.0, 1),)
"""A sum of no kernel."""


class GaussianProcess(Group):
    """Gaussian process regression in time, with a sum of kernels."""

    turbulence: Choice = Choice(
        [POLES, *MATERN, SMOOTH],
        label="Kernel of the turbulence",
        doc="as told: the poles of the model; the others have its rms and its corner frequency.",
    )
    background_rms: Real = Real(
        0.0,
        bounds=(0.0, 100.0),
        softbounds=(0.0, 0.1),
        label="Coloured background",
        doc="RMS of a Matern 1/2 background of the measurement [um]; 0 for none.",
    )
    background_scale: Real = Real(
        1.5,
        bounds=(0.01, 1e4),
        softbounds=(0.1, 100.0),
        label="Time of the background",
        doc="Length scale of the background [ms].",
    )

    def idle(self) -> dict[str, str]:
        """Return the settings without effect: without a background it has no scale."""
        return {} if self.background_rms > 0 else {"background_scale": "Used only where Coloured background is above 0"}


GP = Section("gp", "Gaussian process in time", GaussianProcess)


def kernels_of(lines: Lines, settings: GaussianProcess) -> tuple[Kernel, Kernel, Kernel]:
    """Return the kernels of turbulence, vibration and background of one mode."""
    turbulence = tuple(_turbulence(process, settings.turbulence) for process in lines.turbulence)
    peaks = tuple(Sho(process.rms, process.omega, process.damping) for process in lines.vibration(LINE_WIDTH))
    colour = (Matern(settings.background_rms, settings.background_scale * 1e-3, 1),) if settings.background_rms else ()
    return Sum(turbulence or NOTHING), Sum(peaks or NOTHING), Sum(colour or NOTHING)


def _turbulence(process: Ar2 | Ar3, kind: str) -> Kernel:
    """Return the kernel of a told process: its own, or one with its rms and corner."""
    if kind in MATERN:
        return Matern(process.rms, sqrt(MATERN[kind]) / process.omega, MATERN[kind])
    if kind == SMOOTH:
        return SquaredExponentialInTime(process.rms, 1.0 / process.omega)
    if isinstance(process, Ar2):
        return Sho(process.rms, process.omega, process.damping)
    return Poles(process.rms, tuple(-process.decays / process.dt))


def sampled_model(kernels: Sequence[Kernel], dt: float) -> DisturbanceModel:
    """Return the model of kernels at steps dt [s]: of turbulence and vibration, then of what is of neither; C is the sum now."""
    found = [(one, *one.discretise(dt)) for one in (kernel.state_space() for kernel in kernels)]
    A, Q, P = (block_diag(*parts) for parts in ([A for _, A, _ in found], [Q for _, _, Q in found], [o.P for o, _, _ in found]))
    h = np.concatenate([one.h for one, _, _ in found])
    ends = np.cumsum([len(one.h) for one, _, _ in found])
    place = np.arange(len(h))
    now = np.array([np.where(place < ends[0], h, 0.0), np.where((place >= ends[0]) & (place < ends[1]), h, 0.0)])
    before = np.linalg.lstsq(P, (now @ P @ A.T).T, rcond=1e-14)[0].T  # the likeliest value one step ago
    pairs = np.stack([now, before], axis=1).reshape(4, -1)
    return DisturbanceModel(A, h, Q, dict(zip(TARGETS, now, strict=True)), pairs)


def measured_late(model: DisturbanceModel) -> DisturbanceModel:
    """Return the model with one state more, the sum one step ago: what a measurement sees."""
    n = len(model.A)
    A = np.zeros((n + 1, n + 1))
    A[:n, :n], A[n, :n] = model.A, model.C
    outputs = {target: np.append(row, 0.0) for target, row in model.outputs.items()}
    return DisturbanceModel(A, np.eye(n + 1)[-1], block_diag(model.Q, [[0.0]]), outputs, np.pad(model.pairs, ((0, 0), (0, 1))))


def on_lgs(settings: GaussianProcess, prior: Prior, mode: int, _ratio: int | None) -> ModeFilter:
    """Return the regression of a mode on the LGS measurement, at every fast step."""
    lines = prior.lines[mode]
    model = sampled_model(kernels_of(lines, settings), lines.dt)
    return steady_mode(model, lines.noise, lgs_mean(prior, mode), measured_late(model))


def on_both(settings: GaussianProcess, prior: Prior, mode: int, ratio: int) -> ModeFilter:
    """Return the regression of a mode on both sensors."""
    lines = prior.lines[mode]
    model = sampled_model(kernels_of(lines, settings), lines.dt)
    cycle = optimal_model(MultiRate(), prior, mode, ratio, measured_late(model))
    return cycle._replace(model=model).filter(prior, mode)


GP_LGS = linear_filter(
    "gp-lgs",
    "GP in time",
    TARGETS,
    help="Gaussian process in time, a kernel for the turbulence and one per line, as a filter; not in the paper",
    prior=(Lines, LgsStars),
    settings=GP,
    weight=2.0,
    tunable=Tunable(("gp.background_rms", "gp.background_scale"), ("kalman.lgs_noise", "kalman.turbulence_rms")),
    look=Look("GP in time", "#478B83", "#8EFAF0", (6, 2, 2, 2)),
    step=partial(kalman_filters, on_lgs),
)

GP_BOTH = filter_of_both(
    "gp-both",
    "GP on both sensors",
    TARGETS,
    help="Gaussian process in time on both sensors; not in the paper",
    prior=(Noise, LgsError, LgsStars, Lines),
    settings=GP,
    weight=2.0,
    tunable=Tunable(("gp.background_rms", "gp.background_scale"), ("kalman.lgs_noise", "kalman.ngs_noise")),
    look=Look("GP, both", "#55A17F", "#03E49C", (6, 2, 2, 2, 2, 2)),
    step=partial(kalman_filters, on_both),
)
