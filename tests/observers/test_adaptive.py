"""The adaptive filter: what is found in a window, the filter of it, its error against theory, and what it does after a change."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from wfsobs.execution import run_observer
from wfsobs.observers.base import TARGETS
from wfsobs.observers.kalman import window_model
from wfsobs.observers.kalman.filters import steady_filter
from wfsobs.observers.kalman.window_model import model_filter, pack_spectrum, unpack_spectrum
from wfsobs.progress import Cancelled, Watch
from wfsobs.record import Record, RecordError, delay_signal
from wfsobs.scenario import Scenario
from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.signal.gains import RiccatiError
from wfsobs.signal.statespace import disturbance_model
from wfsobs.spectral.model import BACKGROUND_WORTH, Spectrum, densities
from wfsobs.spectral.quick import WindowFit, quick_spectrum
from wfsobs.spectral.whittle import periodogram_frequencies

DT, NOISE = 1e-3, 0.014
TURBULENCE = Ar2(7.0, 0.9, 0.5, DT)
PEAK = Ar2(2 * pi * 30.0, 0.01, 0.02, DT)
MODEL = Spectrum(NOISE, DT, TURBULENCE, (PEAK,))


def made(n: int, modes: int, seed: int, *vibration: Ar2) -> Record:
    """Turbulence, noise, and these processes one after the other, each for an equal part of the record; the mirror at rest."""
    rng = np.random.default_rng(seed)

    def columns(p: Ar2, length: int) -> np.ndarray:
        return np.column_stack([p.sample(length, rng) for _ in range(modes)])

    turbulence = columns(TURBULENCE, n)
    moving = np.vstack([columns(p, n // len(vibration)) for p in vibration]) if vibration else np.zeros((n, modes))
    z = delay_signal(turbulence + moving, 1) + NOISE * rng.standard_normal((n, modes))
    return Record(z, np.zeros_like(z), DT, turbulence=turbulence, vibration=moving)


def with_window(window: float, interval: float, **more: object) -> Scenario:
    return Scenario().replace({"adaptive.window": window, "adaptive.interval": interval, **more})


def vibration_of(spectrum: Spectrum, z: np.ndarray) -> np.ndarray:
    one = model_filter(spectrum)
    assert one is not None
    return np.column_stack([one.gains.filter(one.rows(TARGETS)).run(column[:, None])[:, 1] for column in z.T])


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(frequency=st.floats(0.05, 450.0), damping=st.floats(1e-4, 0.99), size=st.floats(1e-4, 10.0))
@example(346.1512841333145, 1e-4, 1.0)
def test_densities_are_those_of_the_process_and_slopes_their_derivatives(frequency: float, damping: float, size: float) -> None:
    p, f = Ar2(2 * pi * frequency, damping, size, DT), np.linspace(0.25, 499.0, 200)
    at = np.array([[np.log(p.omega), np.log(damping / (1 - damping)), np.log(size)]])
    S, slopes = densities(at, DT, f)
    np.testing.assert_allclose(S[0], p.psd(f), rtol=1e-8)  # sines by addition: 1e-16 over the least distance, 1e-4 * 3e-4
    # far within what log S is smooth over: the width of the resonance in log omega, 1 in the others. A step as small as the width
    # in these would divide the rounding of S, 1e-12 where the resonance is sharpest, by 2e-9: as much as the tolerance
    for i, step in enumerate((1e-5 * damping, 1e-5, 1e-5)):
        high, low = (densities(at + sign * step * np.eye(3)[i], DT, f)[0][0] for sign in (1, -1))
        slope = np.log(high / low) / (2.0 * step)
        np.testing.assert_allclose(slopes[0, i], slope, rtol=1e-4, atol=1e-3 * np.abs(slope).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "peaks"),
    [
        (2000, [PEAK]),
        (4000, []),
        (4000, [PEAK]),
        (4000, [PEAK, Ar2(2 * pi * 52.0, 0.01, 0.01, DT)]),
        (4000, [Ar2(2 * pi * 52.0, 0.05, 0.02, DT)]),
        (8000, [PEAK]),
    ],
)
def test_the_spectrum_of_a_window_is_near_the_true_one(n: int, peaks: list[Ar2]) -> None:
    """The expected loss of log-likelihood, sum log S / S0 + S0 / S - 1 over all bins, is p / 2 for the best of p numbers (half of
    a chi squared of p). Here there are not only those: a wide peak is taken for several, each of three numbers."""
    truth, f, lost = Spectrum(NOISE, DT, TURBULENCE, tuple(peaks)), periodogram_frequencies(n, DT), []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        z = NOISE * rng.standard_normal(n) + sum(p.sample(n, rng) for p in truth.processes)
        ratio = truth.psd(f) / quick_spectrum(z, DT, 20).psd(f)
        lost.append(np.sum(ratio - 1.0 - np.log(ratio)))
    least = 0.5 * len(truth.vector)
    assert 0.5 * least < np.median(lost) < least + 3 * 3.0 * len(peaks) + 2.0


def test_a_peak_is_where_it_is() -> None:
    """A line of half the noise's rms in a window of 4 s: over three times the error of Rife and Boorstyn, 8 mHz."""
    rng, t = np.random.default_rng(2), DT * np.arange(4000)
    line = NOISE / np.sqrt(2.0) * np.sin(2 * pi * 41.37 * t)
    z = line + NOISE * rng.standard_normal(4000) + TURBULENCE.sample(4000, rng)
    peak = max(quick_spectrum(z, DT, 20).resonances, key=lambda p: p.rms)
    assert peak.omega / (2 * pi) == pytest.approx(41.37, abs=0.025)
    assert peak.rms == pytest.approx(0.5 * NOISE, rel=0.2)


