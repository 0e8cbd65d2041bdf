"""Errors, lags and spectra of signals whose errors, lags and spectra are known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from wfsobs.evaluation.exact_errors import cumulative_rms, scored_samples
from wfsobs.evaluation.scores import batch_means, lag, rms_interval, score, supervised_scores, unsupervised_scores
from wfsobs.record import TOTAL, Estimate, Record
from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.spectrum import psd, rms

NAMES = ["tip", "tilt"]


def record(turbulence: np.ndarray | None = None, vibration: np.ndarray | None = None, n: int = 1000) -> Record:
    return Record(np.zeros((n, 2)), np.zeros((n, 2)), 1e-3, turbulence=turbulence, vibration=vibration)


def test_rms_keeps_the_mean() -> None:
    assert rms(np.array([3.0, 4.0, 3.0, 4.0])) == pytest.approx(np.sqrt(12.5))
    assert rms(np.full(10, -2.0)) == 2.0
    assert rms(np.zeros(0)) == 0.0


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.integers(0, 2**31), st.floats(-6, 3), st.floats(0.0, 0.5), st.integers(0, 300))
def test_scores_of_a_known_error(seed: int, log_scale: float, warm_up: float, unknown: int) -> None:
    """Truth plus noise; the warm-up and the steps without an estimate are left out, and nothing else."""
    rng = np.random.default_rng(seed)
    truth = 10**log_scale * rng.standard_normal((1000, 2))
    values = truth + 10**log_scale * 0.3 * rng.standard_normal((1000, 2))
    start = round(warm_up * 1000)
    values[:unknown] = np.nan
    values[700:705, 1] = np.nan
    wild = truth.copy()
    wild[:start] = 1e9  # whatever the warm-up holds
    found = supervised_scores(record(vibration=wild), [Estimate("x", "vibration", values, 2e-6)], warm_up, NAMES)
    assert [s.mode for s in found] == NAMES
    for mode, s in enumerate(found):
        known = [k for k in range(1000) if k >= start and not np.isnan(values[k, mode])]
        error = np.sqrt(sum((values[k, mode] - truth[k, mode]) ** 2 for k in known) / len(known))
        size = np.sqrt(sum(truth[k, mode] ** 2 for k in known) / len(known))
        assert s.rms == pytest.approx(error, rel=1e-12) and s.truth_rms == pytest.approx(size, rel=1e-12)
        assert s.normalised_rms == pytest.approx(error / size, rel=1e-12)
        assert (s.observer, s.target, s.seconds_per_step) == ("x", "vibration", 2e-6)
        assert (s.start, s.stop, s.apart) == (pytest.approx(1e-3 * known[0]), pytest.approx(1e-3 * (known[-1] + 1)), False)
        assert s.lag == pytest.approx(0.0, abs=1e-4)  # white noise at 0.3: the peak of the correlation is at zero


@pytest.mark.parametrize("share", [1e-3, 0.02, 1.0 / 9.0, 0.2])
def test_an_interval_holds_the_rms_over_all_records_for_slow_errors_and_fast(share: float) -> None:
    """Of 1000 first-order autoregressions of unit variance, whose correlation time is this share of the record."""
    rng, n = np.random.default_rng(3), 2000
    pole = np.exp(-1.0 / (share * n))
    x, _ = lfilter(
        [np.sqrt(1.0 - pole**2)], [1.0, -pole], rng.standard_normal((1000, n)), zi=pole * rng.standard_normal((1000, 1))
    )
    found = [rms_interval(rms(one), batch_means(one[:, None] ** 2)) for one in x]
    assert np.mean([of is not None and of[0] <= 1.0 <= of[1] for of in found]) == pytest.approx(0.945, abs=0.045)


def test_both_together_are_scored_against_the_sum_of_both_truths() -> None:
    """Errors of opposite sign cancel in the sum; the samples are those that both have, the deviation that of the sum."""
    rng = np.random.default_rng(1)
    turbulence, vibration, slow, fast = rng.standard_normal((4, 1000, 2))
    common = rng.standard_normal((1000, 2))
    first, second = turbulence + common + 0.1 * slow, vibration - common + 0.2 * fast
    first[:50], second[:80] = np.nan, np.nan
    sd = {TOTAL: np.full((1000, 2), 0.3)}
    estimates = [
        Estimate("both", "turbulence", first, 1e-6, sd=np.ones((1000, 2)), sd_of_sum=sd),
        Estimate("both", "vibration", second, 2e-6, sd=np.ones((1000, 2)), sd_of_sum=sd),
        Estimate("one", "vibration", vibration, 1e-6),
    ]
    known = record(turbulence, vibration)
    found = [s for s in supervised_scores(known, estimates, 0.0, NAMES) if s.target == TOTAL]
    assert [(s.observer, s.mode, s.seconds_per_step, s.start) for s in found] == [("both", name, 2e-6, 0.08) for name in NAMES]
    for mode, s in enumerate(found):
        left, truth = (0.1 * slow + 0.2 * fast)[80:, mode], (turbulence + vibration)[80:, mode]
        assert s.rms == pytest.approx(np.sqrt(np.mean(left**2)), rel=1e-12)  # rounding of sums
        assert s.truth_rms == pytest.approx(np.sqrt(np.mean(truth**2)), rel=1e-12)
        assert s.calibration is not None and s.calibration.sd == pytest.approx(0.3, rel=1e-12)
    assert not [s for s in supervised_scores(record(vibration=vibration), estimates, 0.0, NAMES) if s.target == TOTAL]


def test_no_truth_no_score_and_zero_truth_no_ratio() -> None:
    estimate = Estimate("x", "vibration", np.ones((1000, 2)), 0.0)
    assert supervised_scores(record(turbulence=np.ones((1000, 2))), [estimate], 0.0, NAMES) == []
    found = supervised_scores(record(vibration=np.zeros((1000, 2))), [estimate], 0.0, NAMES)
    assert [(s.rms, s.truth_rms, s.normalised_rms, s.lag) for s in found] == [(1.0, 0.0, None, None)] * 2


@pytest.mark.parametrize("truth", [None, np.zeros((50, 2))], ids=["measured", "simulated"])
@pytest.mark.parametrize("names", [["tip"], ["tip", "tilt", "defocus"], []], ids=len)
def test_there_are_as_many_names_as_modes(names: list[str], truth: np.ndarray | None) -> None:
    record = Record(np.zeros((50, 2)), np.zeros((50, 2)), 1e-3, turbulence=truth)
    with pytest.raises(ValueError, match=rf"^mode_names takes 2 names, one per mode of the record, not {len(names)}$"):
        score(record, [], mode_names=names)


def test_nothing_left_to_score_gives_no_row() -> None:
    values = np.full((1000, 2), np.nan)
    values[:100, 0] = 1.0
    values[:, 1] = 0.0
    ones, estimates = record(vibration=np.ones((1000, 2))), [Estimate("x", "vibration", values, 0.0)]
    assert [s.mode for s in supervised_scores(ones, estimates, 0.5, NAMES)] == ["tilt"]
    assert supervised_scores(ones, estimates, 5.0, NAMES) == []


def test_an_answer_of_zero_scores_one() -> None:
    truth = np.random.default_rng(0).standard_normal((1000, 2))
    found = supervised_scores(record(vibration=truth), [Estimate("zero", "vibration", np.zeros((1000, 2)), 0.0)], 0.1, NAMES)
    assert [s.normalised_rms for s in found] == [1.0, 1.0] and [s.lag for s in found] == [None, None]


def test_scored_samples_are_pairs() -> None:
    truth, value = np.arange(10.0), np.array([0, 1, np.nan, 3, 4, np.nan, 6, 7, 8, 9.0])
    one, other = scored_samples(record(n=10), truth, value, 0.002)
    assert one.tolist() == other.tolist() == [3, 4, 6, 7, 8, 9]


def late(name: str, error: np.ndarray, start: int, target: str = "vibration") -> Estimate:
    """An estimate that is off by `error` of a truth of zero, from some step on."""
    return Estimate(name, target, np.where(np.arange(error.size) < start, np.nan, error)[:, None] * np.ones(2), 0.0)


def test_a_table_is_scored_on_the_samples_that_all_have() -> None:
    """Calm at the end, so that whoever starts late looks better than it is; one last sample and one gap less."""
    rough = np.where(np.arange(1000) < 500, 3.0, 1.0)
    gap = np.where(np.arange(1000) == 700, np.nan, 1.0)
    estimates = [late("all", rough, 0), late("late", 1.1 * rough, 500), late("gap", gap * rough, 0)]
    found = supervised_scores(record(vibration=np.zeros((1000, 2))), estimates, 0.1, NAMES)
    got = {s.observer: s for s in found if s.mode == "tilt"}
    assert got["all"].rms == pytest.approx(1.0) and got["late"].rms == pytest.approx(1.1)
    assert {(s.start, s.stop, s.apart) for s in found} == {(0.5, 1.0, False)}
    last = late("last", np.where(np.arange(1000) < 999, 1.0, np.nan), 0)
    assert {s.stop for s in supervised_scores(record(vibration=np.zeros((1000, 2))), [*estimates, last], 0.1, NAMES)} == {0.999}


@pytest.mark.parametrize(("start", "apart"), [(549, False), (550, False), (551, True), (990, True)])
def test_who_leaves_less_than_half_stands_apart(start: int, apart: bool) -> None:
    """Of the 900 samples after the warm-up; the others keep theirs."""
    rough = np.where(np.arange(1000) < start, 3.0, 1.0)
    estimates = [late("late", rough, start), late("one", rough, 0), late("two", rough, 50)]
    found = {s.observer: s for s in supervised_scores(record(vibration=np.zeros((1000, 2))), estimates, 0.1, NAMES)}
    assert found["late"].rms == pytest.approx(1.0) and found["late"].start == pytest.approx(1e-3 * start)
    assert [found[name].apart for name in ("late", "one", "two")] == [apart, False, False]
    for name in ("one", "two"):
        assert found[name].start == pytest.approx(0.1 if apart else 1e-3 * start)
        whole = np.sqrt((9.0 * (start - 100) + 1000 - start) / 900)
        assert found[name].rms == pytest.approx(whole if apart else 1.0)


def test_predictions_and_the_residual_are_scored_on_common_samples_too() -> None:
    rough = np.where(np.arange(1000) < 500, 3.0, 1.0)
    y = np.outer(rough, [1.0, 1.0])
    without_truth = Record(y, np.zeros((1000, 2)), 1e-3)
    estimates = [
        late(name, np.zeros(1000), start, target)
        for name, start in (("all", 0), ("late", 499), ("apart", 900))
        for target in ("turbulence", "vibration")
    ]
    found = {s.observer: s for s in unsupervised_scores(without_truth, estimates, 0.1, NAMES) if s.mode == "tip"}
    assert {name: (s.start, s.apart) for name, s in found.items()} == {
        "all": (0.5, False),
        "late": (0.5, False),
        "apart": (pytest.approx(0.901), True),
        "loop": (0.5, False),
    }
    assert all(s.rms == s.truth_rms == pytest.approx(1.0) for s in found.values())


# ---------------------------------------------------------------------- lag


def shifted(delay: float, n: int = 4000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A band-limited periodic signal and itself `delay` samples later, exactly (a phase ramp on its DFT)."""
    rng = np.random.default_rng(seed)
    f = np.fft.rfftfreq(n)
    spectrum = np.exp(-((f / 0.05) ** 2)) * (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size))
    spectrum[0] = 0.0
    return np.fft.irfft(spectrum, n), np.fft.irfft(spectrum * np.exp(-2j * np.pi * f * delay), n)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.floats(-20.0, 20.0), st.floats(-5, -2), st.integers(0, 50))
