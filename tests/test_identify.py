"""Identification: what is put into a record comes out of it, with the errors that are stated, and nothing else."""

from __future__ import annotations

import json
from dataclasses import replace
from math import nan, pi, sqrt
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import binom, gamma, kstest

from wfsobs.cli import main
from wfsobs.identification import Identification, identify
from wfsobs.identification.identification import (
    add_comments,
    format_number,
    identification_dict,
    identification_toml,
    mode_rows,
    whiteness_lines,
)
from wfsobs.identification.one_mode import MEAN, VARIANCE, WIDTH, OneMode, is_continuum, margin
from wfsobs.identification.process import IdentifiedProcess, Number, mean, merge_peaks
from wfsobs.identification.process import with_reliable_std as known_number
from wfsobs.identification.result import autocorrelation_test, cumulated_test, innovations
from wfsobs.pipeline import observe
from wfsobs.progress import Cancelled, Watch
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario, configfile
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.values import SettingError
from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.true_spectra import true_spectra
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.search import PAD, Sinusoid, line_in_record, nearest_line, search_peaks
from wfsobs.spectral.whittle import (
    Cells,
    fast_length,
    fit_spectrum,
    inflation,
    periodogram,
    periodogram_frequencies,
    spectrum_information,
)
from wfsobs.telemetry.records import save_record

pytestmark = pytest.mark.slow

DT = 1e-3
TURBULENCE = Ar2(7.0, 0.9, 0.5, DT)
MODEL = Spectrum(0.014, DT, TURBULENCE, (Ar2(2 * pi * 30.0, 0.02, 0.004, DT),))


def known(duration: float = 60.0, **more: object) -> Scenario:
    """A line and a resonance in tip and tilt, another line in tilt alone."""
    s = PRESETS["paper"]().replace({"run.duration": duration, "kalman.process_noise": "matched", **more})
    return s.replace(
        {
            "vibration.peaks": [
                {"frequency": 24.3, "damping": 0.0, "rms": [0.0012, 0.0015]},
                {"frequency": 47.5, "damping": 0.01, "rms": [0.004, 0.006]},
                {"frequency": 61.7, "damping": 0.0, "rms": [0.0, 0.0015]},
            ]
        }
    )


@pytest.fixture(scope="module")
def record() -> Record:
    return simulate(known())


@pytest.fixture(scope="module")
def found(record: Record) -> Identification:
    return identify(record)


def test_periodogram_of_white_noise_has_its_density() -> None:
    rng = np.random.default_rng(1)
    I = periodogram(rng.standard_normal(100_000), DT)  # noqa: E741
    assert I.mean() == pytest.approx(2.0 * DT, rel=4.0 * sqrt(inflation(100_000) / len(I)))
    assert len(periodogram_frequencies(100_000, DT)) == len(I) and periodogram_frequencies(100_000, DT)[0] == pytest.approx(0.01)


def test_turbulence_does_not_leak_over_the_noise() -> None:
    """Far above the corner the mean periodogram of steep turbulence is its density."""
    turbulence, f = Ar2(7.0, 0.9, 0.5, DT), periodogram_frequencies(20_000, DT)
    I = np.mean([periodogram(turbulence.sample(20_000, np.random.default_rng(i)), DT) for i in range(4)], axis=0)  # noqa: E741
    ratio = (I / turbulence.psd(f))[f > 100.0]
    assert ratio.mean() == pytest.approx(1.0, abs=0.05)  # untapered it is several hundred


def test_cells_keep_every_bin_once() -> None:
    f = periodogram_frequencies(20_000, DT)
    keep = np.where((f > 20.0) & (f < 25.0), 0.0, 1.0)
    cells = Cells(f, f**2, keep, [30.0])
    assert cells.count.sum() == keep.sum()
    assert cells.count @ cells.frequency == pytest.approx(keep @ f)
    assert cells.count @ cells.mean == pytest.approx(keep @ f**2)
    assert np.all(cells.count[np.abs(cells.frequency - 30.0) < 0.4] == 1.0)


@pytest.mark.parametrize("sizes", [(200, 8), (50, 4)])
def test_cells_are_as_wide_as_they_may_be(sizes: tuple[int, int]) -> None:
    """By the definition, over all bins: a cell ends where the sum of one over the widest cell at a bin passes a whole number."""
    f, centres = periodogram_frequencies(20_000, DT), [0.02, 7.3, 30.0, 32.0, 480.0, 600.0]
    j = np.arange(1.0, len(f) + 1.0)
    distances = [np.maximum(np.abs(j - centre / f[0]) / sizes[1], 1.0) for centre in centres]
    widest = np.min([np.maximum(j / sizes[0], 1.0), *distances], axis=0)
    count = np.bincount(np.floor(np.cumsum(1.0 / widest) + 1e-6).astype(int))
    assert np.array_equal(Cells(f, f, np.ones(len(f)), centres, sizes=sizes).count, count[count > 0])


