"""Minimum error of any causal linear observer: Wiener filter by spectral factorisation.

A target s[k] is estimated from all measurements z[k], z[k-1], ... of a stationary process. With the spectrum of z factorised
as S_z = sigma^2 |H|^2, H and 1/H causal, the innovations e = z / H are white, and the best estimate keeps the causal part of
the cross spectrum S_sz = E s z* after whitening,

    G = S_sz / H*,    error = E s^2 - sum_{n >= 0} g[n]^2 / sigma^2
                            = mean(S_s - |S_sz|^2 / S_z) + sum_{n < 0} g[n]^2 / sigma^2.

The second form, the error of the two-sided filter plus the cost of causality, is a sum of positive terms, so that a small
error keeps its digits. H is the exponential of the causal half of the cepstrum, the inverse DFT of log S_z (Kolmogorov; Oppenheim
and Schafer, Discrete-Time Signal Processing, section 13.6). For Gaussian signals no filter is better, linear or not.

Spectra are two-sided and per sample, on the frequencies 0 ... 1/2 of a DFT of even length n, shape (n // 2 + 1,): their
mean over the whole circle is the variance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from wfsobs.typing import Array

Complex = NDArray[np.complex128]

LOOK = 64
"""Measurements after which is looked whether their explained variance is enough."""


Item = TypeVar("Item")
Found = TypeVar("Found")


def in_two_threads(function: Callable[[Item], Found], items: Iterable[Item]) -> list[Found]:
    """Return what a function makes of every item: products and factors of matrices leave the interpreter to others."""
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(function, items))


@dataclass(frozen=True)
class Whitener:
    """Minimum-phase factor of a measurement's spectrum.

    Attributes
    ----------
    spectrum : Array
        S_z, (n // 2 + 1,).
    turn : Array
        H / |H|, complex, (n // 2 + 1,).
    innovation_variance : float
        Variance of the innovations.
    """

    spectrum: Array
    turn: Complex
    innovation_variance: float

    @property
    def n(self) -> int:
        """Length of the DFT."""
        return 2 * (self.spectrum.size - 1)

    @property
    def factor(self) -> Complex:
        """H, (n // 2 + 1,)."""
        return np.sqrt(self.spectrum / self.innovation_variance) * self.turn

    @cached_property
    def backwards(self) -> Complex:
        """1 / (sigma H*), (n // 2 + 1,): what makes of a cross spectrum with z that with its innovations, of variance one."""
        return self.turn * (1.0 / np.sqrt(self.spectrum))


def factorise(spectrum: Array) -> Whitener:
    """Return the minimum-phase factor of a spectrum.

    Parameters
    ----------
    spectrum : Array
        S_z, (n // 2 + 1,).

    Returns
    -------
    Whitener
        Factor and innovation variance.

    Raises
    ------
    ValueError
        The spectrum is not positive throughout.
    """
    if not (np.isfinite(spectrum).all() and (spectrum > 0).all()):
        raise ValueError("the measurement's spectrum must be above 0 at every frequency: it needs some noise")
    n = 2 * (spectrum.size - 1)
    cepstrum = fft.irfft(np.log(spectrum), n)
    variance = float(np.exp(cepstrum[0]))
    cepstrum[0] = cepstrum[n // 2 :] = 0.0  # |H| is that of the spectrum: only the angle is to be found
    angle, turn = fft.rfft(cepstrum).imag, np.empty(spectrum.size, dtype=np.complex128)
    np.cos(angle, out=turn.real)
    np.sin(angle, out=turn.imag)
    return Whitener(spectrum, turn, variance)


def innovations_to_come(cross: Complex, whitener: Whitener, first: int = 1) -> Complex:
    """Return what an estimate from all of z takes from the innovations of later steps, of variance one.

    Parameters
    ----------
    cross : Array
        S_sz, the transform over n of E s[k] z[k-n], (n // 2 + 1,).
    whitener : Whitener
        Factor of S_z.
    first : int
        Steps from k to the first innovation.

    Returns
    -------
    Array
        Transform over t of the weight of e[k+t], (n // 2 + 1,).
    """
    weights = fft.irfft((cross * whitener.backwards).conj(), whitener.n)
    weights[:first] = weights[whitener.n // 2 :] = 0.0
    return fft.rfft(weights)


def error_spectrum(target: Array, cross: Complex, whitener: Whitener, to_come: Complex | None = None) -> Array:
    """Return the spectrum of the minimum error of s[k] from z[k], z[k-1], ....

    Parameters
    ----------
    target : Array
        S_s, (n // 2 + 1,).
    cross : Array
        S_sz, as for `innovations_to_come`.
    whitener : Whitener
        Factor of S_z.
    to_come : Array, optional
        What `innovations_to_come` returns, where already computed.

    Returns
    -------
    Array
        Spectrum of the error, (n // 2 + 1,).
    """
    future = innovations_to_come(cross, whitener) if to_come is None else to_come
    return np.maximum(target - square(cross) / whitener.spectrum, 0.0) + square(future)


def square(z: Complex) -> Array:
    """Return |z|^2."""
    return np.asarray(z.real**2 + z.imag**2)


def explained_variance(autocovariance: Array, cross: Array, *, enough: Array | float = np.inf) -> Array:
    """Return the variance of targets s[k] that n = 1, 2, ... measurements z[k], ..., z[k-n+1] explain.

    Levinson's recursion: the errors of predicting each earlier measurement from the later ones are orthogonal.

    Parameters
    ----------
    autocovariance : Array
        Autocovariance of z at the lags 0 ... n - 1, (n,).
    cross : Array
        E s[k] z[k-j], j = 0 ... n - 1, (n_targets, n).
    enough : Array or float
        Explained variance of each target, (n_targets,); measurements after all have it are left out.

    Returns
    -------
    Array
        Explained variance, (n_targets, n), or of fewer measurements.
    """
    n, error = autocovariance.size, float(autocovariance[0])
    last, rows = np.zeros(n), np.zeros((LOOK, n))  # weights of the newest measurement first, as in `cross`
    out, so_far = np.empty_like(cross), np.zeros((len(cross), 1))
    for start in range(1 - LOOK, n, LOOK):
        orders, errors = range(max(start, 0), min(start + LOOK, n)), []
        for row, k in zip(rows, orders, strict=False):
            reflection = float(last[:k] @ autocovariance[1 : k + 1]) / error
            error *= 1.0 - reflection**2
            np.multiply(last[k - 1 :: -1] if k else last[:0], -reflection, out=row[:k])
            row[1 : k + 1] += last[:k]
            row[k] = 1.0
            last = row
            errors.append(error)
        last = last.copy()
        some = slice(orders.start, orders.stop)
        out[:, some] = so_far + np.cumsum((cross @ rows[: len(orders)].T) ** 2 / errors, axis=1)
        so_far = out[:, orders.stop - 1 : orders.stop]
        if (so_far[:, 0] >= enough).all():
            return out[:, : orders.stop]
    return out


def degrees_of_freedom(covariance: Array, n_steps: int) -> float:
    """Return the degrees of freedom of the mean square of `n_steps` samples of a Gaussian process.

    Those of the chi-square distribution with its mean and variance (Satterthwaite, Biometrics Bulletin 2, 1946); the mean square
    has the variance (2 / N) sum (1 - |k| / N) r[k]^2.

    Parameters
    ----------
    covariance : Array
        Autocovariance r at the lags 0, 1, ....
    n_steps : int
        Number of samples N.

    Returns
    -------
    float
        Degrees of freedom.
    """
    r = covariance[:n_steps]
    weight = 1.0 - np.arange(r.size) / n_steps
    return float(n_steps * r[0] ** 2 / (2.0 * np.sum(weight * r**2) - r[0] ** 2))


def circle_mean(spectrum: Array) -> float:
    """Return the mean over the whole circle of a spectrum given on its upper half: the variance."""
    return float((2.0 * spectrum.sum() - spectrum[0] - spectrum[-1]) / (2 * (spectrum.size - 1)))


def advance_spectrum(spectrum: Complex | Array, steps: int) -> Complex:
    """Return S_sz of z[k] = s[k - steps] + anything independent: the spectrum with the phase of `steps` ahead."""
    return spectrum * _advance(steps, spectrum.shape[-1])


@lru_cache(maxsize=4)
def _advance(steps: int, size: int) -> Complex:
    found = np.exp(2j * np.pi * steps * np.arange(size) / (2 * (size - 1)))
    found.flags.writeable = False
    return found
