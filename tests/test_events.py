"""Events: what they do to the disturbance and to the measurements, and that no observer is told."""

from __future__ import annotations

from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wfsobs import PRESETS, Scenario, SettingError, observe, simulate
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.run import closed_loop, rows
from wfsobs.cost import run_bytes, run_seconds
from wfsobs.evaluation.bound import record_bounds
from wfsobs.evaluation.scores import BOUND, BOUND_BOTH
from wfsobs.identification import identify
from wfsobs.observers import OBSERVERS
from wfsobs.record import Record
from wfsobs.scenario.groups.events import Event, phase_turns, shift, strength, turbulence_time
from wfsobs.signal.autoregressive import Ar2, turbulence_corner
from wfsobs.signal.spectrum import bin_frequencies, random_phase_signal
from wfsobs.simulation.disturbance import interpolate_steps, make_disturbance, shift_peak, shift_process
from wfsobs.simulation.loop import integrate_commands
from wfsobs.simulation.sensing import lgs_weights
from wfsobs.telemetry.records import load_record, save_record

pytestmark = pytest.mark.slow

SHORT = {"run.duration": 3.0, "run.warm_up": 0.5, "gpr_online.training_size": 100, "gpr_offline.training_size": 100}


def changed(*events: dict[str, Any], **more: Any) -> Scenario:
    return PRESETS["paper"]().replace({**SHORT, **more, "events": list(events)})


# ---------------------------------------------------------------------- when what changes


def test_changes_add_up_and_multiply() -> None:
    """Two ramps that overlap and a jump, against the definition integrated step by step."""
    events = [
        Event(start=1.0, duration=2.0, frequency_shift=3.0, strength=0.5, wind_factor=2.0),
        Event(start=2.0, duration=4.0, frequency_shift=-5.0, strength=3.0, wind_factor=0.25),
        Event(start=2.5, frequency_shift=1.0, strength=2.0, wind_factor=3.0),
    ]
    t = np.linspace(0.0, 8.0, 80_001)
    one, two, jump = np.interp(t, [1, 3], [0, 1]), np.interp(t, [2, 6], [0, 1]), (t >= 2.5).astype(float)
    df = 3.0 * one - 5.0 * two + jump
    np.testing.assert_allclose(shift(events, t), df, atol=1e-12)
    np.testing.assert_allclose(strength(events, t), (1 - 0.5 * one) * (1 + 2 * two) * (1 + jump), atol=1e-12)
    blown = np.cumsum((1 + one) * (1 - 0.75 * two) * (1 + 2 * jump)) * 1e-4
    phase = np.cumsum(df) * 1e-4
    np.testing.assert_allclose(phase_turns(events, t), phase, atol=5e-4)  # of a sum of 8e4 terms, one step of the jump
    np.testing.assert_allclose(turbulence_time(events, t), blown, atol=5e-4)


# ---------------------------------------------------------------------- a peak moves