@pytest.mark.parametrize("n", [2000, 59_998, 60_013])
def test_fast_length(n: int) -> None:
    assert 0.98 * n < fast_length(n) <= n


@pytest.mark.parametrize("corner", [2.2, 3.0, 40.0, 900.0])
def test_slopes_of_third_order_are_derivatives_of_the_density(corner: float) -> None:
    """From a corner near that of the pair to one far beyond it; a step of 1e-4 leaves out 1e-8 of it."""
    model = Spectrum(0.014, DT, Ar3(2.0, 0.9, corner, 0.3, DT))
    f, x = np.geomspace(0.02, 499.0, 200), model.vector
    for i, slope in enumerate(model.slopes(f, range(1, 5)), 1):
        up, down = (model.with_vector(x + sign * 1e-4 * np.eye(len(x))[i]).psd(f) for sign in (1, -1))
        np.testing.assert_allclose(slope, (up - down) / 2e-4, rtol=0, atol=1e-6 * np.abs(slope).max())


def test_slopes_and_information_are_derivatives_of_the_likelihood() -> None:
    f = periodogram_frequencies(20_000, DT)
    cells = Cells(f, MODEL.psd(f), np.ones(len(f)), [30.0])  # the mean of the periodogram: information is the curvature
    x, F = MODEL.vector, spectrum_information(MODEL, cells)
    steps = 1e-2 / np.sqrt(np.diag(F))
    here = cells.misfit(MODEL)
    for i, step in enumerate(steps):
        moves = [cells.misfit(MODEL.with_vector(x + sign * step * np.eye(len(x))[i])) for sign in (-1, 1)]
        assert (sum(moves) - 2 * here) / step**2 == pytest.approx(F[i, i], rel=0.02)  # cells take S at their middle


def test_fit_finds_the_model_that_the_spectrum_has() -> None:
    f = periodogram_frequencies(60_000, DT)
    cells = Cells(f, MODEL.psd(f), np.ones(len(f)), [30.0])
    off = MODEL.with_vector(MODEL.vector + np.array([0.2, 0.3, 0.5, -0.3, 0.005, 0.4, 0.3]))
    std = 1.0 / np.sqrt(np.diag(spectrum_information(MODEL, cells)))
    assert np.all(np.abs(fit_spectrum(off, cells).vector - MODEL.vector) < 0.3 * std)


def test_a_narrow_line_is_known_as_well_as_stated() -> None:
    """Undamped or 0.05 to 5 bins wide (half), in white noise of known density: its frequency, and its rms in the record."""
    n, rng, floor, inside = 10_000, np.random.default_rng(2), 2.0 * DT, []
    for i, half in enumerate(np.geomspace(0.05, 5.0, 240)):
        f0, rms = rng.uniform(20.0, 90.0), sqrt(np.exp(rng.uniform(3.0, 8.0)) * max(half, 1.0) * floor / (n * DT))
        if i % 6 == 0:
            x = Sinusoid(f0, sqrt(2.0) * rms * np.exp(2j * pi * rng.random())).signal(n, DT)
        else:
            x = Ar2(2 * pi * f0, half / (n * DT * f0), rms, DT).sample(n, rng)
        z = x + rng.standard_normal(n)
        near = nearest_line(z, DT, f0, (1.0 + half) / (n * DT)).frequency
        f, f_std, found, rms_std = line_in_record(z, DT, near, lambda f: np.full_like(f, floor))
        inside.append((abs(f - f0) < 1.96 * f_std, abs(found - np.sqrt(np.mean(x**2))) < 1.96 * rms_std))
    low, high = (binom.ppf(q, len(inside), 0.95) for q in (1e-3, 0.999))
    assert np.array_equal(np.clip(np.sum(inside, axis=0), low, high), np.sum(inside, axis=0))


def test_an_undamped_line_has_nearly_the_cramer_rao_bound() -> None:
    """Of a line in white noise, var f = 12 / ((2 pi)^2 eta N^3 dt^2), var rms = sigma^2 / N, eta = A^2 / 2 sigma^2.

    Half widths up to a tenth of a bin are as likely by this record, which moves a frequency by 0.13 bins: four times the bound.
    """
    n, amplitude, floor = 60_000, 0.1, 2.0 * DT
    z = Sinusoid(20.0, amplitude).signal(n, DT) + np.random.default_rng(3).standard_normal(n)
    _, f_std, _, rms_std = line_in_record(z, DT, 20.0, lambda f: np.full_like(f, floor))
    bound = sqrt(12.0 / ((2 * pi) ** 2 * amplitude**2 / 2.0 * n**3)) / DT
    assert bound < f_std < 4.0 * bound
    assert rms_std == pytest.approx(1.0 / sqrt(n), rel=0.1)  # a tenth for how long an amplitude that drifts is averaged


