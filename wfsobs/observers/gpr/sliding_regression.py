"""Regression on the last windows of a stream, every mode by itself: one sample in, one estimate out, then an update.

The numbers are those of `gpr_online` over a record. The inverse N of M + sigma_n^2 I (`windows` has the split) is kept up to
date, one slot per training point, a new point taking the slot s of the oldest one:

    without the oldest       N_ = N - q q' / q_s,  q = N e_s           (row and column s become zero)
    with the new point       r = N_ v,  sigma = gamma - v.r,  t = r - e_s
                             N' = N_ + t t' / sigma

where v, gamma are the covariances of the new point with the others and itself. The same steps carry a = N f and b = N delta
along:

    a_ = a - q a_s / q_s,    a' = a_ + t (v.a_ - f_s) / sigma

The newest target is known only with the next sample, so a is kept with 0 in its place, and N e_s = -t / sigma gives what
the target adds. One step of refinement of r against M itself holds the error at rounding level times the condition
number, for any length of stream: a replaced point takes its error with it, so nothing accumulates.

To write all of N at every step would take longer than everything else. The columns q / sqrt(q_s) and t / sqrt(sigma) of several
steps wait beside it, and come in together, those of one mode at other steps than those of another, so that no step takes
much longer than the others.

Gaussian process regression in a sliding window, by recursive elimination.

At every step k the w points before k are the training set and point k is the test. Written as one symmetric
matrix over [points | f | delta], with M between points, the target f and the border delta as two more rows and
-1 / s2 at (delta, delta), the prediction at step k is what is left at (k, f), with opposite sign, once the training
points and delta have been eliminated (`windows` derives it).

b steps in a row share w - b + 1 training points. Eliminating those once, by one Cholesky factorisation of a positive
definite block, leaves the same sliding problem with window b - 1 over the points that come and go; that one is
cut into shorter runs and eliminated again, down to a window so short that all steps are finished together. About
2.2 w^2 operations per step, nothing carried from one run of b steps to the next, so nothing drifts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsymv, dsyr2k

from wfsobs.observers.gpr.windows import ConditionError, Points, SquaredExponential, restart_interval
from wfsobs.observers.stepping import Saved
from wfsobs.signal.linalg import eliminate
from wfsobs.typing import Array

LEAF = 8
"""Runs of this many steps are finished together."""


def _go_on() -> None:
    return None


def run_lengths(window: int) -> list[int]:
    """Return the number of steps that share an elimination on each level, each a multiple of the next.

    For a window below LEAF nothing is shared.
    """
    if window < LEAF:
        return []
    largest = 2 ** int(np.log2((window + 1) / 2))
    lengths = [largest]
    while lengths[-1] > LEAF:
        lengths.append(lengths[-1] // 4 if lengths[-1] // 4 >= 4 * LEAF else LEAF)
    return lengths


def slide(
    S: Array, f: Array, window: int, lengths: list[int], leaves: Array, at: int = 0, check: Callable[[], None] = _go_on
) -> None:
    """Write the small matrices of all steps of a run into leaves[..., at:at + steps].

    S : (window + steps + 2,) square, column-major, lower triangle, over [points | f | delta]; the f row holds what
        eliminations left there, the targets themselves are in f (window + steps,), added when a point is eliminated.
    leaves : (leaf window + 3, leaf window + 3, n)
    check  : called between pieces of work; what it raises ends the work
    """
    steps = S.shape[0] - 2 - window
    if not lengths:
        rows, columns, points = _leaf_indices(S.shape[0], window, steps)
        out, targets = leaves[:, :, at : at + steps], f[points]
        out[...] = S[rows, columns]
        out[:window, window + 1] += targets
        out[window + 1, :window] += targets
        return
    b, rest = lengths[0], lengths[1:]
    for start in range(0, steps, b):
        reduced, targets = _eliminate_common(S, f, window, start, b, check)
        slide(reduced, targets, b - 1, rest, leaves, at + start, check)


def _eliminate_common(S: Array, f: Array, window: int, start: int, b: int, check: Callable[[], None]) -> tuple[Array, Array]:
    """Eliminate the shared training points of steps start ... start + b - 1; return the remaining sliding problem."""
    n = window - b + 1
    common = slice(start + b - 1, start + window)
    going = slice(start, start + b - 1)
    coming = slice(start + window, start + window + b)
    border = slice(S.shape[0] - 2, S.shape[0])
    T = np.empty((window + b + 2, window + b + 2), order="F")
    to = [slice(0, n), slice(n, n + b - 1), slice(n + b - 1, n + 2 * b - 1), slice(n + 2 * b - 1, n + 2 * b + 1)]
    T[to[0], to[0]] = S[common, common]
    T[to[1], to[0]] = S[common, going].T
    T[to[2], to[0]] = S[coming, common]
    T[to[3], to[0]] = S[border, common]
    T[to[3].start, to[0]] += f[common]
    T[to[1], to[1]] = S[going, going]
    T[to[2], to[1]] = S[coming, going]
    T[to[3], to[1]] = S[border, going]
    T[to[2], to[2]] = S[coming, coming]
    T[to[3], to[2]] = S[border, coming]
    T[to[3], to[3]] = S[border, border]
    eliminate(T, n, check)
    return T[n:, n:], np.concatenate([f[going], f[coming]])


@lru_cache(maxsize=16)
def _leaf_indices(size: int, window: int, steps: int) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Where the leaves of a matrix of `size` are in its lower triangle, and which targets belong to them."""
    step = np.arange(steps)
    order = np.vstack([step + np.arange(window + 1)[:, None], np.tile([[size - 2], [size - 1]], steps)])
    return np.maximum(order[:, None], order[None]), np.minimum(order[:, None], order[None]), order[:window]


