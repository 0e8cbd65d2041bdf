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
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from wfsobs.signal.slow_sensor import SlowSensor
from wfsobs.signal.wiener import Complex, Whitener, factorise
from wfsobs.typing import Array

LONGEST = 8192
"""Maximum age of a measurement beside z [steps]."""

TOLERANCE = 2e-4
"""Residual of a solution over its right-hand side."""


@dataclass(frozen=True)
class FastSensors:
    """m fast sensors beside z.

    Attributes
    ----------
    spectra : Array
        Cross spectra of their measurements, the transform over n of E y_i[k] y_j[k-n], noise included, (m, m, n // 2 + 1).
    cross : Array
        Those with z, E y_i[k] z[k-n], (m, n // 2 + 1).
    slow : Array
        Those with the slow sensor, E x[k] y_i[k-n], (m, n // 2 + 1).
    """

    spectra: NDArray[np.complex128]
    cross: NDArray[np.complex128]
    slow: NDArray[np.complex128]


def variance_from_sensors(
    targets: Sequence[tuple[Complex, Complex, NDArray[np.complex128]]], whitener: Whitener, fast: FastSensors, slow: SlowSensor
) -> Array:
    """Return how much the other sensors lower the variance of the minimum error of z alone.

    Parameters
    ----------
    targets : sequence of tuple
        (S_sz, S_sx, S_sy) of each target, as in `variance_from_frames`, and those with the fast sensors, (m, n // 2 + 1).
    whitener : Whitener
        Factor of the spectrum of z.
    fast, slow : FastSensors, SlowSensor
        The other sensors.

    Returns
    -------
    Array
        Explained covariance of the targets, (ratio, n_targets, n_targets), p steps after a frame.
    """
    n, last = whitener.n, len(fast.cross)
    cross = np.vstack([fast.cross, slow.cross])
    of_z = cross / np.sqrt(whitener.spectrum)
    own_spectra = [*(fast.spectra[i, i].real for i in range(last)), slow.spectrum]
    rests = [spectrum - np.abs(seen) ** 2 for spectrum, seen in zip(own_spectra, of_z, strict=True)]
    factors = np.array([*(_factor(rest) for rest in rests[:last]), _frame_factor(rests[last], slow, n)])
    whiten, ahead = 1.0 / factors.conj(), 1.0 / (whitener.H.conj() * np.sqrt(whitener.innovation_variance))
    future = _of_future(cross * ahead, n)
    future *= whiten

    def share(i: int, j: int) -> Complex:
        shared = fast.slow[i] if j == last else fast.spectra[i, j].conj()
        return (shared - of_z[i].conj() * of_z[j]) * whiten[i] * whiten[j].conj()

    regression = _Regression.of(share, future, slow.ratio, n)
    length, wanted = min(LONGEST, n // 2), []
    for on_z, on_x, on_y in targets:
        own = of_z.conj()
        own *= -on_z / np.sqrt(whitener.spectrum)
        own[:last] += on_y
        own[last] += on_x
        found = fft.rfft(_past(own, n), n)
        found *= whiten
        found += np.multiply(future, _of_future(on_z * ahead, n, first=1).conj(), out=own)
        wanted.append(fft.irfft(found, n)[:, :length].copy())
    return _gains(regression, np.array(wanted))


def _factor(spectrum: Array) -> Complex:
    found = factorise(spectrum)
    return found.H * np.sqrt(found.innovation_variance)


def _frame_factor(spectrum: Array, slow: SlowSensor, n: int) -> Complex:
    """Return the factor of the spectrum of the frames' rests, noise included, one coefficient every `ratio` steps."""
    frames = n // 2 // slow.ratio
    covariance = fft.irfft(spectrum, n)[: frames * slow.ratio + 1 : slow.ratio]
    circle = np.concatenate([covariance, covariance[-2:0:-1]])
    factor = _factor(np.maximum(fft.rfft(circle).real, 0.0) + slow.noise)
    spread = np.zeros(n)
    spread[: frames * slow.ratio : slow.ratio] = fft.irfft(factor, 2 * frames)[:frames]
    return fft.rfft(spread)


def _past(spectrum: Complex, n: int) -> Array:
    """Return the coefficients at the ages from 0 on, of E s[k] y[k - age]."""
    out = fft.irfft(spectrum, n)
    out[..., n // 2 :] = 0.0
    return out


def _of_future(spectrum: Complex, n: int, first: int = 0) -> Complex:
    """Return the transform of the coefficients of e[k + first], e[k + first + 1], ..., in that order."""
    backwards = _past(spectrum.conj(), n)
    backwards[..., :first] = 0.0
    return fft.rfft(backwards)


@dataclass(frozen=True)
class _Regression:
    """I + E + K' K on the ages of each phase of the frames: x of shape (ratio, n_targets, n_sensors, n_ages).

    shares : transform of I + E, (n_sensors, n_sensors, n);  hankel : that of K, (n_sensors, n)
    mask : which ages are measured, (ratio, 1, n_sensors, n_ages)
    """

    shares: NDArray[np.complexfloating]
    hankel: NDArray[np.complexfloating]
    mask: Array

    @staticmethod
    def of(share: Callable[[int, int], Complex], future: Complex, ratio: int, n: int) -> _Regression:
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
        hankel = fft.rfft(fft.irfft(future, n)[:, : min(size, n // 2)], size)
        mask = np.ones((ratio, 1, len(future), length))
        mask[:, :, -1] = np.arange(length) % ratio == np.arange(ratio)[:, None, None]
        return _Regression(among, hankel, mask)

    def single(self) -> _Regression:
        """Return the same in single precision."""
        return _Regression(self.shares.astype(np.complex64), self.hankel.astype(np.complex64), self.mask.astype(np.float32))

    def apply(self, x: Array) -> Array:
        """Return (I + E + K' K) x at the ages that are measured."""
        length, size = x.shape[-1], 2 * (self.hankel.shape[-1] - 1)
        transform = fft.rfft(x, size)
        out = transform.copy()
        for i, j in permutations(range(len(self.hankel)), 2):
            out[:, :, i] += self.shares[i, j] * transform[:, :, j]
        known = fft.irfft(np.sum(self.hankel.conj() * transform, axis=2).conj(), size)
        known[..., 0] = known[..., length:] = 0.0
        out += self.hankel * fft.rfft(known, size).conj()[:, :, None]
        return self.mask * fft.irfft(out, size)[..., :length]


def _gains(regression: _Regression, rest: Array) -> Array:
    """Return b' (I + E + K' K)^-1 b of all pairs of targets at every age. rest : b of each target."""
    b = regression.mask * rest
    single = regression.single()
    x = np.concatenate([_solve(single, b[:, [i]].astype(np.float32)) for i in range(b.shape[1])], axis=1).astype(np.float64)
    # Wrong by the square of the error of x, rounding and all.
    out = np.einsum("ptia,puia->ptu", x, 2.0 * b - regression.apply(x))
    return 0.5 * (out + out.transpose(0, 2, 1))


def _solve(regression: _Regression, b: Array) -> Array:
    """Solve (I + E + K' K) x = b for every age, by conjugate gradients."""
    x, residual, direction = np.zeros_like(b), b.copy(), b.copy()
    power = np.sum(b**2, axis=(-2, -1), keepdims=True)
    enough, smallest = TOLERANCE**2 * power, np.finfo(b.dtype).tiny
    while (power > enough).any():
        moved = regression.apply(direction)
        step = power / np.maximum(np.sum(direction * moved, axis=(-2, -1), keepdims=True), smallest)
        x += step * direction
        residual -= step * moved
        before, power = power, np.sum(residual**2, axis=(-2, -1), keepdims=True)
        direction = residual + (power / np.maximum(before, smallest)) * direction
    return x
