"""Squared-exponential covariances of sliding windows, split so that nothing is ill conditioned.

A point x_j is a window: the last `depth` samples up to step j of every channel. With G_ij = <x_i, x_j>,
delta_i = exp(-|x_i|^2 / 2 l^2) and s2 = sigma_SE^2, the kernel of the paper's eq. 13 is

    k(x_i, x_j) = s2 exp(-|x_i - x_j|^2 / 2 l^2) = M_ij + s2 delta_i delta_j,
    M_ij = s2 delta_i delta_j expm1(G_ij / l^2).

M is a covariance of its own (a sum of powers of G). With l far above the windows' norm, K is a huge constant
plus a small signal, cond(K + sigma_n^2 I) = 5e7 at the paper's numbers; M + sigma_n^2 I has 1e2 to 1e5, and the constant is
a rank-one border: with a = M^-1 f, b = M^-1 delta, kappa_i = M_ti (M now with sigma_n^2 on its diagonal),

    mean = kappa.a + (delta_t - kappa.b) (delta.a) / (1 / s2 + delta.b).

Inner products slide: G(i, j) = G(i-1, j-1) + s[i] s[j] - s[i-d] s[j-d], at a cost that depth does not enter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided, sliding_window_view
from scipy.linalg.blas import dsymv
from scipy.linalg.lapack import dpotrf, dpotrs

from wfsobs.typing import Array


@dataclass(frozen=True)
class SquaredExponential:
    """The kernel's numbers, all in [um]: signal_std sigma_SE, length_scale l, noise_std sigma_n."""

    signal_std: float
    length_scale: float
    noise_std: float

    @property
    def variance(self) -> float:
        """s2 = sigma_SE^2 [um^2]."""
        return self.signal_std**2

    def points(self, norm2: Array) -> Points:
        """Return the windows with these squared norms [l^2]."""
        return Points(norm2, np.exp(-0.5 * norm2), float(norm2.max(initial=0.0)))

    def split(self, G: Array, i: Points, j: Points) -> None:
        """Turn inner products G [l^2] of points i and j, which broadcast to its shape, into M (without the noise), in place.

        While |x|^2 < l^2 that is delta_i delta_j expm1(g). Beyond, where the factors could overflow, it is the same
        number as exp(max(g, 0) - (n_i + n_j) / 2) times (1 - exp(-|g|)) with the sign of g.
        """
        if max(i.largest, j.largest) < 1.0:
            np.expm1(G, out=G)
            G *= self.variance * i.delta
            G *= j.delta
            return
        exponent = np.maximum(G, 0.0) - 0.5 * (i.norm2 + j.norm2)
        np.copysign(np.expm1(-np.abs(G)), G, out=G)
        G *= self.variance * np.exp(np.minimum(exponent, 0.0))  # at most 0 but for rounding: |x_i - x_j|^2 >= 0

    def split_times(self, G: Array, i: Points, j: Points, w: Array) -> Array:
        """M w from inner products G (rows, columns) [l^2] of points i (rows,) and j (columns,); uses up G."""
        if max(i.largest, j.largest) < 1.0:  # the factors of `split`, taken out of the matrix
            return i.delta * (np.expm1(G, out=G) @ (self.variance * j.delta * w))
        self.split(G, i.select(lambda p: p[:, None]), j)
        return G @ w

    def own(self, points: Points) -> Array:
        """M of each point with itself [um^2], without the noise: s2 (1 - exp(-|x|^2 / l^2))."""
        return -self.variance * np.expm1(-points.norm2)


class Points(NamedTuple):
    """Windows by the numbers that the kernel needs beside inner products.

    |x|^2 [l^2] and delta, of equal shape, and an upper limit of |x|^2.
    """

    norm2: Array
    delta: Array
    largest: float

    def select(self, part: Callable[[Array], Array]) -> Points:
        """Return some of the points, or all of them in another shape."""
        return Points(part(self.norm2), part(self.delta), self.largest)


MAX_CONDITION = 1e13
"""Condition number of M + sigma_n^2 I beyond which a prediction has no correct digits left to show."""


class ConditionError(ValueError):
    """Kernel numbers that double precision cannot serve; one line saying which and what would help."""


def check_condition(S: Array, kernel: SquaredExponential) -> None:
    """Raise ConditionError if M + sigma_n^2 I is too ill conditioned; S (m, m) column-major, its lower triangle.

    Trace over sigma_n^2 bounds the condition number, which settles all but extreme numbers; for those, power iterations
    on S and on its inverse find it.
    """
    if np.trace(S) <= MAX_CONDITION * kernel.noise_std**2:
        return
    condition = np.inf
    factor, info = dpotrf(S, lower=1)
    if info == 0:
        condition = _largest_eigenvalue(lambda x: dsymv(1.0, S, x, lower=1), len(S))
        condition *= _largest_eigenvalue(lambda x: dpotrs(factor, x, lower=1)[0], len(S))
    if not condition <= MAX_CONDITION:
        raise ConditionError(
            f"the covariance has condition {condition:.1e}, above {MAX_CONDITION:.0e}: raise noise_std "
            f"({kernel.noise_std:g}) or length_scale ({kernel.length_scale:g}), or lower signal_std ({kernel.signal_std:g})"
        )


