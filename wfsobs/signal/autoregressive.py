"""Autoregressive processes of second order, phi[k+1] = a1 phi[k] + a2 phi[k-1] + v[k], and of third, with one more corner.

The paper's eq. 1 (turbulence) and eq. 2 (vibration) are the same process with other numbers.

Beyond the third corner the spectrum falls as f^-6. Frozen flow falls as f^-17/3 there (Conan, Rousset and Madec, JOSA A 12, 1559,
1995), an AR(2) as f^-4: a filter with the AR(2) model takes too much of the noise for turbulence.

Two views of one process are a sum of independent processes, fitted to their spectra. The views are s and m, with real cross
spectrum. With a gain g,

    s = c + d,    m = g c + e,

c is what both see, d and e what one sees alone. Then S_c = S_sm / g, S_d = S_s - S_sm / g and S_e = S_m - g S_sm, which at every
frequency are positive for some g. Here it is the regression of m on s, so that what is strong is common; where others came out
negative they are taken as zero. Each is a third-order process in the white noise beside which it has to be known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, exp, expm1, sin, sqrt
from typing import NamedTuple

import numpy as np
import scipy
from scipy.special import expit, logit

from wfsobs.signal.whittle import negative_log_likelihood, whittle_fit
from wfsobs.signal.wiener import Complex, circle_mean
from wfsobs.typing import Array


def turbulence_corner(wind_speed: float, diameter: float, radial_order: int) -> float:
    """Return the corner frequency of the turbulence model, w0 = 0.6 pi (n + 1) V0 / D (paper, eq. 1d).

    Parameters
    ----------
    wind_speed : float
        V0 [m/s].
    diameter : float
        Aperture diameter D [m].
    radial_order : int
        Radial order n of the Zernike mode.

    Returns
    -------
    float
        Corner frequency [rad/s].

    Examples
    --------
    >>> round(turbulence_corner(15.0, 8.0, 1), 4)
    7.0686
    """
    return 0.6 * np.pi * (radial_order + 1) * wind_speed / diameter


@dataclass(frozen=True)
class Ar2:
    """AR(2) process of given corner frequency, damping and rms.

    Attributes
    ----------
    omega : float
        Corner or natural frequency [rad/s].
    damping : float
        Damping ratio xi, above 0 and at most 1.
    rms : float
        Standard deviation of phi [any unit].
    dt : float
        Time step [s].
    """

    omega: float
    damping: float
    rms: float
    dt: float

    def at(self, dt: float) -> Ar2:
        """Return the same process sampled every `dt` [s]."""
        return replace(self, dt=dt)

    @property
    def frequency(self) -> float:
        """Corner or natural frequency [Hz]."""
        return self.omega / (2.0 * np.pi)

    @property
    def turn(self) -> tuple[float, float]:
        """Decay xi w T and angle w sqrt(1 - xi^2) T of the poles exp(-decay +- i angle) in a step."""
        return self.damping * self.omega * self.dt, self.omega * np.sqrt(1.0 - self.damping**2) * self.dt

    @property
    def a1(self) -> float:
        """First AR coefficient, 2 exp(-xi w T) cos(w sqrt(1 - xi^2) T) (paper, eq. 1b)."""
        decay, angle = self.turn
        return float(2.0 * np.exp(-decay) * np.cos(angle))

    @property
    def a2(self) -> float:
        """Second AR coefficient, -exp(-2 xi w T) (paper, eq. 1c)."""
        return float(-np.exp(-2.0 * self.turn[0]))

    @property
    def correlation(self) -> float:
        """That of phi[k] and phi[k-1]."""
        return self.a1 / (1.0 - self.a2)

    @property
    def denominator(self) -> list[float]:
        """Coefficients 1, -a1, -a2 of the recursion."""
        return [1.0, -self.a1, -self.a2]

    @property
    def transition(self) -> Array:
        """Transition matrix A of the state (phi[k], phi[k-1]), shape (2, 2) (paper, eq. 7c)."""
        return np.array([[self.a1, self.a2], [1.0, 0.0]])

    @property
    def drive_variance(self) -> float:
        """Variance of the drive v for which phi has the variance rms^2."""
        return self.rms**2 * self.unit_drive_variance

    @property
    def unit_drive_variance(self) -> float:
        """Variance of the drive v for which phi has the variance 1.

        (1 + a2) ((1 - a2)^2 - a1^2) / (1 - a2), with the small factors (1 - a1 - a2) and
        (1 + a2) written so that nothing cancels when the process is slow or lightly damped.
        """
        damped, angle = self.turn
        one_plus_a2 = -np.expm1(-2.0 * damped)
        # 1 -+ a1 - a2 = |1 -+ exp(-damped + i angle)|^2
        at_zero = np.expm1(-damped) ** 2 + 4.0 * np.exp(-damped) * np.sin(angle / 2.0) ** 2
        at_nyquist = np.expm1(-damped) ** 2 + 4.0 * np.exp(-damped) * np.cos(angle / 2.0) ** 2
        return float(one_plus_a2 * at_zero * at_nyquist / (1.0 - self.a2))

    def autocovariance(self, n: int) -> Array:
        """Return E phi[k] phi[k-j] for j = 0 ... n - 1, shape (n,)."""
        first = np.array([1.0, self.correlation])
        return self.rms**2 * np.concatenate([first, self.extrapolate(first, max(n - 2, 0))])[:n]

    def psd(self, frequency: Array) -> Array:
        """Return the one-sided power spectral density [unit^2/Hz] at `frequency` [Hz]."""
        turn = 2j * np.pi * np.asarray(frequency) * self.dt
        decay, angle = self.turn
        pole = complex(-decay, angle)
        # |1 - a1 q - a2 q^2| with q = exp(-turn), as the product of the distances to both poles
        distance = np.abs(np.expm1(pole - turn) * np.expm1(pole.conjugate() - turn))
        return 2.0 * self.dt * self.drive_variance / distance**2

    def extrapolate(self, last: Array, n: int) -> Array:
        """Return the expected next `n` steps after the `last` two, shape (n,).

        With the two in reverse order, these are the expected steps before them.
        """
        return self._continue(last, np.zeros(n))

    def _continue(self, last: Array, drive: Array) -> Array:
        rest = scipy.signal.lfiltic([1.0], self.denominator, last[::-1])
        return scipy.signal.lfilter([1.0], self.denominator, drive, zi=rest)[0]

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Draw `n` steps of the process, stationary from the first, shape (n,)."""
        start = rng.standard_normal(2)
        rho1, before = self.correlation, self.rms * start[0]  # phi[-2], and phi[-1] given it
        last = rho1 * before + self.rms * np.sqrt(max(1.0 - rho1**2, 0.0)) * start[1]
        return self._continue(np.array([before, last]), np.sqrt(self.drive_variance) * rng.standard_normal(n))


