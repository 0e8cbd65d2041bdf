"""Online Gaussian process regression as a stream: one sample in, one estimate out, then an update.

The numbers are those of `gpr_online` over a record. The inverse N of M + sigma_n^2 I (`kernels` has the split) is kept up to
date, one slot per training point, a new point taking the slot s of the oldest one:

    without the oldest       N_ = N - q q' / q_s,  q = N e_s           (row and column s become zero)
    with the new point       r = N_ v,  sigma = gamma - v.r,  t = r - e_s
                             N' = N_ + t t' / sigma

where v, gamma are the covariances of the new point with the others and itself. Both together are one symmetric
rank-2 update. The same steps carry a = N f and b = N delta along:

    a_ = a - q a_s / q_s,    a' = a_ - t (f_s - v.a_) / sigma

The newest target is known only with the next sample, so a is kept with 0 in its place, and N e_s = -t / sigma gives what
the target adds. One step of refinement of r against M itself holds the error at rounding level times the condition
number, for any length of stream: a replaced point takes its error with it, so nothing accumulates.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsymv, dsyr2

from wfsobs.bandpass import StreamingBank, bandpass_bank
from wfsobs.observers.gpr_online import kernel_of
from wfsobs.observers.kernels import SquaredExponential, restart_interval
from wfsobs.scenario import Scenario

Array = NDArray[np.float64]


class SlidingRegression:
    """Regression on the last m windows of a stream of samples, one target behind.

    depth, m : samples in a window, windows in the training set; channels : numbers per sample
    """

    def __init__(self, depth: int, m: int, channels: int, kernel: SquaredExponential):
        self.depth, self.m, self.kernel = depth, m, kernel
        self.step = -1
        span = m + depth + 1
        self._history = np.zeros((channels, 4 * span))  # newest sample last, moved back when the end is reached
        self._end = span
        self._products = np.zeros(m + 1)  # <x_k, x_i> for i = k - m ... k
        self._norm2 = np.zeros(m)  # by slot, like everything below
        self._delta = np.zeros(m)
        self._kappa = np.zeros(m)
        self._weights = np.zeros((3, m))  # a without the newest target, N e_newest, b
        self._M = np.zeros((m, m), order="F")  # lower triangles
        self._N = np.zeros((m, m), order="F")
        self._renewed = -(-(m + 1) // restart_interval(depth))
        self._last_target = 0.0
        self._norm_t = self._delta_t = 0.0

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
        a, h, b = self._weights
        kappa, delta = self._kappa, self._delta
        by_kappa, by_delta = self._weights @ kappa, self._weights @ delta
        if not self.ready:
            return float("nan")
        border = (self._delta_t - by_kappa[2]) / (1.0 / self.kernel.variance + by_delta[2])
        at_kappa = by_kappa[0] + last_target * by_kappa[1]
        at_delta = by_delta[0] + last_target * by_delta[1]
        return float(at_kappa + border * at_delta)

    def _slide(self, sample: Array) -> None:
        """Inner products of the newest window with the m before it and itself, from those one step ago."""
        m, d = self.m, self.depth
        if self._end == self._history.shape[1]:
            span = m + d + 1
            self._history[:, :span] = self._history[:, -span:]
            self._end = span
        H, e = self._history, self._end
        H[:, e] = sample
        self._products += H[:, e] @ H[:, e - m : e + 1]
        self._products -= H[:, e - d] @ H[:, e - d - m : e - d + 1]
        self._end += 1

    def _covariances(self) -> None:
        """M between the newest window and those in the slots, zero where a slot is empty."""
        m, s = self.m, self.step % self.m
        filled = min(m, max(self.step - self.depth + 1, 0))
        self._norm_t = max(self._products[m], 0.0)
        G = self._kappa
        G[s:] = self._products[: m - s]
        G[:s] = self._products[m - s : m]
        self.kernel.split(G, self._norm2, np.array([self._norm_t]))
        if filled < m:
            G[(self.step - filled - np.arange(m - filled) - 1) % m] = 0.0
        self._delta_t = float(np.exp(-0.5 * self._norm_t / self.kernel.length_scale**2))

    def update(self) -> None:
        """Put the newest window in the place of the oldest."""
        if self.step < self.depth - 1:
            return
        m, s, N, M = self.m, self.step % self.m, self._N, self._M
        a, h, b = self._weights
        a += self._last_target * h
        v = self._kappa
        v[s] = 0.0
        gone = np.zeros(m)
        if M[s, s] > 0.0:
            q = _column(N, s)
            p = q[s]
            a -= q * (a[s] / p)
            b -= q * (b[s] / p)
            gone = q / np.sqrt(p)
        a[s] = b[s] = 0.0
        _set_column(M, s, v * 0.0)
        r = self._solve_without(v, gone, s)
        r += self._solve_without(v - dsymv(1.0, M, r, lower=1), gone, s)
        gamma = self.kernel.variance * self._own() + self.kernel.noise_std**2
        sigma = gamma - v @ r
        t = r
        t[s] = -1.0
        a -= t * ((0.0 - v @ a) / sigma)
        b -= t * ((self._delta_t - v @ b) / sigma)
        come = t / np.sqrt(sigma)
        dsyr2(0.5, come - gone, come + gone, a=N, lower=1, overwrite_a=1)
        np.divide(t, -sigma, out=h)
        _set_column(N, s, h)
        v[s] = gamma
        _set_column(M, s, v)
        self._norm2[s], self._delta[s] = self._norm_t, self._delta_t
        self._renew_products()

    def _own(self) -> float:
        """M of the newest window with itself over s2: exp(-n) expm1(n) = 1 - exp(-n) with n = |x|^2 / l^2."""
        return float(-np.expm1(-self._norm_t / self.kernel.length_scale**2))

    def _solve_without(self, v: Array, gone: Array, s: int) -> Array:
        """N_ v, the inverse without slot s."""
        out = dsymv(1.0, self._N, v, lower=1) - gone * (gone @ v)
        out[s] = 0.0
        return out

    def _renew_products(self) -> None:
        """Some inner products from their samples at every step, in turn: rounding of the others has no time to grow."""
        d, H, e = self.depth, self._history, self._end
        turns = -(-(self.m + 1) // self._renewed)
        first = self.step % turns * self._renewed
        last = min(first + self._renewed, self.m + 1)
        start = e - self.m - d + first
        self._products[first:last] = sum(
            np.correlate(row[start : start + d + last - first - 1], row[e - d : e], "valid") for row in H)


def _column(S: Array, s: int) -> Array:
    """Column s of a symmetric matrix of which the lower triangle is kept."""
    return np.concatenate([S[s, :s], S[s:, s]])


def _set_column(S: Array, s: int, values: Array) -> None:
    S[s, :s] = values[:s]
    S[s:, s] = values[s:]


class OnlineGprStream:
    """The online GPR of one mode, one sample at a time, as a control loop calls it.

    >>> stream = OnlineGprStream(Scenario().replace({"gpr_online.training_size": 3, "gpr_online.depth": 2}))
    >>> [round(stream.step(y, 0.0), 3) for y in (0.0, 0.1, 0.0, -0.1, 0.0)]
    [nan, nan, nan, nan, -0.0]
    """

    def __init__(self, scenario: Scenario):
        g, b = scenario.gpr_online, scenario.butterworth
        bank = bandpass_bank(b.frequencies, b.bandwidth_online, b.order, scenario.dt)
        self._inputs = g.inputs
        self._bank = StreamingBank(bank)
        self._regression = SlidingRegression(g.depth, g.training_size, 1 if g.inputs == "z" else 2, kernel_of(g))
        self._u = (0.0, 0.0)  # u[k-1], u[k-2]
        self._now: float | None = None
        self._pending = False

    def estimate(self, y: float, u: float | None = None) -> float:
        """Estimate of the vibration at this step [um], from its LGS measurement y [um] and, unless the windows
        are of z, its command u [um]. NaN until the training set is full. `update` must follow."""
        if self._pending:
            raise RuntimeError("estimate was called twice without update")
        z = y - self._u[1]
        if self._inputs == "z":
            sample = np.array([z])
        elif u is None:
            raise ValueError("windows of u and y need the command of this step")
        else:
            sample = np.array([u, y])
        self._now, self._pending = u, True
        return self._regression.predict(sample, self._bank.push(z))

    def update(self, u: float | None = None) -> None:
        """Learn from the last sample. u: its command [um], where `estimate` was not told."""
        u = self._now if u is None else u
        if u is None or not self._pending:
            raise ValueError("update needs the command u, and an estimate before it")
        self._regression.update()
        self._bank.settle()
        self._u, self._pending = (u, self._u[0]), False

    def step(self, y: float, u: float) -> float:
        """`estimate`, then `update`."""
        value = self.estimate(y, u)
        self.update()
        return value
