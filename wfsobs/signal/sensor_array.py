"""What several fast sensors and a slow one add to a fast one: the minimum error of any causal linear observer of all.

As below, e are the innovations of the one sensor z, and what is to be gained by the others is the regression of the
rest of the target on the rests of their measurements, those of age a = 0, 1, ...,

    r_i[a] = y_i'[k - a] + sum_{t > 0} C_i[t + a] e[k+t],

i one of the fast sensors, or the slow one, whose ages are p, p + n, .... The rests y' have the cross spectra
S_ij - S_iz S_zj / S_z. With every one of them whitened by a causal factor of its own spectrum,

    gain = b' (I + E + K' K)^-1 b,

in which E, the shares that sensors have in common, and K, the innovations that are still to come, are Toeplitz and Hankel
matrices, multiplied by the FFT. No matrix spectrum is factorised. Measurements older than LONGEST steps are left out.

With a slow sensor alone beside the fast one: the fast sensor gives z[k] at every step, the slow one a frame y[k] = x[k] + v[k]
at every n-th, v white. Signals are stationary, the two sensors together are so only from one cycle of n steps to the next. With
e the innovations of z, of variance one (`wiener`),

    y[k] = sum_j c[j] e[k-j] + y'[k],

over all j, past and future, where y' is what all of z leaves of the frames: it has the spectrum S_x - |S_xz|^2 / S_z, aliased,
plus that of v. At a step k the last frame is p steps old, p = 0 ... n - 1, and innovations after k are not known. Of the frame of
age p + n i remains

    r_i = y'[k - p - n i] + sum_{t > 0} C[t + p + n i] e[k+t],    C[j] = c[-j],

and of the target likewise s' + sum G[t] e[k+t]. What is to be gained by the frames is the regression of this rest on all r_i. A
causal factor of the spectrum of y' turns it into white noise, in which a Hankel matrix K_ti = C'[t + p + n i] remains:

    gain = b' (I + K' K)^-1 b,    b_i = E s' y'_i + sum_t G[t] K_ti.

I + K' K has few eigenvalues that are not one, so that conjugate gradients need few steps, and no matrix spectrum has to be
factorised.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from wfsobs.signal.wiener import Complex, Whitener, factorise, innovations_to_come, square
from wfsobs.typing import Array

KEPT = 0.875
"""Share of the frames that half the DFT holds that is used: the oldest are whitened without those before them."""

FRAMES_TOLERANCE = 1e-4
"""Residual of a solution over its right-hand side; the gain is wrong by its square at most, since I + K' K is no less than I."""


@dataclass(frozen=True)
class SlowSensor:
    """A slow sensor beside a fast one.

    Attributes
    ----------
    spectrum : Array
        Spectrum of x, what a frame measures, at every fast step, (n // 2 + 1,).
    cross : Array
        S_xz, the transform over n of E x[k] z[k-n], (n // 2 + 1,).
    noise : float
        Variance of v, above zero.
    ratio : int
        Fast steps from frame to frame.
    """

    spectrum: Array
    cross: Complex
    noise: float
    ratio: int


class SlowTarget(NamedTuple):
    """What z and the slow sensor tell of a target, all (n // 2 + 1,).

    of_z    : S_sz, the transform over n of E s[k] z[k-n]
    to_come : `wiener.innovations_to_come` of it
    of_x    : S_sx, the transform over n of E s[k] x[k-n]
    """

    of_z: Complex
    to_come: Complex
    of_x: Complex