SLOWEST = 1e-6
"""Minimum corner of a fitted process, over the sampling rate: 0.1 m/s on 39 m at 10 kHz."""
TOLERANCE = 1e-3
"""Distance of a fit from its minimum, in standard deviations of its parameters."""
STEPS = 100
"""Maximum number of steps of a fit."""


@dataclass(frozen=True)
class Ar3:
    """Process 1 / ((1 - p q) (1 - p* q) (1 - r q)) driven by white noise.

    Attributes
    ----------
    omega, damping : float
        Of the pole pair p = exp((-xi + i sqrt(1 - xi^2)) w T), as of an AR(2) [rad/s, -].
    corner : float
        Corner of the real pole r = exp(-corner T) [rad/s].
    rms : float
        Standard deviation [any unit].
    dt : float
        Time step [s].
    """

    omega: float
    damping: float
    corner: float
    rms: float
    dt: float

    @property
    def frequency(self) -> float:
        """That of the pole pair, omega / 2 pi [Hz]."""
        return self.omega / (2.0 * np.pi)

    @property
    def poles(self) -> Complex:
        """The three poles."""
        return np.exp(-self.decays)

    @property
    def decays(self) -> Complex:
        """Exponents a_i of the three poles exp(-a_i)."""
        pair = complex(self.damping, np.sqrt(1.0 - self.damping**2)) * self.omega * self.dt
        return np.array([pair, pair.conjugate(), self.corner * self.dt])

    @property
    def lattice(self) -> tuple[Array, Array]:
        """Partial autocorrelations k_1, k_2, k_3, all between -1 and 1, and sqrt(1 - k_i^2), both (3,).

        With e_i the elementary symmetric polynomials of the poles, D = 1 + e_2 - e_1 e_3 - e_3^2 and P the product of 1 - p_i p_j
        over i < j,

            1 - k_1 = (1 + e_3) prod (1 - p_i) / D,    1 + k_1 = (1 - e_3) prod (1 + p_i) / D,
            1 - k_2 = D / (1 - e_3^2),    1 + k_2 = P / (1 - e_3^2),    k_3 = e_3,

        which is the step-down recursion in products: nothing cancels when the process is slow.
        """
        x, y, z = self.damping * self.omega * self.dt, sqrt(1.0 - self.damping**2) * self.omega * self.dt, self.corner * self.dt
        total = 2.0 * x + z
        squares = -expm1(-2.0 * z) * _distance(2.0 * x, 2.0 * y)
        pairs = -expm1(-2.0 * x) * _distance(x + z, y)
        last = -expm1(-2.0 * total)
        D = last - 2.0 * cos(y) * exp(x - total) * expm1(-2.0 * x) - exp(z - total) * expm1(-2.0 * z)
        k = np.array([1.0 + (1.0 + exp(-total)) * expm1(-z) * _distance(x, y) / D, pairs / last - 1.0, exp(-total)])
        return k, np.array([sqrt(squares * last) / D, sqrt(D * pairs) / last, sqrt(last)])

    @property
    def unit_drive_variance(self) -> float:
        """Variance of the drive for which the process has the variance 1."""
        return float(np.prod(self.lattice[1]) ** 2)

    @property
    def drive_variance(self) -> float:
        """Variance of the drive for which the process has the variance rms^2."""
        return self.rms**2 * self.unit_drive_variance

    def psd(self, frequency: Array) -> Array:
        """Return the one-sided power spectral density [unit^2/Hz] at `frequency` [Hz]."""
        half = np.pi * np.asarray(frequency) * self.dt
        out = np.full(half.shape, 2.0 * self.dt * self.drive_variance)
        for a in self.decays:  # |1 - p q|^2 without cancellation, and without complex exponentials, which take five times as long
            within = -np.expm1(-a.real)
            out /= within**2 + 4.0 * (1.0 - within) * np.sin(half + 0.5 * a.imag) ** 2
        return out

    def log_slopes(self, frequency: Array) -> Array:
        """Return the derivatives of log `psd` by log omega, logit damping, log corner and log rms, (4, n)."""
        a, xi = self.decays, self.damping
        turn = 2j * np.pi * np.asarray(frequency) * self.dt
        pairs = _inverse_expm1(a[:, None] + a)
        drive = pairs.sum(axis=1) + np.diag(pairs) + 1.0
        total, share = a.sum(), np.exp(a - a.sum())
        drive -= (1.0 + np.exp(-2.0 * total) + share * (1.0 + np.exp(-2.0 * a))) / (
            -np.expm1(-2.0 * total) - (share * np.expm1(-2.0 * a)).sum()
        )
        by_decay = drive[:, None] - 2.0 * _inverse_expm1(a[:, None] + turn)
        damped = self.omega * self.dt * complex(xi * (1.0 - xi), -(xi**2) * np.sqrt((1.0 - xi) / (1.0 + xi)))
        moves = np.array([[a[0], a[1], 0.0], [damped, damped.conjugate(), 0.0], [0.0, 0.0, a[2]]])
        return np.vstack([(moves @ by_decay).real, np.full(by_decay.shape[1], 2.0)])


