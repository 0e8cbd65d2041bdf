"""The least error of any causal linear observer: Wiener filter by spectral factorisation.

A target s[k] is estimated from all measurements z[k], z[k-1], ... of a stationary process. With the spectrum of z factorised
as S_z = sigma^2 |H|^2, H and 1/H causal, the innovations e = z / H are white, and the best estimate keeps of the
cross spectrum S_sz = E s z* what is causal after whitening,

    G = S_sz / H*,    error = E s^2 - sum_{n >= 0} g[n]^2 / sigma^2
                            = mean(S_s - |S_sz|^2 / S_z) + sum_{n < 0} g[n]^2 / sigma^2.

The second form, the error of the two-sided filter plus what causality costs, is a sum of positive terms, so that a small
error keeps its digits. H is the exponential of the causal half of the cepstrum, the inverse DFT of log S_z (Kolmogorov; Oppenheim
and Schafer, Discrete-Time Signal Processing, section 13.6). No filter of Gaussian signals does better, linear or not.

Spectra are two-sided and per sample, on the frequencies 0 ... 1/2 of a DFT of even length n, shape (n // 2 + 1,): their
mean over the whole circle is the variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wfsobs.typing import Array

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Whitener:
    """H (n // 2 + 1,) complex of the measurement's spectrum S_z (n // 2 + 1,), and the variance of the innovations."""

    spectrum: Array
    H: Complex
    innovation_variance: float

    @property
    def n(self) -> int:
        """Length of the DFT."""
        return 2 * (self.spectrum.size - 1)


def factorise(spectrum: Array) -> Whitener:
    """The minimum-phase factor of a spectrum. Raises ValueError unless it is positive throughout."""
    if not (np.isfinite(spectrum).all() and (spectrum > 0).all()):
        raise ValueError("the measurement's spectrum must be above 0 at every frequency: it needs some noise")
    n = 2 * (spectrum.size - 1)
    cepstrum = np.fft.irfft(np.log(spectrum), n)
    causal = np.zeros(n)
    causal[1 : n // 2] = cepstrum[1 : n // 2]
    causal[n // 2] = 0.5 * cepstrum[n // 2]
    return Whitener(spectrum, np.exp(np.fft.rfft(causal)), float(np.exp(cepstrum[0])))


def error_spectrum(target: Array, cross: Complex, whitener: Whitener) -> Array:
    """The spectrum of the least error of s[k] from z[k], z[k-1], ..., (n // 2 + 1,).

    target : S_s; cross : S_sz, the transform over n of E s[k] z[k-n]; both (n // 2 + 1,)
    """
    g = np.fft.irfft(cross / whitener.H.conj(), whitener.n)
    g[: whitener.n // 2] = 0.0
    anticausal = np.abs(np.fft.rfft(g)) ** 2 / whitener.innovation_variance
    return np.maximum(target - np.abs(cross) ** 2 / whitener.spectrum, 0.0) + anticausal


def causal_error(target: Array, cross: Complex, whitener: Whitener) -> float:
    """Variance of that error."""
    return circle_mean(error_spectrum(target, cross, whitener))


def explained(measured: Array, cross: Array) -> Array:
    """What n = 1, 2, ... measurements z[k], ..., z[k-n+1] explain of the variance of targets s[k], (n_targets, n).

    measured : autocovariance of z at the lags 0 ... n - 1, (n,); cross : E s[k] z[k-j], j = 0 ... n - 1, (n_targets, n)

    Levinson's recursion: the errors of predicting each earlier measurement from the later ones are orthogonal.
    """
    n = measured.size
    backwards = np.ascontiguousarray(cross[:, ::-1])
    predictor, error = np.zeros(n), float(measured[0])
    predictor[0] = 1.0
    out = np.empty_like(backwards)
    for k in range(n):
        if k:
            reflection = float(predictor[:k] @ measured[k:0:-1]) / error
            predictor[1 : k + 1] -= reflection * predictor[k - 1 :: -1] if k > 1 else reflection
            error *= 1.0 - reflection**2
        out[:, k] = (backwards[:, n - 1 - k :] @ predictor[: k + 1]) ** 2 / error
    return np.cumsum(out, axis=1)


def freedom(covariance: Array, n_steps: int) -> float:
    """Degrees of freedom of the mean square of `n_steps` samples of a Gaussian process with the autocovariance r at the lags
    0, 1, ...: those of the chi-square distribution with its mean and variance (Satterthwaite, Biometrics Bulletin 2, 1946).

    The mean square has the variance (2 / N) sum (1 - |k| / N) r[k]^2.
    """
    r = covariance[:n_steps]
    weight = 1.0 - np.arange(r.size) / n_steps
    return float(n_steps * r[0] ** 2 / (2.0 * np.sum(weight * r**2) - r[0] ** 2))


def circle_mean(spectrum: Array) -> float:
    """Mean over the whole circle of a spectrum given on its upper half: the variance."""
    return float((2.0 * spectrum.sum() - spectrum[0] - spectrum[-1]) / (2 * (spectrum.size - 1)))


def advanced(spectrum: Complex | Array, steps: int) -> Complex:
    """S_sz of z[k] = s[k - steps] + anything independent: the spectrum, turned `steps` ahead."""
    return spectrum * np.exp(2j * np.pi * steps * np.arange(spectrum.size) / (2 * (spectrum.size - 1)))
