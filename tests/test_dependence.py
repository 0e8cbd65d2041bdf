"""What results depend on: what is known is what a run would give, bit by bit, and nothing else runs."""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Collection
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import param
import pytest

from tests.records import ON_PAPER
from wfsobs.dependence import Memo, RecordMemo, digest, observers_reached, record_digest, simulate_once
from wfsobs.evaluation.bound import record_bounds
from wfsobs.evaluation.result import Failure
from wfsobs.execution import each_estimate
from wfsobs.observers import OBSERVERS
from wfsobs.priors_from.scenario import prior_and_settings, usual_observers
from wfsobs.record import Estimate, Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.scenario.scenario import idle_settings, used_settings, why_idle_at
from wfsobs.settings.values import Reals, SettingError
from wfsobs.simulation.loop import record_settings, simulate, training_settings
from wfsobs.testing import QUICK

BASE = PRESETS["paper"]().replace({**QUICK, "run.duration": 0.6})

SOURCES: dict[str, dict[str, Any]] = {
    "paper": {},
    "frozen-flow": {"turbulence.source": "frozen-flow", "sensors.lenslets.lgs_subapertures": 8, "vibration.source": "ar2"},
    "ideal sensors": {"turbulence.source": "frozen-flow", "sensors.kind": "zernike", "kalman.peak": "matched"},
    "photons": {"sensors.noise_from": "photons", "turbulence.source": "ar3", "sensors.lgs_combination": "minimum-variance"},
    "processes": {"turbulence.source": "processes", "vibration.source": "measured", "loop.closed": False},
    "tables": {
        "turbulence.source": "psd",
        "turbulence.psd": {"frequency": [0.0, 50.0, 400.0], "tip": [1e-3, 1e-5, 0.0], "tilt": [1e-3, 1e-5, 0.0]},
        "vibration.source": "none",
        "multipeak.turbulence_order": 2,
    },
    "second order modes": {"telescope.radial_order": 2, "kalman.peak": "matched", "multirate.measurement_noise": "manual"},
    "nothing": {"turbulence.source": "none", "vibration.source": "none"},
}
"""Between them every source, sensor and choice."""


def scenario_of(name: str) -> Scenario:
    return BASE.replace(SOURCES[name])


def other_values(p: param.Parameter, value: Any) -> list[Any]:
    """Return other values that a setting takes, the nearest first."""
    if isinstance(p, param.Boolean):
        return [not value]
    if isinstance(p, param.Selector):
        return [v for v in p.objects if v != value]
    if isinstance(p, Reals):
        return [[1.01 * v for v in value], [0.5 * v for v in value], [*value, 1.0]]
    if isinstance(p, param.Integer):
        return [value + 1, value - 1]
    return [1.01 * value, 0.99 * value, 0.5]


def changes_of(scenario: Scenario, below: Collection[str] = ("",)) -> dict[str, Scenario]:
    """Return the scenario with one setting changed, for every setting (of some groups) of which some change is accepted."""
    out = {}
    for path, _, p in scenario.walk():
        if not any(f"{path}.".startswith(f"{group}." if group else "") for group in below):
            continue
        for value in other_values(p, scenario_value(scenario, path)):
            try:
                changed = scenario.replace({path: value})
                changed.validate()
            except SettingError:
                continue
            if changed != scenario:
                out[path] = changed
                break
    return out


def scenario_value(scenario: Scenario, path: str) -> Any:
    node: Any = scenario
    for key in path.split("."):
        node = node[int(key)] if isinstance(node, list) else getattr(node, key)
    return node


def estimates(record: Record, scenario: Scenario, observers: list[str], known: RecordMemo | None = None) -> dict[Any, Any]:
    """Return the values of estimates, and the reasons of those that there are not."""
    found = each_estimate(record, scenario, observers=observers, memo=known)
    return {e.observer if isinstance(e, Failure) else (e.observer, e.target): value_of(e) for e in found}


def value_of(item: Estimate | Failure) -> Any:
    return item.reason if isinstance(item, Failure) else item.values.tobytes()


def same(one: Record, other: Record) -> bool:
    return digest(one) == digest(other)