def _inverse_expm1(s: Complex) -> Complex:
    """Return 1 / (exp(s) - 1), finite for a large real part."""
    lost: Complex = np.expm1(-s)
    return -(1.0 + lost) / lost


def _distance(decay: float, angle: float) -> float:
    """Return the square of |1 - exp(-decay + i angle)| without cancellation."""
    return expm1(-decay) ** 2 + 4.0 * exp(-decay) * sin(0.5 * angle) ** 2


class Ar3Fits:
    """Fits of third-order processes in white noise to spectra, each from where the last one of its name ended.

    A fit makes the innovations of the filter built on it as white and as small as possible: it minimises the mean of
    log S + S_true / S (`whittle`). Frequencies are thinned to a fixed number per octave, each with the weight of those it
    replaces. There can be two minima, with the pair below or above the real pole: the first fit starts from `start` and from the
    same with the two exchanged, and keeps the lower minimum. A later one starts where the two before it ended, which takes a
    quarter of the steps. A minimum that comes up while both are at another one is not found.
    """

    def __init__(self) -> None:
        self._minima: dict[str, list[Ar3]] = {}

    def fit(self, name: str, spectrum: Array, noise: float, start: Ar3) -> Ar3:
        """Fit a spectrum.

        Parameters
        ----------
        name : str
            Of the spectrum: its fit starts where the last one of this name ended.
        spectrum : Array
            Two-sided spectrum per sample, on the frequencies of `wiener`, (n // 2 + 1,) [um^2].
        noise : float
            Variance of the white noise, the same in spectrum and fit [um^2].
        start : Ar3
            First guess where there is no fit of this name.

        Returns
        -------
        Ar3
            The process whose spectrum is nearest.
        """
        exchanged = replace(start, omega=start.corner, corner=start.omega)
        found = self._minima[name] = _minima(spectrum, noise, self._minima.get(name, [start, exchanged]))
        return found[0]


