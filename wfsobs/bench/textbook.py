"""Textbook versions for comparison: correct, vectorised where a textbook is, nothing shared between steps.

`windows` are prepared, one per row, at no cost in the comparison. The kernel is written as in any textbook,

    K = s2 exp(-|x - x'|^2 / 2 l^2),    |x - x'|^2 = |x|^2 + |x'|^2 - 2 <x, x'>,

with all the inner products from one matrix product (gemm). The `exact_` functions are the reference of errors:
the same regression in the split form of `observers.kernels`, which is well conditioned, from direct products.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.linalg import cho_factor, cho_solve

from wfsobs.observers.gpr.windows import SquaredExponential
from wfsobs.typing import Array

BLOCK = 256
"""Windows predicted at a time, so that the covariances stay in the cache."""


def windows(signals: Array, depth: int) -> Array:
    """Return the window ending at every step from depth - 1 on, (n - depth + 1, channels * depth), of signals (n, channels)."""
    view = sliding_window_view(signals, depth, axis=0)
    return view.reshape(len(view), -1)


def covariance(X: Array, Z: Array, kernel: SquaredExponential) -> Array:
    """Return the squared-exponential kernel between the rows of X (n, p) and of Z (m, p), (n, m), by one gemm."""
    K = X @ Z.T
    K *= -2.0
    K += np.einsum("ij,ij->i", X, X)[:, None]
    K += np.einsum("ij,ij->i", Z, Z)
    K *= -0.5 / kernel.length_scale**2
    np.exp(K, out=K)
    K *= kernel.variance
    return K


def cholesky_factor(X: Array, kernel: SquaredExponential) -> tuple[Array, bool]:
    """Cholesky factor of K + sigma_n^2 I of the windows X (m, p)."""
    K = covariance(X, X, kernel)
    K.flat[:: len(X) + 1] += kernel.noise_std**2
    # K is symmetric: its transpose is column-major, so that LAPACK needs no copy.
    return cho_factor(K.T, lower=True, overwrite_a=True, check_finite=False)


def train_textbook(X: Array, f: Array, kernel: SquaredExponential) -> Array:
    """Weights (K + sigma_n^2 I)^-1 f, (m,), of windows X (m, p) and targets f (m,)."""
    return cho_solve(cholesky_factor(X, kernel), f, check_finite=False)


def predict_textbook(X: Array, trained_on: Array, weights: Array, kernel: SquaredExponential) -> Array:
    """Mean at the windows X (n, p) from stored weights (m,) of the windows `trained_on` (m, p), (n,)."""
    out = np.empty(len(X))
    for start in range(0, len(X), BLOCK):
        block = slice(start, start + BLOCK)
        out[block] = covariance(X[block], trained_on, kernel) @ weights
    return out


def predict_online(X: Array, f: Array, rows: Array, m: int, kernel: SquaredExponential) -> Array:
    """Mean at some rows of X (n, p), each trained anew on the m rows before it and their targets in f (n,)."""
    return np.array(
        [
            predict_textbook(X[r : r + 1], X[r - m : r], train_textbook(X[r - m : r], f[r - m : r], kernel), kernel)[0]
            for r in rows
        ]
    )


@dataclass
class OnlineStream:
    """The same one step at a time, with all that does not need the newest sample done before it comes."""

    X: Array
    m: int
    kernel: SquaredExponential

    def prepare(self, row: int) -> None:
        """Kernel and Cholesky factor of the training windows of a row of X."""
        self._trained_on = self.X[row - self.m : row]
        self._factor = cholesky_factor(self._trained_on, self.kernel)

    def estimate(self, row: int, f: Array) -> float:
        """Mean at the row, from targets f (m,) of which the newest has come with the sample."""
        weights = cho_solve(self._factor, f, check_finite=False)
        return float(covariance(self.X[row : row + 1], self._trained_on, self.kernel)[0] @ weights)


def kalman_loop(A: Array, B: Array, C: Array, L: Array, y: Array, u: Array) -> Array:
    """Run the steady-state Kalman filter of the paper's eq. 8 and 9, step by step; return the filtered states (n_steps, n).

    A (n, n), B (n,), C (n,), filter gain L (n,), y, u (n_steps,). Works in the precision of its arguments.
    """
    x, out = np.zeros_like(B), np.empty((len(y), len(B)), dtype=y.dtype)
    for k in range(len(y)):
        filtered = x + L * (y[k] - C @ x)
        out[k] = filtered
        x = A @ filtered + B * u[k]
    return out


def multirate_loop(
    A: Array, B: Array, C: Array, C_ngs: Array, L: Array, L_both: Array, y: Array, z_ngs: Array, u: Array
) -> Array:
    """Run the paper's multi-rate filter (eq. 11), step by step; return the filtered states (n_steps, n).

    L (n,) where there is an LGS measurement alone, L_both (n, 2) where z_ngs (n_steps,) is not NaN.
    """
    C_both = np.vstack([C, C_ngs])
    both, frame = np.column_stack([y, z_ngs]), ~np.isnan(z_ngs)
    x, out = np.zeros_like(B), np.empty((len(y), len(B)), dtype=y.dtype)
    for k in range(len(y)):
        filtered = x + (L_both @ (both[k] - C_both @ x) if frame[k] else L * (y[k] - C @ x))
        out[k] = filtered
        x = A @ filtered + B * u[k]
    return out


def exact_weights(X: Array, f: Array, kernel: SquaredExponential) -> tuple[Array, float]:
    """(w, c) of the split form: weights w = (K + sigma_n^2 I)^-1 f (m,), and c = s2 delta.w."""
    delta = _delta(X, kernel)
    M = _split(X, X, kernel)
    M.flat[:: len(X) + 1] += kernel.noise_std**2
    a, b = cho_solve(cho_factor(M, lower=True), np.column_stack([f, delta])).T
    c = (delta @ a) / (1.0 / kernel.variance + delta @ b)
    return a - b * c, float(c)


def exact_predict(X: Array, trained_on: Array, w: Array, c: float, kernel: SquaredExponential) -> Array:
    """Mean at the windows X (n, p), (n,)."""
    return _split(X, trained_on, kernel) @ w + _delta(X, kernel) * c


def exact_online(X: Array, f: Array, rows: Array, m: int, kernel: SquaredExponential) -> Array:
    """Return the exact values of `predict_online`."""
    trained = [exact_weights(X[r - m : r], f[r - m : r], kernel) for r in rows]
    return np.array([exact_predict(X[r : r + 1], X[r - m : r], w, c, kernel)[0] for r, (w, c) in zip(rows, trained, strict=True)])


def _delta(X: Array, kernel: SquaredExponential) -> Array:
    return np.exp(-0.5 * np.einsum("ij,ij->i", X, X) / kernel.length_scale**2)


def _split(X: Array, Z: Array, kernel: SquaredExponential) -> Array:
    """s2 delta delta' expm1(<x, x'> / l^2), for |x| < l."""
    return kernel.variance * np.outer(_delta(X, kernel), _delta(Z, kernel)) * np.expm1(X @ Z.T / kernel.length_scale**2)