class TestSettingsWithoutEffect:
    @pytest.mark.slow
    @pytest.mark.parametrize("name", SOURCES)
    def test_record_priors_and_bounds_stay(self, name: str) -> None:
        scenario = scenario_of(name)
        idle = idle_settings(scenario)
        changes = changes_of(scenario, idle)
        assert len(changes) > 10
        values = {path: scenario_value(changed, path) for path, changed in changes.items()}
        whole = scenario.replace(values)
        assert used_settings(whole) == used_settings(scenario), "one without effect does not give another one an effect"
        record, again = simulate(scenario), simulate(whole)
        assert same(record, again)
        assert digest(record_bounds(whole, record)) == digest(record_bounds(scenario, record))
        for observer in OBSERVERS.values():
            assert given(observer, record, whole) == given(observer, record, scenario)

    def test_every_reason_is_one_line_and_every_path_exists(self) -> None:
        for name in SOURCES:
            scenario = scenario_of(name)
            for path, reason in idle_settings(scenario, is_simulated=False).items():
                scenario_value(scenario, path)
                assert reason.startswith("Used only") and "\n" not in reason

    def test_a_setting_in_use_is_not_among_them(self) -> None:
        scenario = Scenario().replace({"sensors.noise_from": "photons", "gpr_online.inputs_filter": "high-pass"})
        idle = idle_settings(scenario)
        assert "gpr_online.highpass" not in idle and "gpr_offline.highpass" in idle
        assert "sensors.spots" not in idle and "sensors.lgs_noise" in idle
        manual = {"kalman.process_noise": "manual", "control.integrator": "manual", "kalman.peak": "matched"}
        assert {"kalman.vibration_rms", "control.gain"} <= set(idle)
        idle = idle_settings(scenario.replace(manual))
        assert not {"kalman.vibration_rms", "control.gain"} & set(idle) and "kalman.frequency" in idle

    def test_a_given_record_needs_no_simulation(self) -> None:
        assert {"loop", "events", "run.seed"} <= set(idle_settings(BASE, is_simulated=False))
        assert not {"loop", "events", "run.seed"} & set(idle_settings(BASE))


def given(observer: Any, record: Record, scenario: Scenario) -> str:
    """Return a digest of what an observer receives beside measurements, or why there is nothing."""
    try:
        return digest(prior_and_settings(observer, record, scenario)[0], used_settings(scenario).get(observer.group))
    except ValueError as error:
        return str(error)


@pytest.mark.slow
def test_what_is_known_is_what_a_whole_run_gives() -> None:
    """Change every setting with an effect that the record does not depend on, one at a time; numbers that no observer is given
    all at once, so that it shows if one of them has an effect.
    """
    memo, idle = Memo(), idle_settings(BASE)
    record = simulate_once(BASE, memo)
    kept = list(each_estimate(record, BASE, memo=RecordMemo(memo, record)))
    changes = {path: s for path, s in changes_of(BASE).items() if record_settings(s) == record_settings(BASE)}
    # of the others see test_record_priors_and_bounds_stay
    used = {path: s for path, s in changes.items() if not any(f"{path}.".startswith(f"{group}.") for group in idle)}
    values = {path: scenario_value(s, path) for path, s in used.items() if not observers_reached(BASE, s)}
    numbers = {path: value for path, value in values.items() if not isinstance(value, str | bool)}
    assert len(numbers) > 10
    alone = {path: s for path, s in used.items() if path not in numbers}
    for path, changed in {**alone, "numbers": BASE.replace(numbers)}.items():
        now, reached = simulate_once(changed, memo), observers_reached(BASE, changed)
        assert reached is not None and record_digest(now) == record_digest(record), path
        names = [name for name in ON_PAPER if not OBSERVERS[name].slow or name in reached]
        known = RecordMemo(memo, now)
        found = estimates(now, changed, names, known)
        assert set(names) - known.known_observers <= reached, path
        assert found == estimates(simulate(changed), changed, names), path
    assert kept and {"multipeak.line_width", "control.delay", "gpr_online.length_scale"} <= set(changes)
    told_otherwise = BASE.replace({path: scenario_value(changed, path) for path, changed in changes.items()})
    assert digest(record_bounds(told_otherwise, record)) == digest(record_bounds(BASE, record))


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "most"), [("ut4", 2), ("higher-orders", 1)])
def test_no_setting_of_a_preset_changes_an_estimate_that_is_known(preset: str, most: int) -> None:
    """Of the observers that a change may reach, those that do not run again have what a run of their own gives, bit by bit.

    Of the changes that may reach the same observers, the first one or two are made.
    """
    base = PRESETS[preset]().replace({**QUICK, "run.duration": 0.4})
    if preset == "higher-orders":  # five modes have all of its kinds of coupling, and need a quarter of the time
        base = base.replace({"telescope.radial_order": 2})
    memo, idle = Memo(), idle_settings(base)
    record = simulate_once(base, memo)
    names = [name for name in usual_observers(base, record) if not OBSERVERS[name].slow]
    kept = list(each_estimate(record, base, observers=names, memo=RecordMemo(memo, record)))
    changes = {path: s for path, s in changes_of(base).items() if record_settings(s) == record_settings(base)}
    told, made = 0, Counter[frozenset[str]]()
    for path, changed in changes.items():
        if why_idle_at(path, idle):
            continue  # test_record_priors_and_bounds_stay
        reached = observers_reached(base, changed)
        assert reached is not None, path
        made[frozenset(reached)] += 1
        if made[frozenset(reached)] > most:
            continue
        now = simulate_once(changed, memo)
        known = RecordMemo(memo, now)
        found = estimates(now, changed, sorted(reached.intersection(names)), known)
        recalled, told = sorted(known.known_observers), told + len(known.known_observers)
        assert {key: value for key, value in found.items() if key[0] in recalled} == estimates(now, changed, recalled), path
    assert kept and told