def variance_from_frames(targets: Sequence[SlowTarget], whitener: Whitener, slow: SlowSensor) -> Array:
    """Return how much the frames lower the variance of the minimum error of z alone.

    Parameters
    ----------
    targets : sequence of SlowTarget
        The targets.
    whitener : Whitener
        Factor of the spectrum of z.
    slow : SlowSensor
        The other sensor.

    Returns
    -------
    Array
        Explained covariance of the targets, (ratio, n_targets, n_targets), p steps after a frame.
    """
    n, ratio = whitener.n, slow.ratio
    half = n // 2
    frames = fft.next_fast_len(half // ratio, real=True)  # those beyond half the DFT are not kept
    of_z = slow.cross.conj() * (1.0 / whitener.spectrum)
    noise = _frame_whitener(fft.irfft(slow.spectrum - (of_z * slow.cross).real, n)[: frames * ratio + 1 : ratio], slow.noise)

    def by_age(spectrum: Complex) -> Array:
        """Return the coefficients of e[k], e[k+1], ..., or E s' y'[k], E s' y'[k-1], ..., with the frames whitened."""
        found = fft.irfft(spectrum, n)
        found[half:] = 0.0
        return _whiten_frames(found, noise, ratio)

    ahead = by_age((slow.cross * whitener.backwards).conj())  # C'
    of_frame = fft.rfft(ahead.ravel(), n)
    rests = []
    for target in targets:
        known = fft.irfft(of_frame * target.to_come.conj(), n)[: frames * ratio]
        rests.append(by_age(target.of_x - target.of_z * of_z) + known.reshape(ahead.shape))
    kept = max(round(KEPT * (half // ratio)), 1)
    return _gains_of_frames(ahead[:kept], np.array(rests)[:, :kept])


def _frame_whitener(covariance: Array, noise: float) -> Whitener:
    """Return the factor of the spectrum of y', from its autocovariance without noise at the lags of frames."""
    circle = np.concatenate([covariance, covariance[-2:0:-1]])
    return factorise(np.maximum(fft.rfft(circle).real, 0.0) + noise)


def _whiten_frames(x: Array, noise: Whitener, ratio: int) -> Array:
    """Return F^-1 x for every age up to `ratio`, (frames, ratio), where F is the factor of the covariance of y' by age."""
    frames = noise.n // 2
    by_age = x[: frames * ratio].reshape(frames, ratio)
    return fft.irfft(fft.rfft(by_age, noise.n, axis=0) * noise.backwards[:, None], noise.n, axis=0)[:frames]


def _gains_of_frames(ahead: Array, rest: Array) -> Array:
    """Return b' (I + K' K)^-1 b of all pairs of targets at every age.

    ahead : C', (frames, ratio);  rest : b, (n_targets, frames, ratio)
    """
    length = min(len(ahead), LONGEST)
    near = rest[:, :length].transpose(2, 0, 1)
    out = near @ _solve_frames(ahead.astype(np.float32), near, length).transpose(0, 2, 1)
    out += np.einsum("aip,bip->pab", rest[:, length:], rest[:, length:])
    return 0.5 * (out + out.transpose(0, 2, 1))


def _solve_frames(ahead: NDArray[np.float32], rest: Array, length: int) -> Array:
    """Solve (I + K' K) x = rest for every age, (ratio, n_targets, length), by conjugate gradients in single precision."""
    scale = np.sqrt(np.sum(rest**2, axis=-1, keepdims=True))
    b = (rest / np.where(scale > 0.0, scale, 1.0)).astype(np.float32)
    ratio = ahead.shape[1]
    size = fft.next_fast_len(2 * length, real=True)
    common = fft.rfft(ahead[1 : 2 * length + 1].T, size)
    # Of the innovations in the present cycle, those after the step are not known.
    first = ahead[:length].T * (np.arange(ratio)[:, None, None] < np.arange(ratio)[:, None])  # (age, step, frame)

    def apply(x: NDArray[np.float32]) -> NDArray[np.float32]:
        reversed_x = fft.rfft(x, size).conj()
        # Not by BLAS: as fast here, and one of its products once told of an invalid value where there was none.
        out = x + np.einsum("asp,apf->asf", np.einsum("asf,apf->asp", x, first), first)
        total = np.zeros_like(reversed_x)
        for hankel in common:
            known = fft.irfft(hankel * reversed_x, size)[..., :length]
            total += hankel * fft.rfft(known, size).conj()
        return out + fft.irfft(total, size)[..., :length]

    return scale * _conjugate_gradients(apply, b, axis=-1, tolerance=FRAMES_TOLERANCE)


LONGEST = 8192
"""Maximum age of a measurement beside z [steps], and, of a slow sensor alone, number of frames of which K' K is not left out."""

STEPS = 500
"""Maximum number of steps, where a few do: signals of 1e5 times their noise take thousands, which gain no digit."""

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
    found = _frame_whitener(covariance, slow.noise)
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
    x = [_conjugate_gradients(single.apply, one.astype(np.float32), (0, 2), TOLERANCE).astype(np.float64) for one in b]
    # Wrong by the square of the error of x, rounding and all.
    out = np.einsum("tipa,uipa->ptu", x, [2.0 * one - regression.apply(of) for one, of in zip(b, x, strict=True)])
    return 0.5 * (out + out.transpose(0, 2, 1))


def _conjugate_gradients(apply: Callable[[Array], Array], b: Array, axis: int | tuple[int, ...], tolerance: float) -> Array:
    """Solve M x = b, M symmetric and positive, for all right-hand sides at once; after STEPS steps as far as that goes.

    Parameters
    ----------
    apply : callable
        x -> M x.
    b : Array
        Right-hand sides.
    axis : int or tuple of int
        Axes of b of one right-hand side; along the others each is another.
    tolerance : float
        Residual of every solution over its right-hand side.

    Returns
    -------
    Array
        x, as b.
    """
    x, residual, direction = np.zeros_like(b), b.copy(), b.copy()
    power = np.sum(b**2, axis=axis, keepdims=True)
    enough, smallest = tolerance**2 * power, np.finfo(b.dtype).tiny
    for _ in range(STEPS):
        if not (power > enough).any():
            break
        moved = apply(direction)
        step = power / np.maximum(np.sum(direction * moved, axis=axis, keepdims=True), smallest)
        x += step * direction
        residual -= step * moved
        before, power = power, np.sum(residual**2, axis=axis, keepdims=True)
        direction = residual + (power / np.maximum(before, smallest)) * direction
    return x