def test_no_strong_line_is_lost_and_every_line_is_known_as_well_as_stated() -> None:
    """Four lines a record, half widths of 0.05 to 5 bins. Their gain of log-likelihood is that of their bins, at their mean."""
    n, found, false = 20_000, [], 0
    f = periodogram_frequencies(n, DT)
    turbulence = Ar2(7.0686, 0.9, 0.5, DT)
    floor = Spectrum(0.014, DT, turbulence)
    for seed in range(100, 112):
        rng = np.random.default_rng(seed)
        z = 0.014 * rng.standard_normal(n) + turbulence.sample(n, rng)
        lines = []
        for low, high in ((12.0, 22.0), (26.0, 40.0), (44.0, 60.0), (66.0, 95.0)):
            f0, half = rng.uniform(low, high), np.exp(rng.uniform(np.log(0.05), np.log(5.0)))
            S0 = float(floor.psd(np.array([f0]))[0])
            rms = sqrt(np.exp(rng.uniform(3.0, 8.0)) * max(half, 1.0) * S0 / (n * DT))
            x = Ar2(2 * pi * f0, half / (n * DT * f0), rms, DT).sample(n, rng)
            z += x
            lines.append((f0, half * f[0], np.sqrt(np.mean(x**2))))
        (mode,) = identify(Record(z[:, None], np.zeros((n, 1)), DT)).modes
        I = periodogram(z, DT)  # noqa: E741
        false += max(len(mode.peaks) - len(lines), 0)
        for f0, half, rms in lines:
            near = [p for p in mode.peaks if abs(p.frequency.value - f0) < 3.0 * (f[0] + half)]
            about = np.abs(f - f0) < max(half, f[0])
            ratio = max(float(np.mean(I[about] / floor.psd(f[about]))), 1.0)
            assert near or about.sum() * (ratio - 1.0 - np.log(ratio)) < 40.0
            for p in sorted(near, key=lambda p: abs(p.frequency.value - f0))[:1]:
                found.append((abs(p.frequency.value - f0) < 1.96 * p.frequency.std, abs(p.rms.value - rms) < 1.96 * p.rms.std))
                assert p.ensemble_rms is not None
                assert np.isnan(p.ensemble_rms.std) or p.damping.value * p.frequency.value > 0.99 * f[0]
    low, high = (binom.ppf(q, len(found), 0.95) for q in (1e-3, 0.999))
    assert np.array_equal(np.clip(np.sum(found, axis=0), low, high), np.sum(found, axis=0))
    assert false <= binom.isf(1e-3, 12, 0.05)


@pytest.mark.parametrize("modes", [1, 2])
def test_search_finds_nothing_in_white_noise_as_often_as_it_says(modes: int) -> None:
    n, level, runs = 4000, 0.2, 150
    rng = np.random.default_rng(3)
    hits = sum(
        search_peaks(
            np.sum([periodogram(rng.standard_normal(n), DT, PAD) for _ in range(modes)], axis=0) / (2.0 * DT), n, DT, modes, level
        ).best
        is not None
        for _ in range(runs)
    )
    assert 0.2 * level * runs < hits < level * runs + 3.0 * sqrt(level * runs)  # a bound, near since the widths overlap


def test_whiteness_tests_are_uniform_on_white_noise_and_see_what_is_not() -> None:
    n, rng = 4000, np.random.default_rng(4)
    noise = [rng.standard_normal(n) for _ in range(60)]
    flat = Spectrum(1.0, DT)
    p = np.array(
        [(cumulated_test(periodogram(x, DT) / (2 * DT), n), autocorrelation_test(innovations(x, flat), 1)) for x in noise]
    )
    assert min(kstest(column, "uniform").pvalue for column in p.T) > 1e-3
    coloured = Ar2(2 * pi * 100.0, 0.5, 0.5, DT).sample(n, rng) + noise[0]
    assert cumulated_test(periodogram(coloured, DT) / (2 * DT), n) < 1e-6 > autocorrelation_test(innovations(coloured, flat), 1)


def test_innovations_have_the_variance_that_the_spectrum_says() -> None:
    """Kolmogorov: log of the variance of one-step prediction is the mean of log S."""
    rng = np.random.default_rng(5)
    z = 0.014 * rng.standard_normal(40_000) + sum(p.sample(40_000, rng) for p in (TURBULENCE, *MODEL.resonances))
    f = np.linspace(0.0, 0.5 / DT, 200_001)
    least = np.exp(np.mean(np.log(MODEL.psd(f) / (2.0 * DT))))
    assert np.var(innovations(z, MODEL)) == pytest.approx(least, rel=4.0 * sqrt(2.0 / 40_000))


