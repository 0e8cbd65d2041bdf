"""Regression on the last windows of a stream: one sample in, one estimate out, then an update.

The numbers are those of `gpr_online` over a record. The inverse N of M + sigma_n^2 I (`kernels` has the split) is kept up to
date, one slot per training point, a new point taking the slot s of the oldest one:

    without the oldest       N_ = N - q q' / q_s,  q = N e_s           (row and column s become zero)
    with the new point       r = N_ v,  sigma = gamma - v.r,  t = r - e_s
                             N' = N_ + t t' / sigma

where v, gamma are the covariances of the new point with the others and itself. Both together are one symmetric
rank-2 update. The same steps carry a = N f and b = N delta along:

    a_ = a - q a_s / q_s,    a' = a_ + t (v.a_ - f_s) / sigma

The newest target is known only with the next sample, so a is kept with 0 in its place, and N e_s = -t / sigma gives what
the target adds. One step of refinement of r against M itself holds the error at rounding level times the condition
number, for any length of stream: a replaced point takes its error with it, so nothing accumulates.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.linalg.blas import dsymv, dsyr2

from wfsobs.observers.gpr.kernels import ConditionError, Points, SquaredExponential, restart_interval
from wfsobs.signal.stepping import Saved
from wfsobs.typing import Array

ENOUGH = 2e-10
"""Of M N - I. Predictions then differ by up to 1e-8 of their rms from those that are always refined."""
SAVED = ("history", "products", "kappa", "weights", "M", "N")
"""Arrays of the state."""


class SlidingRegression:
    """Regression on the last m windows of a stream of samples, one target behind.

    depth, m : samples in a window, windows in the training set; channels : numbers per sample
    """

    def __init__(self, depth: int, m: int, channels: int, kernel: SquaredExponential):
        self.depth, self.m, self.kernel = depth, m, kernel
        self.step = -1
        self._span = m + depth + 1
        self._history = np.zeros((4 * self._span, channels))  # newest sample last, moved to the front at the end
        self._end = self._span
        self._products = np.zeros(m + 1)  # <x_k, x_i> for i = k - m ... k
        renewed = -(-(m + 1) // restart_interval(depth))
        self._renewal = np.add.outer(np.arange(renewed) * channels, np.arange(depth * channels))  # samples of windows
        self._points = kernel.points(np.zeros(m))  # by slot, like everything below
        self._newest = kernel.points(np.zeros(1))
        self._kappa = np.zeros(m)
        self._weights = np.zeros((3, m))  # a without the newest target, b, N e_newest
        self._M = np.zeros((m, m), order="F")
        self._N = np.zeros((m, m), order="F")  # lower triangle
        self._last_target = 0.0

    @property
    def ready(self) -> bool:
        """Whether the training set was full when the last sample came."""
        return self.step >= self.depth + self.m - 1

    def predict(self, sample: Array, last_target: float) -> float:
        """Take the sample of this step and the target of the window before it; return the prediction.

        NaN until the training set is full. `update` must follow before the next sample.
        """
        self.step += 1
        self._last_target = last_target
        self._slide(sample)
        self._covariances()
        if not self.ready:
            return float("nan")
        a, b, h = self._weights @ np.array([self._kappa, self._points.delta]).T
        border = (self._newest.delta[0] - b[0]) / (1.0 / self.kernel.variance + b[1])
        return float(a[0] + last_target * h[0] + border * (a[1] + last_target * h[1]))

    def save(self) -> Saved:
        """Return a copy of the state."""
        points, newest = ([p.norm2, p.delta] for p in (self._points, self._newest))
        numbers = [self.step, self._end, self._last_target, self._points.largest, self._newest.largest]
        state = {name: getattr(self, f"_{name}").copy() for name in SAVED}
        return state | {"points": np.array(points), "newest": np.array(newest), "numbers": np.array(numbers)}

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        for name in SAVED:
            getattr(self, f"_{name}")[...] = state[name]
        self.step, self._end = (int(i) for i in state["numbers"][:2])
        self._last_target, *largest = state["numbers"][2:].tolist()
        self._points, self._newest = (
            Points(x[0].copy(), x[1].copy(), most) for x, most in zip((state["points"], state["newest"]), largest, strict=True)
        )

    def _slide(self, sample: Array) -> None:
        """Inner products of the newest window with the m before it and itself, from those one step ago."""
        m, d = self.m, self.depth
        if self._end == len(self._history):
            self._history[: self._span] = self._history[-self._span :]
            self._end = self._span
        H, e = self._history, self._end
        H[e] = sample / self.kernel.length_scale
        self._products += H[e - m : e + 1] @ H[e]
        self._products -= H[e - d - m : e - d + 1] @ H[e - d]
        self._end += 1

    def _covariances(self) -> None:
        """M between the newest window and those in the slots, zero where a slot is empty."""
        m, s = self.m, self.step % self.m
        filled = min(m, max(self.step - self.depth + 1, 0))
        self._newest = self.kernel.points(np.maximum(self._products[m:], 0.0))
        G = self._kappa
        G[s:] = self._products[: m - s]
        G[:s] = self._products[m - s : m]
        self.kernel.split(G, self._points, self._newest)
        if filled < m:
            G[(self.step - filled - np.arange(m - filled) - 1) % m] = 0.0

    def update(self) -> None:
        """Put the newest window in the place of the oldest. Raises ConditionError if the precision is not enough."""
        if self.step < self.depth - 1:
            return
        s, N, M, v = self.step % self.m, self._N, self._M, self._kappa
        a, b, h = self._weights
        ab = self._weights[:2]
        a += self._last_target * h
        gone = np.zeros(self.m)
        if M[s, s] > 0.0:
            q = _column(N, s)
            ab -= (ab[:, s : s + 1] / q[s]) * q
            gone = q / np.sqrt(q[s])
        ab[:, s] = v[s] = 0.0
        r = self._solve_without(v, gone, s)
        gamma = self.kernel.own(self._newest)[0] + self.kernel.noise_std**2
        sigma = gamma - v @ r
        if not self._is_enough(v, r, sigma, s):
            r += self._solve_without(v - dsymv(1.0, M, r, lower=1), gone, s)
            sigma = gamma - v @ r
        if not sigma > 0.0:
            raise ConditionError(
                "the covariance is no longer positive definite: raise noise_std or length_scale, or lower signal_std"
            )
        t = r
        t[s] = -1.0
        a += ((v @ a) / sigma) * t
        b += ((v @ b - self._newest.delta[0]) / sigma) * t
        come = t / np.sqrt(sigma)
        dsyr2(0.5, come - gone, come + gone, a=N, lower=1, overwrite_a=1)
        np.divide(t, -sigma, out=h)
        _set_column(N, s, h)
        v[s] = gamma
        M[s] = M[:, s] = v
        self._points.norm2[s], self._points.delta[s] = self._newest.norm2[0], self._newest.delta[0]
        self._points = self._points._replace(largest=max(self._points.largest, self._newest.largest))
        self._renew_products()

    def _solve_without(self, v: Array, old_column: Array, s: int) -> Array:
        """N_ v, the inverse without slot s; sets v[s] to zero."""
        v[s] = 0.0
        out = dsymv(1.0, self._N, v, lower=1)
        out -= old_column * (old_column @ v)
        out[s] = 0.0
        return out

    def _is_enough(self, v: Array, r: Array, sigma: float, s: int) -> bool:
        """Whether the new column of N, r / sigma, is right to ENOUGH, as the oldest and the middle row of M_ r = v tell."""
        oldest, middle = (s + 1) % self.m, (s + self.m // 2) % self.m
        M, enough = self._M, ENOUGH * sigma
        return abs(v[oldest] - M[:, oldest] @ r) <= enough and abs(v[middle] - M[:, middle] @ r) <= enough

    def _renew_products(self) -> None:
        """Recompute some inner products from their samples, in turn: rounding of the others has no time to grow."""
        turns = -(-(self.m + 1) // len(self._renewal))
        first = min(self.step % turns * len(self._renewal), self.m + 1 - len(self._renewal))
        d, e, H = self.depth, self._end, self._history
        windows = H.ravel().take(self._renewal + (e - self.m - d + first) * H.shape[1])
        self._products[first : first + len(windows)] = windows @ H[e - d : e].ravel()


def _column(S: Array, s: int) -> Array:
    """Column s of a symmetric matrix of which the lower triangle is kept."""
    return np.concatenate([S[s, :s], S[s:, s]])


def _set_column(S: Array, s: int, values: Array) -> None:
    S[s, :s] = values[:s]
    S[s:, s] = values[s:]