def finish(leaves: Array, window: int) -> tuple[Array, Array]:
    """Eliminate training points and delta of every small matrix at once; uses up `leaves`.

    Returns (mean, variance), each (n,): prediction, and predictive variance with the noise in it.
    """
    T = leaves
    order = [*range(window), window + 2]
    for done, p in enumerate(order):
        rest = [*order[done + 1 :], window, window + 1]
        for q in rest:
            factor = T[q, p] / T[p, p]
            for r in rest:
                if r <= q:
                    T[q, r] -= factor * T[p, r]
                    T[r, q] = T[q, r]
    return -T[window + 1, window], T[window, window].copy()


ENOUGH = 2e-10
"""Of M N - I. Predictions then differ by up to 1e-8 of their rms from those that are always refined."""
WAITING = 8
"""Steps whose columns come into N together."""
SAVED = ("history", "products", "kappa", "weights", "M", "N", "columns")
"""Arrays of the state."""


class SlidingRegression:
    """Regression on the last m windows of a stream of samples, one target behind.

    depth, m : samples in a window, windows in the training set; channels : numbers per sample; n_modes : streams side by side
    """

    depth: int
    m: int
    kernel: SquaredExponential
    step: int

    def __init__(self, depth: int, m: int, channels: int, kernel: SquaredExponential, n_modes: int = 1):
        self.depth, self.m, self.kernel, n = depth, m, kernel, n_modes
        self._span = m + depth + 1
        self._history = np.zeros((n, 4 * self._span, channels))  # newest sample last, moved to the front at the end
        self._products = np.zeros((n, m + 1))  # <x_k, x_i> for i = k - m ... k
        renewed = min(-(-(m + 1) * WAITING // restart_interval(depth)), m + 1)
        self._renewal = np.add.outer(np.arange(renewed), np.arange(depth))  # samples of windows
        self._kappa = np.zeros((n, m))  # by slot, like everything below
        self._weights = np.zeros((n, 3, m))  # a without the newest target, b, N e_newest
        self._M, self._N = np.zeros((2, n, m, m))
        self._lower = [N.T for N in self._N]  # of which the lower triangle is kept; column-major views, as BLAS has them
        self._columns = np.zeros((n, 2 * WAITING, m))  # N is the one above, plus those of points that came, minus those that went
        self._signs = np.repeat([1.0, -1.0], WAITING)
        self._turns = (np.arange(n) * max(1, WAITING // n) - 1) % WAITING  # of WAITING steps: when the columns of a mode come in
        self._begin()

    @property
    def ready(self) -> bool:
        """Whether the training set was full when the last sample came."""
        return self.step >= self.depth + self.m - 1

    def predict(self, samples: Array, last_targets: Array) -> Array:
        """Take the samples (n_modes, channels) of this step and the targets (n_modes,) of the windows before; return predictions.

        NaN until the training set is full. `update` must follow before the next sample.
        """
        self.step += 1
        self._learn(np.asarray(last_targets, dtype=float))
        self._slide(samples)
        self._covariances()
        return self._means() if self.ready else np.full(len(samples), np.nan)

    def _learn(self, targets: Array) -> None:
        """Bring in the targets that have come."""
        self._last_target = targets

    def _means(self) -> Array:
        """Predictions for the newest windows."""
        over = self._weights @ np.stack((self._kappa, self._points.delta), axis=2)
        (a, b, h), last = over.transpose(1, 2, 0), self._last_target
        border = (self._newest.delta[:, 0] - b[0]) / (1.0 / self.kernel.variance + b[1])
        return a[0] + last * h[0] + border * (a[1] + last * h[1])

    def reset(self) -> None:
        """Set the state back to before the first sample."""
        for name in SAVED:
            getattr(self, f"_{name}")[...] = 0.0
        self._begin()

    def _begin(self) -> None:
        self.step, self._end, n = -1, self._span, len(self._kappa)
        self._points, self._newest = self.kernel.points(np.zeros((n, self.m))), self.kernel.points(np.zeros((n, 1)))
        self._last_target = np.zeros(n)

    def save(self) -> Saved:
        """Return a copy of the state."""
        points, newest = ([p.norm2, p.delta] for p in (self._points, self._newest))
        numbers = [self.step, self._end, self._points.largest, self._newest.largest]
        state = {name: getattr(self, f"_{name}").copy() for name in SAVED}
        own = {"points": np.array(points), "newest": np.array(newest), "last_target": self._last_target.copy()}
        return state | own | {"numbers": np.array(numbers)}

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        for name in SAVED:
            getattr(self, f"_{name}")[...] = state[name]
        self.step, self._end = (int(i) for i in state["numbers"][:2])
        self._last_target = state["last_target"].copy()
        self._points, self._newest = (
            Points(x[0].copy(), x[1].copy(), most)
            for x, most in zip((state["points"], state["newest"]), state["numbers"][2:].tolist(), strict=True)
        )

    def _slide(self, samples: Array) -> None:
        """Inner products of the newest windows with the m before them and themselves, from those one step ago."""
        m, d, H = self.m, self.depth, self._history
        if self._end == H.shape[1]:
            H[:, : self._span] = H[:, -self._span :]
            self._end = self._span
        e = self._end
        H[:, e] = samples / self.kernel.length_scale
        for products, h in zip(self._products, H, strict=True):
            products += h[e - m : e + 1] @ h[e]
            products -= h[e - d - m : e - d + 1] @ h[e - d]
        self._end += 1

    def _covariances(self) -> None:
        """M between the newest window and those in the slots, zero where a slot is empty."""
        m, s = self.m, self.step % self.m
        filled = min(m, max(self.step - self.depth + 1, 0))
        self._newest = self.kernel.points(np.maximum(self._products[:, m:], 0.0))
        G = self._kappa
        G[:, s:] = self._products[:, : m - s]
        G[:, :s] = self._products[:, m - s : m]
        self.kernel.split(G, self._points, self._newest)
        if filled < m:
            G[:, (self.step - filled - np.arange(m - filled) - 1) % m] = 0.0

    def update(self) -> None:
        """Put the newest window in the place of the oldest. Raises ConditionError if the precision is not enough."""
        if self.step < self.depth - 1:
            return
        s, place = self.step % self.m, self.step % WAITING
        v, ab, h = self._kappa, self._weights[:, :2], self._weights[:, 2]
        ab[:, 0] += self._last_target[:, None] * h
        self._remove(s, place)
        r = np.empty_like(v)
        for mode, x in enumerate(v):
            r[mode] = self._times(mode, x)
        gamma = self.kernel.own(self._newest)[:, 0] + self.kernel.noise_std**2
        sigma = gamma - np.vecdot(v, r)
        for mode in np.flatnonzero(~self._are_enough(v, r, sigma, s)).tolist():
            r[mode] += self._times(mode, self._left(mode, v[mode], r[mode], s))
            sigma[mode] = gamma[mode] - v[mode] @ r[mode]
        if not (sigma > 0.0).all():
            raise ConditionError(
                "the covariance is no longer positive definite: raise noise_std or length_scale, or lower signal_std"
            )
        t = r
        t[:, s] = -1.0
        over = np.vecdot(ab, v[:, None])
        over[:, 1] -= self._newest.delta[:, 0]
        ab += (over / sigma[:, None])[:, :, None] * t[:, None]
        self._columns[:, place] = t / np.sqrt(sigma)[:, None]
        np.divide(t, -sigma[:, None], out=h)
        v[:, s] = gamma
        self._M[:, s] = self._M[:, :, s] = v
        self._points.norm2[:, s], self._points.delta[:, s] = self._newest.norm2[:, 0], self._newest.delta[:, 0]
        self._points = self._points._replace(largest=max(self._points.largest, self._newest.largest))
        for mode in np.flatnonzero(self._turns == place).tolist():
            self._gather(mode)
        if place == 0:
            self._renew_products()

    def _remove(self, s: int, place: int) -> None:
        """Take slot s out: its rows and columns are zero then; what it was adds to the columns that wait."""
        ab = self._weights[:, :2]
        if self._M[0, s, s] > 0.0:
            q = self._column(s)
            ab -= (ab[:, :, s] / q[:, s, None])[:, :, None] * q[:, None]
            self._columns[:, WAITING + place] = q / np.sqrt(q[:, s, None])
        for N in self._lower:
            N[s, :s] = N[s:, s] = 0.0
        self._columns[:, :, s] = 0.0
        ab[:, :, s] = self._kappa[:, s] = 0.0

    def _gather(self, mode: int) -> None:
        """Bring the columns of a mode that wait into N."""
        come, gone = self._columns[mode, :WAITING], self._columns[mode, WAITING:]
        # c c' - g g' in one pass over N
        dsyr2k(0.5, (come - gone).T, (come + gone).T, beta=1.0, c=self._lower[mode], lower=1, overwrite_c=1)
        self._columns[mode] = 0.0

    def _times(self, mode: int, v: Array) -> Array:
        """Return N v of a mode."""
        out, columns = dsymv(1.0, self._lower[mode], v, lower=1), self._columns[mode]
        out += (self._signs * (columns @ v)) @ columns
        return out

    def _column(self, s: int) -> Array:
        """Return column s of N, (n_modes, m)."""
        out = np.empty_like(self._kappa)
        for column, N, waiting in zip(out, self._lower, self._columns, strict=True):
            column[:s], column[s:] = N[s, :s], N[s:, s]
            column += (self._signs * waiting[:, s]) @ waiting
        return out

    def _left(self, mode: int, v: Array, r: Array, s: int) -> Array:
        """Return what r leaves of v = M_ r, without slot s."""
        out = v - self._M[mode] @ r
        out[s] = 0.0
        return out

    def _are_enough(self, v: Array, r: Array, sigma: Array, s: int) -> Array:
        """Whether the new column of N, r / sigma, is right to ENOUGH, as the oldest and the middle row of M_ r = v tell."""
        out = np.ones(len(v), dtype=bool)
        for row in ((s + 1) % self.m, (s + self.m // 2) % self.m):
            out &= np.abs(v[:, row] - np.vecdot(self._M[:, row], r)) <= ENOUGH * sigma
        return out

    def _renew_products(self) -> None:
        """Recompute some inner products from their samples, in turn: rounding of the others has no time to grow."""
        turns = -(-(self.m + 1) // len(self._renewal))
        first = min(self.step // WAITING % turns * len(self._renewal), self.m + 1 - len(self._renewal))
        d, e = self.depth, self._end
        at = self._renewal + (e - self.m - d + first)
        for products, H in zip(self._products, self._history, strict=True):
            products[first : first + len(at)] = H.take(at, axis=0).reshape(len(at), -1) @ H[e - d : e].ravel()


class LateRegression(SlidingRegression):
    """Regression on a stream whose targets come late, as those of a prediction do: `late` of the m windows have none yet.

    The target of the window that ends at step j, what will be `late` steps on, is known only at step j + 1 + late. Until then
    the window must not count; but leaving a point out of a Gaussian process is the same as giving it the target that makes its
    own weight zero, so it can sit in its slot with that target, and the sliding goes on as it is. With the samples of step k
    `predict` takes the targets of the windows k - 1 - late.

    Raises ValueError if no window would have one.
    """

    def __init__(self, depth: int, m: int, channels: int, kernel: SquaredExponential, late: int, n_modes: int = 1):
        if late >= m:
            raise ValueError(f"training size {m}: must be above the delay of the targets, {late} steps")
        super().__init__(depth, m, channels, kernel, n_modes)
        self.late = late

    def _means(self) -> Array:
        waiting = [(self.step - 1 - i) % self.m for i in range(self.late)]
        columns = np.array([self._column(slot) for slot in waiting[1:]]).reshape(-1, *self._kappa.shape)
        return np.array([self._mean(mode, waiting, columns[:, mode]) for mode in range(len(self._kappa))])

    def _mean(self, mode: int, waiting: list[int], columns: Array) -> float:
        """Prediction of a mode; columns : of N at the windows that wait but the newest, (late - 1, m)."""
        # weights a of the known targets, and of a 1 at each window that waits, the newest first
        parts = np.vstack([self._weights[mode, : 2 * self.late + 1 : 2], columns])
        b, both = self._weights[mode, 1], np.array([self._kappa[mode], self._points.delta[mode]])
        (along, _), over = both @ b, parts @ both.T
        constants = over[:, 1] / (1.0 / self.kernel.variance + both[1] @ b)
        mean = over[:, 0] + constants * (self._newest.delta[mode, 0] - along)
        own = parts[:, waiting] - np.outer(constants, b[waiting])  # weights of the windows that wait: to become zero
        targets = np.linalg.solve(own[1:].T, -own[0]) if self.late > 1 else -own[0] / own[1:].ravel()
        return float(mean[0] + targets @ mean[1:])

    def _learn(self, targets: Array) -> None:
        """Bring in the targets of the newest windows that have them."""
        self._last_target = np.zeros(len(targets))  # none for the newest window
        window = self.step - 1 - self.late
        if window >= self.depth - 1:
            self._weights[:, 0] += targets[:, None] * self._column(window % self.m)