def test_known_peaks_are_found_and_no_others(found: Identification) -> None:
    assert found.white
    truth = known()
    for i, mode in enumerate(found.modes):
        there = [p for p in truth.vibration.peaks if p.rms[i] > 0]
        assert len(mode.peaks) == len(there)
        for p, peak in zip(mode.peaks, there, strict=True):
            assert abs(p.frequency.value - peak.frequency) < max(0.1, 3.0 * p.frequency.std)
            assert p.pure == (peak.damping == 0)
            assert abs(p.rms.value - peak.rms[i]) < 4.0 * p.rms.std
        assert abs(mode.noise.value - 0.02 / sqrt(2.0)) < 4.0 * mode.noise.std
        assert mode.turbulence and abs(mode.turbulence.frequency.value - 7.0686 / (2 * pi)) < 4.0 * mode.turbulence.frequency.std


def test_closed_loop_is_its_open_loop_twin(record: Record, found: Identification) -> None:
    assert record.open_loop_y is not None
    opened = identify(replace(record, y_lgs=record.open_loop_y, u=np.zeros_like(record.u)))
    for a, b in zip(found.modes, opened.modes, strict=True):
        assert len(a.peaks) == len(b.peaks)
        for p, q in zip(a.peaks, b.peaks, strict=True):
            assert abs(p.frequency.value - q.frequency.value) < 0.01 * p.frequency.std
            assert abs(p.rms.value - q.rms.value) < 0.01 * p.rms.std


def test_a_resonance_as_uncertain_as_this_is_taken_off() -> None:
    """Two in the place of one: their powers cannot be told apart, and one is left with both."""
    rng = np.random.default_rng(10)
    true = Ar2(2 * pi * 30.0, 0.02, 0.02, DT)
    mode = OneMode(true.sample(20_000, rng) + 0.014 * rng.standard_normal(20_000), DT)
    half = replace(true, rms=true.rms / sqrt(2.0))
    mode.spectrum = Spectrum(0.014, DT, None, (half, replace(half, omega=1.001 * half.omega)))
    assert mode.prune() and not mode.prune()
    (left,) = mode.spectrum.resonances
    assert left.rms == pytest.approx(true.rms, rel=0.15)


@pytest.mark.parametrize(("removals", "count"), [([], 2), ([30.3], 1), ([45.0], 2)])
def test_a_resonance_that_was_taken_off_does_not_come_back_by_a_split(removals: list[float], count: int) -> None:
    """Else it would be taken off and come back until the last sweep, as in three of ten minutes of `ut4` and `ut4-floor`."""
    rng = np.random.default_rng(11)
    two = [Ar2(2 * pi * f, 0.01, 0.02, DT) for f in (30.0, 32.0)]
    z = sum((one.sample(60_000, rng) for one in two), 0.014 * rng.standard_normal(60_000))
    mode = OneMode(z, DT)
    mode.spectrum = Spectrum(0.014, DT, None, (Ar2(2 * pi * 31.0, 0.04, 0.03, DT),))
    mode.removals = removals
    mode.polish()
    assert len(mode.spectrum.resonances) == count


def test_missing_frames_change_little(record: Record, found: Identification) -> None:
    y = record.y_lgs.copy()
    y[5000:5020], y[np.random.default_rng(6).integers(0, len(y), 50)] = np.nan, np.nan
    gappy = identify(replace(record, y_lgs=y))
    for a, b in zip(found.modes, gappy.modes, strict=True):
        assert [p.pure for p in a.peaks] == [p.pure for p in b.peaks]
        for p, q in zip(a.peaks, b.peaks, strict=True):
            assert abs(p.frequency.value - q.frequency.value) < p.frequency.std


def test_nothing_is_found_in_turbulence_and_noise_nor_turbulence_in_noise() -> None:
    for seed in (1, 2):
        quiet = identify(simulate(known(30.0, **{"run.seed": seed}).replace({"vibration.source": "none"})))
        assert not quiet.peaks and all(mode.turbulence for mode in quiet.modes)
    bare = {"vibration.source": "none", "turbulence.source": "none", "sensors.lgs_low_frequency_rms": 0.0}
    nothing = identify(simulate(known(20.0, **{"run.seed": 2}).replace(bare)))
    assert not nothing.peaks and not any(mode.turbulence for mode in nothing.modes)
    assert nothing.scenario().turbulence.source == "none" and nothing.scenario().vibration.source == "none"


@pytest.mark.parametrize("seed", [1, 2])
def test_vibration_is_not_called_turbulence_where_there_is_none(seed: int) -> None:
    """Three resonances in white noise: the filter of what was found predicts other records as that of the truth does."""
    rng, n = np.random.default_rng(seed), 20_000
    peaks = [Ar2(2 * pi * f, 0.012, rms, DT) for f, rms in ((23.8, 0.03), (47.5, 0.05), (80.0, 0.02))]
    z = 0.014 * rng.standard_normal(2 * n) + sum(p.sample(2 * n, rng) for p in peaks)
    (mode,) = identify(Record(z[:n, None], np.zeros((n, 1)), DT)).modes
    assert mode.turbulence is None and ("no turbulence", None, None, None) in mode_rows(mode)
    assert [p.frequency.value for p in mode.peaks] == pytest.approx([23.8, 47.5, 80.0], abs=1.0)
    truth = Spectrum(0.014, DT, None, tuple(peaks))
    found, true = (np.std(innovations(z[n:], spectrum)) for spectrum in (mode.spectrum, truth))
    assert found < 1.01 * true


