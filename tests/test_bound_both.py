"""The bound of both sensors against Riccati covariances, exact estimates of finite records, regression and foreign figures."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import cholesky, solve_triangular, toeplitz

from tests.records import kalman_model
from wfsobs.evaluation.bound import NO_BOUND, bound, bound_rms, least_errors_of_both, record_bounds
from wfsobs.evaluation.result import can_be_best
from wfsobs.evaluation.scores import BOUND, BOUND_BOTH, COMMON_BOUNDS, SCORED
from wfsobs.observers.kalman.filters import optimal_cycle
from wfsobs.priors_from.scenario import measurement_noise
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.gains import periodic_steady_state
from wfsobs.simulation.disturbance import damping_for_width, line_width
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.sensing import lgs_error_process
from wfsobs.simulation.true_spectra import TrueSpectra, has_known_spectra, true_spectra
from wfsobs.typing import Array

# The truth is the model of `multirate-optimal`: AR(2) turbulence, one line, two LGS with slow errors of their own.
MATCHED = Scenario().replace(
    {
        "vibration.source": "ar2",
        "kalman.frequency": 47.5,
        "kalman.damping": 0.03,
        "vibration.peaks": [{"frequency": 47.5, "damping": 0.03, "rms": [0.05, 0.05]}],
        "sensors.lgs_low_frequency_rms": 0.05,
    }
)


def riccati_errors(scenario: Scenario) -> tuple[dict[str, Array], dict[str, Array]]:
    """Target -> rms errors of phi[k] and of phi[k + 1] at every phase, from the periodic Riccati equation of the true model."""
    model, ratio = kalman_model(scenario, 0, scenario.dt), scenario.sensors.exposure_ratio
    cycle = optimal_cycle(model, ratio, *measurement_noise(scenario, 0), [lgs_error_process(scenario, 0, scenario.dt)])
    states = periodic_steady_state(cycle)
    extra = len(states[0].P) - len(model.A)
    rows = {name: np.append(row, np.zeros(extra)) for name, row in model.outputs.items()}
    rows["total"] = sum(rows.values(), np.zeros(extra + len(model.A)))
    # The frame is at the last step of the cycle, so that step j is j steps after a frame.
    phases = [(j - 1) % ratio for j in range(ratio)]
    filtered = {name: np.array([np.sqrt(row @ states[j].posterior @ row) for j in phases]) for name, row in rows.items()}
    ahead = {name: np.array([np.sqrt(row @ states[(j + 1) % ratio].P @ row) for j in phases]) for name, row in rows.items()}
    return filtered, ahead


@settings(max_examples=10, deadline=None)
@given(
    ratio=st.sampled_from([1, 2, 5, 8]),
    wind=st.floats(4.0, 60.0),
    frequency=st.floats(5.0, 80.0),
    damping=st.floats(0.01, 0.5),
    vibration=st.floats(0.002, 0.2),
    slow=st.floats(0.001, 0.2),
    lgs=st.floats(0.005, 0.2),
    ngs=st.floats(0.002, 0.2),
)
def test_where_the_truth_is_its_model_it_is_the_error_of_the_optimal_filter(
    ratio: int, wind: float, frequency: float, damping: float, vibration: float, slow: float, lgs: float, ngs: float
) -> None:
    scenario = MATCHED.replace(
        {
            "sensors.exposure_ratio": ratio,
            "turbulence.wind_speed": wind,
            "vibration.peaks": [{"frequency": frequency, "damping": damping, "rms": [vibration]}],
            "kalman.frequency": frequency,
            "kalman.damping": damping,
            "sensors.lgs_low_frequency_rms": slow,
            "sensors.lgs_noise": lgs,
            "sensors.ngs_noise": ngs,
        }
    )
    spectra = true_spectra(scenario, 0)
    for ahead, expected in enumerate(riccati_errors(scenario)):
        for name, error in least_errors_of_both(spectra, ahead).items():
            # At half the DFT the narrowest line has exp(-10) of its correlation, which comes round.
            assert error.phases == pytest.approx(expected[name], rel=1e-3), (name, ahead)


def test_the_wrapped_line_is_all_that_differs_from_the_riccati_covariance() -> None:
    for ahead, expected in enumerate(riccati_errors(MATCHED)):
        for name, error in least_errors_of_both(true_spectra(MATCHED, 0), ahead).items():
            # conjugate gradients stop at 1e-4, wrong by its square of variances up to 100 times that of both together
            assert error.phases == pytest.approx(expected[name], rel=1e-5), (name, ahead)


@pytest.mark.parametrize(("frequency", "rms"), [(5.96, 1.0), (48.3, 0.3), (48.3, 0.1), (48.3, 0.03), (18.1, 1e-3)])
def test_of_a_narrow_line_however_strong_nothing_comes_round(frequency: float, rms: float) -> None:
    peak = {"frequency": frequency, "damping": 1e-4, "rms": [rms]}
    scenario = MATCHED.replace({"run.duration": 10.0, "vibration.peaks": [peak], "kalman.frequency": frequency})
    scenario = scenario.replace({"kalman.damping": damping_for_width(line_width(scenario), frequency, 1e-4)})
    for ahead, expected in enumerate(riccati_errors(scenario)):
        for name, error in least_errors_of_both(true_spectra(scenario, 0), ahead).items():
            # up to 3e-3 of the noise's variance comes round, of errors that are some 4e-2 of it
            assert error.phases == pytest.approx(expected[name], rel=4e-3), (name, ahead)


@pytest.mark.parametrize(
    "changes",
    [
        {"turbulence.wind_speed": 0.1, "sensors.lgs_rate": 5000.0},
        {"run.duration": 30.0, "vibration.peaks": [{"frequency": 5.96, "damping": 1e-4, "rms": [3.0]}]},
    ],
)
def test_where_more_would_come_round_there_is_no_bound(changes: dict[str, Any]) -> None:
    scenario = MATCHED.replace(changes)
    assert not has_known_spectra(scenario)
    with pytest.raises(ValueError, match=re.escape(NO_BOUND)):
        bound(scenario)


SLOW_RATE = MATCHED.replace(
    {
        "sensors.lgs_rate": 250.0,
        "vibration.source": "peaks",
        "vibration.cutoff": 60.0,
        "gpr_offline.training_size": 10,
        "gpr_offline.depth": 10,
    }
)
PEAKS = [{"frequency": 17.0, "damping": 0.02, "rms": [0.05]}, {"frequency": 31.0, "damping": 0.01, "rms": [0.02]}]
FLOW = {"turbulence.source": "frozen-flow", "sensors.kind": "zernike", "sensors.lgs_low_frequency_rms": 0.0}

RECORDS: dict[str, dict[str, Any]] = {
    "peaks": {"vibration.peaks": PEAKS},
    "pure line": {"vibration.peaks": [*PEAKS, {"frequency": 40.0, "damping": 0.0, "rms": [0.05]}]},
    "frozen flow": {**FLOW, "vibration.peaks": PEAKS},
    "slow flow": {**FLOW, "turbulence.wind_speed": 3.0, "vibration.source": "none"},
    "stars off the axis": {**FLOW, "vibration.peaks": PEAKS, "sensors.lgs_radius": 30.0, "sensors.ngs_direction": [20.0, -10.0]},
    "minimum variance": {**FLOW, "vibration.peaks": PEAKS, "sensors.lgs_combination": "minimum-variance"},
    "blind": {"vibration.peaks": PEAKS, "sensors.tip_tilt_indetermination": True},
}


def exact_errors(spectra: TrueSpectra, cycles: int, phase: int, ahead: int) -> dict[str, float]:
    """rms errors of the best estimate from `cycles` cycles of z and frames, the last frame `phase` steps old, by Cholesky.

    Covariances are summed here from those of single steps, frames as means of `ratio` of them.
    """
    known = spectra.without_lines
    ngs, n = known.ngs, known.ngs.ratio
    last = cycles * n + phase
    z, frames, mean = np.arange(1, last + 1), np.arange(n, last + 1, n), np.arange(1, n + 1)

    def covariance(spectrum: Array, lag: Array) -> Array:
        return np.fft.irfft(spectrum, 2 * (spectrum.size - 1))[lag]

    steps = frames[:, None] - mean  # that a frame has seen
    among = covariance(ngs.signal, np.abs(np.subtract.outer(np.arange(0, last, n), mean[:, None] - mean))).mean(axis=(1, 2))
    with_z = covariance(ngs.measurement_cross, steps[:, :, None] + 1 - z).mean(axis=1)
    measured = np.block(
        [
            [toeplitz(covariance(known.measurement, np.arange(last))), with_z.T],
            [with_z, toeplitz(among[: frames.size]) + ngs.noise * np.eye(frames.size)],
        ]
    )
    names = list(known.signal)
    wanted = [
        np.concatenate(
            [
                covariance(known.cross[name], last + ahead + 1 - z),
                covariance(ngs.cross[name], last + ahead - steps).mean(axis=1),
            ]
        )
        for name in names
    ]
    explained = solve_triangular(cholesky(measured, lower=True), np.array([*wanted, np.sum(wanted, axis=0)]).T, lower=True)
    own = [covariance(known.signal[name], np.array(0)) for name in names]
    left = np.array([*own, sum(own)]) - np.sum(explained**2, axis=0)
    return dict(zip([*names, "total"], np.sqrt(left).tolist(), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("case", RECORDS)
def test_the_best_estimate_of_a_long_record_comes_near_from_above(case: str) -> None:
    spectra = true_spectra(SLOW_RATE.replace(RECORDS[case]), 0)
    for phase, ahead in ((0, 0), (3, 1)):
        least = least_errors_of_both(spectra, ahead)
        short, long = (exact_errors(spectra, cycles, phase, ahead) for cycles in (200, 400))
        for name, exact in long.items():
            assert least[name].phases[phase] <= exact * (1 + 1e-4), "what wraps around the DFT"
            # What a record of 8 s leaves more than an endless one falls as the inverse of its length; in slow air even slower.
            endless = np.sqrt(2.0 * exact**2 - short[name] ** 2)
            assert least[name].phases[phase] == pytest.approx(endless, rel=2e-3 if case == "slow flow" else 1e-3), (name, phase)


@pytest.mark.slow
def test_regression_on_a_long_record_comes_near_from_above() -> None:
    """The synthesis, both sensors and the spectra together: 200 s to learn from, 200 s to be scored on."""
    scenario = SLOW_RATE.replace(
        {**RECORDS["stars off the axis"], "vibration.peaks": PEAKS[:1], "loop.closed": False, "run.duration": 400.0}
    )
    n, phase = scenario.sensors.exposure_ratio, 2
    record = simulate(scenario)
    assert record.y_ngs is not None and record.turbulence is not None and record.vibration is not None
    at = np.arange(60 * n + phase, record.n_steps, n)
    inputs = np.hstack([record.z[at[:, None] - np.arange(120), 0], record.y_ngs[(at - phase)[:, None] - n * np.arange(40), 0]])
    truth = np.column_stack([record.turbulence[at, 0], record.vibration[at, 0]])
    half = len(at) // 2
    found = np.linalg.lstsq(inputs[:half], truth[:half], rcond=None)[0]
    error = np.sqrt(np.mean((inputs[half:] @ found - truth[half:]) ** 2, axis=0))
    least = least_errors_of_both(true_spectra(scenario, 0))
    for name, rms in zip(("turbulence", "vibration"), error, strict=True):
        # 160 coefficients from 9900 equations: 0.8 % above; 9900 errors, alike over some five: 1.6 % at one sigma; 0.5 s of taps.
        assert rms == pytest.approx(least[name].phases[phase] * 1.008, rel=0.05), name


FIGURES = {
    ("paper", 0): {"turbulence": (15.10, 13.99), "vibration": (10.82, 9.40)},
    ("ut4", 0): {"turbulence": (11.12, 8.78), "vibration": (6.30, 5.69)},
    ("galacsi-nfm", 0): {"turbulence": (11.72, 11.15), "vibration": (7.19, 7.26)},
    ("galacsi-wfm", 0): {"turbulence": (11.29, 10.77), "vibration": (5.84, 5.79)},
    ("ut4", 1): {"total": (9.70, 8.87)},
}
"""(preset, steps ahead) -> tip and tilt of lifted Wiener filters of 10 to 40 s, computed apart from this project [nm]."""


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "ahead"), FIGURES)
def test_filters_of_many_seconds_come_near_from_above(preset: str, ahead: int) -> None:
    scenario = PRESETS[preset]()
    for mode in range(2):
        least = bound_rms(scenario, mode, ahead, information="both")
        for target, figures in FIGURES[preset, ahead].items():
            # Two decimals. Lines 1/160 Hz wide have a memory of 50 s, so that a filter of 10 s leaves up to 0.5 % more.
            assert -0.006 < figures[mode] - 1e3 * least[target] < 0.005 + 0.005 * figures[mode], (mode, target)


def test_more_sensors_leave_less_and_worse_ones_more() -> None:
    scenario = PRESETS["paper"]()
    noisy = [scenario.replace({"sensors.ngs_noise": noise}) for noise in (0.005, 0.01, 0.05, 10.0)]
    noises = [bound_rms(one, 0, information="both") for one in noisy]
    alone = bound_rms(scenario, 0)
    for target, least in alone.items():
        errors = [found[target] for found in noises]
        assert errors == sorted(errors) and errors[-1] <= least
        # a frame of 10 um of noise against 37 nm, some 20 of them alike: 3e-4 of the information
        assert errors[-1] == pytest.approx(least, rel=1e-3)


def test_frames_that_see_what_the_lasers_see_not() -> None:
    """Without tip and tilt in the LGS the turbulence is known from the NGS alone."""
    blind = PRESETS["paper"]().replace({"sensors.tip_tilt_indetermination": True, "vibration.source": "none"})
    seeing = blind.replace({"sensors.tip_tilt_indetermination": False, "sensors.lgs_noise": 10.0})
    expected = bound_rms(seeing, 0, information="both")
    # 10 um of noise in an LGS tell 1e-5 of what a frame does
    assert bound_rms(blind, 0, information="both")["turbulence"] == pytest.approx(expected["turbulence"], rel=1e-3)


def test_events_have_none_and_no_bound_is_best() -> None:
    scenario = PRESETS["lost-frames"]()
    record = simulate(scenario)
    assert record_bounds(scenario, record) == []
    found = record_bounds(scenario.before_events, record)
    assert {bound.row for bound in found} == set(COMMON_BOUNDS) and not can_be_best(BOUND_BOTH, False)


@pytest.mark.slow
def test_what_is_remembered_is_of_these_settings() -> None:
    scenario = PRESETS["paper"]().replace({"run.duration": 2.0})
    for changed in ({"run.seed": 7}, {"turbulence.wind_speed": 30.0}, {"sensors.lgs_noise": 0.01}, {"run.duration": 3.0}):
        record_bounds(scenario, simulate(scenario))  # in the memory before each
        other = scenario.replace(changed)
        found = {(it.row, it.target, it.column): it.error.rms for it in record_bounds(other, simulate(other))}
        for mode in range(2):
            both, alone = bound_rms(other, mode, information="both"), bound_rms(other, mode)
            for target in SCORED:
                assert found[BOUND_BOTH, target, mode] == both[target], changed
                assert found[BOUND, target, mode] == alone[target], changed
