"""Error budgets: they add up, and every term is alone where its cause is the only one."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.linalg import solve_discrete_lyapunov

import wfsobs
from tests.records import kalman_model
from wfsobs.cli import main
from wfsobs.evaluation.budget import AVERAGED, TERMS, Budget, error_budget, shapley_shares, split_lines, split_record
from wfsobs.evaluation.result import Result
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.observers.kalman.filters import steady_filter
from wfsobs.pipeline import run
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.autoregressive import Ar2
from wfsobs.simulation.loop import simulate, simulate_noise

LINEAR = ("kf-lgs", "kf-ngs", "multirate", "multirate-optimal", "ridge", "ridge-30", "butterworth-cl", "persistence")
QUIET_SKY = {
    "turbulence.source": "none",
    "vibration.source": "none",
    "sensors.lgs_noise": 0.0,
    "sensors.ngs_noise": 0.0,
    "sensors.lgs_low_frequency_rms": 0.0,
    "kalman.process_noise": "manual",
    "kalman.turbulence_rms": 0.5,
    "kalman.vibration_rms": 0.06,
    "kalman.measurement_noise": "manual",
    "run.warm_up": 1.0,
}
"""Nothing happens and nothing is measured, and the filters do not know."""


def quiet(**changes: object) -> Scenario:
    return PRESETS["paper"]().replace(QUIET_SKY | {name.replace("__", "."): value for name, value in changes.items()})


def budgets(scenario: Scenario, *observers: str) -> list[Budget]:
    return error_budget(without_bounds(scenario, observers), observers=observers)


def without_bounds(scenario: Scenario, observers: Sequence[str]) -> Result:
    """A run whose bounds, which take longer than all else, nobody looks at."""
    return wfsobs.observe(simulate(scenario), scenario, observers=observers, gate=False)


def assert_adds_up(found: Iterable[Budget]) -> None:
    # Rounding only: the terms of a linear observer are exact, and so are averages over all orders.
    for it in found:
        assert sum(it.terms.values()) == pytest.approx(it.total, rel=1e-6), it


SOON = {
    "lost-frames": [
        {"kind": "frames", "start": 0.6, "duration": 0.3, "sensor": "lgs", "share": 0.5},
        {"kind": "frames", "start": 1.0, "duration": 0.3, "sensor": "ngs", "share": 0.5},
    ],
    "laser-dropout": [
        {"kind": "laser", "start": 0.6, "duration": 0.3, "lasers": 1},
        {"kind": "laser", "start": 1.0, "duration": 0.15, "lasers": 2},
    ],
}
"""What happens in these presets, in a record of 1.5 s."""

BRIEF = {
    "run.duration": 1.5,
    "run.warm_up": 0.5,
    "gpr_offline.training_size": 40,
    "gpr_offline.depth": 30,
    "adaptive.window": 0.4,
}
"""Long enough for what is exact."""


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "ut4", "galacsi-nfm", "lost-frames", "laser-dropout"])
def test_the_terms_add_up_to_the_mean_square_error_of_the_table(preset: str) -> None:
    scenario = PRESETS[preset]().replace({**BRIEF, "events": SOON.get(preset, [])})
    if preset == "galacsi-nfm":
        scenario = scenario.replace({"sensors.kind": "zernike"})  # ut4 has lenslets; those of four stars take long
    result = without_bounds(scenario, LINEAR)
    found = error_budget(result)
    scores = {(s.observer, s.target, s.mode): s.rms**2 for s in result.scores}
    assert {(b.observer, b.target, b.mode): b.total for b in found} == scores
    assert_adds_up(found)


def test_a_filter_of_many_lines_adds_up_and_has_none_that_is_not_modelled() -> None:
    found = budgets(PRESETS["paper"]().replace(BRIEF), "kf-multi")
    assert_adds_up(found)
    # Nothing but rounding: every line is in the model, so that this source is empty.
    assert max(abs(b.terms["lines"]) for b in found) < 1e-15


@pytest.mark.slow
def test_observers_that_are_not_linear_add_up_too_if_they_are_named() -> None:
    scenario = PRESETS["paper"]().replace(BRIEF)
    result = without_bounds(scenario, ["gpr-offline", "kf-adaptive"])
    assert {b.reason for b in error_budget(result)} == {"not linear, takes 16 runs: only if named"}
    found = error_budget(result, observers=["gpr-offline", "kf-adaptive"], mode="tip")
    assert {(b.observer, b.mode, b.method) for b in found} == {(n, "tip", AVERAGED) for n in ("gpr-offline", "kf-adaptive")}
    assert_adds_up(found)


def test_the_budget_of_a_mode_does_not_depend_on_which_others_are_asked_for() -> None:
    scenario = PRESETS["paper"]().replace(BRIEF)
    names = [*LINEAR, "gpr-offline"]
    result = without_bounds(scenario, names)
    every = error_budget(result, observers=names)
    for mode in ("tip", "tilt"):
        for one, it in zip(error_budget(result, observers=names, mode=mode), [b for b in every if b.mode == mode], strict=True):
            assert (one.observer, one.target, one.total) == (it.observer, it.target, it.total)
            assert one.terms == pytest.approx(it.terms, abs=1e-12 * it.total)  # rounding


def test_an_observer_that_looks_ahead_has_no_budget() -> None:
    (one, _) = budgets(PRESETS["paper"]().replace({"run.duration": 2.0}), "butterworth-ol")
    assert one.reason == "looks ahead" and not one.terms


def only(term: str, found: Iterable[Budget], least: float = 1.0 - 1e-9) -> None:
    """All of the errors is this term, or the share `least`."""
    for it in found:
        assert it.total > 0
        assert it.terms[term] / it.total == pytest.approx(1.0, abs=1.0 - least + 1e-9), it
        assert all(abs(value) <= (1.0 - least + 1e-9) * it.total for name, value in it.terms.items() if name != term), it


@pytest.mark.slow
def test_noise_alone_is_noise_of_the_size_that_the_gain_gives() -> None:
    scenario = quiet(sensors__lgs_noise=0.02, sensors__ngs_noise=0.01, run__duration=100.0)
    found = budgets(scenario, *LINEAR[:4])
    only("noise", found)
    model, r = kalman_model(scenario, 0, scenario.dt), 0.02**2 / 2  # the mean of two LGS
    F, G, H, J = steady_filter(model, scenario.kalman.lgs_noise)[0].steps[0]
    P = solve_discrete_lyapunov(F, r * G @ G.T)
    expected = np.diag(H @ P @ H.T + r * J @ J.T)
    for target, variance in zip(("turbulence", "vibration"), expected, strict=True):
        one = next(b for b in found if (b.observer, b.target, b.mode) == ("kf-lgs", target, "tip"))
        # 100 s of noise in a band of 10 Hz or more: 2000 independent values, a deviation of 3 % of the variance; four of them.
        assert one.terms["noise"] == pytest.approx(variance, rel=0.12)


def test_the_slow_error_of_the_lgs_alone_is_cone_effect() -> None:
    only("cone", (b for b in budgets(quiet(sensors__lgs_low_frequency_rms=0.049, run__duration=3.0), "kf-lgs", "multirate")))


@pytest.mark.slow
def test_a_line_that_is_not_modelled_is_that() -> None:
    peak = [{"frequency": 20.0, "damping": 0.01, "rms": [0.02, 0.02]}]
    only("lines", budgets(quiet(vibration__source="peaks", vibration__peaks=peak, run__duration=3.0), "kf-lgs", "kf-ngs"))


def test_a_line_in_a_right_model_without_noise_is_lag_of_one_step() -> None:
    peak = [{"frequency": 30.0, "damping": 0.05, "rms": [0.02, 0.02]}]
    scenario = quiet(vibration__source="ar2", vibration__peaks=peak, run__duration=11.0).replace(
        {"kalman.process_noise": "matched", "kalman.measurement_noise": "matched", "kalman.peak": "matched"}
    )
    found = [b for b in budgets(scenario, "kf-lgs") if b.target == "vibration"]
    only("lag", found)
    step = Ar2(2.0 * np.pi * 30.0, 0.05, 0.02, scenario.dt)
    for it in found:
        # What drives the process in a step is white: 10,000 values, a deviation of 1.4 %; four of them.
        assert it.terms["lag"] == pytest.approx(step.unit_drive_variance * step.rms**2, rel=0.057)


def test_a_line_at_the_wrong_frequency_in_the_model_is_mismatch() -> None:
    peak = [{"frequency": 47.5, "damping": 0.0, "rms": [0.02, 0.02]}]
    changes = {"kalman.frequency": 46.5, "kalman.damping": 0.001, "kalman.vibration_rms": 0.02, "kalman.lgs_noise": 0.1}
    scenario = quiet(vibration__source="peaks", vibration__peaks=peak, run__duration=3.0).replace(changes)
    # The filter of the right model follows a pure line that has no noise but for its width of 0.025 Hz.
    only("mismatch", (b for b in budgets(scenario, "kf-lgs") if b.target == "vibration"), 0.99)


def test_the_right_model_has_no_mismatch() -> None:
    peak = [{"frequency": 30.0, "damping": 0.05, "rms": [0.02, 0.02]}]
    matched = dict.fromkeys(("kalman.process_noise", "kalman.measurement_noise", "kalman.peak"), "matched")
    changes = {"vibration.source": "ar2", "vibration.peaks": peak, "sensors.lgs_low_frequency_rms": 0.0, "run.duration": 4.0}
    for it in budgets(PRESETS["paper"]().replace(matched | changes), "kf-lgs"):
        # The same filter twice: what is left is the precision of the Riccati equation.
        assert abs(it.terms["mismatch"]) < 1e-6 * it.total
        assert it.terms["lines"] == 0.0
        assert min(it.terms["noise"], it.terms["lag"]) > 0.05 * it.total


BOTH_RIGHT = {
    "two processes": PRESETS["paper"](),
    "other beams": PRESETS["ut4"]().replace({"multipeak.turbulence_order": 3, "sensors.kind": "zernike"}),
    **{name: PRESETS["paper"]().replace({"events": events, "run.warm_up": 0.5}) for name, events in SOON.items()},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SOON)
def test_a_missing_measurement_is_none_to_the_filter_of_the_right_model(name: str) -> None:
    for it in budgets(BOTH_RIGHT[name].replace({"run.duration": 1.5}), "kf-multi"):
        assert abs(it.terms["mismatch"]) < 1e-6 * it.total, it


@pytest.mark.slow
@pytest.mark.parametrize("name", BOTH_RIGHT)
def test_a_filter_of_both_sensors_whose_model_is_right_has_no_mismatch(name: str) -> None:
    """With the slow error of the LGS, which both sensors together tell from the turbulence."""
    for it in budgets(BOTH_RIGHT[name].replace({"run.duration": 1.5 if name in SOON else 4.0}), "multirate-multi"):
        # The same filter twice: what is left is the precision of the Riccati equation.
        assert abs(it.terms["mismatch"]) < 1e-6 * it.total, it
        assert it.terms["noise"] + it.terms["lag"] > 0.5 * it.total


def test_the_bound_beside_a_budget_is_that_of_what_the_observer_measures() -> None:
    scenario = PRESETS["paper"]().replace({"run.duration": 2.0})
    result = run(scenario, observers=["kf-lgs", "kf-ngs", "multirate-optimal"])
    least = {(s.observer, s.target, s.mode): s.rms**2 for s in result.scores if s.observer in BOUNDS}
    own = {"kf-lgs": "bound", "multirate-optimal": "bound-both"}
    for it in error_budget(result):
        # No bound of the NGS alone is computed.
        assert it.bound == (least[own[it.observer], it.target, it.mode] if it.observer in own else None)


def test_the_sources_are_the_record() -> None:
    scenario = PRESETS["lost-frames"]().replace({"run.duration": 14.0})
    record = simulate(scenario)
    sources = split_record(record, simulate_noise(scenario), [[17.25, 47.44]] * 2, [[47.44]] * 2)
    seen = [source.measurement for source in sources.values()]
    assert record.open_loop_y is not None
    np.testing.assert_allclose(sum(one.lgs for one in seen), record.open_loop_y, rtol=0, atol=1e-12)
    np.testing.assert_allclose(sum(one.ngs for one in seen), record.z_ngs, rtol=0, atol=1e-12)
    for target in ("turbulence", "vibration"):
        np.testing.assert_allclose(sum(s.truth[target] for s in sources.values()), record.truth(target), rtol=0, atol=1e-12)


def test_each_frequency_belongs_to_the_nearest_line() -> None:
    t = np.arange(2000) * 1e-3
    tones = {f: np.cos(2.0 * np.pi * f * t) for f in (10.0, 14.0, 16.0, 40.0)}
    known = split_lines(sum(tones.values()), 1e-3, [10.0, 20.0], [10.5])
    np.testing.assert_allclose(known, tones[10.0] + tones[14.0], atol=1e-9)


def test_the_average_over_orders_shares_what_two_causes_do_together() -> None:
    """The estimate x y + z: x and y have half of it each (Shapley's symmetry)."""
    values = {"x": 3.0, "y": 2.0, "z": 5.0}

    def estimate(names: Iterable[str]) -> dict[str, np.ndarray]:
        of = set(names)
        return {"a": np.array([6.0 * ({"x", "y"} <= of) + values["z"] * ("z" in of)])}

    share = shapley_shares(tuple(values), estimate, estimate(()))
    assert [float(share[name]["a"][0]) for name in values] == pytest.approx([3.0, 3.0, 5.0])


def test_a_record_that_was_not_simulated_from_its_scenario_is_refused() -> None:
    result = run(PRESETS["paper"]().replace({"run.duration": 2.0}), observers=["kf-lgs"])
    for other in (replace(result, record=replace(result.record, vibration=None)), replace(result, scenario=PRESETS["paper"]())):
        with pytest.raises(ValueError, match="takes a record that was simulated from its scenario"):
            wfsobs.error_budget(other)


def call(*arguments: str):
    return CliRunner().invoke(main, arguments)


SHORT = ("--set", "run.duration=1.5", "--set", "run.warm_up=0.5")
FEW = tuple(f"--observer={name}" for name in ("kf-lgs", "multirate", "butterworth-ol", "butterworth-cl", "zero"))


@pytest.mark.slow
def test_the_command_prints_a_table_and_adds_to_the_rows() -> None:
    out = call("run", *SHORT, *FEW, "--budget-of", "kf-lgs")
    assert out.exit_code == 0 and "Error budget: parts of the mean square error" in out.stdout
    assert all(label.split()[0] in out.stdout for label in TERMS.values())
    rows = json.loads(call("run", *SHORT, *FEW, "--budget", "--json").stdout)
    for row in chain(r for r in rows if r["observer"] == "kf-lgs"):
        assert sum(row["budget"]["terms_um2"].values()) == pytest.approx(row["rms_um"] ** 2, rel=1e-6)
    assert {r["budget"]["reason"] for r in rows if r["observer"] == "butterworth-ol"} == {"looks ahead"}
    out = call("run", *SHORT, "--set", "vibration.source=none", "--observer", "multirate-multi", "--budget")
    assert out.exit_code == 0 and re.search(r"vibration  . tip  [^\n]* 0\.00 . +0\.0 . +0\.0 +0 % ", out.stdout), (
        "an error of zero"
    )
    out = call("run", *SHORT, "--observer", "zero", "--budget-of", "kf-lgs")
    assert out.exit_code == 0 and "wfsobs: --budget-of kf-lgs: it did not run" in out.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--budget", "--seeds", "2"), "--budget: is of one record, without --over-time; leave --seeds at 1"),
        (("--budget-of", "kf"), "--budget-of kf: no such observer"),
    ],
)
def test_the_command_refuses_in_one_line(arguments: tuple[str, ...], said: str) -> None:
    out = call("run", *SHORT, *arguments)
    assert out.exit_code == 2 and out.stderr.startswith(f"wfsobs: {said}") and len(out.stderr.splitlines()) == 1
