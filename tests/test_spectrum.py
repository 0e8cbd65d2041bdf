"""Spectra against quadrature, signals against the spectrum they were made from, bin by bin."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from wfsobs.signal.spectrum import (
    bin_edges,
    bin_frequencies,
    gaussian_signal,
    psd,
    random_phase_signal,
    resonance_power,
    table_power,
)

EXAMPLES = settings(max_examples=25, deadline=None, derandomize=True)
EPS = np.finfo(float).eps

frequencies = st.floats(-2.0, np.log10(5000.0)).map(lambda x: 10**x)
dampings = st.floats(-8.0, 0.0).map(lambda x: min(10**x, 1.0))


def resonance(f: mp.mpf, f0: mp.mpf, xi: mp.mpf) -> mp.mpf:
    """1 / |f0^2 - f^2 + 2 i xi f0 f|^2, whose integral over (0, inf) is pi / (4 xi f0^3)."""
    return 1 / ((f0**2 - f**2) ** 2 + (2 * xi * f0 * f) ** 2) * 4 * xi * f0**3 / mp.pi


@pytest.mark.slow
@EXAMPLES
@given(frequencies, dampings, st.lists(st.floats(-3.0, 3.0), min_size=2, max_size=5, unique=True))
def test_resonance_power_is_the_integral_over_each_bin(f0: float, xi: float, positions: list[float]) -> None:
    # edges anywhere from 1e-3 f0 to 1e3 f0, and close around the peak where it is narrow
    edges = np.sort([f0 * 10**p for p in positions] + [f0 * (1 - 3 * xi), f0 * (1 + xi)])
    edges = np.unique(edges[edges >= 0])
    power = resonance_power(f0, xi, edges)
    with mp.workdps(30):
        split = [mp.mpf(f0) * (1 + s * xi) for s in (-100, -10, -1, 0, 1, 10, 100)]
        for low, high, got in zip(edges, edges[1:], power, strict=False):
            points = [mp.mpf(float(low)), *(s for s in split if low < s < high), mp.mpf(float(high))]
            wanted = mp.quad(lambda f: resonance(f, mp.mpf(f0), mp.mpf(xi)), points)
            # The antiderivative is of order 1 and rounded at eps; near the pole its argument f - p is rounded by eps f0
            # against a distance of at least xi f0; at damping 1 (a double pole, taken as 1 - 1e-9) it cancels to
            # sqrt(2e-9) of itself, and the pole itself is moved by 1e-9.
            distance = max(xi, float(abs(1 - low / f0)))
            distance = min(distance, max(xi, float(abs(1 - high / f0))))
            tolerance = 20 * EPS * (1 / distance + 1 / np.sqrt(1 - min(xi, 1 - 1e-9) ** 2)) + 2e-9 * (xi > 0.99)
            assert abs(got - wanted) <= tolerance


@EXAMPLES
@given(frequencies, dampings)
def test_all_of_a_resonance_is_one(f0: float, xi: float) -> None:
    edges = f0 * np.concatenate([[0.0], np.geomspace(1e-4, 1e4, 300)])
    # Beyond F the density is below 4 xi / pi f0^3 / f^4 (1 + ...): 4 xi / (3 pi) (f0 / F)^3 is left out, 1e-12 here. At
    # damping 1, taken as 1 - 1e-9, the antiderivative cancels to sqrt(2e-9) of itself.
    assert abs(resonance_power(f0, xi, edges).sum() - 1) < 2e-12 + 50 * EPS / np.sqrt(1 - min(xi, 1 - 1e-9) ** 2)
    assert (resonance_power(f0, xi, edges) >= 0).all()


def test_a_pure_line_is_in_one_bin() -> None:
    power = resonance_power(47.4969, 0.0, np.arange(0.0, 100.0, 0.1))
    # Damping 0 counts as 1e-12: xi / pi (1 / 6.5e-5 + 1 / 2.0e-3) is outside, the edges being that far in units of f0.
    assert power[474] == pytest.approx(1.0 - 5.0e-9, abs=1e-10)
    assert power.sum() == pytest.approx(1.0, abs=1e-10)


@EXAMPLES
@given(st.integers(1, 400), st.floats(-5.0, -1.0))
def test_bins_tile_the_band(n: int, log_dt: float) -> None:
    dt = 10**log_dt
    f, edges = bin_frequencies(n, dt), bin_edges(n, dt)
    assert f.size == n // 2 + 1 and edges.size == f.size + 1
    slack = 4 * EPS / dt
    assert edges[0] == 0.0 and (edges[:-1] <= f + slack).all() and (f <= edges[1:] + slack).all()
    # an odd number of samples has no bin at Nyquist; its last bin ends there all the same
    assert edges[-1] == pytest.approx(0.5 / dt, rel=4 * EPS)
    middle = 0.5 * (edges[1:] + edges[:-1])[1:-1]
    assert np.allclose(middle, f[1:-1], rtol=1e-12)


@EXAMPLES
@given(st.integers(1, 300), st.integers(0, 2**32 - 1))
def test_a_signal_has_exactly_the_spectrum_it_was_made_from(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    power = rng.random(n // 2 + 1) * 10 ** rng.uniform(-12, 6)
    x = random_phase_signal(power, n, rng)
    wanted = power.copy()
    wanted[0] = 0.0
    if n % 2 == 0:
        wanted[-1] = 0.0
    got = 2.0 * np.abs(np.fft.rfft(x)) ** 2 / n**2
    # two FFTs, each good to eps log n of the largest amplitude
    assert np.abs(np.sqrt(got) - np.sqrt(wanted)).max() <= 50 * EPS * np.sqrt(power.sum())
    assert np.mean(x**2) == pytest.approx(wanted.sum(), rel=1e-12)
    assert abs(x.mean()) <= 50 * EPS * np.sqrt(power.sum())


def test_phases_are_uniform_and_new_each_time() -> None:
    n = 20_001
    first = np.fft.rfft(random_phase_signal(np.ones(n // 2 + 1), n, np.random.default_rng(1)))[1:]
    second = np.fft.rfft(random_phase_signal(np.ones(n // 2 + 1), n, np.random.default_rng(2)))[1:]
    for phases in (np.angle(first), np.angle(second), np.angle(first * second.conj())):
        # Kolmogorov-Smirnov at 1e-4: a false alarm once in 10000 seeds; half a circle or a fixed phase fails by far
        assert kstest(phases / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-4
    neighbours = np.mean(np.exp(1j * np.angle(first[1:] * first[:-1].conj())))
    assert abs(neighbours) < 4.0 / np.sqrt(n / 2)  # mean of 10000 unit vectors


def test_gaussian_amplitudes_are_independent_normal_numbers() -> None:
    n = 20_001
    power = np.linspace(1.0, 3.0, n // 2 + 1)
    bins = 2.0 * np.fft.rfft(gaussian_signal(power, n, np.random.default_rng(1)))[1:] / (n * np.sqrt(power[1:]))
    parts = (bins.real, bins.imag)
    for part in parts:
        assert kstest(part, "norm").pvalue > 1e-4  # a false alarm once in 10000 seeds
        assert abs(np.corrcoef(part[1:], part[:-1])[0, 1]) < 4.0 / np.sqrt(n / 2)
    assert abs(np.corrcoef(*parts)[0, 1]) < 4.0 / np.sqrt(n / 2)


@pytest.mark.parametrize("size", [0, 5, 7])
def test_power_must_have_one_entry_per_bin(size: int) -> None:
    with pytest.raises(ValueError, match="one entry per DFT bin, 6"):
        random_phase_signal(np.ones(size), 10, np.random.default_rng(0))


@pytest.mark.parametrize("dt", [0, -1e-3, np.nan])
def test_a_spectrum_needs_a_time_step(dt: float) -> None:
    with pytest.raises(ValueError, match=r"^dt = .*: takes a time step above 0 s$"):
        psd(np.ones(100), dt)


@pytest.mark.parametrize("resolution", [0.0, -1.0, np.nan, 2001.0])
def test_a_spectrum_needs_a_resolution_that_has_a_window(resolution: float) -> None:
    with pytest.raises(ValueError, match=r"^resolution = .*: takes more than 0 Hz, and no more than 1 / dt = 1000 Hz$"):
        psd(np.ones(100), 1e-3, resolution=resolution)


def test_a_spectrum_does_not_take_masked_numbers_as_measured() -> None:
    y = np.ma.array(np.arange(200.0).reshape(100, 2), mask=np.arange(200).reshape(100, 2) == 7)
    is_known = ~np.isnan(psd(y, 1e-3)[1]).any(axis=0)
    np.testing.assert_array_equal(is_known, [True, False])


# ---------------------------------------------------------------------- tables


def integral(f: np.ndarray, S: np.ndarray, low: float, high: float) -> float:
    """Integral of the table, linear between its points and zero outside, by 20000 midpoints."""
    x = low + (np.arange(20_000) + 0.5) * (high - low) / 20_000
    return float(np.interp(x, f, S, left=0.0, right=0.0).mean() * (high - low))


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.integers(2, 30), st.integers(3, 40), st.integers(0, 2**32 - 1), st.booleans())
def test_table_power_is_the_integral_over_each_bin(points: int, n: int, seed: int, starts_at_zero: bool) -> None:
    rng = np.random.default_rng(seed)
    f = np.sort(rng.uniform(0, 120, points))  # 100 Hz is half the rate: some of the table may lie beyond
    if starts_at_zero:
        f[0] = 0.0
    S = rng.exponential(size=points)
    power = table_power(f, S, n, 1 / 200)
    edges = bin_edges(n, 1 / 200)
    for low, high, got in zip(edges, edges[1:], power, strict=False):
        # midpoints miss at most half a step at each jump of the table's ends: width / 20000 S each
        assert got == pytest.approx(integral(f, S, low, high), abs=2 * S.max() * (high - low) / 20_000 + 1e-12)


@pytest.mark.parametrize("n", [1, 2, 777, 1000, 3000, 10_000, 60_001])
def test_a_table_keeps_its_variance_at_any_length_of_record(n: int) -> None:
    """Lines one step of 0.028 Hz wide (a measured spectrum): bins of a short record are far wider."""
    f = np.arange(0.0, 100.0, 0.028)
    S = np.zeros_like(f)
    S[[300, 700, 1725]] = 0.01
    assert table_power(f, S, n, 1e-3).sum() == pytest.approx(np.trapezoid(S, f), rel=1e-12)


def test_a_smooth_table_gives_density_times_bin_width() -> None:
    f = np.linspace(0.0, 500.0, 26)
    power = table_power(f, 3.0 + 0.01 * f, 1000, 1e-3)
    # linear over every bin: the midpoint value is the mean; the first bin is half as wide
    assert np.allclose(power[1:-1], (3.0 + 0.01 * np.arange(1.0, 500.0)) * 1.0, rtol=1e-10)
    assert power[0] == pytest.approx(0.5 * 3.0025)