def test_a_slow_vibration_is_not_called_turbulence_where_there_is_none() -> None:
    """Below the lowest frequency of a peak: too narrow for turbulence, and told to the filters."""
    rng, n = np.random.default_rng(1), 20_000
    sway = Ar2(2 * pi * 3.0, 0.003, 0.1, DT)
    z = 0.014 * rng.standard_normal(2 * n) + sway.sample(2 * n, rng)
    (mode,) = identify(Record(z[:n, None], np.zeros((n, 1)), DT)).modes
    assert mode.turbulence is None and not mode.peaks
    (slow,) = [row for row in mode_rows(mode) if row[0] == "slow, of the continuum"]
    assert slow[1] is not None and abs(slow[1].value - 3.0) < 4.0 * slow[1].std
    found, true = (np.std(innovations(z[n:], spectrum)) for spectrum in (mode.spectrum, Spectrum(0.014, DT, None, (sway,))))
    assert found < 1.01 * true and len(mode.prior.turbulence) == 1


def test_third_order_and_background_are_found_where_they_are() -> None:
    """Turbulence that falls as f^-6, and coloured noise such as aliasing; a scenario holds both, and the means over the modes."""
    s = known().replace(
        {
            "vibration.source": "none",
            "turbulence.source": "ar3",
            "turbulence.third_corner": 3.0,
            "sensors.lgs_low_frequency_rms": 0.0,
        }
    )
    record, rng = simulate(s), np.random.default_rng(8)
    coloured = [Ar2(2 * pi * 30.0, 0.8, 0.004, DT).sample(record.n_steps, rng) for _ in range(2)]
    got = identify(replace(record, y_lgs=record.y_lgs + np.column_stack(coloured)))
    assert got.white and not got.peaks
    for m in got.modes:
        assert m.turbulence and m.turbulence.third_corner and m.background
        for number, true in ((m.turbulence.damping, 0.9), (m.turbulence.third_corner, 3.0)):
            if np.isnan(number.std):  # at a bound, or known to a third at best: of the right size all the same
                assert 0.5 < number.value / true < 2.0
            else:
                assert abs(number.value - true) < 4.0 * number.std
        pairs = [(m.turbulence.frequency, 7.0686 / (2 * pi)), (m.background.frequency, 30.0), (m.background.rms, 0.004)]
        for number, true in pairs:
            assert abs(number.value - true) < 4.0 * number.std
            assert number.std < 0.6 * true
    model = got.scenario(s)
    assert [p.third_corner > 0 for p in model.turbulence.processes] == [True, False] * 2
    assert model.turbulence.third_corner == pytest.approx(3.0, rel=0.5)  # the mean of two that are known to a third


def test_frozen_flow_leaves_white_noise_and_no_peak() -> None:
    """In two records of the sensor without aliasing; an AR(2) alone fails all tests on them."""
    s = PRESETS["ut4"]().replace({"vibration.source": "none", "run.duration": 30.0, "sensors.kind": "zernike"})
    for seed in (1, 2):
        got = identify(simulate(s.replace({"run.seed": seed})))
        assert got.white and not got.peaks


def test_a_right_spectrum_has_no_margin_and_one_with_lobes_that_of_its_lobes() -> None:
    """I / S of a record of 60 s at 1 kHz is exponential; lobes of 2 Hz, a factor 2.2 up and down, from 3 to 12 Hz."""
    rng, f = np.random.default_rng(11), periodogram_frequencies(60_000, DT)
    lobes = np.where((f > 3.0) & (f < 12.0), np.exp(0.8 * np.sin(pi * f)), 1.0)
    right = [margin(rng.exponential(size=len(f))) for _ in range(40)]
    wrong = np.array([margin(rng.exponential(lobes)) for _ in range(40)])
    assert sum(x.max() > 1.0 for x in right) <= 10  # a tenth of a percent at any of some hundred frequencies, most alike
    inside = wrong[:, (f > 5.0) & (f < 9.0)]
    assert np.exp(0.6) < np.median(inside) < np.exp(1.2)  # what noise dips by is in it
    assert np.mean(wrong[:, f > 30.0] > 1.0) < 0.01
    f = periodogram_frequencies(30_000, DT)
    first = np.exp(0.8 * np.cos(2 * pi * (f - 5.0) / 6.0)) ** (f < 12.0)  # 5 Hz above the smooth curve, 2 and 8 Hz below it
    top = np.array([margin(rng.exponential(first)) for _ in range(40)])[:, (f > 4.5) & (f < 5.5)]
    assert np.exp(0.4) < np.median(top) < np.exp(1.2)  # there are four dips of 27 bins to tell it from
    dips = gamma(WIDTH, scale=1.0 / WIDTH)
    worth, worth_squared = (dips.expect(lambda r: (WIDTH * (r - 1.0 - np.log(r))) ** k, ub=1.0) for k in (1, 2))  # noqa: B023
    assert (worth, worth_squared - worth**2) == pytest.approx((MEAN, VARIANCE), abs=1e-4)  # four digits are given