def test_lag_of_a_signal_delayed_by_part_of_a_sample(delay: float, log_dt: float, seed: int) -> None:
    """Positive is late. The signal is exactly the same elsewhere, so the correlation is 1 there; the parabola is off by
    its fourth derivative, some 1 / 6^2 of a sample for a correlation 6 samples wide."""
    dt = 10**log_dt
    truth, value = shifted(delay, seed=seed)
    found = lag(truth, value, dt)
    reach = round(0.025 / dt)
    if abs(delay) < reach - 1:
        assert found is not None and abs(found / dt - delay) < 0.01
    else:  # not looked for beyond 25 ms
        assert found is not None and abs(found) <= (reach + 0.5) * dt


@pytest.mark.parametrize("delay", [-0.4, -0.25, 0.0, 0.1, 0.25, 0.49])
def test_lag_of_a_sine_is_the_parabola_through_a_cosine(delay: float) -> None:
    """Through three points of cos(w (j - delay)) the parabola has its top at tan(w delay) / (2 tan(w / 2))."""
    w = 2 * np.pi * 47.0 * 1e-3
    t = np.arange(40_000)
    found = lag(np.cos(w * t), np.cos(w * (t - delay)), 1e-3)
    # a long record: pieces that are not whole periods count for 1 / (w n) = 1e-4
    assert found == pytest.approx(np.tan(w * delay) / (2 * np.tan(w / 2)) * 1e-3, abs=1e-3 * 1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_lag_of_a_line_in_an_estimate_is_the_one_nearest_to_zero(seed: int) -> None:
    """The filter follows a line of 47.5 Hz, 3 ms late, and has some of one of 10 Hz upside down, which makes the correlation a
    period of 21 ms away the higher one."""
    rng, dt, t = np.random.default_rng(seed), 1e-3, np.arange(9003) * 1e-3
    slow, line = (np.cos(2 * np.pi * (f * t + rng.random())) for f in (10.0, 47.5))
    # 0.3 cos(2 pi 10 Hz tau) beside cos(2 pi 47.5 Hz (tau - 3 ms)) has its slope, 19 / s, at a curvature of 297^2 / s^2: 0.2 ms.
    assert lag((slow + line)[3:], line[:-3] - 0.3 * slow[3:], dt) == pytest.approx(3e-3, abs=3e-4)


def test_lag_does_not_see_scale_offset_or_noise() -> None:
    truth, value = shifted(3.0)
    noisy = 7.0 + 0.01 * value + 0.003 * truth.std() * np.random.default_rng(1).standard_normal(truth.size)
    # noise of 0.3 in 4000 samples moves a peak 6 samples wide by 0.3 * 6 / sqrt(4000 / 6) or less: 0.07
    assert lag(truth - 5.0, noisy, 1e-3) == pytest.approx(3e-3, abs=1.5e-4)


@pytest.mark.parametrize("seed", range(6))
def test_lag_of_slow_turbulence_in_a_short_record(seed: int) -> None:
    """9 s of turbulence, 3 samples late, alone and with the noise of a sensor. A plain cross-correlation, which loses
    terms at the ends, says 1.4 +- 1 here."""
    rng = np.random.default_rng(seed)
    x = Ar2(7.0686, 0.9, 0.5, 1e-3).sample(9003, rng)
    truth, value = x[3:], x[:-3]
    assert lag(truth, value, 1e-3) == pytest.approx(3e-3, abs=1e-6)
    noisy = 0.8 * value + 0.014 * rng.standard_normal(value.size)
    # spread found over 60 seeds: 0.04 samples; 4.5 of it
    assert lag(truth, noisy, 1e-3) == pytest.approx(3e-3, abs=1.8e-4)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_lag_of_next_to_nothing(n: int) -> None:
    rising = np.arange(float(n))
    found = lag(rising, rising, 1e-3)
    assert found is None if n == 1 else found == pytest.approx(0.0, abs=1e-3)
    assert lag(np.ones(n), rising, 1e-3) is None and lag(rising, np.ones(n), 1e-3) is None


# ---------------------------------------------------------------------- spectra


@pytest.mark.parametrize("n", [2000, 10_000, 60_001])
def test_welch_integrates_to_the_variance(n: int) -> None:
    """White noise, and AR(2) vibration slow against nothing: the mean of the windows' variances is the variance."""
    rng = np.random.default_rng(1)
    x = np.column_stack([rng.standard_normal(n), Ar2(298.4, 0.03, 0.02, 1e-3).sample(n, rng)])
    f, density = psd(x, 1e-3)
    assert f[1] - f[0] == pytest.approx(0.5) and f[-1] == pytest.approx(500.0)
    assert density.shape == (f.size, 2)
    # Hann windows weigh the ends of the record less: the variance of 2 s pieces, spread sqrt(2 / dof), 4.5 of it
    for column, dof in ((0, n / 2), (1, 2 * np.pi * 47.5 * 0.03 * n * 1e-3)):
        power = density[:, column].sum() * 0.5
        assert abs(power / np.var(x[:, column]) - 1) < 4.5 * np.sqrt(2 / dof) * (0.3 if n > 3000 else 1.0)


def test_welch_follows_the_closed_form() -> None:
    p = Ar2(298.4, 0.1, 0.02, 1e-3)
    f, density = psd(p.sample(200_000, np.random.default_rng(2))[:, None], 1e-3)
    ratio = density[2:-2, 0] / p.psd(f[2:-2])
    # 199 half-overlapping windows are worth 105 independent ones: a spread of 1 / sqrt(105) per bin
    assert abs(ratio.mean() - 1) < 4.5 / np.sqrt(105 * ratio.size / 1.5)
    assert 0.7 / np.sqrt(105) < ratio.std() < 1.4 / np.sqrt(105)


def test_a_tone_has_its_power_at_its_frequency() -> None:
    t = np.arange(8000) * 1e-3
    f, density = psd((0.1 * np.sqrt(2) * np.sin(2 * np.pi * 40.0 * t))[:, None], 1e-3)
    assert f[np.argmax(density[:, 0])] == 40.0
    assert density[:, 0].sum() * 0.5 == pytest.approx(0.01, rel=1e-6)


@pytest.mark.parametrize("n", [2, 10, 999])
def test_a_record_shorter_than_a_window_is_one_window(n: int) -> None:
    f, density = psd(np.random.default_rng(0).standard_normal((n, 2)), 1e-3)
    assert f.size == n // 2 + 1 == len(density) and np.isfinite(density).all()


def test_cumulative_rms_counts_from_high_to_low() -> None:
    f = np.arange(5) * 0.5
    density = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 8.0], [4.0, 0.0], [5.0, 0.0]])
    got = cumulative_rms(f, density)
    wanted = [[np.sqrt(0.5 * density[k:, c].sum()) for c in range(2)] for k in range(5)]
    assert np.allclose(got, wanted, rtol=1e-14)
    assert (np.diff(got, axis=0) <= 0).all()
