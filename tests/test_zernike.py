"""Noll's modes: against their definition, integrated numerically over the disc."""

from __future__ import annotations

from itertools import pairwise
from math import factorial

import numpy as np
import pytest

from tests.noll import noll_covariance
from wfsobs.atmosphere import Footprint, Wave
from wfsobs.sensors.zernike import (
    ZernikeProjection,
    bessel_ratio,
    noll,
    tabulated_bessel_ratio,
    transform,
    up_to_order,
)

MODES = range(1, 29)


def radial(n: int, m: int, r: np.ndarray) -> np.ndarray:
    """Noll, eq. 2."""
    out = np.zeros_like(r)
    for s in range((n - m) // 2 + 1):
        below = factorial(s) * factorial((n + m) // 2 - s) * factorial((n - m) // 2 - s)
        out += (-1) ** s * factorial(n - s) / below * r ** (n - 2 * s)
    return out


def on_disc() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes (r, angle) and weights of the mean over the unit disc, exact for polynomials of degree 60."""
    x, w = np.polynomial.legendre.leggauss(32)
    r2 = 0.5 * (x + 1.0)
    angle = 2.0 * np.pi * np.arange(64) / 64
    r, a = np.meshgrid(np.sqrt(r2), angle)
    return r.ravel(), a.ravel(), np.tile(0.5 * w / 64, 64)


def values(j: int, r: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Noll, eq. 1."""
    n, signed = noll(j)
    m = abs(signed)
    turn = np.ones_like(a) if m == 0 else np.sqrt(2.0) * (np.cos(m * a) if signed > 0 else np.sin(m * a))
    return np.sqrt(n + 1.0) * radial(n, m, r) * turn


def test_the_modes_are_noll_s() -> None:
    """Table I of the paper: all of a radial order before the next, even numbers are cosines; and they are orthonormal."""
    orders = [noll(j) for j in MODES]
    assert len(set(orders)) == len(orders)
    assert [n for n, _ in orders] == sorted(n for n, _ in orders)
    for j, (n, m) in zip(MODES, orders, strict=True):
        assert abs(m) <= n and (n - m) % 2 == 0 and (m == 0 or (m > 0) == (j % 2 == 0))
    for (n, m), (p, q) in pairwise(orders):
        assert n < p or abs(m) <= abs(q)
    r, a, w = on_disc()
    z = np.array([values(j, r, a) for j in MODES])
    assert np.allclose(z * w @ z.T, np.eye(len(z)), atol=1e-12)


@pytest.mark.parametrize("order", range(1, 7))
def test_how_many_modes_an_order_has(order: int) -> None:
    assert list(up_to_order(order)) == [j for j in range(2, 60) if noll(j)[0] <= order]


@pytest.mark.parametrize("j", MODES)
def test_transform_is_the_projection_of_a_plane_wave(j: int) -> None:
    r, a, w = on_disc()
    k = np.array([[0.01, 0.0], [1.3, 0.4], [-2.0, 5.0], [0.0, -7.0], [6.0, 6.0]])
    wave = np.exp(1j * (k[:, :1] * r * np.cos(a) + k[:, 1:] * r * np.sin(a)))
    assert np.allclose(transform(j, k[:, 0], k[:, 1]), wave @ (w * values(j, r, a)), atol=1e-12)


@pytest.mark.parametrize("order", range(1, 8))
def test_the_table_of_bessel_functions(order: int) -> None:
    x = np.random.default_rng(order).uniform(0.0, 1000.0, 20_000)
    size = np.sqrt(2.0 / np.pi) * np.maximum(x, 1.0) ** -1.5
    assert np.abs((tabulated_bessel_ratio(order, x) - bessel_ratio(order, x)) / size).max() < 1e-5
    assert tabulated_bessel_ratio(order, np.array([0.0, 2000.0])).tolist() == [0.5 if order == 1 else 0.0, 0.0]


@pytest.mark.parametrize("angle", [0.0, 0.7, -2.5, np.pi / 2])
@pytest.mark.parametrize("footprint", [Footprint(), Footprint(0.8, (1.5, -0.7))])
def test_the_ideal_sensor_is_the_sum_over_its_waves(angle: float, footprint: Footprint) -> None:
    """Folding, tables and rotation against the transform at every single wave."""
    rng = np.random.default_rng(3)
    ky = np.sort(rng.uniform(0.01, 3.0, 9))
    ky = np.concatenate([-ky[::-1], ky])
    kx = rng.uniform(0.01, 3.0, 5)
    amplitude = rng.standard_normal((18, 5)) + 1j * rng.standard_normal((18, 5))
    wave = Wave(kx, ky, angle, amplitude)
    sensor = ZernikeProjection(8.0, tuple(MODES))
    expected = np.einsum("jyx,yx->jx", sensor.transform(*wave.in_pupil(), footprint), amplitude)
    assert np.allclose(sensor.measure(wave, footprint), expected, atol=1e-4 * np.abs(expected).max())
    assert sensor.n_outputs == 28


def test_covariances_of_kolmogorov_turbulence() -> None:
    """Noll's residual errors (his Table IV) are differences of these, printed to about three digits; and the integral of
    the spectrum over all of the plane, for radial order 1 to 6, to the digits of its constant."""
    residual = [1.0299, 0.582, 0.134, 0.111, 0.0880, 0.0648, 0.0587, 0.0525, 0.0463, 0.0401, 0.0377]
    for j, (before, after) in enumerate(pairwise(residual), start=2):
        assert noll_covariance(j, j) == pytest.approx(before - after, rel=0.01, abs=2e-4)
    k = np.exp(np.linspace(-30.0, 8.0, 200_000))  # cycles per diameter
    for j in (2, 4, 7, 11, 16, 22):
        n = noll(j)[0]
        density = 0.0229 * k ** (-11 / 3) * (n + 1) * (2.0 * bessel_ratio(n + 1, np.pi * k)) ** 2 * 2.0 * np.pi * k**2
        assert noll_covariance(j, j) == pytest.approx(np.trapezoid(density, np.log(k)), rel=5e-4)
    assert noll_covariance(2, 8) == pytest.approx(-0.0141, rel=0.01) and noll_covariance(3, 7) == noll_covariance(2, 8)
    assert noll_covariance(2, 3) == noll_covariance(2, 7) == noll_covariance(4, 5) == 0.0
    with pytest.raises(ValueError, match="piston"):
        noll_covariance(1, 4)