@pytest.mark.parametrize("name", ["ut4", "galacsi-nfm"])
def test_lobes_of_frozen_flow_are_no_peaks(name: str) -> None:
    """Tip drawn from the closed form of its spectrum: of many layers a peak in each of these records where lobes count; with a
    margin not more than the level allows."""
    s, found = PRESETS[name]().replace({"vibration.source": "none", "run.duration": 60.0}), 0
    S = true_spectra(s, 0).measurement
    n = 2 * (len(S) - 1)
    for seed in range(1001, 1005):
        rng = np.random.default_rng(seed)
        z = np.fft.irfft(np.sqrt(S) * np.fft.rfft(rng.standard_normal(n)), n)[:60_000, None]
        found += bool(identify(Record(z, np.zeros_like(z), DT)).peaks)
    assert found <= binom.isf(0.01, 4, 0.05)


def test_filter_built_from_the_result_is_as_good_as_from_the_truth(found: Identification) -> None:
    truth = known()
    model = found.scenario(truth)
    test = simulate(known(20.0, **{"run.seed": 99}))
    a, b = ([s.rms for s in observe(test, s, observers=["kf-multi"]).scores] for s in (model, truth))
    assert np.all(np.array(a) < 1.05 * np.array(b))


def test_result_as_a_file_of_settings(record: Record, found: Identification, tmp_path: Path) -> None:
    save_record(tmp_path / "r.npz", record)
    out = tmp_path / "f.toml"
    done = CliRunner().invoke(main, ["identify", str(tmp_path / "r.npz"), "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "resonance" in done.stdout and "residual is white at 1 %" in done.stdout
    saved = configfile.load_scenario(out)
    saved.validate()
    assert saved == found.scenario(PRESETS["paper"]())
    assert out.read_text().count("+-") >= 4 + 2 * len(found.peaks)
    assert saved.turbulence.wind_speed == pytest.approx(15.0, abs=4 * found.shared_settings(saved)["turbulence.wind_speed"].std)


def test_rows_are_the_numbers(found: Identification) -> None:
    said = json.loads(json.dumps(identification_dict(found), allow_nan=False))
    assert [len(m["peaks"]) for m in said["modes"]] == [len(m.peaks) for m in found.modes]
    assert said["modes"][0]["noise"] == found.modes[0].noise.value
    assert said["modes"][1]["peaks"][0]["frequency_std"] == found.modes[1].peaks[0].frequency.std


def test_neighbours_that_look_like_one_are_told_apart() -> None:
    rng = np.random.default_rng(7)
    two = [Ar2(2 * pi * 23.87, 0.011, 0.0036, DT), Ar2(2 * pi * 25.25, 0.009, 0.0042, DT)]
    z = 0.014 * rng.standard_normal(60_000) + sum(p.sample(60_000, rng) for p in (Ar2(7.0, 0.9, 0.5, DT), *two))
    peaks = identify(Record(np.column_stack([z]), np.zeros((60_000, 1)), DT)).modes[0].peaks
    assert len(peaks) == 2
    for p, true in zip(peaks, two, strict=True):
        assert abs(p.frequency.value - true.omega / (2 * pi)) < 4.0 * p.frequency.std


@pytest.mark.parametrize(("bins", "rms"), [(3.0, 0.006), (5.0, 0.0012), (8.0, 0.006), (10.0, 0.0012)])
def test_two_undamped_lines_a_few_bins_apart_are_told_apart(bins: float, rms: float) -> None:
    """What is stated of either is that of a line alone: one to six Cramer-Rao bounds of its frequency (two to four were seen)."""
    n, rng = 20_000, np.random.default_rng(12)
    lines = [Sinusoid(f, sqrt(2.0) * rms * np.exp(2j * pi * rng.random())) for f in (30.0, 30.0 + bins / (n * DT))]
    z = 0.014 * rng.standard_normal(n) + TURBULENCE.sample(n, rng) + sum(line.signal(n, DT) for line in lines)
    (mode,) = identify(Record(z[:, None], np.zeros((n, 1)), DT)).modes
    bound = sqrt(12.0 / n**3) * 0.014 / (2 * pi * rms * DT)
    assert len(mode.peaks) == 2 and mode.whiteness.white
    for p, true in zip(mode.peaks, lines, strict=True):
        assert p.pure and abs(p.frequency.value - true.frequency) < 3.5 * p.frequency.std
        assert bound < p.frequency.std < 6.0 * bound
        assert abs(p.rms.value - rms) < 3.5 * p.rms.std  # a probability of 5e-4 each, as above
        assert 1.0 < p.rms.std * sqrt(n) / 0.014 < 2.0  # bounds of a line in the noise: turbulence is beside it, and its width


@pytest.mark.parametrize("seed", [1, 3])
def test_a_line_beside_a_stronger_one_is_not_told_apart_into_two(seed: int) -> None:
    """Found while the stronger one was a resonance, and not yet at its place: what it leaves is no other line."""
    n, rng = 20_000, np.random.default_rng(seed)
    start = TURBULENCE.sample(n, rng) + 0.014 * rng.standard_normal(n)
    lines = [Sinusoid(f, sqrt(2.0) * rms * np.exp(2j * pi * rng.random())) for f, rms in ((30.0, 0.03), (30.4, 0.006))]
    (mode,) = identify(Record((start + sum(x.signal(n, DT) for x in lines))[:, None], np.zeros((n, 1)), DT)).modes
    assert len(mode.peaks) == 2
    for p, true in zip(mode.peaks, lines, strict=True):
        assert abs(p.frequency.value - true.frequency) < 3.5 * p.frequency.std


def test_a_narrow_resonance_is_not_told_apart_into_lines() -> None:
    """Of half widths of 0.4, 0.7 and 2 bins, which look most like two lines: twice three in a record, far from each other."""
    n, f = 20_000, (18.0, 24.0, 32.0, 41.0, 51.0, 60.0)
    for seed in (13, 14):
        rng = np.random.default_rng(seed)
        true = [Ar2(2 * pi * f0, half / (n * DT * f0), 0.003, DT) for f0, half in zip(f, 2 * (0.4, 0.7, 2.0), strict=True)]
        z = 0.014 * rng.standard_normal(n) + sum(p.sample(n, rng) for p in (TURBULENCE, *true))
        (mode,) = identify(Record(z[:, None], np.zeros((n, 1)), DT)).modes
        assert [p.frequency.value for p in mode.peaks] == pytest.approx(f, abs=0.3)


def test_peaks_that_agree_are_one() -> None:
    def peak(f: float, xi: float = 0.01, rms: float = 0.01) -> IdentifiedProcess:
        return IdentifiedProcess(Number(f, 0.01), Number(xi, 0.001 if xi else 0.0), Number(rms, 0.001))

    both, *alone = merge_peaks([(peak(20.0), peak(30.0), peak(40.0, 0.0, 0.02)), (peak(20.03), peak(31.0), peak(40.0))])
    assert both.frequency.value == pytest.approx(20.015) and all(both.rms)
    assert [p.frequency.value for p in alone] == [30.0, 31.0, 40.0, 40.0]


T = np.arange(6000)[:, None] * DT
NOISE = 0.01 * np.random.default_rng(9).standard_normal((6000, 1))


@pytest.mark.parametrize(
    ("z", "said"),
    [
        (np.sin(2 * pi * 20.3 * T) + np.where((T > 2) & (T < 3), 0.0, NOISE), "not stationary"),  # held samples
        (np.round(NOISE / 0.02) * 0.02, "is white"),  # counts
        (NOISE + 3.0 * T, "NOT white"),  # drift
        (NOISE + 5.0 * (np.arange(6000)[:, None] % 997 == 500), "is white at 1 % ("),  # outliers
        (NOISE * (1.0 + (T > 3)), "not stationary"),
    ],
)
def test_records_that_are_none_of_the_model_are_survived_and_told(z: np.ndarray, said: str) -> None:
    got = identify(Record(z, np.zeros_like(z), DT))
    assert said in whiteness_lines(got)[0]
    json.dumps(identification_dict(got), allow_nan=False)
    got.scenario().validate()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"y_lgs": np.where(np.arange(4000)[:, None] == 7, np.inf, np.ones((4000, 2))), "u": np.zeros((4000, 2))},
            "is inf at step 7",
        ),
        ({"y_lgs": np.zeros((900, 2)), "u": np.zeros((900, 2))}, "900 samples, identification needs"),
        ({"y_lgs": np.zeros((4000, 2)), "u": np.zeros((4000, 2))}, "tip: z is constant"),
        ({"y_lgs": np.ones((4000, 2)), "u": np.zeros((4000, 2)), "dt": 0.1}, "lowest peak frequency = 5 Hz: .* 2.5 Hz"),
    ],
)
def test_unusable_records_are_refused(change: dict, said: str) -> None:
    with pytest.raises(RecordError, match=said):
        identify(Record(**{"dt": DT, **change}))