def _minima(spectrum: Array, noise: float, starts: Sequence[Ar3]) -> list[Ar3]:
    """Return where the fits from these starts end, the lowest minimum first."""
    n, dt = 2 * (spectrum.size - 1), starts[0].dt
    edges = np.unique(np.concatenate([[1], np.geomspace(1, n // 2 + 1, 400).astype(int)]))
    bins, count = edges[:-1], np.diff(edges)
    frequency = (bins + 0.5 * (count - 1)) / (n * dt)
    mean = np.add.reduceat(spectrum[: edges[-1]], bins) / count + noise

    def process(x: Array) -> Ar3:
        return Ar3(float(np.exp(x[0])), float(expit(x[1])), float(np.exp(x[2])), float(np.exp(x[3])), dt)

    def density(x: Array) -> Array:
        return process(x).psd(frequency) / (2.0 * dt) + noise

    def log_slopes(x: Array, S: Array) -> Array:
        return process(x).log_slopes(frequency) * (1.0 - noise / S)

    slowest = np.log(SLOWEST / dt)
    bounds = np.array([(slowest, np.log(1.0 / dt)), (-4.0, 6.0), (slowest, np.log(3.0 / dt)), (np.log(1e-6), np.log(1e3))])
    found = []
    for start in starts:
        first = np.array([np.log(start.omega), logit(min(start.damping, 0.999)), np.log(start.corner), np.log(start.rms)])
        found.append(whittle_fit(density, log_slopes, first, bounds, mean, count, TOLERANCE, STEPS))
    return [process(x) for x in sorted(found, key=lambda x: negative_log_likelihood(density(x), mean, count))]


NOTHING = 1e-6
"""Variance over that of the noise below which a process is left out."""

FLOOR = 1e-12
"""Minimum of a spectrum, over the noise: where others would be negative."""


class SharedProcess(NamedTuple):
    """Processes common to both views, of s alone and of m alone; gain : of m for those in common."""

    gain: float
    common: tuple[Ar3, ...]
    first: tuple[Ar3, ...]
    second: tuple[Ar3, ...]


def fit_shared_process(
    first: Array, second: Array, cross: Array, noise: float, start: Ar3, fits: Ar3Fits | None = None
) -> SharedProcess:
    """Fit the processes of two views.

    Parameters
    ----------
    first, second : Array
        Spectra of s and m per sample, on the frequencies of `wiener`, (n // 2 + 1,).
    cross : Array
        Real part of their cross spectrum, (n // 2 + 1,).
    noise : float
        Variance of the white noise of a measurement.
    start : Ar3
        First guess of shape; each starts with its own rms.
    fits : Ar3Fits, optional
        Those of similar spectra, to start from.

    Returns
    -------
    SharedProcess
        Gain and processes.
    """
    fits = fits or Ar3Fits()

    def fit(name: str, spectrum: Array) -> tuple[Ar3, ...]:
        positive = np.maximum(spectrum, FLOOR * noise)
        variance = circle_mean(positive)
        if variance <= NOTHING * noise:
            return ()
        return (fits.fit(name, positive, noise, replace(start, rms=float(np.sqrt(variance)))),)

    strength, together = circle_mean(first), circle_mean(cross)
    gain = together / strength if strength > 0 else 0.0
    if gain <= 0.0:
        return SharedProcess(0.0, (), fit("first", first), fit("second", second))
    common = cross / gain
    return SharedProcess(gain, fit("common", common), fit("first", first - common), fit("second", second - gain * cross))
