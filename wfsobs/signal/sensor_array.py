"""What several fast sensors and a slow one add to a fast one: the minimum error of any causal linear observer of all.

As in `slow_sensor`, e are the innovations of the one sensor z, and what is to be gained by the others is the regression of the
rest of the target on the rests of their measurements, those of age a = 0, 1, ...,

    r_i[a] = y_i'[k - a] + sum_{t > 0} C_i[t + a] e[k+t],

i one of the fast sensors, or the slow one, whose ages are p, p + n, .... The rests y' have the cross spectra
S_ij - S_iz S_zj / S_z. With every one of them whitened by a causal factor of its own spectrum,

    gain = b' (I + E + K' K)^-1 b,

in which E, the shares that sensors have in common, and K, the innovations that are still to come, are Toeplitz and Hankel
matrices, multiplied by the FFT. No matrix spectrum is factorised. Measurements older than LONGEST steps are left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from wfsobs.signal.slow_sensor import SlowSensor, SlowTarget
from wfsobs.signal.wiener import Complex, Whitener, factorise, innovations_to_come, square
from wfsobs.typing import Array

LONGEST = 8192
"""Maximum age of a measurement beside z [steps]."""

TOLERANCE = 2e-4
"""Residual of a solution over its right-hand side."""


@dataclass(frozen=True)
class FastSensors:
    """m fast sensors beside z.

    Their spectra, (n // 2 + 1,) each, are asked for one at a time: together they are more than the processor's cache holds.

    Attributes
    ----------
    count : int
        m.
    between : callable
        (i, j) -> cross spectrum of two measurements, the transform over n of E y_i[k] y_j[k-n], noise included.
    with_z : callable
        i -> that with z, of E y_i[k] z[k-n].
    with_slow : callable
        i -> that with the slow sensor, of E x[k] y_i[k-n].
    """

    count: int
    between: Callable[[int, int], Complex]
    with_z: Callable[[int], Complex]
    with_slow: Callable[[int], Complex]


def variance_from_sensors(
    targets: Sequence[tuple[SlowTarget, Callable[[int], Complex] | None]], whitener: Whitener, fast: FastSensors, slow: SlowSensor
) -> Array:
    """Return how much the other sensors lower the variance of the minimum error of z alone.

    Parameters
    ----------
    targets : sequence of tuple
        Each target as in `variance_from_frames`, and i -> cross spectrum of it and a fast sensor; None where they have nothing
        in common.
    whitener : Whitener
        Factor of the spectrum of z.
    fast, slow : FastSensors, SlowSensor
        The other sensors.

    Returns
    -------
    Array
        Explained covariance of the targets, (ratio, n_targets, n_targets), p steps after a frame.
    """
    n, root = whitener.n, 1.0 / np.sqrt(whitener.spectrum)
    of_z, whiten, future = list[Complex](), list[Complex](), list[Complex]()
    for i in range(fast.count + 1):
        is_slow = i == fast.count
        cross = slow.cross if is_slow else fast.with_z(i)
        of_z.append(cross * root)
        own = (slow.spectrum if is_slow else fast.between(i, i).real) - square(of_z[i])
        whiten.append(1.0 / _frame_factor(own, slow, n).conj() if is_slow else factorise(own).backwards)
        future.append(innovations_to_come(cross, whitener, first=0) * whiten[i])

    def share(i: int, j: int) -> Complex:
        shared = fast.with_slow(i) if j == fast.count else fast.between(i, j).conj()
        return (shared - of_z[i].conj() * of_z[j]) * (whiten[i] * whiten[j].conj())

    def rest(i: int, target: SlowTarget, with_fast: Callable[[int], Complex] | None) -> Array:
        past = of_z[i].conj() * (target.of_z * -root)
        if i == fast.count:
            past += target.of_x
        elif with_fast is not None:
            past += with_fast(i)
        by_age = fft.irfft(past, n)
        by_age[n // 2 :] = 0.0
        return fft.irfft(fft.rfft(by_age) * whiten[i] + future[i] * target.to_come.conj(), n)[: min(LONGEST, n // 2)].copy()

    wanted = np.array([[rest(i, *target) for i in range(fast.count + 1)] for target in targets])
    return _gains(_Regression.of(share, future, slow.ratio, n), wanted)


def _frame_factor(spectrum: Array, slow: SlowSensor, n: int) -> Complex:
    """Return the factor of the spectrum of the frames' rests, noise included, one coefficient every `ratio` steps."""
    frames = n // 2 // slow.ratio
    covariance = fft.irfft(spectrum, n)[: frames * slow.ratio + 1 : slow.ratio]
    circle = np.concatenate([covariance, covariance[-2:0:-1]])
    found = factorise(np.maximum(fft.rfft(circle).real, 0.0) + slow.noise)
    spread = np.zeros(n)
    spread[: frames * slow.ratio : slow.ratio] = fft.irfft(found.factor * np.sqrt(found.innovation_variance), 2 * frames)[:frames]
    return fft.rfft(spread)


@dataclass(frozen=True)
class _Regression:
    """I + E + K' K on the ages of each phase of the frames: x of shape (n_sensors, ratio, n_ages).

    shares : transform of I + E, (n_sensors, n_sensors, n);  hankel : that of K, (n_sensors, n)
    mask : which ages are measured, as x
    """

    shares: NDArray[np.complexfloating]
    hankel: NDArray[np.complexfloating]
    mask: Array

    @staticmethod
    def of(share: Callable[[int, int], Complex], future: Sequence[Complex], ratio: int, n: int) -> _Regression:
        """Return that of what sensors i < j have in common, share(i, j), and the future."""
        length = min(LONGEST, n // 2)
        size = fft.next_fast_len(2 * length, real=True)
        among = np.ones((len(future), len(future), size // 2 + 1), dtype=np.complex128)  # each of them is white
        near = np.zeros(size)
        for i, j in combinations(range(len(future)), 2):
            kernel = fft.irfft(share(i, j), n)
            near[:length], near[1 - length :] = kernel[:length], kernel[1 - length :]
            among[i, j] = fft.rfft(near)
            among[j, i] = among[i, j].conj()
        hankel = np.array([fft.rfft(fft.irfft(one, n)[: min(size, n // 2)], size) for one in future])
        mask = np.ones((len(future), ratio, length))
        mask[-1] = np.arange(length) % ratio == np.arange(ratio)[:, None]
        return _Regression(among, hankel, mask)

    def single(self) -> _Regression:
        """Return the same in single precision."""
        return _Regression(self.shares.astype(np.complex64), self.hankel.astype(np.complex64), self.mask.astype(np.float32))

    def apply(self, x: Array) -> Array:
        """Return (I + E + K' K) x at the ages that are measured."""
        length, size = x.shape[-1], 2 * (self.hankel.shape[-1] - 1)
        transform = fft.rfft(x, size)
        out = transform.copy()
        for i, j in permutations(range(len(out)), 2):
            out[i] += self.shares[i, j] * transform[j]
        known = reduce(np.add, [hankel * seen.conj() for hankel, seen in zip(self.hankel, transform, strict=True)])
        future = fft.irfft(known, size)
        future[:, 0] = future[:, length:] = 0.0
        known = fft.rfft(future, size).conj()
        for i, hankel in enumerate(self.hankel):
            out[i] += hankel * known
        return self.mask * fft.irfft(out, size)[..., :length]


def _gains(regression: _Regression, rest: Array) -> Array:
    """Return b' (I + E + K' K)^-1 b of all pairs of targets at every age.

    rest : b of each target, (n_targets, n_sensors, n_ages)
    """
    b, single = regression.mask * rest[:, :, None], regression.single()
    x = [_solve(single, one.astype(np.float32)).astype(np.float64) for one in b]
    # Wrong by the square of the error of x, rounding and all.
    out = np.einsum("tipa,uipa->ptu", x, [2.0 * one - regression.apply(of) for one, of in zip(b, x, strict=True)])
    return 0.5 * (out + out.transpose(0, 2, 1))


def _solve(regression: _Regression, b: Array) -> Array:
    """Solve (I + E + K' K) x = b for every age, by conjugate gradients."""
    x, residual, direction = np.zeros_like(b), b.copy(), b.copy()
    power = np.sum(b**2, axis=(0, 2), keepdims=True)
    enough, smallest = TOLERANCE**2 * power, np.finfo(b.dtype).tiny
    while (power > enough).any():
        moved = regression.apply(direction)
        step = power / np.maximum(np.sum(direction * moved, axis=(0, 2), keepdims=True), smallest)
        x += step * direction
        residual -= step * moved
        before, power = power, np.sum(residual**2, axis=(0, 2), keepdims=True)
        direction = residual + (power / np.maximum(before, smallest)) * direction
    return x