@pytest.mark.parametrize(
    "setting", [{"lowest": x} for x in (0.0, -1.0, np.nan)] + [{"level": x} for x in (0.0, -1.0, 0.51, np.nan)]
)
def test_a_level_or_a_frequency_that_no_search_has_is_one_line(setting: dict[str, float]) -> None:
    (name, value), white = *setting.items(), np.random.default_rng(1).standard_normal((4000, 1))
    with pytest.raises(SettingError, match=rf"^{name} = {value:g}: takes a number above 0( and up to 0\.5)?$"):
        identify(Record(white, 0.0 * white, DT), **setting)


def test_cancel_and_progress(record: Record) -> None:
    told: list[float] = []
    identify(Record(record.y_lgs[:8000], record.u[:8000], record.dt), watch=Watch(progress=told.append))
    assert told == sorted(told) and told[-1] == 1.0
    with pytest.raises(Cancelled):
        identify(record, watch=Watch(is_cancelled=lambda: True))


def test_written_and_annotated() -> None:
    assert format_number(Number(0.00312, 0.00099)) == "0.00312 +- 0.00099"
    text = add_comments("[a]\nx = 1\n\n[[a.b]]\nx = 2\n\n[[a.b]]\nx = 3\n", {"a.x": "one", "a.b.1.x": "three"})
    assert text == "[a]\nx = 1  # one\n\n[[a.b]]\nx = 2\n\n[[a.b]]\nx = 3  # three\n"


