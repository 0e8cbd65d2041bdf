"""The tapered periodogram of one mode, and its bins averaged in cells for fits."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from scipy.fft import next_fast_len, rfft
from scipy.signal.windows import tukey

from wfsobs.typing import Array

TAPERED, MOST_TAPERED = 500, 0.05
"""Samples under the cosine at either end of a record, and their maximum share.

Leakage of turbulence over the noise falls as f^-6 beyond two periods of it, 4 Hz at 1 kHz, below which no noise is visible; more
would cost power of lines.
"""
FINE, NEAR = 200, 8
"""A cell is at most 1 / FINE of its frequency wide, and 1 / NEAR of its distance to the next resonance."""


@lru_cache(maxsize=4)
def taper(n: int) -> Array:
    """Return Tukey's taper for n samples, its mean square 1, (n,)."""
    h = tukey(n, 2.0 * min(TAPERED / n, MOST_TAPERED))
    h /= np.sqrt(np.mean(h**2))
    h.flags.writeable = False
    return h


@lru_cache(maxsize=4)
def inflation(n: int) -> float:
    """Return the factor by which the taper raises the variance of a mean over bins.

    n sum h^4 / (sum h^2)^2: 1.009 at 60 000 samples.
    """
    return float(np.mean(taper(n) ** 4))


def periodogram(x: Array, dt: float, pad: int = 1) -> Array:
    """Compute the one-sided periodogram [unit^2/Hz] of x (n,) at j / (pad n dt), j = 1, 2, ... below Nyquist."""
    n = len(x)
    spectrum = rfft(taper(n) * x, pad * n)[1 : (pad * n + 1) // 2]
    return 2.0 * dt / n * (spectrum.real**2 + spectrum.imag**2)


def periodogram_frequencies(n: int, dt: float, pad: int = 1) -> Array:
    """Return the frequencies [Hz] of `periodogram`."""
    return np.arange(1, (pad * n + 1) // 2) / (pad * n * dt)


def fast_length(n: int) -> int:
    """Return the longest length up to n whose Fourier transform is fast, at most 2 % shorter, or n."""
    for length in range(n, int(0.98 * n), -1):
        if next_fast_len(length) == length:
            return length
    return n


class Cells:
    """Bins of a periodogram, averaged where the spectrum is smooth.

    Parameters
    ----------
    f, I : Array
        Frequencies [Hz] and periodogram, (bins,).
    keep : Array
        Bins in use, bool (bins,).
    resonances : iterable of float
        Frequencies [Hz] near which cells stay narrow.
    share : Array or float
        Measured share of each bin (`missing`); by default all.
    sizes : tuple of int
        As FINE and NEAR.

    Attributes
    ----------
    bin_width : float
        1 / length of the record [Hz].
    frequency, mean, count, share : Array
        Frequency [Hz], mean of the periodogram, number of bins and measured share, each (cells,).
    """

    bin_width: float
    count: Array
    frequency: Array
    mean: Array
    share: Array

    def __init__(
        self,
        f: Array,
        I: Array,  # noqa: E741
        keep: Array,
        resonances: Iterable[float] = (),
        share: Array | float = 1.0,
        sizes: tuple[int, int] = (FINE, NEAR),
    ):
        self.bin_width, j = float(f[0]), np.arange(1.0, len(f) + 1.0)
        fine, near = sizes
        size = np.maximum(j / fine, 1.0)
        for centre in resonances:
            bin_ = centre / f[0]
            # no further off than where |j - bin| / near = j / fine, cells are narrower than elsewhere
            first, last = int(bin_ * fine / (fine + near)), int(bin_ * fine / (fine - near)) + 1
            size[first:last] = np.minimum(size[first:last], np.maximum(np.abs(j[first:last] - bin_) / near, 1.0))
        cell = np.floor(np.cumsum(1.0 / size) + 1e-6).astype(int)
        count = np.bincount(cell, keep)
        used = count > 0
        self.count = count[used]
        self.frequency = np.bincount(cell, keep * f)[used] / self.count
        self.mean = np.bincount(cell, keep * I)[used] / self.count
        self.share = np.bincount(cell, keep * share)[used] / self.count