CASES = {
    "multipeak.line_width": set(),
    "multipeak.turbulence_order": {"kf-multi", "multirate-multi", "gp-lgs", "gp-both"},
    "kalman.frequency": {"kf-lgs", "kf-ngs", "multirate", "multirate-optimal"},
    "butterworth.bandwidth_offline": {"butterworth-ol", "gpr-offline", "ridge", "ridge-30"},
    "butterworth.bandwidth_online": {"butterworth-cl", "gpr-online"},
    "multirate.model_lgs_error": {"multirate-optimal"},
    "kalman.ngs_between_frames": {"kf-ngs"},
    "gpr_online.length_scale": {"gpr-online"},
    "gpr_offline.length_scale": {"gpr-offline", "ridge"},
    "adaptive.peak_count": {"kf-adaptive", "multirate-adaptive", "gpr-adaptive"},
    "adaptive.depth": {"gpr-adaptive"},
    "sensors.spots.lgs_photons": set(),
    "gpr_online.highpass": set(),
    "kalman.lgs_noise": set(),
    "control.gain": set(),
    "control.delay": set(),
}
"""Setting of the paper's scenario -> observers that run again."""


@pytest.fixture(scope="module")
def before() -> tuple[Memo, Record, list[Any]]:
    """A memo, and what is held of the base scenario."""
    memo = Memo()
    record = simulate_once(BASE, memo)
    return memo, record, list(each_estimate(record, BASE, memo=RecordMemo(memo, record)))


def double(x: float, y: float = 0.0) -> float:
    return 2.0 * x + y


def test_a_function_counts_with_what_is_bound_to_it_and_one_that_may_hold_more_has_no_digest() -> None:
    names = {digest(bound) for bound in (partial(double), partial(double, 1.0), partial(double, 2.0), partial(double, y=1.0))}
    assert len(names) == 4 and digest(partial(double, 1.0)) in names
    held = 1.0
    for function in (lambda x: x, lambda x: x + held, Memo().get):
        with pytest.raises(TypeError, match="a partial has no digest"):
            digest(partial(function, 1.0))