def test_a_jump_shifts_the_spectrum_bin_by_bin() -> None:
    """By a whole number of bins from the start: every bin has what the one below it had, times the strength."""
    n, dt, bins = 4000, 1e-3, 12
    power = np.where(np.abs(bin_frequencies(n, dt) - 40.0) < 30.0, np.random.default_rng(1).random(n // 2 + 1), 0.0)
    x = random_phase_signal(power, n, np.random.default_rng(2))
    y = shift_peak(x, [Event(start=0.0, frequency_shift=bins / (n * dt), strength=0.5)], dt)
    after = 2.0 * np.abs(np.fft.rfft(y) / n) ** 2
    np.testing.assert_allclose(after[bins:], 0.25 * power[:-bins], atol=1e-12)


@pytest.mark.parametrize("duration", [0.0, 0.7])
def test_a_pure_line_keeps_its_phase(duration: float) -> None:
    """A line that drifts or jumps is a cosine of the phase integrated by hand, without a step."""
    s = changed(
        {"kind": "peak", "start": 1.0, "duration": duration, "frequency_shift": 4.0, "strength": 2.0},
        **{"turbulence.source": "none", "vibration.peaks": [{"frequency": 30.0, "damping": 0.0, "rms": [0.1, 0.0]}]},
    )
    x = make_disturbance(s, s.n_steps, np.random.default_rng(3)).vibration[:, 0]
    t = np.arange(s.n_steps) * s.dt
    grown = np.clip((t - 1.0) / duration, 0, 1) if duration else (t >= 1.0).astype(float)
    late = np.clip(t - 1.0, 0, None)
    phase = 30.0 * t + 4.0 * (np.where(late < duration, late**2 / 2 / duration, late - duration / 2) if duration else late)
    basis = (1.0 + grown)[:, None] * np.column_stack([np.cos(2 * np.pi * phase), np.sin(2 * np.pi * phase)])
    found, *_ = np.linalg.lstsq(basis, x)
    np.testing.assert_allclose(basis @ found, x, atol=1e-12)
    assert np.hypot(*found) == pytest.approx(0.1 * sqrt(2), rel=1e-9)


@pytest.mark.parametrize(("frequency", "damping", "within"), [(47.5, 0.03, 0.01), (47.5, 1e-6, 1e-4), (200.0, 0.01, 0.005)])
def test_ends_of_a_process_leave_no_trace(frequency: float, damping: float, within: float) -> None:
    """The analytic signal of a piece of 5 s as good as that of 45 s around it, as a share of the rms, first period included."""
    process, dt, around = Ar2(2 * np.pi * frequency, damping, 1.0, 1e-3), 1e-3, 20_000
    x = process.sample(5000 + 2 * around, np.random.default_rng(4))
    jump = [Event(start=0.0, frequency_shift=3.0)]
    whole = shift_peak(x, jump, dt, around)[around:-around]
    error = shift_process(process, x[around:-around], jump) - whole
    assert np.sqrt(np.mean(error**2)) < within
    assert np.sqrt(np.mean(error[: round(1 / frequency / dt)] ** 2)) < within
    assert np.std(whole - x[around:-around]) > 0.5, "it did move"


@pytest.mark.parametrize("source", ["peaks", "ar2"])
def test_what_was_before_stays_and_so_do_the_others(source: str) -> None:
    """Up to the event the record is that of the same scenario whose event changes nothing; of the AR(2), that of none."""
    event = {"kind": "peak", "peak": 14, "start": 1.5}
    more = {"vibration.source": source}
    after, still = (simulate(changed(e, **more)) for e in ({**event, "frequency_shift": 3.0, "strength": 2.0}, event))
    assert after.vibration is not None and still.vibration is not None
    np.testing.assert_allclose(after.vibration[:1500], still.vibration[:1500], atol=1e-12)
    assert np.std(after.vibration[1500:] - still.vibration[1500:]) > 0.005
    np.testing.assert_array_equal(after.turbulence, still.turbulence)
    assert after.training is not None and still.training is not None
    np.testing.assert_array_equal(after.training.y_lgs, still.training.y_lgs)
    if source == "ar2":
        np.testing.assert_allclose(still.y_lgs, simulate(changed(**more)).y_lgs, atol=1e-12)


# ---------------------------------------------------------------------- the wind changes


@pytest.mark.parametrize("factor", [1.5, 2.0])
def test_frozen_flow_at_a_factor_is_frozen_flow_at_that_wind(factor: float) -> None:
    """From the start: the same waves, since a layer is a sum over its lengths; every star's. What differs is interpolation and
    the time that a step averages over, 0.01 nm of 500 nm together."""
    s = changed(
        **{
            "turbulence.source": "frozen-flow",
            "sensors.kind": "zernike",
            "vibration.source": "none",
            "turbulence.layers": [{"height": 4000.0}],
        }
    )
    warped = s.replace({"events": [{"kind": "wind", "start": 0.0, "wind_factor": factor}]})
    one = make_disturbance(warped, 3000, np.random.default_rng(5))
    other = make_disturbance(s.replace({"turbulence.wind_speed": 15.0 * factor}), 3000, np.random.default_rng(5))
    assert one.lgs_turbulence and other.lgs_turbulence and one.ngs_turbulence is not None
    for a, b in zip(
        (one.turbulence, one.ngs_turbulence, *one.lgs_turbulence),
        (other.turbulence, other.ngs_turbulence, *other.lgs_turbulence),
        strict=True,
    ):
        assert np.std(b) > 0.1 and np.sqrt(np.mean((a - b) ** 2)) < 1e-5


def test_reading_between_steps_errs_by_less_than_a_hundredth_of_the_noise() -> None:
    """Against band-limited interpolation, of turbulence at 30 m/s; the LGS together have 14 nm."""
    n, dt = 4096, 1e-3
    density = Ar2(turbulence_corner(30.0, 8.0, 1), 0.9, 0.5, dt).psd(bin_frequencies(n, dt))
    x = random_phase_signal(density / (n * dt), n, np.random.default_rng(6))
    at = np.random.default_rng(7).uniform(20, n - 20, 300)
    bins = np.fft.rfft(x)[1 : n // 2] * (2.0 / n)
    exact = (np.exp(2j * np.pi * np.outer(at, np.arange(1, n // 2)) / n) @ bins).real
    assert 1e-6 < np.std(interpolate_steps(x, at) - exact) < 0.14e-3


def test_a_wind_that_falls_or_stays_leaves_what_was_before() -> None:
    quiet, falls, stays = (
        simulate(changed(*e))
        for e in ([], [{"kind": "wind", "start": 2.0, "wind_factor": 0.3}], [{"kind": "wind", "start": 2.0}])
    )
    np.testing.assert_allclose(quiet.y_lgs[:2000], falls.y_lgs[:2000], atol=1e-12)
    np.testing.assert_allclose(quiet.y_lgs, stays.y_lgs, atol=1e-12)
    assert falls.turbulence is not None and quiet.turbulence is not None
    steps = [np.std(np.diff(r.turbulence[2000:], axis=0)) for r in (falls, quiet)]
    assert 0.2 < steps[0] / steps[1] < 0.45, "slower by 0.3"


def test_wind_that_grows_costs_what_its_turbulence_costs() -> None:
    s = PRESETS["ut4"]()
    grown = s.replace({"events": [{"kind": "wind", "start": 0.0, "wind_factor": 4.0}]})
    longer = s.replace({"run.duration": 40.0, "gpr_online.training_size": 2})
    assert run_seconds(s) < run_seconds(grown) < run_seconds(s) + run_seconds(longer)
    assert run_bytes(grown) - run_bytes(s) == pytest.approx(2 * 140.0 * 30_000, rel=1e-3)


# ---------------------------------------------------------------------- lasers and frames

NOISE_ALONE = {
    "turbulence.source": "none",
    "vibration.source": "none",
    "sensors.lgs_low_frequency_rms": 0.0,
    "loop.closed": False,
}


def test_fewer_lasers_are_noisier_and_none_are_nothing() -> None:
    r = simulate(
        changed(
            {"kind": "laser", "start": 1.0, "duration": 1.0}, {"kind": "laser", "start": 1.5, "duration": 0.25}, **NOISE_ALONE
        )
    )
    both, one = r.y_lgs[:1000].std(), r.y_lgs[1000:1500].std()
    assert both == pytest.approx(0.02 / sqrt(2), rel=0.08) and one == pytest.approx(0.02, rel=0.08)  # 3.5 sigma of 1000, 2000
    assert np.flatnonzero(np.isnan(r.y_lgs[:, 0])).tolist() == list(range(1500, 1750)) and r.missing == 250
    assert r.y_lgs[1750:2000].std() == pytest.approx(0.02, rel=0.12)
    without = simulate(changed(**NOISE_ALONE))
    np.testing.assert_array_equal(r.y_lgs[2000:], without.y_lgs[2000:])


def test_the_weights_of_those_left_are_those_of_so_many() -> None:
    """The first star stands where one alone would; of minimum variance."""
    s = changed(
        **{
            "turbulence.source": "frozen-flow",
            "sensors.lgs_combination": "minimum-variance",
            "sensors.lgs_radius": 20.0,
            "sensors.kind": "zernike",
        }
    )
    np.testing.assert_allclose(lgs_weights(s, 1), lgs_weights(s.replace({"sensors.lgs_count": 1})), rtol=1e-9)
    r = simulate(s.replace({"events": [{"kind": "laser", "start": 1.0, "duration": 1.0}]}))
    assert not r.missing


def test_frames_are_lost_at_random_in_their_time() -> None:
    r = simulate(
        changed(
            {"kind": "frames", "start": 1.0, "duration": 1.0, "share": 0.3},
            {"kind": "frames", "start": 0.5, "duration": 2.0, "share": 0.5, "sensor": "ngs"},
        )
    )
    lost = np.isnan(r.y_lgs).any(axis=1)
    assert not lost[:1000].any() and not lost[2000:].any()
    assert abs(lost.sum() - 300) < 4 * sqrt(1000 * 0.3 * 0.7)
    assert r.y_ngs is not None
    frames = np.isnan(r.y_ngs[5::5]).any(axis=1)
    assert not frames[:99].any() and not frames[499:].any()
    assert abs(frames.sum() - 200) < 4 * sqrt(400 * 0.25)
    whole = simulate(changed())
    np.testing.assert_allclose(r.y_lgs[:1000], whole.y_lgs[:1000], atol=1e-12)  # by a loop, not a filter


def test_the_integrator_holds_its_command_where_a_frame_is_lost() -> None:
    rng = np.random.default_rng(8)
    y, nothing = rng.standard_normal((400, 2)), np.full((1, 2), np.nan)
    np.testing.assert_allclose(
        integrate_commands(np.vstack([y, nothing]), 0.3, 0.99)[:400], integrate_commands(y, 0.3, 0.99), atol=1e-12
    )
    y[rng.random(y.shape) < 0.3] = np.nan
    u = integrate_commands(y, 0.3, 0.99)
    for mode in (0, 1):
        for k in range(2, 400):
            measured = y[k, mode] + u[k - 2, mode]
            expected = u[k - 1, mode] if np.isnan(measured) else 0.99 * u[k - 1, mode] - 0.3 * measured
            assert u[k, mode] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("rate", [10.0, 20.0])
def test_a_record_of_a_step_or_two_may_have_events(rate: float) -> None:
    s = Scenario.from_dict(
        {
            "run": {"duration": 0.1, "warm_up": 0.0},
            "sensors": {"lgs_rate": rate},
            "gpr_offline": {"training_size": 2, "depth": 1},
            "vibration": {"source": "ar2", "peaks": [{"frequency": 2.0}]},
            "kalman": {"frequency": 2.0},
            "butterworth": {"frequencies": [2.0]},
            "events": [
                {"kind": "peak", "start": 0.0, "frequency_shift": 1.0},
                {"kind": "wind", "start": 0.0, "wind_factor": 3.0},
                {"kind": "laser", "start": 0.0, "duration": 1.0, "lasers": 2},
            ],
        }
    )
    record = simulate(s)
    assert record.n_steps == record.missing == round(rate / 10) and record.vibration is not None
    assert np.isfinite(record.vibration).all()


# ---------------------------------------------------------------------- who sees it, and who is not told

BROKEN = (
    {"kind": "laser", "start": 1.0, "duration": 0.3, "lasers": 2},
    {"kind": "frames", "start": 1.5, "duration": 1.0, "share": 0.3},
    {"kind": "frames", "start": 1.5, "duration": 1.0, "share": 0.3, "sensor": "ngs"},
)


@pytest.fixture(scope="module")
def broken() -> tuple[Scenario, Record]:
    s = changed(
        *BROKEN,
        {"kind": "wind", "start": 1.2, "wind_factor": 1.5},
        {"kind": "peak", "peak": 14, "start": 1.2, "frequency_shift": 3.0},
    )
    return s, simulate(s)


def test_no_observer_is_told(broken: tuple[Scenario, Record]) -> None:
    """The same record, with the events in the settings and without: the same estimates, none of them NaN once it has begun."""
    s, record = broken
    told, not_told = observe(record, s), observe(record, s.replace({"events": []}))
    assert {e.observer for e in told.estimates} <= set(OBSERVERS) and len(told.estimates) == len(not_told.estimates) >= 17
    for a, b in zip(told.estimates, not_told.estimates, strict=True):
        np.testing.assert_array_equal(a.values, b.values, err_msg=a.observer)
        known = ~np.isnan(a.values[:, 0])
        assert known.any() and known[np.argmax(known) : -1].all(), a.observer
    both = sum(len(OBSERVERS[name].targets) == 2 for name in {e.observer for e in told.estimates})
    assert len(told.scores) == 2 * (len(told.estimates) + both) and all(np.isfinite(x.rms) for x in told.scores)


def test_the_loop_runs_with_the_laws_of_before(broken: tuple[Scenario, Record]) -> None:
    s, record = broken
    names = ["integrator", "lqg-kf-multi", "lqg-multirate-optimal"]
    plan, before = design(s, names), design(s.replace({"events": []}), names)
    assert plan.bounds == {} and set(before.bounds) == {BOUND, BOUND_BOTH}
    for name in names:
        for one, other in zip(plan.laws[name], before.laws[name], strict=True):
            assert one.law and other.law and one.law.gain == other.law.gain
            np.testing.assert_array_equal(one.law.poles, other.law.poles)
            assert one.predicted_rms is None
    found = rows(closed_loop(record, plan), 1)
    assert record.turbulence is not None
    assert all(0 < r["residual_rms_nm"] < 1e3 * record.turbulence.std() for r in found) and len(found) == 6


def test_there_is_no_bound_where_spectra_change(broken: tuple[Scenario, Record]) -> None:
    s, record = broken
    assert record_bounds(s, record) == [] and record_bounds(s.replace({"events": []}), record)


def test_records_with_events_are_files_like_others(broken: tuple[Scenario, Record], tmp_path: Path) -> None:
    s, record = broken
    save_record(tmp_path / "r.npz", record)
    again = load_record(tmp_path / "r.npz", s)
    np.testing.assert_array_equal(again.y_lgs, record.y_lgs)
    np.testing.assert_array_equal(again.y_ngs, record.y_ngs)
    assert again.missing == record.missing > 300


def test_a_record_with_lost_frames_can_be_identified() -> None:
    s = changed({"kind": "frames", "start": 0.0, "duration": 2.0, "share": 0.1}, **{"vibration.source": "none"})
    found = identify(simulate(s))
    assert [0.012 < mode.spectrum.noise < 0.017 for mode in found.modes] == [True, True]
    assert found.scenario(s).events == []


# ---------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("event", "more", "says"),
    [
        ({"start": 3.0}, {}, "events.0.start = 3: must be below run.duration = 3 s"),
        ({"start": 1.0, "kind": "laser"}, {}, "events.0.duration = 0: takes a number above 0 s, for kind laser"),
        ({"start": 1.0, "kind": "frames"}, {}, "events.0.duration = 0: takes a number above 0 s, for kind frames"),
        (
            {"start": 1.0, "duration": 1.0, "kind": "laser", "lasers": 3},
            {},
            "events.0.lasers = 3: takes up to sensors.lgs_count = 2",
        ),
        ({"start": 1.0, "peak": 15}, {}, "events.0.peak = 15: vibration.peaks has 15 entries, numbered from 0"),
        ({"start": 1.0}, {"vibration.source": "measured"}, "events.0.kind = peak: takes vibration.source = peaks or ar2, not"),
        ({"start": 1.0, "peak": 14, "frequency_shift": -48.0}, {}, "events.0.frequency_shift = -48: moves peak 14 to -0.56 Hz"),
        ({"start": 1.0, "peak": 14, "frequency_shift": 460.0}, {}, "it must stay between 0 and half the LGS rate, 500 Hz"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(event: dict[str, Any], more: dict[str, Any], says: str) -> None:
    with pytest.raises(SettingError) as caught:
        changed(event, **more).validate()
    assert says in str(caught.value) and "\n" not in str(caught.value)


def test_a_peak_must_stay_in_range_all_through() -> None:
    """Up by a ramp and down by a jump at its end: out of range before, not after."""
    up = {"start": 0.5, "duration": 1.0, "peak": 14, "frequency_shift": 460.0}
    down = {"start": 1.5, "peak": 14, "frequency_shift": -460.0}
    with pytest.raises(SettingError, match=r"moves peak 14 to 507\.44 Hz"):
        changed(up, down).validate()
    changed({**up, "start": 2.6}).validate()  # the record is over before


def test_work_that_wind_asks_for_is_bounded() -> None:
    gale = {"kind": "wind", "start": 0.0, "wind_factor": 10.0}
    changed(gale).validate()
    with pytest.raises(SettingError, match="at most 10 times as much"):
        changed(gale, {**gale, "wind_factor": 1.2}).validate()
