"""From settings to scores: order, failures, progress, cancelling, what a record states."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pandas
import pytest
from astropy.units import Unit

from tests.records import ON_PAPER
from wfsobs import PRESETS, Record, RecordError, Scenario, SettingError, observe, run, simulate
from wfsobs.dependence import Memo, RecordMemo, digest
from wfsobs.evaluation.bound import bound_rms
from wfsobs.evaluation.result import Failure
from wfsobs.evaluation.scores import BOUND, BOUND_BOTH, BOUNDS, COMMON_BOUNDS, LOOP, PREDICTION, RESIDUAL, SCORED, score
from wfsobs.execution import each_estimate
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS, Observer
from wfsobs.pipeline import as_stated
from wfsobs.priors_from.scenario import usual_observers
from wfsobs.progress import Cancelled, Watch
from wfsobs.record import Estimate, Estimates
from wfsobs.signal.spectrum import rms


def scenario(changes: dict[str, Any] | None = None) -> Scenario:
    base = PRESETS["paper"]()
    base.update(
        {
            "run": {"duration": 0.8, "warm_up": 0.3},
            "gpr_offline": {"training_size": 60, "depth": 25},
            "gpr_online": {"training_size": 60, "depth": 25},
            "adaptive": {"window": 0.25},
        }
    )
    return base.replace(changes or {})


def test_results_come_in_the_order_of_the_registry() -> None:
    backwards = ON_PAPER[::-1]
    result = run(scenario(), observers=backwards)
    assert not result.failures
    pairs = [(e.observer, e.target) for e in result.estimates]
    assert pairs == [(name, target) for name in ON_PAPER for target in sorted(OBSERVERS[name].targets)]
    of = {name: OBSERVERS[name].targets for name in ON_PAPER}
    rows = [
        (name, target, mode)
        for name in ON_PAPER
        for target in SCORED
        for mode in ("tip", "tilt")
        if target in of[name] or (target == "total" and len(of[name]) == 2)
    ]
    rows += [(bound, target, mode) for mode in ("tip", "tilt") for bound in COMMON_BOUNDS for target in SCORED]
    assert [(s.observer, s.target, s.mode) for s in result.scores] == rows
    found = result.estimate("kf-lgs", "vibration")
    assert found is not None and found.values.shape == result.record.y_lgs.shape and found.seconds_per_step > 0
    assert result.estimate("kf-ngs", "vibration") is None


def test_scores_are_those_of_the_estimates() -> None:
    result = run(scenario(), observers=["kf-lgs", "butterworth-ol"])  # the second has no last sample, which so counts for none
    for s in result.scores:
        if s.observer in BOUNDS:
            truth, mode = result.record.truth(s.target), ("tip", "tilt").index(s.mode)
            scored = slice(300, 799 if s.target == "vibration" else 800)  # those of the rows beside it
            assert truth is not None and s.truth_rms == pytest.approx(np.sqrt(np.mean(truth[scored, mode] ** 2)), rel=1e-12)
            assert (s.start, s.stop) == pytest.approx((0.3, scored.stop / 1000))
            information = "lgs" if s.observer == BOUND else "both"
            assert s.rms == bound_rms(scenario(), mode, information=information)[s.target]
            assert (s.interval is None, s.phases is None) == (s.observer == BOUND_BOTH, s.observer == BOUND)
            # rms is over all phases of a frame
            assert s.phases is None or s.rms == pytest.approx(np.sqrt(np.mean(np.square(s.phases))), rel=1e-12)
            continue
        truth, mode = result.record.truth(s.target), ("tip", "tilt").index(s.mode)
        of = [e for e in result.estimates if e.observer == s.observer and s.target in (e.target, "total")]
        assert truth is not None and len(of) == 1 + (s.target == "total")
        error = (sum(e.values for e in of) - truth)[300 : 799 if s.target == "vibration" else 800, mode]
        assert s.rms == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12)


@pytest.mark.parametrize(("window", "apart"), [(0.4, False), (0.7, True)])
def test_the_late_adaptive_filter_is_scored_with_the_others_or_apart(window: float, apart: bool) -> None:
    result = run(scenario({"adaptive.window": window}), observers=["kf-lgs", "kf-adaptive", "zero"])
    begins = 1e-3 * (round(1000 * window) - 1 + result.record.delay)  # the first window is full
    for s in (s for s in result.scores if s.observer not in BOUNDS):
        own = s.observer == "kf-adaptive"
        assert s.apart == (apart and own) and s.stop == pytest.approx(0.8)
        assert s.start == pytest.approx(begins if own or not apart else 0.3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"turbulence.source": "frozen-flow", "sensors.kind": "zernike", "telescope.radial_order": 2},
        {"turbulence.source": "frozen-flow", "sensors.lgs_radius": 30.0, "sensors.lgs_combination": "minimum-variance"},
        {"telescope.radial_order": 2, "sensors.tip_tilt_indetermination": True},
        {"turbulence.source": "psd", "turbulence.psd": {"frequency": [0.5, 50.0], "tip": [1e-2, 1e-3], "tilt": [1e-2, 1e-3]}},
    ],
)
def test_every_observer_on_every_turbulence_and_mode(changes: dict[str, Any]) -> None:
    s = scenario(changes)
    result = run(s)
    assert not result.failures
    assert {score.mode for score in result.scores if score.observer not in BOUNDS} == {mode.name for mode in s.modes}
    assert all(np.isfinite(score.rms) for score in result.scores)
    again = simulate(s)
    assert digest(again) == digest(result.record)
    rest = [name for name in usual_observers(s, again) if name not in ON_PAPER]  # those come twice in the test below
    for other in observe(again, s, observers=rest, gate=False).estimates if rest else ():
        one = result.estimate(other.observer, other.target)
        assert one is not None and np.array_equal(one.values, other.values, equal_nan=True)


@pytest.mark.slow
def test_same_seed_same_result_and_a_subset_is_part_of_it() -> None:
    one, same = run(scenario()), run(scenario())
    some = run(scenario(), observers=["gpr-online", "multirate"])
    for e in one.estimates:
        twin = same.estimate(e.observer, e.target)
        assert twin is not None and np.array_equal(e.values, twin.values, equal_nan=True)
        if (part := some.estimate(e.observer, e.target)) is not None:
            assert np.array_equal(e.values, part.values, equal_nan=True)
    assert {e.observer for e in some.estimates} == {"gpr-online", "multirate"}
    other = run(scenario({"run.seed": 9}), observers=["kf-lgs"]).estimate("kf-lgs", "vibration")
    mine = one.estimate("kf-lgs", "vibration")
    assert other is not None and mine is not None and not np.array_equal(other.values, mine.values)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("missing", "words", "left_out"),
    [
        (
            {"y_ngs": None, "ratio": None},
            "NGS measurements",
            ["kf-ngs", "multirate", "multirate-optimal", "multirate-multi", "multirate-adaptive", "gp-both"],
        ),
        ({"open_loop_y": None}, "measurements with the mirror at rest", ["butterworth-ol"]),
        ({"training": None}, "training data", ["gpr-offline", "ridge", "ridge-30"]),
    ],
)
def test_what_a_record_lacks_is_one_line_per_observer(missing: dict[str, None], words: str, left_out: list[str]) -> None:
    record = replace(simulate(scenario()), **missing)
    result = observe(record, scenario())
    assert [f.observer for f in result.failures] == left_out
    for failure in result.failures:
        assert failure.reason == f"{failure.observer} left out: the record has no {words}"
    assert {e.observer for e in result.estimates} == set(ON_PAPER) - set(left_out)


def test_a_record_without_truth_is_scored_by_prediction_and_residual() -> None:
    """Only an observer of both targets says what the next measurement will be."""
    record = replace(simulate(scenario()), turbulence=None, vibration=None)
    result = observe(record, scenario(), observers=["kf-lgs", "kf-ngs", "multirate-optimal", "zero"])
    assert len(result.estimates) == 7
    assert {(s.observer, s.target) for s in result.scores} == {
        ("kf-lgs", PREDICTION),
        ("multirate-optimal", PREDICTION),
        ("zero", PREDICTION),
        (LOOP, RESIDUAL),
    }
    start = round(scenario().run.warm_up / record.dt)
    for mode, name in enumerate(("tip", "tilt")):
        found = {s.observer: s for s in result.scores if s.mode == name}
        values = [result.estimate("kf-lgs", target).values[:, mode] for target in TARGETS]
        n, total = record.ratio, values[0] + values[1]
        fused = np.full(record.n_steps, np.nan)
        for k in range(n, record.n_steps, n):
            z = record.z[k - n + 1 : k + 1, mode]
            fused[k - n + 1 : k + 1] = z - np.mean(z) + record.z_ngs[k, mode]
        known = [k for k in range(start + 1, record.n_steps) if fused[k] == fused[k]]
        assert len(known) > 0.9 * (record.n_steps - start)
        assert found["kf-lgs"].rms == pytest.approx(rms(np.array([fused[k] - total[k - 1] for k in known])), rel=1e-12)
        assert found["zero"].rms == found["zero"].truth_rms == pytest.approx(rms(fused[known]), rel=1e-12)
        assert found[LOOP].rms == pytest.approx(rms(record.y_lgs[known, mode]), rel=1e-12)
        assert found["kf-lgs"].normalised_rms == pytest.approx(found["kf-lgs"].rms / found["zero"].rms, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "ut4"])
def test_without_truth_observers_rank_as_by_the_truth(preset: str) -> None:
    """The slow error of the LGS, in z, makes the best observer the worst by z; without its vibration a model is worse."""
    s = PRESETS[preset]().replace({"run.duration": 8.0})
    names = ["kf-lgs", "kf-multi", "multirate-optimal", "multirate-multi"]
    known = observe(record := simulate(s), s, observers=names)
    alone = observe(replace(record, turbulence=None, vibration=None), s, observers=names)
    for mode in ("tip", "tilt"):
        true = {x.observer: x.rms for x in known.scores if x.observer in names and (x.target, x.mode) == ("total", mode)}
        told = {x.observer: x.rms for x in alone.scores if x.observer in names and (x.target, x.mode) == (PREDICTION, mode)}
        assert min(told, key=told.__getitem__) == min(true, key=true.__getitem__) == "multirate-multi"
        both, single = ["multirate-optimal", "multirate-multi"], ["kf-lgs", "kf-multi"]
        assert max(told[name] for name in both) < 0.8 * min(told[name] for name in single)


def test_a_mode_without_ngs_is_scored_by_the_lgs() -> None:
    """A tip-tilt NGS says nothing of the others; frames that do not count say nothing either."""
    record = replace(simulate(scenario()), turbulence=None, vibration=None)
    assert record.y_ngs is not None
    of_tip, early = record.y_ngs.copy(), record.y_ngs.copy()
    of_tip[:, 1], early[round(scenario().run.warm_up / record.dt) :] = np.nan, np.nan
    records = [record, *(replace(record, y_ngs=y) for y in (of_tip, early)), replace(record, y_ngs=None, ratio=None)]
    by = [observe(one, scenario(), observers=["kf-lgs"]).scores for one in records]
    whole, tip, before, none = ({(s.target, s.mode): s.rms for s in scores} for scores in by)
    assert tip == {key: (none if key[1] == "tilt" else whole)[key] for key in whole}
    assert before == none and whole[PREDICTION, "tip"] != none[PREDICTION, "tip"]


def test_without_ngs_or_with_most_frames_lost_the_next_lgs_measurement_counts() -> None:
    record = replace(simulate(scenario()), turbulence=None, vibration=None)
    assert record.y_ngs is not None and record.ratio is not None
    y_ngs, n, start = record.y_ngs.copy(), record.ratio, round(scenario().run.warm_up / record.dt)
    y_ngs[: int(0.9 * record.n_steps)] = np.nan
    for one in (replace(record, y_ngs=None, ratio=None), replace(record, y_ngs=y_ngs)):
        result = observe(one, scenario(), observers=["kf-lgs"])
        total = result.estimate("kf-lgs", "turbulence").values + result.estimate("kf-lgs", "vibration").values
        (row,) = (s for s in result.scores if s.observer == "kf-lgs" and s.mode == "tip")
        assert row.rms == pytest.approx(rms((record.z[start + 1 :] - total[start:-1])[:, 0]), rel=1e-12), n


@pytest.mark.slow
def test_a_single_mode_record() -> None:
    whole = simulate(scenario())
    assert whole.y_ngs is not None and whole.turbulence is not None and whole.training is not None
    t = whole.training
    assert t.open_loop_y is not None and whole.open_loop_y is not None and whole.vibration is not None
    record = Record(
        whole.y_lgs[:, :1],
        whole.u[:, :1],
        whole.dt,
        whole.y_ngs[:, :1],
        whole.ratio,
        whole.open_loop_y[:, :1],
        turbulence=whole.turbulence[:, :1],
        vibration=whole.vibration[:, :1],
        training=type(t)(t.y_lgs[:, :1], t.u[:, :1], t.open_loop_y[:, :1]),
    )
    one, both = observe(record, scenario()), observe(whole, scenario())
    assert not one.failures and {s.mode for s in one.scores} == {"tip"}
    for e in one.estimates:
        twin = both.estimate(e.observer, e.target)
        assert twin is not None
        assert np.allclose(e.values[:, 0], twin.values[:, 0], rtol=1e-9, atol=1e-12, equal_nan=True)


def test_quick_ones_first_and_progress_only_forward() -> None:
    s = scenario()
    told: list[float] = []
    partial: list[tuple[str, str]] = []
    watch = Watch(progress=told.append)
    items = list(each_estimate(simulate(s), s, watch, None, lambda o, t, _values: partial.append((o, t))))
    names = [item.observer for item in items]
    weights = [OBSERVERS[name].weight for name in names]
    assert weights == sorted(weights) and names[-1] == "gpr-online"
    assert told == sorted(told) and 0.0 <= told[0] and told[-1] == pytest.approx(1.0)
    assert set(partial) == {("gpr-online", "vibration")}
    assert all(isinstance(item, Estimate) for item in items)


@pytest.mark.parametrize("after", [0, 1, 3, 7, 20])
def test_cancelling_stops_the_work(after: int) -> None:
    s = scenario({"run.duration": 2.0})
    asked: list[bool] = []

    def cancelled() -> bool:
        asked.append(True)
        return len(asked) > after

    with pytest.raises(Cancelled):
        run(s, watch=Watch(is_cancelled=cancelled))
    # both modes of a GPR may ask once more before they see that the other has stopped
    assert len(asked) <= after + 3


def test_the_record_overrides_the_scenario_where_it_states_something() -> None:
    made = simulate(scenario({"sensors.lgs_rate": 500.0, "sensors.exposure_ratio": 3}))
    stated = as_stated(made, scenario())
    assert (stated.sensors.lgs_rate, stated.sensors.exposure_ratio) == (500.0, 3)
    assert stated.difference(scenario()) == {"sensors": {"lgs_rate": 500.0, "exposure_ratio": 3}}
    result = observe(made, scenario(), observers=["kf-ngs", "kf-lgs"])
    assert result.scenario == stated
    right = observe(made, stated, observers=["kf-ngs", "kf-lgs"])
    for one, other in zip(result.estimates, right.estimates, strict=True):
        assert np.array_equal(one.values, other.values, equal_nan=True)
    own = scenario()
    assert as_stated(simulate(own), own) is own
    without_ngs = replace(made, y_ngs=None, ratio=None)
    assert as_stated(without_ngs, scenario()).sensors.exposure_ratio == scenario().sensors.exposure_ratio


def test_observers_are_one_text_or_any_of_them() -> None:
    for chosen in ("zero", iter(["zero"]), {"zero": 1}.keys()):
        assert {s.observer for s in run(scenario(), observers=chosen).scores} >= {"zero"}  # type: ignore[arg-type]
    with pytest.raises(SettingError, match="observer 'nul': no such observer"):
        run(scenario(), observers=(name for name in ["zero", "nul"]))  # type: ignore[arg-type]


def test_a_star_that_is_lost_throughout_is_said_to_be_the_likely_reason() -> None:
    record = simulate(scenario())
    assert record.y_ngs is not None
    lost = replace(record, y_ngs=np.full_like(record.y_ngs, np.nan))
    reason = "multirate-adaptive left out: turbulence is NaN in every step, perhaps for too few measurements of the LGS or NGS"
    result = observe(lost, scenario({"adaptive.window": 0.25}), observers=["multirate-adaptive"])
    assert [f.reason for f in result.failures] == [reason]


def test_a_record_of_more_modes_than_the_settings_have() -> None:
    three = np.random.default_rng(1).standard_normal((1000, 3))
    result = observe(Record(three, 0.0 * three, 1e-3), scenario(), observers="kf-lgs")
    assert result.scenario.telescope.radial_order == 2 and {s.mode for s in result.scores} == {"tip", "tilt", "defocus"}
    with pytest.raises(SettingError, match=r"telescope\.radial_order = 7: takes a whole number from 1 to 6"):
        observe(Record(np.zeros((9, 28)), np.zeros((9, 28)), 1e-3), scenario())


@pytest.mark.parametrize("kind", [list, "float32", pandas.DataFrame, np.asfortranarray])
def test_a_record_of_numbers_of_any_kind(kind: Any) -> None:
    y = np.random.default_rng(1).integers(-99, 99, (500, 2)).astype(float)
    other = y.astype(kind) if isinstance(kind, str) else kind(y.tolist())
    one, two = (observe(Record(x, x, 1e-3), scenario(), observers=["kf-lgs"]) for x in (y, other))
    np.testing.assert_array_equal(one.estimates[0].values, two.estimates[0].values)


NM = Unit("nm")


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"y_lgs": np.zeros(9)}, r"y_lgs has shape \(9,\); expected \(n_steps, n_modes\)"),
        ({"u": np.zeros((8, 2))}, r"u has shape \(8, 2\); expected \(9, 2\), that of y_lgs"),
        ({"turbulence": np.zeros((9, 1))}, r"turbulence has shape \(9, 1\); expected \(9, 2\), that of y_lgs"),
        ({"y_lgs": [["a", "b"]]}, "y_lgs holds <U1, not numbers"),
        ({"y_lgs": np.ones((9, 2)) * 1j}, "y_lgs holds complex128, not numbers"),
        ({"u": np.ones((9, 2), bool)}, "u holds bool, not numbers"),
        (
            {"vibration": np.full((9, 2), -2e12)},
            r"vibration is -2000000000000\.0 at step 0, mode 0; .* up to 1e\+12, .*",
        ),
        ({"y_lgs": [[1.0], [1.0, 2.0]]}, "y_lgs holds no numbers, or rows of unlike lengths"),
        ({"u": np.ones((9, 2)) * NM}, "u has the unit nm; takes plain numbers in um, .*"),
        ({"u": [np.ones(2) * NM] * 9}, "u has the unit nm; takes plain numbers in um, .*"),
        ({"u": np.full((9, 2), np.inf)}, "u is inf at step 0, mode 0; it takes finite numbers"),
        ({"dt": 0}, "dt takes a time step above 0 s, not 0"),
        ({"dt": np.nan}, "dt takes a time step above 0 s, not nan"),
        ({"dt": "1 ms"}, r"dt takes a time step \[s\], not '1 ms'"),
        ({"delay": 1.5}, "delay takes a whole number of steps from 1, not 1.5"),
        ({"delay": 0}, "delay takes a whole number of steps from 1, not 0"),
        ({"delay": "2"}, "delay takes a whole number of steps from 1, not '2'"),
        ({"delay": None}, "delay takes a whole number of steps from 1, not None"),
        ({"delay": np.nan}, "delay takes a whole number of steps from 1, not nan"),
        ({"delay": True}, "delay takes a whole number of steps from 1, not True"),
        ({"ratio": 2.5}, "ratio takes a whole number of steps from 1, not 2.5"),
        ({"ratio": 0}, "ratio takes a whole number of steps from 1, not 0"),
        ({"ratio": [5, [5]]}, r"ratio takes a whole number of steps from 1, not \[5, \[5\]\]"),
        ({"lgs_stars": np.ones(8, int)}, r"lgs_stars takes 9 whole numbers from 0, not int64 of shape \(8,\)"),
        ({"lgs_stars": np.full(9, 1.5)}, r"lgs_stars takes 9 whole numbers from 0, not float64 of shape \(9,\)"),
        ({"lgs_stars": np.full(9, -1)}, r"lgs_stars takes 9 whole numbers from 0, not int64 of shape \(9,\)"),
        (
            {"lgs_stars": np.ma.masked_less(np.arange(9), 1)},
            r"lgs_stars takes 9 whole numbers from 0, not float64 of shape \(9,\)",
        ),
        ({"y_ngs": np.zeros((9, 2))}, "y_ngs needs ratio, the number of fast steps per NGS frame"),
        ({"y_ngs": np.zeros((9, 2)), "ratio": 4}, "y_ngs has a frame at step 1; with ratio = 4 frames are at steps 4, 8, .*"),
        ({"y_stars": np.zeros((9, 2))}, r"y_stars has shape \(9, 2\); expected \(9, n_lgs, 2\)"),
        ({"y_stars": np.zeros((9, 3, 1))}, r"y_stars has shape \(9, 3, 1\); expected \(9, n_lgs, 2\)"),
        ({"y_stars": np.full((9, 3, 2), np.inf)}, "y_stars is inf at step 0, mode 0; it takes finite numbers"),
    ],
)
def test_what_is_no_record_is_one_line(change: dict[str, Any], line: str) -> None:
    good: dict[str, Any] = {"y_lgs": np.zeros((9, 2)), "u": np.zeros((9, 2)), "dt": np.array(1e-3)}
    assert Record(**good).dt == 1e-3
    with pytest.raises(RecordError, match=f"^{line}$"):
        Record(**(good | change))


@pytest.mark.parametrize(
    "kind", [np.ma.array, lambda x, mask: [np.ma.array(row, mask=gone) for row, gone in zip(x, mask, strict=True)]]
)
def test_what_is_masked_is_missing(kind: Any) -> None:
    numbers = np.arange(18).reshape(9, 2)
    mask = numbers % 5 == 0
    for shape in (lambda x: x, lambda x: x.astype(float)):
        record = Record(kind(shape(numbers), mask=mask), kind(shape(numbers), mask=~mask), 1e-3)
        np.testing.assert_array_equal(record.y_lgs, np.where(mask, np.nan, numbers))
        np.testing.assert_array_equal(record.u, np.where(mask, numbers, np.nan))


def test_whole_numbers_of_any_kind_are_whole_numbers() -> None:
    record = Record(np.zeros((9, 2)), np.zeros((9, 2)), 1e-3, ratio=5.0, delay=np.array(2.0), lgs_stars=[3.0] * 9)  # type: ignore[arg-type]
    assert (record.ratio, record.delay) == (5, 2) and type(record.ratio) is type(record.delay) is int
    assert record.lgs_stars is not None and record.lgs_stars.dtype == int


def test_a_record_too_slow_for_the_settings_is_refused() -> None:
    made = simulate(scenario())
    slow = replace(made, dt=1 / 90)
    with pytest.raises(SettingError, match="45 Hz"):
        observe(slow, scenario())


def test_an_observer_that_cannot_work_is_left_out_with_its_reason() -> None:
    s = scenario(
        {
            "gpr_online.training_size": 2000,
            "multirate.measurement_noise": "manual",
            "multirate.lgs_noise": 0.04,
            "multirate.ngs_noise": 0.001,
        }
    )
    result = run(s)
    assert [f.observer for f in result.failures] == ["multirate", "gpr-online"]
    assert all(isinstance(f, Failure) and "\n" not in f.reason and len(f.reason) < 250 for f in result.failures)


def raise_error(error: Exception) -> None:
    raise error


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda z: {"vibration": z[:, 0]}, r"vibration takes an array of the shape \(800, 2\), .* not \(800,\)"),
        (lambda z: {"vibration": z[:-1]}, r"not \(799, 2\)"),
        (lambda z: {"vibration": z.tolist()}, "not list"),
        (lambda z: Estimates({"vibration": z}, {"vibration": z[0]}), r"sd of vibration takes .* not \(2,\)"),
        (lambda z: {"vibration": z * 1j}, "vibration takes real numbers, .* not complex128"),
        (lambda z: {"vibration": z.astype(object)}, "not object"),
        (lambda z: {"vibration": np.full_like(z, np.inf)}, "not infinite ones"),
        (lambda z: {"turbulence": z}, "returns no vibration"),
        (lambda z: None, "returns NoneType, not a dictionary"),
        (lambda z: {"vibration": np.full_like(z, np.nan)}, "vibration is NaN in every step, perhaps for too few"),
        (lambda z: {"vibration": np.ma.masked_array(z, z > 0)}, "vibration takes NaN where there is no number, not a mask$"),
        (lambda z: Estimates({"vibration": z}, {"vibration": z * 0 - 1}), "sd of vibration takes numbers from 0, not negative"),
        (lambda z: {"vibration": np.where(z > 0, 1e200, np.nan)}, "vibration takes numbers up to 1e\\+100, not 1e\\+200$"),
        (lambda z: raise_error(ValueError()), "ValueError$"),
        (lambda z: raise_error(KeyError("x")), "KeyError: 'x'$"),
        (lambda z: raise_error(SystemExit(3)), "SystemExit: 3$"),
        (lambda z: raise_error(ValueError("singular\n  matrix")), "singular matrix$"),
        (lambda z: raise_error(np.linalg.LinAlgError("singular")), "singular$"),
    ],
)
def test_what_is_no_estimate_is_one_line_and_the_others_keep_theirs(
    make: Any, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = Observer("mine", "Mine", ("vibration",), lambda measurements, *_: make(measurements.z))
    monkeypatch.setitem(OBSERVERS, "mine", mine)
    result = run(scenario(), observers=["mine", "zero"])
    assert [f.observer for f in result.failures] == ["mine"] and re.match(f"mine left out: .*{reason}", result.failures[0].reason)
    assert {e.observer for e in result.estimates} == {"zero"}


def test_want_of_memory_is_no_result_of_an_observer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(OBSERVERS, "mine", Observer("mine", "Mine", ("vibration",), lambda *_: raise_error(MemoryError())))
    with pytest.raises(MemoryError):
        run(scenario(), observers=["mine", "zero"])


def test_an_observer_that_cannot_count_its_peaks_runs_with_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = replace(OBSERVERS["kf-lgs"], counts=lambda *_: raise_error(KeyError("x")))
    monkeypatch.setitem(OBSERVERS, "kf-lgs", wrong)
    record = simulate(scenario())
    found = each_estimate(record, scenario(), observers=["kf-lgs", "zero"], memo=RecordMemo(Memo(), record))
    assert {e.observer for e in found} == {"kf-lgs", "zero"}


@pytest.mark.parametrize("n", [1, 5, 21, 100])
def test_a_vibration_that_an_ngs_frame_averages_away_is_missed_all_the_same(n: int) -> None:
    """A line of 47.5 Hz of 0.2 um, of which the mean over 21 ms has nothing: who leaves it out has its rms more."""
    rng, steps, t = np.random.default_rng(0), 4200, 1e-3 * np.arange(4200)
    line, slow = 0.2 * np.sqrt(2.0) * np.sin(2.0 * np.pi * 47.5 * t), 0.5 * np.sin(2.0 * np.pi * 0.3 * t)
    total = (line + slow)[:, None]
    y_lgs = np.vstack([[[0.0]], total[:-1]]) + 0.3 + 0.01 * rng.standard_normal((steps, 1))  # with an error of the LGS of 0.3 um
    y_ngs = np.full((steps, 1), np.nan)
    for k in range(n, steps, n):
        y_ngs[k] = total[k - n : k].mean() + 0.01 * rng.standard_normal()
    record = Record(y_lgs, np.zeros((steps, 1)), 1e-3, y_ngs=y_ngs, ratio=n)
    guesses = {"right": (slow, line), "blind": (slow, 0.0 * line), "biased": (slow + 0.3, line)}
    estimates = [Estimate(name, TARGETS[i], both[i][:, None], 0.0) for name, both in guesses.items() for i in (0, 1)]
    found = {s.observer: s.rms for s in score(record, estimates) if s.target == PREDICTION}
    noise = 0.01 * np.sqrt(2.0 - 1.0 / n) if n > 1 else 0.01  # within a frame that of the LGS, of its mean that of the NGS
    assert found["right"] == pytest.approx(noise, rel=0.1)
    assert found["blind"] == pytest.approx(np.hypot(0.2, noise), rel=0.02)
    assert found["biased"] == pytest.approx(np.hypot(0.3, noise), rel=0.02)