class TestReuse:
    @pytest.mark.slow
    @pytest.mark.parametrize("path", CASES)
    def test_only_what_depends_runs(self, path: str, before: tuple[Memo, Record, list[Any]]) -> None:
        memo, record, kept = before
        assert not any(isinstance(item, Failure) for item in kept)
        changed = changes_of(BASE, [path])[path]
        now = simulate_once(changed, memo)
        assert now is record
        found = list(each_estimate(now, changed, memo=RecordMemo(memo, now)))
        assert {e.observer for e in found if not any(e is old for old in kept)} == CASES[path]

    @pytest.mark.parametrize("path", ["sensors.ngs_noise", "sensors.exposure_ratio"])
    def test_what_only_the_ngs_sees_runs_its_observers_alone(self, path: str, before: tuple[Memo, Record, list[Any]]) -> None:
        memo, record, kept = before
        changed = changes_of(BASE, [path])[path]
        now = simulate_once(changed, memo)
        assert now is not record and np.array_equal(now.y_lgs, record.y_lgs)
        known = RecordMemo(memo, now)
        found = list(each_estimate(now, changed, memo=known))
        ran = {e.observer for e in found if not any(e is old for old in kept)}
        assert ran == {name for name in ON_PAPER if "ngs" in OBSERVERS[name].sensors}
        assert known.known_observers == set(ON_PAPER) - ran

    def test_a_noise_that_is_stated_as_it_is_runs_no_filter_of_the_ngs(self, before: tuple[Memo, Record, list[Any]]) -> None:
        memo, record, _kept = before
        assert BASE.kalman.ngs_noise == BASE.sensors.ngs_noise, "so that it is the same number, by another way"
        changed, known = BASE.replace({"kalman.measurement_noise": "manual"}), RecordMemo(memo, record)
        list(each_estimate(record, changed, observers=["kf-ngs", "kf-lgs"], memo=known))
        assert known.known_observers == {"kf-ngs"}

    def test_what_follows_from_an_estimate_is_of_the_truth_too(self, before: tuple[Memo, Record, list[Any]]) -> None:
        memo, record, kept = before
        assert record.turbulence is not None
        other = replace(record, turbulence=record.turbulence + 1.0)
        made = [[], []]
        for of, list_of in zip((record, other), made, strict=True):
            known = RecordMemo(memo, of)
            (estimate,) = (e for e in each_estimate(of, BASE, observers=["persistence"], memo=known))
            assert any(estimate is old for old in kept)
            list_of.append(known.derive(estimate, "offset", lambda of=of: Failure("persistence", str(of.turbulence[0, 0]))))
        assert made[0][0].reason != made[1][0].reason

    def test_other_training_data_leave_the_record(self, before: tuple[Memo, Record, list[Any]]) -> None:
        memo, record, _ = before
        changed = BASE.replace({"gpr_offline.training_size": 61})
        assert record_settings(changed) == record_settings(BASE) and training_settings(changed) != training_settings(BASE)
        now = simulate_once(changed, memo)
        assert now.y_lgs is record.y_lgs and now.training is not None and record.training is not None
        assert len(now.training.y_lgs) == len(record.training.y_lgs) + 1 and same(now, simulate(changed))

    def test_known_ones_come_before_any_runs(self, before: tuple[Memo, Record, list[Any]]) -> None:
        memo, record, _ = before
        changed = BASE.replace({"kalman.ngs_between_frames": "propagate"})
        order = [e.observer for e in each_estimate(record, changed, memo=RecordMemo(memo, record)) if isinstance(e, Estimate)]
        assert order[-1] == "kf-ngs" and "kf-ngs" not in order[:-1]

    def test_other_measurements_are_another_record(self, before: tuple[Memo, Record, list[Any]]) -> None:
        memo, record, _ = before
        y = record.y_lgs.copy()
        y[-1, 0] = np.nextafter(y[-1, 0], np.inf)
        moved = replace(record, y_lgs=y)
        known = RecordMemo(memo, moved)
        list(each_estimate(moved, BASE, observers=["kf-lgs", "persistence"], memo=known))
        assert known.known_observers == set()

    def test_nothing_is_kept_that_nobody_holds(self) -> None:
        memo = Memo()
        record = simulate_once(BASE, memo)
        kept = list(each_estimate(record, BASE, observers=["kf-lgs"], memo=RecordMemo(memo, record)))
        assert len(memo) == 4, "a record by two names, and two estimates"
        del record, kept
        gc.collect()
        assert len(memo) == 0

    def test_what_follows_from_an_estimate_is_made_once_as_long_as_it_is_held(
        self, before: tuple[Memo, Record, list[Any]]
    ) -> None:
        memo, record, kept = before
        known = RecordMemo(memo, record)
        list(each_estimate(record, BASE, observers=["kf-lgs"], memo=known))
        estimate = next(e for e in kept if e.observer == "kf-lgs")
        made: list[str] = []

        def derive(of: Estimate, what: str) -> Failure:
            return known.derive(of, what, lambda: made.append(what) or Failure(what, what))  # type: ignore[func-returns-value]

        held = [derive(estimate, what) for what in ("a", "b", "a")]
        assert made == ["a", "b"] and held[0] is held[2] is not held[1]
        del held
        gc.collect()
        derive(estimate, "a")
        derive(Estimate("nobody", "turbulence", estimate.values, 0.0), "a")
        assert made == ["a", "b", "a", "a"]


class TestDigest:
    def test_it_tells_values_from_each_other(self) -> None:
        one = np.array([1.0, 2.0])
        values = [1, 1.0, True, "1", None, (1,), [1], one, one.astype(np.float32), one.reshape(1, 2), one[::-1], {"a": 1}]
        assert len({digest(value) for value in values}) == len(values)
        assert len({digest("ab", "c"), digest("a", "bc"), digest("abc")}) == 3
        assert digest(one[::-1]) == digest(np.array([2.0, 1.0])), "the same numbers, whatever their layout"

    def test_what_has_no_value_is_refused(self) -> None:
        with pytest.raises(TypeError, match="a function has no digest"):
            digest(lambda: 1)
