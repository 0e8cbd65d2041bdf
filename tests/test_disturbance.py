"""Turbulence and vibration as a scenario asks for them, and random streams that settings do not reshuffle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import periodogram

from wfsobs.scenario import Scenario
from wfsobs.simulation.disturbance import Disturbance, make_disturbance, turbulence_process, vibration_variance

N = 4000


def made(changes: dict[str, Any] | None = None, n: int = N, seed: int = 5) -> Disturbance:
    return make_disturbance(scenario(changes), n, np.random.default_rng(seed))


def scenario(changes: dict[str, Any] | None = None) -> Scenario:
    base = Scenario()
    base.update(
        {
            "run": {"duration": N / 1000},
            "vibration": {
                "peaks": [
                    {"frequency": 20.3, "damping": 0.01, "rms": [0.03, 0.01]},
                    {"frequency": 47.4969, "damping": 0.03, "rms": [0.02, 0.04]},
                    {"frequency": 33.3, "damping": 0.0, "rms": [0.005, 0.007]},
                    {"frequency": 61.7, "damping": 0.0, "rms": [0.011]},
                ]
            },
        }
    )
    return base.replace(changes or {})


def powers(x: np.ndarray) -> np.ndarray:
    """Variance per DFT bin of each column."""
    return 2.0 * np.abs(np.fft.rfft(x, axis=0)) ** 2 / len(x) ** 2


# ---------------------------------------------------------------------- vibration


@pytest.mark.parametrize("n", [N, N - 1, 997])
def test_damped_peaks_have_the_spectrum_of_the_scenario(n: int) -> None:
    s = scenario(
        {
            "vibration.peaks": [p.to_dict() for p in scenario().vibration.peaks[:2]],
            "run.duration": n / 1000,
            "vibration.synthesis": "random-phase",
        }
    )
    x = make_disturbance(s, n, np.random.default_rng(1)).vibration
    f = np.fft.rfftfreq(n, 1e-3)
    df = f[1]
    for mode in range(2):
        # fine sums of the two densities over each bin, 400 midpoints; the peaks are 0.2 Hz wide and more
        offsets = (np.arange(400) + 0.5) / 400 - 0.5
        fine = f[1:-1, None] + df * offsets
        wanted = (
            sum(
                peak.rms[mode] ** 2
                * 4
                * peak.damping
                * peak.frequency**3
                / np.pi
                / ((peak.frequency**2 - fine**2) ** 2 + (2 * peak.damping * peak.frequency * fine) ** 2)
                for peak in s.vibration.peaks
            ).mean(axis=1)
            * df
        )
        wanted[f[1:-1] > 80.0] = 0.0
        # midpoints of width df / 400 across a line of half width xi f: (df / 400 / xi f)^2 < 1e-4 of the bin
        assert np.allclose(powers(x)[1:-1, mode], wanted, rtol=2e-4, atol=1e-15)
        assert x[:, mode].var() == pytest.approx(vibration_variance(s, mode), rel=1e-10)
        assert abs(x[:, mode].mean()) < 1e-14


def test_variance_is_that_of_the_peaks_below_the_cutoff() -> None:
    s = scenario({"vibration.cutoff": 500.0})
    for mode in range(2):
        total = sum(peak.rms[mode] ** 2 for peak in s.vibration.peaks if mode < len(peak.rms))
        # left out: half a bin at zero and what the resonances have above 500 Hz, below 1e-4 of them
        assert vibration_variance(s, mode) == pytest.approx(total, rel=2e-4)
        assert vibration_variance(s, mode) < total


@pytest.mark.parametrize("cutoff", [30.0, 50.0, 80.0])
@pytest.mark.parametrize("source", ["peaks", "psd"])
def test_nothing_above_the_cutoff(cutoff: float, source: str) -> None:
    table = {"frequency": [0.0, 500.0], "tip": [1e-5, 1e-5], "tilt": [2e-5, 0.0]}
    base = {"vibration.cutoff": cutoff, "vibration.synthesis": "random-phase"}
    x = made(base | {"vibration.source": source, "vibration.psd": table}).vibration
    f = np.fft.rfftfreq(N, 1e-3)
    above = powers(x)[f > cutoff + 1.0]
    below = powers(x)[(f > 1) & (f < cutoff)]
    if source == "peaks":  # pure lines lie between bins: their leakage is not cut, the noise floor of the rest is
        damped = [p.to_dict() for p in scenario().vibration.peaks[:2]]
        x = made(base | {"vibration.peaks": damped}).vibration
        above, below = powers(x)[f > cutoff], powers(x)[(f > 1) & (f < cutoff)]
    assert above.max() < 1e-30 and below.min() > 1e-12


@pytest.mark.slow
def test_a_gaussian_record_has_the_covariance_of_its_spectrum_and_does_not_repeat() -> None:
    """Over records: at every lag that of the resonance, at the last one too, where an inverse DFT of the record's own length has
    all but its variance."""
    n, seeds, rms, f0, xi = 500, 400, 0.05, 30.0, 0.01
    s = scenario(
        {
            "vibration.peaks": [{"frequency": f0, "damping": xi, "rms": [rms, rms]}],
            "vibration.cutoff": 499.0,
            "run.duration": n / 1000,
        }
    )
    x = np.hstack([make_disturbance(s, n, np.random.default_rng(seed)).vibration for seed in range(seeds)])
    for lag in (0, 1, 17, 100, n - 1):
        # A resonance driven by white noise: exp(-a t) (cos b t + a / b sin b t), a = xi w, b = w sqrt(1 - xi^2).
        t, a = lag / 1000, xi * 2 * np.pi * f0
        b = a / xi * np.sqrt(1 - xi**2)
        wanted = rms**2 * np.exp(-a * t) * (np.cos(b * t) + a / b * np.sin(b * t))
        products = x[0] * x[lag]
        # 800 records of two modes: four standard errors of their mean.
        assert products.mean() == pytest.approx(wanted, abs=4 * products.std() / np.sqrt(products.size)), lag
    repeated = np.hstack(
        [
            make_disturbance(s.replace({"vibration.synthesis": "random-phase"}), n, np.random.default_rng(seed)).vibration
            for seed in range(20)
        ]
    )
    assert np.mean(repeated[0] * repeated[-1]) > 0.9 * rms**2


@pytest.mark.parametrize("source", ["peaks", "psd"])
def test_a_gaussian_record_ends_at_the_cutoff(source: str) -> None:
    table = {"frequency": [0.0, 500.0], "tip": [1e-5, 1e-5], "tilt": [2e-5, 0.0]}
    damped = [p.to_dict() for p in scenario().vibration.peaks[:2]]
    x = made({"vibration.cutoff": 50.0, "vibration.source": source, "vibration.psd": table, "vibration.peaks": damped}).vibration
    f, power = periodogram(x, 1000.0, window="blackmanharris", axis=0)
    # The window's side lobes are 92 dB below a line, its main lobe 4 bins of 0.25 Hz wide on either side.
    assert power[f > 51.25].max() < 1e-8 * power.max() and power[(f > 5) & (f < 49)].min() > 1e-9 * power.max()


def test_pure_lines_keep_their_own_frequency_and_rms() -> None:
    """A line between DFT bins: a sine and a cosine of exactly that frequency explain all of it."""
    lines = [
        {"frequency": f, "damping": 0.0, "rms": [tip, 0.02]}
        for f, tip in ((10.123, 0.01), (48.33, 0.02), (79.9, 0.03), (96.7, 0.04))
    ]
    x = made({"vibration.peaks": lines}).vibration
    t = np.arange(N) / 1000
    for mode in range(2):
        basis = np.column_stack([g(2 * np.pi * p["frequency"] * t) for p in lines for g in (np.cos, np.sin)])
        weights = np.linalg.lstsq(basis, x[:, mode], rcond=None)[0]
        assert np.abs(basis @ weights - x[:, mode]).max() < 1e-12  # phases of 2 pi f t < 2500 are rounded by 1e-13
        amplitudes = np.hypot(weights[::2], weights[1::2])
        wanted = [np.sqrt(2) * p["rms"][mode] for p in lines[:3]] + [0.0]  # the last lies above the cut-off
        assert np.allclose(amplitudes, wanted, rtol=1e-9, atol=1e-12)
    assert vibration_variance(scenario({"vibration.peaks": lines}), 1) == pytest.approx(3 * 0.02**2, rel=1e-12)


@pytest.mark.slow
def test_phases_of_lines_are_uniform_over_seeds() -> None:
    s = scenario({"vibration.peaks": [{"frequency": 25.0, "damping": 0.0, "rms": [1.0, 1.0]}]})
    starts = np.array([make_disturbance(s, 40, np.random.default_rng(seed)).vibration for seed in range(300)])
    quadrature = starts[:, 0] + 1j * starts[:, 10]  # 10 ms are a quarter period of 25 Hz: sqrt(2) exp(-i phase)
    assert np.allclose(np.abs(quadrature), np.sqrt(2), rtol=1e-9)
    for column in quadrature.T / np.sqrt(2):
        assert abs(column.mean()) < 4 / np.sqrt(300) and abs((column**2).mean()) < 4 / np.sqrt(300)
    assert abs(np.mean(quadrature[:, 0] * quadrature[:, 1].conj()) / 2) < 4 / np.sqrt(300)


@pytest.mark.parametrize("step", [0.5, 0.028])
@pytest.mark.parametrize("seconds", [1.3, 4.0, 20.0])
def test_a_psd_table_gives_its_variance(step: float, seconds: float) -> None:
    f = np.arange(1.0, 79.0, step)
    rng = np.random.default_rng(0)
    tip, tilt = 1e-6 * rng.exponential(size=(2, f.size))
    s = scenario(
        {
            "vibration.source": "psd",
            "vibration.synthesis": "random-phase",
            "run.duration": seconds,
            "vibration.psd": {"frequency": f.tolist(), "tip": tip.tolist(), "tilt": tilt.tolist()},
        }
    )
    x = make_disturbance(s, s.n_steps, np.random.default_rng(3)).vibration
    for mode, density in enumerate((tip, tilt)):
        assert x[:, mode].var() == pytest.approx(np.trapezoid(density, f), rel=1e-10)
        assert vibration_variance(s, mode) == pytest.approx(x[:, mode].var(), rel=1e-10)


def test_a_coarse_table_does_not_make_the_signal_repeat() -> None:
    """A table every 0.5 Hz, as for MAVIS: used as DFT bins it would repeat every 2 s, training leaking into test."""
    f = np.arange(0.0, 80.5, 0.5)
    table = {"frequency": f.tolist(), "tip": [1e-5] * f.size, "tilt": [1e-5] * f.size}
    x = made({"vibration.source": "psd", "vibration.psd": table}, n=20_000).vibration
    for mode in range(2):
        for lag in (2000, 4000, 10_000):
            # 80 Hz over 10 s and more have 1600 degrees of freedom and more: 1 / sqrt(1600) = 0.025, four times that
            assert abs(np.corrcoef(x[lag:, mode], x[:-lag, mode])[0, 1]) < 0.1


def test_ar2_vibration_is_the_sum_of_its_peaks() -> None:
    s = scenario({"vibration.source": "ar2"})
    n, seeds = 3000, range(40)
    x = np.array([make_disturbance(s, n, np.random.default_rng(seed)).vibration for seed in seeds])
    for mode in range(2):
        wanted = sum(peak.rms[mode] ** 2 for peak in s.vibration.peaks if mode < len(peak.rms))
        assert vibration_variance(s, mode) == pytest.approx(wanted, rel=1e-12)
        per_seed = (x[:, :, mode] ** 2).mean(axis=1)
        # a line of damping 0 (1e-6) has an exponential power in each seed: the spread is measured, 4 of it allowed
        assert abs(per_seed.mean() - wanted) < 4 * per_seed.std() / np.sqrt(len(seeds))
        assert per_seed.std() / np.sqrt(len(seeds)) < 0.1 * wanted


@pytest.mark.parametrize("source", ["peaks", "psd", "measured", "ar2", "none"])
def test_every_source_has_its_shape(source: str) -> None:
    table = {"frequency": [10.0, 20.0], "tip": [1.0, 1.0], "tilt": [1.0, 1.0]}
    for n in (1, 2, 3, 10):
        made_now = made({"vibration.source": source, "vibration.psd": table, "turbulence.source": "none"}, n)
        assert made_now.vibration.shape == made_now.turbulence.shape == (n, 2)
        assert np.isfinite(made_now.vibration).all() and not made_now.turbulence.any()
    if source == "none":
        assert not made({"vibration.source": "none"}).vibration.any()
        assert vibration_variance(scenario({"vibration.source": "none"}), 0) == 0.0


# ---------------------------------------------------------------------- random streams


@pytest.mark.slow
def test_modes_and_sources_are_independent() -> None:
    s = scenario({"vibration.cutoff": 500.0})
    runs = [make_disturbance(s, N, np.random.default_rng(seed)) for seed in range(30)]
    x = np.array([np.column_stack([d.turbulence[::100], d.vibration[::100]]) for d in runs])  # (seed, step, signal)
    x = x / x.std(axis=(0, 1))
    products = np.einsum("sti,stj->sij", x, x) / x.shape[1]
    mean, error = products.mean(axis=0), products.std(axis=0) / np.sqrt(len(runs))
    off = ~np.eye(4, dtype=bool)
    assert (np.abs(mean[off]) < 4.5 * error[off]).all()
    assert (error[off] < 0.2).all()


SAME_TURBULENCE: dict[str, Any] = {
    "vibration.source": "none",
    "vibration.cutoff": 30.0,
    "vibration.peaks": [],
    "vibration.peaks.0.frequency": 21.0,
    "sensors.lgs_noise": 0.1,
    "sensors.lgs_count": 4,
    "loop.gain": 0.1,
    "run.warm_up": 0.1,
    "gpr_offline.depth": 10,
}
SAME_VIBRATION: dict[str, Any] = {
    "turbulence.source": "none",
    "turbulence.rms": 1.0,
    "turbulence.wind_speed": 5.0,
    "telescope.diameter": 39.0,
    "sensors.exposure_ratio": 2,
    "sensors.ngs_noise": 0.0,
    "loop.closed": False,
}


@pytest.mark.parametrize("path", SAME_TURBULENCE)
def test_turbulence_stays_when_something_else_changes(path: str) -> None:
    assert np.array_equal(made({path: SAME_TURBULENCE[path]}).turbulence, made().turbulence)


@pytest.mark.parametrize("path", SAME_VIBRATION)
def test_vibration_stays_when_something_else_changes(path: str) -> None:
    assert np.array_equal(made({path: SAME_VIBRATION[path]}).vibration, made().vibration)


def test_strength_only_scales() -> None:
    assert np.allclose(made({"turbulence.rms": 1.0}).turbulence, 2.0 * made().turbulence, rtol=1e-12)


@pytest.mark.parametrize(
    "change",
    [
        {"vibration.peaks.0.damping": 0.0},  # a damped peak before them becomes a line
        {"vibration.peaks.2.rms": [0.0, 0.0]},  # a line before it goes silent
        {"vibration.peaks.2.damping": 0.02},  # and becomes a resonance
        {"vibration.peaks.4": {"frequency": 70.0, "damping": 0.0}},  # one more behind them
        {"vibration.cutoff": 65.0},
    ],
)
def test_a_line_keeps_its_phase_when_other_peaks_change(change: dict[str, Any]) -> None:
    """The 61.7 Hz line of tip, found by its sine and cosine, is the same before and after."""
    t = np.arange(N) / 1000

    def line(changes: dict[str, Any]) -> np.ndarray:
        silent = {f"vibration.peaks.{i}.rms": [0.0, 0.0] for i in range(3)} | (
            {"vibration.peaks.4.rms": [0.0]} if "vibration.peaks.4" in changes else {}
        )
        x = made(changes | silent).vibration[:, 0]
        basis = np.column_stack([np.cos(2 * np.pi * 61.7 * t), np.sin(2 * np.pi * 61.7 * t)])
        return np.linalg.lstsq(basis, x, rcond=None)[0]

    assert np.hypot(*line({})) == pytest.approx(np.sqrt(2) * 0.011, rel=1e-9)
    assert np.allclose(line(change), line({}), rtol=0, atol=1e-12)


def test_ar2_peaks_keep_their_numbers_when_one_is_added() -> None:
    ar2 = {"vibration.source": "ar2"}
    more = made(ar2 | {"vibration.peaks.4": {"frequency": 5.0, "rms": [0.0, 0.0]}}).vibration
    assert np.allclose(more, made(ar2).vibration, rtol=0, atol=1e-15)


def test_turbulence_is_the_process_of_the_paper() -> None:
    """Paper, eq. 1 and Table 1 at 1 ms and 5 ms: coefficients computed here from the printed formulas."""
    for dt in (1e-3, 5e-3):
        p = turbulence_process(Scenario(), 0, dt)
        w0 = 0.6 * np.pi * 2 * 15.0 / 8.0
        assert p.a1 == pytest.approx(2 * np.exp(-0.9 * w0 * dt) * np.cos(w0 * np.sqrt(1 - 0.81) * dt), rel=1e-14)
        assert p.a2 == pytest.approx(-np.exp(-1.8 * w0 * dt), rel=1e-14)
        assert p.rms == 0.5
