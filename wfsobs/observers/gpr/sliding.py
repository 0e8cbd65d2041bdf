"""Gaussian process regression in a sliding window, by recursive elimination.

At every step k the w points before k are the training set and point k is the test. Written as one symmetric
matrix over [points | f | delta], with M between points, the target f and the border delta as two more rows and
-1 / s2 at (delta, delta), the prediction at step k is what is left at (k, f), with opposite sign, once the training
points and delta have been eliminated (`kernels` derives it).

b steps in a row share w - b + 1 training points. Eliminating those once, by one Cholesky factorisation of a positive
definite block, leaves the same sliding problem with window b - 1 over the points that come and go; that one is
cut into shorter runs and eliminated again, down to a window so short that all steps are finished together. About
2.2 w^2 operations per step, nothing carried from one run of b steps to the next, so nothing drifts.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

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
        _gather_leaves(S, f, window, steps, leaves[:, :, at : at + steps])
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


def _gather_leaves(S: Array, f: Array, window: int, steps: int, out: Array) -> None:
    """out[:, :, i] = the matrix of [training points of step i | its test point | f | delta], symmetric."""
    rows, columns, points = _leaf_indices(S.shape[0], window, steps)
    out[...] = S[rows, columns]
    targets = f[points]
    out[:window, window + 1] += targets
    out[window + 1, :window] += targets


@lru_cache(maxsize=16)
def _leaf_indices(size: int, window: int, steps: int) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Where the leaves of a matrix of `size` are in its lower triangle, and which targets belong to them."""
    step = np.arange(steps)
    order = np.vstack(
        [
            step + np.arange(window + 1)[:, None],
            np.full((1, steps), size - 2),
            np.full((1, steps), size - 1),
        ]
    )
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