@pytest.mark.parametrize("seed", range(5))
def test_a_window_without_peaks_has_none_to_speak_of(seed: int) -> None:
    """What is taken for one now and then is less than the noise."""
    record = made(4000, 1, seed)
    got = quick_spectrum(record.z[:, 0], DT, 20)
    assert got.turbulence is not None
    assert sum(p.rms**2 for p in got.resonances) < NOISE**2


HISS = Ar2(2 * pi * 60.0, 0.8, 0.03, DT)
"""A coloured background of twice the noise's rms."""


@pytest.mark.parametrize("turbulence", [TURBULENCE, Ar3(7.0, 0.9, 30.0, 0.5, DT)])
def test_slopes_of_a_fit_with_a_background(turbulence: Ar2 | Ar3) -> None:
    """Central differences of the logarithm of the density, which curves by less than 1 in every number but the frequency of a
    peak, by 1 / damping^2 = 1e4: steps of 1e-6 are wrong by 1e-8 and 1e-2 of the steepest, 100; rounding by 1e-9."""
    start = Spectrum(NOISE, DT, turbulence, (PEAK,), HISS)
    fit = WindowFit(made(4000, 1, 0, PEAK).z[:, 0], DT, start)
    f = fit.cells.frequency
    S, slopes = fit.density(fit.x, f)
    np.testing.assert_allclose(S, start.psd(f), rtol=1e-9)
    assert fit.spectrum.vector == pytest.approx(start.vector, rel=1e-9)
    for i, slope in enumerate(slopes):
        up, down = (np.log(fit.density(fit.x + sign * 1e-6 * np.eye(len(fit.x))[i], f)[0]) for sign in (1, -1))
        expected = np.zeros(len(f)) if i == 5 else (up - down) / 2e-6  # the background keeps its damping
        np.testing.assert_allclose(slope, expected, atol=1e-6 * max(1.0, np.abs(slope).max()), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("peaks", [(), (PEAK,)])
def test_a_coloured_background_is_found(peaks: tuple[Ar2, ...]) -> None:
    """The loss of log-likelihood as above; a fit without a background loses more than BACKGROUND_WORTH of it."""
    truth, f, lost, poor = Spectrum(NOISE, DT, TURBULENCE, peaks, HISS), periodogram_frequencies(4000, DT), [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        z = NOISE * rng.standard_normal(4000) + sum(p.sample(4000, rng) for p in truth.processes)
        found = quick_spectrum(z, DT, 20)
        for to, spectrum in ((lost, found), (poor, quick_spectrum(z, DT, 0))):  # without peaks no background is looked for
            ratio = truth.psd(f) / spectrum.psd(f)
            to.append(np.sum(ratio - 1.0 - np.log(ratio)))
    least = 0.5 * len(truth.vector)
    assert 0.5 * least < np.median(lost) < least + 3 * 3.0 * len(peaks) + 2.0
    assert np.median(poor) > least + BACKGROUND_WORTH


@pytest.mark.parametrize("hiss", [None, HISS])
def test_a_background_is_kept_while_it_is_there(hiss: Ar2 | None) -> None:
    """A window begins with the background of the one before. Without one it is dropped; with one it is as the truth has it, to
    three deviations of its rms, 4 % of it: 4 s have 480 independent samples of 60 Hz."""
    truth, rms_found = Spectrum(NOISE, DT, TURBULENCE, (), hiss), []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        z = NOISE * rng.standard_normal(4000) + sum(p.sample(4000, rng) for p in truth.processes)
        found = quick_spectrum(z, DT, 20, before=Spectrum(NOISE, DT, TURBULENCE, (), HISS)).background
        rms_found.append(0.0 if found is None else found.rms)
    assert np.median(rms_found) == (0.0 if hiss is None else pytest.approx(hiss.rms, rel=0.12))


@pytest.mark.slow
def test_the_filter_of_a_window_with_a_background_is_nearly_that_of_the_truth() -> None:
    """A peak of 60 nm in a background of 60 nm: within 12 % of the filter that is told the spectrum, behind the first window. It
    learns ten numbers from 4 s, and takes a bit of turbulence for a peak now and then. A filter that is told all but the
    background is a third above it at least."""
    peak, hiss = replace(PEAK, rms=0.06), replace(HISS, rms=0.06)
    truth, errors = Spectrum(NOISE, DT, TURBULENCE, (peak,), hiss), []
    for seed in range(3):
        record = made(12_000, 1, seed, peak)
        noise = delay_signal(hiss.sample(12_000, np.random.default_rng(seed + 50))[:, None], 1)
        seen = replace(record, y_lgs=record.y_lgs + noise)
        learnt = run_observer("kf-adaptive", seen, with_window(4.0, 0.5))["vibration"]
        told = [vibration_of(spectrum, seen.z) for spectrum in (truth, replace(truth, background=None))]
        errors.append([rms((x - record.vibration)[4500:]) for x in (learnt, *told)])
    own, best, without = np.sqrt(np.mean(np.square(errors), axis=0))
    assert 0.99 * best < own < 1.12 * best
    assert without > 1.3 * best


@settings(max_examples=30, deadline=None)
@given(st.booleans(), st.booleans(), st.integers(0, 3))
def test_a_spectrum_is_what_was_packed(turbulence: bool, background: bool, peaks: int) -> None:
    one = Spectrum(NOISE, DT, TURBULENCE if turbulence else None, (PEAK,) * peaks, HISS if background else None)
    assert unpack_spectrum(pack_spectrum(one, 5), DT) == one


@pytest.mark.parametrize("seed", range(4))
def test_the_background_of_another_window_is_only_a_start(seed: int) -> None:
    """Noise three times as strong, a third of the turbulence: what is found then is as likely as without, to a tenth
    of the 2.0 that four numbers lose to the truth."""
    z = made(4000, 1, seed).z[:, 0]
    other = Spectrum(3.0 * NOISE, DT, Ar2(20.0, 0.5, 0.17, DT))
    f, alone, moved = periodogram_frequencies(4000, DT), quick_spectrum(z, DT, 0), quick_spectrum(z, DT, 0, before=other)
    ratio = alone.psd(f) / moved.psd(f)
    assert np.sum(ratio - 1.0 - np.log(ratio)) < 0.2


@pytest.mark.parametrize("most", [0, 1, 3])
def test_no_more_peaks_than_allowed(most: int) -> None:
    rng = np.random.default_rng(1)
    peaks = [Ar2(2 * pi * f, 0.01, 0.02, DT) for f in (20.0, 30.0, 40.0, 50.0, 60.0)]
    z = NOISE * rng.standard_normal(4000) + sum(p.sample(4000, rng) for p in peaks)
    assert len(quick_spectrum(z, DT, most).resonances) == most


def test_filters_of_given_models_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the models given, a loop of the paper's recursion from rest at the start of every window, step by step."""
    record = made(1700, 1, 4, PEAK)
    models = [MODEL, Spectrum(0.02, DT, TURBULENCE, (Ar2(2 * pi * 33.0, 0.02, 0.01, DT),)), Spectrum(0.02, DT, None, (PEAK,))]
    given_models = iter(models)
    monkeypatch.setattr(window_model, "quick_spectrum", lambda *_: next(given_models))
    got = run_observer("kf-adaptive", record, with_window(1.0, 0.25))
    z, expected = record.z[2:, 0], np.full((1700, 2), np.nan)
    for i, spectrum in enumerate(models):
        model = disturbance_model([spectrum.turbulence] if spectrum.turbulence else [], spectrum.resonances)
        L = steady_filter(model, spectrum.noise)[1].L[:, 0]
        start, mean = 250 * i, z[250 * i : 250 * i + 1000].mean()
        x = np.zeros(len(model.A))
        for k in range(start, min(start + 1249, len(z))):
            x = model.A @ x
            x = x + L * (z[k] - mean - model.C @ x)
            if k >= start + 999:
                expected[2 + k] = model.outputs["turbulence"] @ x + mean, model.outputs["vibration"] @ x
    assert np.isnan(expected[:1001]).all() and np.isfinite(expected[1001:]).all()
    for i, target in enumerate(("turbulence", "vibration")):
        np.testing.assert_allclose(got[target][:, 0], expected[:, i], rtol=0, atol=1e-12)


@pytest.fixture(scope="module", name="jump")
def _jump() -> tuple[Record, dict[str, np.ndarray]]:
    """Eight modes in which the peak moves by 3 Hz at 10 s, and the adaptive estimate."""
    record = made(20_000, 8, 5, PEAK, Ar2(2 * pi * 33.0, 0.01, 0.02, DT))
    return record, run_observer("kf-adaptive", record, with_window(4.0, 0.5))


@pytest.mark.slow
def test_error_on_a_stationary_record_is_near_what_theory_says_of_the_true_model(
    jump: tuple[Record, dict[str, np.ndarray]],
) -> None:
    """Before the jump, 47 s in all. The peak is 0.6 Hz wide, so that its error has some 30 independent values, its rms known to
    13 %, but to the filter of the truth the very same happens, so that their ratio is known better: above 0.98, and seven numbers
    found from 4 s cost 3 %, in windows with a false peak more."""
    record, got = jump
    model = disturbance_model([TURBULENCE], [PEAK])
    kalman, steady = steady_filter(model, NOISE)
    ideal = np.stack([kalman.run(column[:, None]) for column in record.z.T], axis=-1)
    for i, target in enumerate(("turbulence", "vibration")):
        truth, row = record.truth(target), model.outputs[target]
        assert truth is not None
        theory = float(np.sqrt(row @ steady.posterior @ row))
        best, adaptive = (rms((x - truth)[4100:10_000]) for x in (ideal[:, i], got[target]))
        assert best == pytest.approx(theory, rel=0.13)
        assert 0.98 < adaptive / best < 1.08


@pytest.mark.slow
def test_after_a_jump_it_is_back_within_window_and_interval(jump: tuple[Record, dict[str, np.ndarray]]) -> None:
    """Errors of 8 modes over 2 s are known to 13 %; the filter that knew the old peak stays 60 % worse."""
    record, got = jump
    assert record.vibration is not None
    error = got["vibration"] - record.vibration
    fixed = vibration_of(MODEL, record.z) - record.vibration
    before, settled = rms(error[6000:10_000]), rms(error[16_500:])
    assert settled == pytest.approx(before, rel=0.15)
    assert rms(error[10_000:11_000]) > 1.4 * settled
    assert rms(error[14_500:16_500]) < 1.1 * settled
    assert rms(fixed[14_500:16_500]) > 1.5 * settled and rms(fixed[16_500:]) > 1.5 * settled


def test_what_fails_leaves_the_filter_before_in_charge(monkeypatch: pytest.MonkeyPatch) -> None:
    record = made(3000, 1, 6, PEAK)
    s = with_window(1.0, 0.5)
    calls = iter([MODEL, RiccatiError("no"), FloatingPointError("log"), np.linalg.LinAlgError("singular"), MODEL])

    def some(*_: object) -> Spectrum:
        it = next(calls)
        if isinstance(it, Exception):
            raise it
        return it

    monkeypatch.setattr(window_model, "quick_spectrum", some)
    got = run_observer("kf-adaptive", record, s)
    monkeypatch.setattr(window_model, "quick_spectrum", lambda *_: MODEL)
    expected = run_observer("kf-adaptive", record, s)
    for target, values in expected.items():
        assert np.isfinite(values[1001:]).all()
        np.testing.assert_array_equal(got[target], values)


def test_a_window_that_does_not_move_is_estimated_as_it_is() -> None:
    record = Record(np.full((600, 1), 0.25), np.zeros((600, 1)), DT)
    got = run_observer("kf-adaptive", record, with_window(0.5, 0.1))
    assert np.allclose(got["turbulence"][501:], 0.25, rtol=1e-12) and not got["vibration"][501:].any()


def test_records_that_are_too_short() -> None:
    record = made(1001, 1, 7)
    with pytest.raises(RecordError, match=r"the record has 1001 steps; adaptive.window = 1 s needs 1002"):
        run_observer("kf-adaptive", record, with_window(1.0, 0.5))
    with pytest.raises(RecordError, match=r"adaptive.window = 0.1: takes 1 s or more, 100 samples"):
        run_observer("kf-adaptive", Record(record.y_lgs, record.u, 0.01), with_window(0.1, 0.5))


def test_progress_and_cancelling() -> None:
    record, told = made(3000, 2, 8, PEAK), list[float]()
    run_observer("kf-adaptive", record, with_window(1.0, 0.25), Watch(progress=told.append))
    assert len(told) == 16 and min(told) == 0.0 and 0.5 < max(told) < 1.0
    with pytest.raises(Cancelled):
        run_observer("kf-adaptive", record, with_window(1.0, 0.25), Watch(is_cancelled=lambda: True))


@pytest.mark.parametrize(
    "changes",
    [
        {"scale": 1e-6},
        {"scale": 1e3},
        {"noise": 0.0},
        {"noise": 100.0},
        {"offset": 1e3},
        {"line": 0.5},
    ],
)
def test_estimates_are_sensible_whatever_the_record_is_like(changes: dict[str, float]) -> None:
    """In any unit, without noise, buried in it, far from zero, with a pure line: finite, and no worse than no estimate."""
    record = made(3000, 1, 9, PEAK)
    assert record.vibration is not None and record.turbulence is not None
    scale, line = changes.get("scale", 1.0), changes.get("line", 0.0) * np.sin(2 * pi * 41.3 * DT * np.arange(3000))[:, None]
    truth = {"turbulence": scale * record.turbulence + changes.get("offset", 0.0), "vibration": scale * record.vibration + line}
    noise = record.z - delay_signal(record.turbulence + record.vibration, 1)
    z = delay_signal(truth["turbulence"] + truth["vibration"], 1) + scale * changes.get("noise", 1.0) * noise
    got = run_observer("kf-adaptive", Record(z, np.zeros_like(z), DT), with_window(1.5, 0.5))
    for target, values in got.items():
        assert np.isfinite(values[1501:]).all()
        assert rms(values[1501:] - truth[target][1501:]) < 1.1 * rms(truth[target][1501:])
