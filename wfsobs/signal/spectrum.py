"""Spectra and signals: damped lines, tables, a bank of band-passes, and the inverse DFT (paper, Algorithm 4).

All spectra are one-sided power spectral densities: their integral over positive frequencies is the
variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag

from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.typing import Array, fill_masked


def bandpass_bank(frequencies: Sequence[float], bandwidth: float, order: int, dt: float) -> list[Array]:
    """Design one digital Butterworth band-pass per centre frequency.

    Parameters
    ----------
    frequencies : sequence of float
        Centres [Hz].
    bandwidth : float
        Full width [Hz]: the edges are centre +- bandwidth / 2.
    order : int
        Order of each filter.
    dt : float
        Time step [s].

    Returns
    -------
    list of Array
        Second-order sections, one array per centre.
    """
    return [_bandpass(f - bandwidth / 2.0, f + bandwidth / 2.0, order, dt).copy() for f in frequencies]


@lru_cache(maxsize=64)  # a run asks several times for the same ones
def _bandpass(low: float, high: float, order: int, dt: float) -> Array:
    return scipy.signal.butter(order, [low, high], "bandpass", fs=1.0 / dt, output="sos")


def filter_causal(bank: Sequence[Array], x: Array) -> Array:
    """Return the sum of the band-passes of x (n, n_modes) along the steps, from rest; same shape."""
    out = np.zeros_like(x)
    for sos in bank:
        out += scipy.signal.sosfilt(sos, x, axis=0)
    return out


def filter_zero_phase(bank: Sequence[Array], x: Array) -> Array:
    """Return the sum of the band-passes, each run forward and then backward in time, so without delay; same shape.

    Not causal: for references and training targets only.
    """
    out = np.zeros_like(x)
    for sos in bank:
        forward = scipy.signal.sosfilt(sos, x, axis=0)
        out += scipy.signal.sosfilt(sos, forward[::-1], axis=0)[::-1]
    return out


def bank_recursion(bank: Sequence[Array]) -> PeriodicFilter:
    """Return `filter_causal` of one signal as a recursion."""
    systems = [sos2ss(sos) for sos in bank]
    A = block_diag(*(A for A, *_ in systems))
    b, c = (np.concatenate([system[i] for system in systems]) for i in (1, 2))
    return PeriodicFilter([(A, b[:, None], c[None], np.array([[sum(d for *_, d in systems)]]))])


def sos2ss(sos: Array) -> tuple[Array, Array, Array, float]:
    """Return the state space (A, b, c, d) of second-order sections in series, each in transposed direct form II."""
    A, b, c, d = np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0
    for b0, b1, b2, _, a1, a2 in sos:
        Ai = np.array([[-a1, 1.0], [-a2, 0.0]])
        bi = np.array([b1 - a1 * b0, b2 - a2 * b0])
        A = np.block([[A, np.zeros((len(A), 2))], [np.outer(bi, c), Ai]])
        b, c, d = np.concatenate([b, bi * d]), np.concatenate([b0 * c, [1.0, 0.0]]), b0 * d
    return A, b, c, d


def bin_frequencies(n: int, dt: float) -> Array:
    """Return the frequencies [Hz] of the DFT of `n` samples every `dt` [s], 0 to Nyquist, spaced 1 / (n dt)."""
    return np.fft.rfftfreq(n, dt)


def resonance_power(frequency: float, damping: float, edges: ArrayLike) -> Array:
    """Return the share of a damped resonance's variance between successive edges.

    The density is that of a white-driven mass-spring-damper, S(f) ~ 1 / |f0^2 - f^2 + 2 i xi f0 f|^2,
    of integral 1 over (0, inf). It is integrated in closed form, so a resonance that is narrower than
    its bin keeps its power. With p = f0 (sqrt(1 - xi^2) + i xi), 1 / ((f^2 - p^2) (f^2 - p*^2))
    has the antiderivative Im(log((f - p) / (f + p)) / 2p) / Im(p^2).
    Damping 1 (a double pole) is computed as 1 - 1e-9.

    Parameters
    ----------
    frequency : float
        Natural frequency f0 [Hz].
    damping : float
        Damping ratio xi.
    edges : array_like
        Edges of the bins [Hz].

    Returns
    -------
    Array
        Shares, (len(edges) - 1,).
    """
    xi = min(max(damping, 1e-12), 1.0 - 1e-9)
    p = complex(np.sqrt(1.0 - xi**2), xi)  # in units of f0
    f = np.asarray(edges, dtype=float) / frequency
    # Both logarithms stay on one side of the cut for real f >= 0, Im p > 0.
    integral = ((np.log(p - f) - np.log(p + f)) / (2.0 * p)).imag
    total = (1j * np.pi / (2.0 * p)).imag  # log(p - f) - log(p + f) -> i pi
    return np.maximum(np.diff(integral) / total, 0.0)


def bin_edges(n: int, dt: float) -> Array:
    """Return the edges [Hz] of the DFT bins; the first bin (frequency 0) and the last are half as wide."""
    f = bin_frequencies(n, dt)
    df = 1.0 / (n * dt)
    return np.clip(np.append(f - df / 2.0, f[-1] + df / 2.0), 0.0, 0.5 / dt)


def table_power(frequency: ArrayLike, density: ArrayLike, n: int, dt: float) -> Array:
    """Return the variance in each DFT bin of a tabulated density.

    The density is integrated over the bin, so a line narrower than the bins of a short record keeps its power.

    Parameters
    ----------
    frequency : array_like
        Frequencies of the table [Hz].
    density : array_like
        Density [unit^2/Hz], linear between the frequencies and zero outside them.
    n : int
        Length of the DFT.
    dt : float
        Time step [s].

    Returns
    -------
    Array
        Variance [unit^2], (n // 2 + 1,).
    """
    f, S = np.asarray(frequency, float), np.asarray(density, float)
    edges = bin_edges(n, dt)
    grid = np.union1d(f, edges)
    heights = np.interp(grid, f, S, left=0.0, right=0.0)
    # np.interp is zero outside [f[0], f[-1]] but not at these two: the pieces that end there from outside are empty.
    pieces = 0.5 * np.diff(grid) * (heights[1:] + heights[:-1])
    pieces[(grid[1:] <= f[0]) | (grid[:-1] >= f[-1])] = 0.0
    total = np.concatenate([[0.0], np.cumsum(pieces)])
    return np.diff(total[np.searchsorted(grid, edges)])


def random_phase_signal(power: ArrayLike, n: int, rng: np.random.Generator) -> Array:
    """Draw a real signal of `n` samples whose DFT bins have a given power and random phases.

    The amplitude of a bin of power S df is sqrt(2 S df), its phase uniform on [0, 2 pi) (paper,
    Algorithm 4, which prints S itself as amplitude and drops the imaginary unit). The bins at zero
    and at Nyquist stay empty: a phase means nothing there.

    Parameters
    ----------
    power : array_like
        Variance in each bin [unit^2], (n // 2 + 1,).
    n : int
        Number of samples.
    rng : numpy.random.Generator
        Source of the phases.

    Returns
    -------
    Array
        The signal, (n,).
    """
    power = _one_per_bin(power, n)
    phases = 2.0 * np.pi * rng.random(power.size)
    return _of_bins(np.sqrt(2.0 * power), np.exp(1j * phases), n)


def gaussian_signal(power: ArrayLike, n: int, rng: np.random.Generator) -> Array:
    """Draw one period of a stationary Gaussian process of given power in each DFT bin.

    Cosine and sine of a bin have independent normal amplitudes (Shinozuka and Deodatis, Appl. Mech. Rev. 44, 1991). The
    process is periodic; a short piece of the period is not.

    Parameters
    ----------
    power : array_like
        Variance in each bin [unit^2], (n // 2 + 1,).
    n : int
        Number of samples in a period.
    rng : numpy.random.Generator
        Source of the amplitudes.

    Returns
    -------
    Array
        The signal, (n,).
    """
    power = _one_per_bin(power, n)
    a, b = rng.standard_normal((2, power.size))
    return _of_bins(np.sqrt(power), a + 1j * b, n)


def _one_per_bin(power: ArrayLike, n: int) -> Array:
    power = np.asarray(power, dtype=float)
    if power.shape != (n // 2 + 1,):
        raise ValueError(f"power must have one entry per DFT bin, {n // 2 + 1}, not {power.shape}")
    return power


def _of_bins(amplitude: Array, turn: NDArray[np.complex128], n: int) -> Array:
    """Return the signal of `n` samples whose bins have these amplitudes and factors, without zero and Nyquist."""
    bins = 0.5 * n * amplitude * turn
    bins[0] = 0.0
    if n % 2 == 0:
        bins[-1] = 0.0
    return np.fft.irfft(bins, n)


def rms(x: Array) -> float:
    """Return the root of the mean square; the mean is included."""
    return float(np.sqrt(np.mean(np.square(x)))) if x.size else 0.0


def psd(x: ArrayLike, dt: float, *, resolution: float = 0.5) -> tuple[Array, Array]:
    """Estimate the power spectral density by Welch's method.

    Averages half-overlapping Hann windows of 1 / resolution seconds, or of the whole record if that is shorter.

    Parameters
    ----------
    x : array_like
        Signals, (n,) or (n, n_columns), without NaN.
    dt : float
        Time step [s].
    resolution : float
        Resolution [Hz].

    Returns
    -------
    frequency : Array
        Frequencies [Hz].
    density : Array
        One-sided density [unit^2/Hz], a column per signal.

    Raises
    ------
    ValueError
        There is no such time step, or no window of such a resolution.
    """
    if not 0.0 < dt < np.inf:
        raise ValueError(f"dt = {dt:g}: takes a time step above 0 s")
    if not 0.0 < resolution <= 1.0 / dt:
        raise ValueError(f"resolution = {resolution:g}: takes more than 0 Hz, and no more than 1 / dt = {1.0 / dt:g} Hz")
    x = fill_masked(x).astype(float)
    window = min(round(1.0 / (resolution * dt)), len(x))
    frequency, density = scipy.signal.welch(x, fs=1.0 / dt, nperseg=window, axis=0, detrend="constant")
    return frequency, density


def expected_psd(spectrum: Array, dt: float, n_steps: int, resolution: float = 0.5) -> tuple[Array, Array]:
    """Return the expectation of `psd` for a stationary signal of this spectrum.

    The autocovariance times that of the window, transformed: the spectrum as smooth as the window makes it. Taking off the mean
    of each window, which changes the lowest two frequencies, is left out.

    Parameters
    ----------
    spectrum : Array
        Two-sided spectrum per sample, on the frequencies of `wiener`, (n // 2 + 1,), n at least twice a window.
    dt : float
        Time step [s].
    n_steps : int
        Steps of the record.
    resolution : float
        Resolution [Hz].

    Returns
    -------
    frequency : Array
        Frequencies [Hz].
    density : Array
        One-sided density [unit^2/Hz].
    """
    length, n = min(round(1.0 / (resolution * dt)), n_steps), 2 * (spectrum.size - 1)
    window = scipy.signal.get_window("hann", length)
    power = np.abs(np.fft.rfft(window, 2 * length)) ** 2
    weight = np.fft.irfft(power)[:length] / np.sum(window**2)
    covariance = np.zeros(length)
    covariance[: min(length, n // 2)] = np.fft.irfft(spectrum, n)[: min(length, n // 2)]
    weighted = weight * covariance
    folded = weighted.copy()
    folded[1:] += weighted[:0:-1]  # lags -1 ... 1 - length
    density = 2.0 * dt * np.fft.rfft(folded).real
    density[0] *= 0.5
    if length % 2 == 0:
        density[-1] *= 0.5
    return np.fft.rfftfreq(length, dt), np.maximum(density, 0.0)
