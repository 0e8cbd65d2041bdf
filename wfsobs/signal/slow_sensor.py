"""What a slow sensor adds to a fast one: the minimum error of any causal linear observer of both.

The fast sensor gives z[k] at every step, the slow one a frame y[k] = x[k] + v[k] at every n-th, v white. Signals are stationary,
the two sensors together are so only from one cycle of n steps to the next. With e the innovations of z, of variance one
(`wiener`),

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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from wfsobs.signal.wiener import Complex, Whitener, factorise
from wfsobs.typing import Array

KEPT = 0.875
"""Share of the frames that half the DFT holds that is used: the oldest are whitened without those before them."""

LONGEST = 8192
"""Maximum number of frames of which K' K is not left out."""

TOLERANCE = 1e-4
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
    return _gains(ahead[:kept], np.array(rests)[:, :kept])


def _frame_whitener(covariance: Array, noise: float) -> Whitener:
    """Return the factor of the spectrum of y', from its autocovariance without noise at the lags of frames."""
    circle = np.concatenate([covariance, covariance[-2:0:-1]])
    return factorise(np.maximum(fft.rfft(circle).real, 0.0) + noise)


def _whiten_frames(x: Array, noise: Whitener, ratio: int) -> Array:
    """Return F^-1 x for every age up to `ratio`, (frames, ratio), where F is the factor of the covariance of y' by age."""
    frames = noise.n // 2
    by_age = x[: frames * ratio].reshape(frames, ratio)
    return fft.irfft(fft.rfft(by_age, noise.n, axis=0) * noise.backwards[:, None], noise.n, axis=0)[:frames]


def _gains(ahead: Array, rest: Array) -> Array:
    """Return b' (I + K' K)^-1 b of all pairs of targets at every age.

    ahead : C', (frames, ratio);  rest : b, (n_targets, frames, ratio)
    """
    length = min(len(ahead), LONGEST)
    near = rest[:, :length].transpose(2, 0, 1)
    out = near @ _solve(ahead.astype(np.float32), near, length).transpose(0, 2, 1)
    out += np.einsum("aip,bip->pab", rest[:, length:], rest[:, length:])
    return 0.5 * (out + out.transpose(0, 2, 1))


def _solve(ahead: NDArray[np.float32], rest: Array, length: int) -> Array:
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

    x, residual = np.zeros_like(b), b.copy()
    direction, power = b.copy(), np.sum(b**2, axis=-1)
    smallest = np.finfo(b.dtype).tiny
    while (power > TOLERANCE**2).any():
        moved = apply(direction)
        step = power / np.maximum(np.sum(direction * moved, axis=-1), smallest)
        x += step[..., None] * direction
        residual -= step[..., None] * moved
        before, power = power, np.sum(residual**2, axis=-1)
        direction = residual + (power / np.maximum(before, smallest))[..., None] * direction
    return scale * x
