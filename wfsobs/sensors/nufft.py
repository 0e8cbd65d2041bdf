"""Non-uniform FFT of a square grid, and Lagrange interpolation.

A sum of exponentials is one Fourier transform onto a grid of twice the resolution, and five points of that grid along each
axis for every point, with a Kaiser-Bessel window whose own transform is divided out beforehand: the non-uniform fast
Fourier transform of type 2 (J. A. Fessler and B. P. Sutton, IEEE Trans. Signal Process. 51, 560, 2003).
"""

from __future__ import annotations

import numpy as np
from scipy.fft import ifft2, next_fast_len
from scipy.sparse import csr_array
from scipy.special import i0

from wfsobs.typing import Array

WIDTH = 5
SHAPE = np.pi * WIDTH * 0.75  # of the window, for a grid twice as fine
FINE = 2048  # points of the table of the window between two grid points; linear between them it is good to 1e-6
CHUNK = 1 << 16  # points at a time


def _window() -> Array:
    """Return weights (FINE + 2, WIDTH) of the grid points about a point, by the distance of the first from the edge."""
    distance = np.arange(FINE + 2)[:, None] / FINE + np.arange(WIDTH) - WIDTH / 2
    return i0(SHAPE * np.sqrt(np.maximum(1.0 - (distance / (WIDTH / 2)) ** 2, 0.0)))


WINDOW = _window()


class TrigonometricSum:
    """f_m(x, y) = sum_pq w_m[q, p] exp(i (p x + q y)), p and q from -(n - 1) / 2 to (n - 1) / 2, to 1e-5 of sum |w|.

    Parameters
    ----------
    weights : Array
        Real, (m, n, n), n even.
    """

    def __init__(self, weights: Array) -> None:
        m, n, _ = weights.shape
        self._size = next_fast_len(2 * n)
        p = np.arange(n) - n // 2  # the sum's p less 1/2
        window = np.sqrt(SHAPE**2 - (np.pi * WIDTH * p / self._size) ** 2 + 0j)
        correction = (window / (WIDTH * np.sinh(window))).real
        padded = np.zeros((m, self._size, self._size))
        padded[:, p[:, None], p[None, :]] = weights * correction[:, None] * correction
        grid = ifft2(padded, norm="forward")
        table = np.moveaxis(grid, 0, -1).reshape(-1, m).astype(np.complex64, order="C")
        self._table = table.view(np.float32)  # (size^2, 2 m); single precision is finer than the window

    def __call__(self, x: Array, y: Array) -> Array:
        """Return the sums at the points (x, y) [rad]: complex (m, *shape of x)."""
        points = np.stack([np.ravel(x), np.ravel(y)])
        out = np.empty((points.shape[1], self._table.shape[1] // 2), dtype=complex)
        for start in range(0, len(out), CHUNK):
            part = slice(start, start + CHUNK)
            out[part] = (self._interpolation(*points[:, part]) @ self._table).view(np.complex64)
        out *= np.exp(0.5j * points.sum(axis=0))[:, None]
        return out.T.reshape(-1, *np.shape(x))

    def _interpolation(self, x: Array, y: Array) -> csr_array:
        """Return the matrix (points, size^2) that interpolates the table at the points."""
        (column, across), (row, along) = self._taps(x), self._taps(y)
        index = row[:, :, None] * self._size + column[:, None, :]
        weight = along[:, :, None] * across[:, None, :]
        starts = np.arange(len(x) + 1) * WIDTH**2
        return csr_array((weight.ravel(), index.ravel(), starts), shape=(len(x), self._size**2))

    def _taps(self, x: Array) -> tuple[Array, Array]:
        """Return the grid points about each x, and their weights: (points, WIDTH) each."""
        at = x * (self._size / (2.0 * np.pi)) - WIDTH / 2
        first = np.ceil(at)
        place = (first - at) * FINE
        below = place.astype(np.intp)
        weights = WINDOW[below] + (WINDOW[below + 1] - WINDOW[below]) * (place - below)[:, None]
        return (first.astype(np.int64)[:, None] + np.arange(WIDTH)) % self._size, weights.astype(np.float32)


def lagrange_weights(t: Array, taps: int) -> Array:
    """Return weights (taps, len(t)) that interpolate values at 1 - taps / 2 ... taps / 2 to t, 0 <= t <= 1."""
    nodes = np.arange(taps) + 1 - taps // 2
    out = np.ones((taps, len(t)))
    for i, node in enumerate(nodes):
        for other in np.delete(nodes, i):
            out[i] *= (t - other) / (node - other)
    return out
