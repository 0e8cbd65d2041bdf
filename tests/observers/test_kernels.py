"""Sliding inner products and the split of the squared exponential against their definitions."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.observers.gpr.windows import (
    ConditionError,
    SquaredExponential,
    band,
    check_condition,
    sliding_products,
    square_from_band,
    squared_norms,
)

EPS = np.finfo(float).eps
EXAMPLES = settings(max_examples=50, deadline=None, derandomize=True)


def window(x: np.ndarray, end: int, depth: int) -> np.ndarray:
    """The samples end - depth + 1 ... end of every channel, zeros outside the record."""
    padded = np.vstack([np.zeros((depth + 500, x.shape[1])), x, np.zeros((depth + 500, x.shape[1]))])
    at = end + depth + 500
    return padded[at - depth + 1 : at + 1].ravel()


@EXAMPLES
@given(
    st.integers(1, 40),
    st.integers(1, 60),
    st.integers(1, 50),
    st.integers(1, 2),
    st.integers(-10, 60),
    st.integers(-60, 60),
    st.integers(0, 2**31),
)
def test_sliding_products_are_inner_products(
    depth: int, rows: int, offsets: int, channels: int, i0: int, shift: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.standard_normal((70, channels)), rng.standard_normal((90, channels)) * 10 ** rng.uniform(-3, 3)
    got = sliding_products(a, b, depth, i0, i0 + shift, rows, offsets)
    assert got.shape == (rows, offsets)
    size = np.abs(a).max() * np.abs(b).max() * depth * channels
    for r in range(0, rows, 7):
        for c in range(0, offsets, 5):
            wanted = window(a, i0 + r, depth) @ window(b, i0 + shift + r + c, depth)
            # sliding from one direct product to the next adds two roundings per step, at most max(16, depth) times
            assert abs(got[r, c] - wanted) <= 4 * EPS * size * max(16, depth)


def test_products_do_not_drift() -> None:
    """A record whose first windows are a million times larger leaves nothing in the later ones."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((5000, 1))
    x[:300] *= 1e6
    norms = squared_norms(x, 20)
    for end in (19, 300, 340, 1000, 4999):
        # rounding of the loud part is forgotten once a product has been made anew, max(16, depth) steps later
        assert norms[end] == pytest.approx(np.sum(window(x, end, 20) ** 2), rel=1e-13 if end != 300 else 1e-3)
    assert (norms[:19] > 0).all()  # windows reaching before the start: those samples are zero


def exact_split(kernel: SquaredExponential, x: np.ndarray, y: np.ndarray) -> mp.mpf:
    """k(x, y) - s2 delta_x delta_y in 50 digits, k as printed (paper, eq. 13)."""
    with mp.workdps(50):
        X, Y = [mp.mpf(float(v)) for v in x], [mp.mpf(float(v)) for v in y]
        l2 = 2 * mp.mpf(kernel.length_scale) ** 2
        distance = sum((p - q) ** 2 for p, q in zip(X, Y, strict=True))
        norms = sum(p * p for p in X) + sum(q * q for q in Y)
        return mp.mpf(kernel.signal_std) ** 2 * (mp.exp(-distance / l2) - mp.exp(-norms / l2))


@EXAMPLES
@given(st.floats(-1.0, 5.0), st.floats(-3.0, 4.0), st.floats(-1.5, 0.5), st.integers(1, 8), st.integers(0, 2**31))
def test_split_kernel_in_long_arithmetic(log_l: float, log_s: float, log_amplitude: float, d: int, seed: int) -> None:
    kernel = SquaredExponential(10**log_s, 10**log_l, 0.1)
    x = 10**log_amplitude * np.random.default_rng(seed).standard_normal((12, 2))
    V, points = band(x, d, kernel, d, 5, 2)
    for r in range(3):
        for lag in range(3):
            one, other = window(x, d + r, d), window(x, d + r + lag, d)
            entry = V[r, lag] - kernel.noise_std**2 * (lag == 0)
            wanted = exact_split(kernel, one, other)
            # rounding of the inner product, 8 d eps |x|^2, counts relative to l^2 in the exponent and as it is in front
            size = (one @ one + other @ other) / kernel.length_scale**2
            slack = 16 * (d + 16) * EPS * size * kernel.variance + 4 * EPS * kernel.noise_std**2
            assert abs(entry - wanted) <= slack + 8 * EPS * abs(wanted)
    for r in range(5):
        norm2 = np.sum(window(x, d + r, d) ** 2)
        assert points.norm2[r] == pytest.approx(norm2 / kernel.length_scale**2, rel=1e-13)
        assert points.delta[r] == pytest.approx(np.exp(-norm2 / 2 / kernel.length_scale**2), rel=1e-12, abs=1e-300)


def test_square_from_band_is_the_covariance_matrix() -> None:
    rng = np.random.default_rng(1)
    x, kernel = rng.standard_normal((60, 2)), SquaredExponential(3.0, 20.0, 0.2)
    V, points = band(x, 6, kernel, 8, 30, 11)
    for start in (0, 5, 18):
        S = square_from_band(V, start, 12)
        X = np.array([window(x, 8 + start + i, 6) for i in range(12)])
        distance = np.sum((X[:, None] - X[None]) ** 2, axis=2)
        delta = np.exp(-np.sum(X**2, axis=1) / 2 / 20.0**2)
        full = 9.0 * np.exp(-distance / 2 / 20.0**2) - 9.0 * np.outer(delta, delta) + 0.04 * np.eye(12)
        lower = np.tril_indices(12)
        # the plain difference cancels: eps of the 9.0 in front
        assert np.abs(S[lower] - full[lower]).max() < 20 * EPS * 9.0
        assert np.allclose(points.delta[start : start + 12], delta, rtol=1e-13)


@pytest.mark.parametrize("condition", [1e3, 1e11, 1e12, 1e14, 1e16])
def test_the_condition_check_knows_its_limit(condition: float) -> None:
    """Symmetric matrices of a given condition: below 1e13 accepted, above refused with the three numbers that matter."""
    rng = np.random.default_rng(2)
    basis = np.linalg.qr(rng.standard_normal((40, 40)))[0]
    noise = 0.01
    S = np.asfortranarray(basis * np.concatenate([[condition], np.geomspace(1, condition**0.5, 39)]) @ basis.T * noise**2)
    kernel = SquaredExponential(5.0, 300.0, noise)
    if condition < 1e13:
        check_condition(S, kernel)
    else:
        with pytest.raises(ConditionError, match=r"noise_std \(0.01\).*length_scale \(300\).*signal_std \(5\)") as caught:
            check_condition(S, kernel)
        assert "\n" not in str(caught.value)