def _largest_eigenvalue(apply: Callable[[Array], Array], n: int) -> float:
    """Of a symmetric positive matrix, by power iteration from a start that no symmetry makes orthogonal to it."""
    x = 1.0 + 0.5 * np.sin(1.0 + np.arange(n) ** 2)
    largest = 0.0
    for _ in range(30):
        x = apply(x / np.linalg.norm(x))
        largest = float(np.linalg.norm(x))
    return largest


def squared_norms(signals: Array, depth: int) -> Array:
    """|x_j|^2 of the window ending at every step, samples before the start being zero, (n,); signals (n, channels).

    A window is the end of one block of `depth` samples and the start of the next, so that sums from the blocks' borders
    outwards are all it takes and nothing is ever subtracted.
    """
    n = signals.shape[0]
    blocks = np.zeros((-(-n // depth) + 1, depth))
    blocks.reshape(-1)[depth : depth + n] = np.square(signals).sum(axis=1)
    out = np.cumsum(blocks, axis=1)
    out[1:, :-1] += np.cumsum(blocks[:-1, :0:-1], axis=1)[:, ::-1]
    return out.ravel()[depth : depth + n]


TILE = 64
"""Rows worked on at a time, few enough to stay in the cache."""


def restart_interval(depth: int) -> int:
    """Return the steps after which sliding inner products restart from direct ones: the samples of a window.

    Rounding never grows beyond that of a direct product, and the cost stays independent of depth.
    """
    return max(16, depth)


def sliding_products(a: Array, b: Array, depth: int, i0: int, j0: int, rows: int, offsets: int, triangle: bool = False) -> Array:
    """Inner products of windows of `a` with windows of `b` along diagonals, shape (rows, offsets).

    out[r, c] = <window of a ending at i0 + r, window of b ending at j0 + r + c>; a, b (n, channels), samples
    outside the records are zero. Every so many rows are direct dot products, the others slide from them.
    triangle: leave out what has r + c >= rows, but for the last few rows.
    """
    out = np.zeros((rows, offsets))
    interval = restart_interval(depth)
    span = rows + offsets - 1
    ones = [_cut(x, i0 - depth, depth + rows) for x in a.T]  # samples i0 - depth ... i0 + rows - 1 of each channel
    others = [_cut(x, j0 - depth, depth + span) for x in b.T]
    # What row r has more than the one above: what comes into the window less what goes out, a product of 2 x channels numbers.
    factors = np.stack([one[depth:] for one in ones] + [-one[:rows] for one in ones], axis=1)[:, None]
    samples = np.stack([other[depth:] for other in others] + [other[:span] for other in others])
    pieces = sliding_window_view(samples, offsets, axis=1).transpose(1, 0, 2)  # [r, :, c] = samples[:, r + c]
    for top in range(0, rows, TILE):
        bottom, wide = min(top + TILE, rows), min(offsets, rows - top) if triangle else offsets
        np.matmul(factors[top:bottom], pieces[top:bottom, :, :wide], out=out[top:bottom, None, :wide])
        for r in range(top, bottom):
            if r % interval:
                out[r, :wide] += out[r - 1, :wide]
            else:
                out[r, :wide] = sum(
                    np.correlate(other[r + 1 : r + depth + wide], one[r + 1 : r + depth + 1], "valid")
                    for one, other in zip(ones, others, strict=True)
                )
    return out


def _cut(x: Array, start: int, length: int) -> Array:
    """x[start : start + length] with zeros outside the record."""
    out = np.zeros(length)
    low, high = max(start, 0), min(start + length, x.size)
    if high > low:
        out[low - start : high - start] = x[low:high]
    return out


def band(signals: Array, depth: int, kernel: SquaredExponential, first: int, rows: int, reach: int) -> tuple[Array, Points]:
    """M + sigma_n^2 I of the windows ending at first ... first + rows - 1, by lag, and those windows.

    Returns (V, points): V (rows, reach + 1) with V[r, lag] = entry of windows first + r and first + r + lag, as far as
    that one is among the rows; points (rows,).
    """
    signals = signals / kernel.length_scale
    V = sliding_products(signals, signals, depth, first, first, rows, reach + 1, triangle=True)
    samples = np.column_stack([_cut(channel, first - depth + 1, depth - 1 + rows + reach) for channel in signals.T])
    points = kernel.points(squared_norms(samples, depth)[depth - 1 :])
    later = points.select(lambda p: sliding_window_view(p, reach + 1)[:rows])
    for top in range(0, rows, TILE):
        part, wide = slice(top, min(top + TILE, rows)), min(reach + 1, rows - top)
        here = points.select(lambda p, part=part: p[part, None])
        kernel.split(V[part, :wide], here, later.select(lambda p, part=part, wide=wide: p[part, :wide]))
    V[:, 0] += kernel.noise_std**2
    return V, points.select(lambda p: p[:rows])


def square_from_band(V: Array, start: int, n: int) -> Array:
    """Return a view of V as the symmetric matrix of points start ... start + n - 1, column-major, read-only.

    Its lower triangle is valid down to V's largest lag; the rest is meaningless.
    """
    row, item = V.strides
    return as_strided(V[start:], (n, n), (item, row - item), writeable=False)
