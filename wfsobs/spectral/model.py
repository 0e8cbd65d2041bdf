"""The spectrum of one mode of z: white noise, turbulence of order two or three, AR(2) resonances. For lines see `search`.

A measurement may have a coloured background, noise that is flat up to a corner far above that of turbulence: the aliasing of a
Shack-Hartmann sensor is like that.

Any spectrum is approximated by the sum of a few AR(2) processes, the rational function of their poles that is nearest to it. What
a filter makes of a spectrum is decided where that stands above what else is measured, `beside`. The processes are therefore
fitted by Whittle's likelihood of both together, all octaves with the same weight: a filter tells disturbances apart at low
frequencies, of which a linear axis has few. They are added one by one, each where the likelihood gains most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from math import log, pi, sqrt

import numpy as np
from scipy.special import expit, logit

from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.signal.whittle import whittle_fit
from wfsobs.typing import Array


def densities(numbers: Array, dt: float, f: Array) -> tuple[Array, Array]:
    """Compute the densities of AR(2) processes and the derivatives of their logarithms.

    The density is that of the drive over the squares of two distances |1 - r exp(i a)|^2 = (1 - r)^2 + 4 r sin(a / 2)^2, where
    r exp(+- i angle) are the poles and a = angle -+ 2 pi f dt; that of the drive has two such distances as well, with a = angle
    and a = angle - pi.

    Parameters
    ----------
    numbers : Array
        Log of omega [rad/s], logit of the damping, log of the rms [um], (processes, 3).
    dt : float
        Time step [s].
    f : Array
        Frequencies [Hz].

    Returns
    -------
    density : Array
        One-sided [um^2/Hz], (processes, len(f)).
    slopes : Array
        Derivatives of its logarithm by the numbers, (processes, 3, len(f)).
    """
    omega, damping, rms = np.exp(numbers[:, :1]), expit(numbers[:, 1:2]), np.exp(numbers[:, 2:])
    damped, rest = damping * omega * dt, np.sqrt(expit(-numbers[:, 1:2]) * (1.0 + damping))  # rest = sqrt(1 - damping^2)
    angle, r, short, lost = rest * omega * dt, np.exp(-damped), -np.expm1(-damped), -np.expm1(-2.0 * damped)  # 1 - r, 1 - r^2

    def distance(half_sine: Array, sine: Array) -> tuple[Array, Array]:
        """Return the inverse of one, of 2 sqrt(r) sin(a / 2), and the derivative of its logarithm by a, of 2 r sin(a)."""
        inverse = 1.0 / (short**2 + half_sine**2)
        return inverse, sine * inverse

    # The derivative of the logarithm by r is 1 / r - (1 - r^2) / r over the distance.
    wide, turned = 2.0 * np.sqrt(r), np.pi * f * dt
    s, c, of_sine, of_cosine = (g(x) for x in (0.5 * angle, angle) for g in (np.sin, np.cos))
    drive, drive_a = zip(distance(wide * s, 2.0 * r * of_sine), distance(wide * c, -2.0 * r * of_sine), strict=True)
    sc, cs = wide * s * np.cos(turned), wide * c * np.sin(turned)
    of_sum, of_difference = 2.0 * r * of_sine * np.cos(2.0 * turned), 2.0 * r * of_cosine * np.sin(2.0 * turned)
    (low, low_a), (high, high_a) = distance(sc - cs, of_sum - of_difference), distance(sc + cs, of_sum + of_difference)
    S = 2.0 * dt * rms**2 * lost / ((1.0 + r**2) * drive[0] * drive[1]) * (low * high)
    by_r = lost / r * (low + high - drive[0] - drive[1]) - 2.0 * r / lost - 2.0 * r / (1.0 + r**2)
    by_angle = sum(drive_a) - low_a - high_a
    slopes = np.empty((len(numbers), 3, len(f)))
    slopes[:, 0] = angle * by_angle - damped * r * by_r
    slopes[:, 1] = (r * by_r + damping / rest * by_angle) * (-omega * dt * damping * (1.0 - damping))
    slopes[:, 2] = 2.0
    return S, slopes


SLOW, FAST, LEAST = 1e-3, 1.5, 0.02
"""Bounds of omega of third-order turbulence, over the rate, and of its damping: beyond them it loses digits."""
RMS = 2
"""Index of the log of the rms among the numbers of a process."""
HIGHEST = 0.999
"""Maximum damping of a process: at 1 its two poles are one."""


@dataclass(frozen=True)
class Spectrum:
    """Model of the spectrum of one mode.

    Attributes
    ----------
    noise : float
        Rms of the white noise [um].
    dt : float
        Time step [s].
    turbulence : Ar2 or Ar3, optional
        Coloured noise of the atmosphere.
    resonances : tuple of Ar2
        Any number.
    background : Ar2, optional
        Another coloured noise.
    """

    noise: float
    dt: float
    turbulence: Ar2 | Ar3 | None = None
    resonances: tuple[Ar2, ...] = ()
    background: Ar2 | None = None

    @property
    def continuum(self) -> tuple[Ar2 | Ar3, ...]:
        """Turbulence and background, where present."""
        return tuple(p for p in (self.turbulence, self.background) if p is not None)

    @property
    def processes(self) -> tuple[Ar2 | Ar3, ...]:
        """Turbulence and background, where present, and the resonances."""
        return self.continuum + self.resonances

    def psd(self, f: Array) -> Array:
        """Return the one-sided power spectral density [um^2/Hz] at f [Hz]."""
        sine, cosine = np.sin(np.pi * f * self.dt), np.cos(np.pi * f * self.dt)
        return 2.0 * self.dt * self.noise**2 + sum((_density(p, sine, cosine) for p in self.processes), np.zeros_like(f))

    def without(self, resonance: Ar2) -> Spectrum:
        """Return the spectrum without one of its resonances."""
        return replace(self, resonances=tuple(p for p in self.resonances if p is not resonance))

    @property
    def vector(self) -> Array:
        """Parameter vector: log noise, then log omega, logit damping, log rms of every process, (numbers,).

        A third corner lies beyond omega; its parameter is the log of the distance, over omega.
        """
        return np.concatenate([[np.log(self.noise)], *map(_vector, self.processes)])

    @property
    def starts(self) -> list[int]:
        """Index in `vector` of the first parameter of every process, and of the end."""
        return list(accumulate((3 + isinstance(p, Ar3) for p in self.processes), initial=1))

    @property
    def free_parameters(self) -> list[int]:
        """Indices in `vector` that fits change: all but the damping of the background, which is flat up to its corner."""
        fixed = self.starts[self.turbulence is not None] + 1 if self.background else -1
        return [i for i in range(self.starts[-1]) if i != fixed]

    def with_vector(self, vector: Array) -> Spectrum:
        """Return the spectrum with this parameter `vector`."""
        processes = [_process(vector[a:b], self.dt) for a, b in pairwise(self.starts)]
        turbulence, background = (None if p is None else processes.pop(0) for p in (self.turbulence, self.background))
        return replace(
            self, noise=float(np.exp(vector[0])), turbulence=turbulence, background=background, resonances=tuple(processes)
        )

    def slopes(self, f: Array, indices: Sequence[int]) -> Array:
        """Return the derivatives of the density by parameters, in the order of `indices`, (len(indices), len(f)) [um^2/Hz]."""
        rows = {0: np.full_like(f, 4.0 * self.dt * self.noise**2)}
        ranges = zip(pairwise(self.starts), self.processes, strict=True)
        moved = [(start, p) for (start, end), p in ranges if any(start <= i < end for i in indices)]
        if second := [(start, p) for start, p in moved if isinstance(p, Ar2)]:
            density, slopes = densities(np.array([_vector(p) for _, p in second]), self.dt, f)
            slopes *= density[:, None]
            rows |= {start + i: slopes[k, i] for k, (start, _) in enumerate(second) for i in range(3)}
        for start, p in moved:
            if isinstance(p, Ar3):
                rows |= {start + i: row for i, row in enumerate(_slopes_of_third_order(p, f))}
        return np.array([rows[i] for i in indices])


def _slopes_of_third_order(p: Ar3, f: Array) -> Array:
    """Return the derivatives of the density by the parameters of a process, (4, len(f)) [um^2/Hz]."""
    by_omega, by_damping, by_corner, by_rms = p.psd(f) * p.log_slopes(f)
    return np.array([by_omega + by_corner, by_damping, by_rms, (1.0 - p.omega / p.corner) * by_corner])


def _density(p: Ar2 | Ar3, sine: Array, cosine: Array) -> Array:
    """Return the one-sided power spectral density [um^2/Hz] of a process; most of the work of `Ar2.psd` is sine and cosine."""
    damped, angle = p.damping * p.omega * p.dt, 0.5 * p.omega * np.sqrt(1.0 - p.damping**2) * p.dt
    # |1 - exp(-damped + 2i x)|^2 = (1 - exp(-damped))^2 + 4 exp(-damped) sin^2 x at both x = pi f dt -+ angle
    a, b = sine * np.cos(angle), cosine * np.sin(angle)
    flat, turning = np.expm1(-damped) ** 2, 4.0 * np.exp(-damped)
    out = 2.0 * p.dt * p.drive_variance / ((flat + turning * (a - b) ** 2) * (flat + turning * (a + b) ** 2))
    if isinstance(p, Ar3):
        decay = p.corner * p.dt
        out /= np.expm1(-decay) ** 2 + 4.0 * np.exp(-decay) * sine**2
    return out


def _vector(p: Ar2 | Ar3) -> Array:
    more = [np.log(max(p.corner / p.omega - 1.0, 1e-6))] if isinstance(p, Ar3) else []
    return np.array([np.log(p.omega), logit(p.damping), np.log(p.rms), *more])


def _process(v: Array, dt: float) -> Ar2 | Ar3:
    omega, damping, rms = float(np.exp(v[0])), min(max(float(expit(v[1])), 1e-9), HIGHEST), float(np.exp(v[2]))
    if len(v) == 3:
        return Ar2(omega, damping, rms, dt)
    omega = min(max(omega, SLOW / dt), FAST / dt)
    return Ar3(omega, max(damping, LEAST), min(omega * (1.0 + float(np.exp(v[3]))), 2.0 * FAST / dt), rms, dt)


DAMPING = 0.8
"""Its damping, which no fit changes."""
BACKGROUND_REACHES = (0.02, 0.08)
"""Its corners, over the rate, at which a fit starts: 20 and 80 Hz at 1 kHz."""
BACKGROUND_WORTH = 8.0
"""Minimum gain of log-likelihood for its two parameters: noise gains as much with a probability of 0.03 % (chi squared of 16)."""


def with_first_guess(spectrum: Spectrum, reach: float) -> Spectrum:
    """Return a spectrum with a background to start from, of about half the density of the noise.

    reach : its corner over the rate
    """
    dt = spectrum.dt
    return replace(spectrum, background=Ar2(2.0 * pi * reach / dt, DAMPING, spectrum.noise * sqrt(reach), dt))


BINS = 400
"""Approximate number of bands, evenly spaced in the logarithm of the frequency."""
NARROWEST, WIDEST = 1e-4, 0.99
"""Bounds of the damping."""
WEAKEST, STRONGEST = 1e-5, 1e5
"""Bounds of the rms of a process, over that of the whole spectrum."""
TOLERANCE, STEPS = 0.1, 60
"""Distance of a fit from its minimum, in standard deviations of its parameters; maximum number of steps."""


def fit_processes(spectrum: Array, beside: Array, dt: float, count: int) -> tuple[Ar2, ...]:
    """Fit a sum of processes to a spectrum.

    Parameters
    ----------
    spectrum, beside : Array
        Two-sided spectra per sample of what is to be modelled, and of what else is measured, which is above zero; on the
        frequencies of `wiener`, (n // 2 + 1,).
    dt : float
        Time step [s].
    count : int
        Number of processes.

    Returns
    -------
    tuple of Ar2
        The processes; none for a spectrum of zero.
    """
    n = 2 * (spectrum.size - 1)
    edges = np.unique(np.geomspace(1, n // 2 + 1, BINS).astype(int))
    low, high, size = edges[:-1], edges[1:], np.diff(edges)
    f = 0.5 * (low + high - 1) / (n * dt)
    own, other = (2.0 * dt * np.add.reduceat(x[: edges[-1]], low) / size for x in (spectrum, beside))
    power = size * own / (n * dt)
    if not power.any():
        return ()
    rms, weight, x = np.sqrt(power.sum()), np.ones_like(f), np.zeros(0)
    bounds = [(log(2.0 * pi * f[0]), log(0.95 * pi / dt)), (logit(NARROWEST), logit(WIDEST))]
    bounds.append((log(WEAKEST * rms), log(STRONGEST * rms)))

    def density(x: Array) -> Array:
        return other + densities(x.reshape(-1, 3), dt, f)[0].sum(axis=0)

    def log_slopes(x: Array, S: Array) -> Array:
        parts, slopes = densities(x.reshape(-1, 3), dt, f)
        return (parts[:, None] * slopes).reshape(-1, f.size) / S

    for _ in range(count):
        S = density(x) if x.size else other
        first, last = _strongest_band((own + other) / S)
        width, centre = (high[last] - low[first]) / (n * dt), 0.5 * (high[last] + low[first] - 1) / (n * dt)
        excess = np.sum((size * (own + other - S))[first : last + 1]) / (n * dt)
        new = [log(2.0 * pi * centre), logit(np.clip(0.25 * width / centre, 2.0 * NARROWEST, 0.9)), 0.5 * log(excess)]
        x = np.concatenate([x, new])
        x = whittle_fit(density, log_slopes, x, np.array(bounds * (x.size // 3)), own + other, weight, TOLERANCE, STEPS)
    return tuple(Ar2(float(np.exp(w)), float(expit(d)), float(np.exp(a)), dt) for w, d, a in x.reshape(-1, 3))


def _strongest_band(ratio: Array) -> tuple[int, int]:
    """Return the first and the last bin of the run that gains most by one density for all; ratio : wanted over present."""
    best = (-1.0, 0, 0)
    for length in 2 ** np.arange(int(np.log2(ratio.size)) + 1):
        mean = np.convolve(ratio, np.full(length, 1.0 / length), "valid")
        gain = np.where(mean > 1.0, length * (mean - 1.0 - np.log(mean)), -1.0)
        at = int(np.argmax(gain))
        best = max(best, (float(gain[at]), at, at + int(length) - 1))
    return best[1:]