@pytest.mark.parametrize(
    ("damping", "rms", "frequency", "smooth"),
    [
        (0.15, 0.02, 8.0, True),  # on the slope of turbulence, where its density is as high: no maximum
        (0.02, 0.02, 8.0, False),  # narrow
        (0.15, 0.1, 8.0, False),  # stronger than turbulence by far: a maximum
        (0.3, 0.02, 60.0, False),  # far above, where there is nothing but noise
        (0.02, 0.02, 4.0, True),  # below what is looked at
    ],
)
def test_a_resonance_without_a_maximum_is_of_the_continuum(damping: float, rms: float, frequency: float, smooth: bool) -> None:
    p = Ar2(2 * pi * frequency, damping, rms, DT)
    assert is_continuum(Spectrum(0.014, DT, TURBULENCE, (p,)), p, 5.0) == smooth


def test_turbulence_that_no_third_order_fits_is_no_vibration() -> None:
    """A second process on its slope: found, told to the filters as turbulence, written, and no peak."""
    rng = np.random.default_rng(12)
    z = 0.014 * rng.standard_normal(60_000) + sum(p.sample(60_000, rng) for p in (TURBULENCE, Ar2(2 * pi * 8.0, 0.2, 0.02, DT)))
    got = identify(Record(z[:, None], np.zeros((60_000, 1)), DT))
    (mode,) = got.modes
    assert got.white and not got.peaks and len(mode.broad) == 1
    (p,) = mode.broad
    for number, true in ((p.frequency, 8.0), (p.rms, 0.02)):
        assert abs(number.value - true) < 4.0 * number.std
    assert p.damping.value > 0.1
    assert len(mode.prior.turbulence) == 2 and not mode.prior.lines
    assert len(got.scenario().turbulence.processes) == 2
    assert "broad, of the continuum" in [name for name, *_ in mode_rows(mode)]


def test_a_number_has_no_interval_where_none_is_known_to_hold() -> None:
    """Of a record so short that turbulence hardly moves; a line two bins from half the rate."""
    rng, n = np.random.default_rng(13), 5000
    z = 0.014 * rng.standard_normal(n) + Ar2(2.0, 0.9, 0.5, DT).sample(n, rng)
    z += 0.02 * np.cos(2 * pi * (500.0 - 2.0 / (n * DT)) * DT * np.arange(n))
    result = identify(Record(z[:, None], np.zeros((n, 1)), DT))
    (mode,) = result.modes
    assert mode.turbulence and np.isnan(mode.turbulence.frequency.std) and np.isfinite(mode.noise.std)
    (line,) = [p for p in mode.peaks if p.frequency.value > 490.0]
    assert np.isnan(line.rms.std)
    assert identification_dict(result)["modes"][0]["turbulence"]["frequency_std"] is None
    assert known_number(Number(0.3, 0.11)).value == 0.3 and np.isnan(known_number(Number(0.3, 0.11)).std)
    assert known_number(Number(0.3, 0.09)) == Number(0.3, 0.09)
    assert "+- -" in identification_toml(result, result.scenario())
    assert tuple(mean([Number(1.0, nan), Number(2.0, 0.1)])) == pytest.approx((2.0, 0.1), rel=1e-12)
    assert np.isnan(mean([Number(1.0, nan), Number(2.0, nan)]).std)
