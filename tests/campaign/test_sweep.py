"""Sweeps: cells are runs of the library, and who wins is what a paired t-test says."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from math import nan
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import t as student

import wfsobs
from wfsobs.campaign.sweep import EACH_RUN, EACH_STEP, MOST_CELLS, SweepResults, parse_axis, plan_sweep, run_sweep
from wfsobs.cli import main
from wfsobs.evaluation.result import row_label
from wfsobs.evaluation.scores import BOUND, Score
from wfsobs.evaluation.verdict import sentence_of_several
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError

SHORT = {"run.duration": 1.0, "run.warm_up": 0.2, "run.seed": 7}
FEW = ("kf-lgs", "kf-multi", "multirate")


@pytest.fixture(scope="module")
def base() -> Scenario:
    return wfsobs.PRESETS["paper"]().replace(SHORT)


@pytest.fixture(scope="module")
def results(base: Scenario) -> SweepResults:
    """Two by two cells with three seeds each."""
    axes = [parse_axis("turbulence.wind_speed=5:20:2"), parse_axis("sensors.exposure_ratio=5,10")]
    return run_sweep(plan_sweep(base, axes, 3, FEW))


@pytest.mark.slow
def test_a_cell_is_a_run_of_the_library(results: SweepResults, base: Scenario) -> None:
    assert [dict(c) for c in results.sweep.cells] == [
        {"turbulence.wind_speed": v, "sensors.exposure_ratio": r} for v in (5, 20) for r in (5, 10)
    ]
    assert results.n_done == results.sweep.n_runs == 12
    cell = 2
    runs = [
        wfsobs.run(base.replace({"turbulence.wind_speed": 20.0, "sensors.exposure_ratio": 5, "run.seed": seed}), observers=FEW)
        for seed in (7, 8, 9)
    ]
    for target, mode in (("turbulence", "tip"), ("vibration", "tilt")):
        for name in (*FEW, BOUND):
            key = (name, target, mode)
            expected = [s.rms for run in runs for s in run.scores if (s.observer, s.target, s.mode) == key]
            error = results.error(cell, key)
            if not expected:
                assert error is None, "multirate estimates turbulence alone"
                continue
            assert error is not None
            # The same computation.
            assert error[0] == pytest.approx(np.mean(expected), rel=1e-12)
            if name != BOUND:
                low, high = student.interval(0.95, 2, np.mean(expected), np.std(expected, ddof=1) / np.sqrt(3))
                assert error[1:] == pytest.approx((max(low, 0.0), high), rel=1e-9)


def invented(base: Scenario, errors: dict[str, list[float]]) -> SweepResults:
    """A sweep whose first cell has these errors [um], one per seed."""
    sweep = plan_sweep(base, [parse_axis("turbulence.wind_speed=5,10")], len(next(iter(errors.values()))))
    results = SweepResults(sweep)
    for values in zip(*errors.values(), strict=True):
        of = zip(errors, values, strict=True)
        results = results.add(0, [Score(name, "turbulence", "tip", rms, 1.0, rms, None, 0.0) for name, rms in of])
    return results


def test_the_winner_is_that_of_a_paired_t_test(base: Scenario) -> None:
    rng = np.random.default_rng(3)
    outcomes = set()
    for _ in range(40):
        common = rng.normal(1.0, 0.2, 6)  # what the records have in common: it cancels in pairs
        errors = {name: list(common + shift + rng.normal(0.0, 0.02, 6)) for name, shift in (("kf-lgs", 0.02), ("kf-multi", 0.0))}
        best = invented(base, {**errors, "zero": [0.1] * 6}).winner(0, "turbulence", "tip")
        assert best is not None and best.margin is not None
        first, second = sorted(errors, key=lambda name: float(np.mean(errors[name])))
        assert best.name == first, "an estimate of zero is never the best"
        assert best.margin == pytest.approx(np.mean(errors[second]) / np.mean(errors[first]) - 1.0, rel=1e-12)
        # The logarithm of the ratio of the means, with the scatter of its influences.
        one, other = (np.array(errors[name]) / np.mean(errors[name]) for name in (first, second))
        t = np.log1p(best.margin) / ((other - one).std(ddof=1) / np.sqrt(6))
        significant = bool(2.0 * student.sf(t, 5) < 0.05)
        assert best.is_significant == significant and best.ties == (() if significant else (second,))
        outcomes.add(significant)
    assert outcomes == {True, False}


def test_two_seeds_decide_nothing(base: Scenario) -> None:
    best = invented(base, {"kf-lgs": [1.0, 1.0], "kf-multi": [9.0, 9.1]}).winner(0, "turbulence", "tip")
    assert best is not None and best.name == "kf-lgs" and not best.is_significant and best.ties == ()
    assert invented(base, {"kf-lgs": [1.0]}).winner(1, "turbulence", "tip") is None


def test_every_cell_has_its_first_seed_before_any_has_its_second(base: Scenario) -> None:
    results = SweepResults(plan_sweep(base, [parse_axis("turbulence.wind_speed=5:15:3")], 2))
    order = []
    while (following := results.next_run()) is not None:
        order.append(following)
        if following == (1, 0):
            results = results.add_failure(1, "they exclude each other")
        else:
            results = results.add(following[0], [])
    assert order == [(0, 0), (1, 0), (2, 0), (0, 1), (2, 1)]
    assert results.n_done == results.sweep.n_runs == 6


@pytest.mark.parametrize(
    ("over", "seeds", "line"),
    [
        (["turbulence.wind_speed=20:5:4"], 2, "the first number must be below the second"),
        (["turbulence.wind_speed=0:5:4:log"], 2, "must be below the second and above 0"),
        (["turbulence.wind_speed=5:20:1"], 2, "takes low:high:number with a number from 2 to 50"),
        (["turbulence.wind_speed=5:nan:3"], 2, "takes low:high:number"),
        (["turbulence.wind_speed=5:20"], 2, "1 values; takes 2 to 50, as low:high:number or with commas"),
        (["turbulence.wind_speed=5,5"], 2, "has 5 twice"),
        (["turbulence.wind_speed"], 2, "takes name=value,value"),
        (["turbulence.wind=5,6"], 2, "turbulence.wind: no such setting"),
        (["sensors.exposure_ratio=1:4:3"], 2, "sensors.exposure_ratio = 2.5: takes a whole number from 1 to 100"),
        (["turbulence.wind_speed=5:500:4"], 2, "turbulence.wind_speed = 170: takes a number from 0.1 to 100 m/s"),
        (["run.seed=1,2"], 2, "every scenario has the same seeds"),
        (["run.duration=1,2", "run.duration=3,4"], 2, "run.duration: is given twice"),
        (["run.duration=1,2", "run.warm_up=0,1", "telescope.diameter=8,10"], 2, "takes one or two settings, not 3"),
        (["turbulence.wind_speed=5:20:30", "kalman.frequency=5:20:30"], 2, f"900 scenarios, at most {MOST_CELLS}"),
        (["turbulence.wind_speed=5,6"], 0, "seeds = 0: takes a whole number from 1 to 100"),
    ],
)
def test_what_cannot_be_run_is_refused_in_one_line(base: Scenario, over: list[str], seeds: int, line: str) -> None:
    with pytest.raises(SettingError) as refused:
        plan_sweep(base, [parse_axis(text) for text in over], seeds)
    assert line in str(refused.value) and "\n" not in str(refused.value)


def test_an_unknown_observer_is_refused(base: Scenario) -> None:
    with pytest.raises(SettingError, match="observer 'kf-lsg': no such observer"):
        plan_sweep(base, [parse_axis("turbulence.wind_speed=5,6")], 1, ["kf-lsg"])


def test_time_is_that_of_the_observers_chosen(base: Scenario) -> None:
    axis = [parse_axis("run.duration=10,20")]
    few, every = (plan_sweep(base, axis, 2, names) for names in (FEW, None))
    # Two seeds of each duration; no straight line over it, for the windows of the adaptive filters come one at a time.
    runs = [base.replace({"run.duration": d}) for d in (10.0, 20.0)]
    one_seed = sum(EACH_RUN + EACH_STEP * s.n_steps * len(s.modes) + wfsobs.cost.run_seconds(s) for s in runs)
    assert every.seconds == pytest.approx(2 * one_seed, rel=1e-12)
    assert 4 * EACH_RUN < few.seconds < every.seconds / 1.5


@pytest.mark.slow
def test_command_line(results: SweepResults, tmp_path: Path) -> None:
    file = tmp_path / "errors.csv"
    words = [f"--set={path}={value}" for path, value in SHORT.items()] + [f"--observer={name}" for name in FEW]
    over = ["--over=turbulence.wind_speed=5:20:2", "--over", "sensors.exposure_ratio=5,10"]
    done = CliRunner().invoke(main, ["sweep", *words, *over, "--seeds=3", f"--csv={file}"], env={"COLUMNS": "200"})
    assert done.exit_code == 0 and "4 scenarios x 3 seeds = 12 runs, about" in done.stderr
    with file.open() as text:
        saved = list(csv.DictReader(text))
    expected = results.rows()
    assert len(saved) == len(expected) > 0
    for row, one in zip(saved, expected, strict=True):
        assert (row["turbulence.wind_speed"], row["observer"], row["rank"]) == (
            str(one["turbulence.wind_speed"]),
            one["observer"],
            one["rank"],
        )
        assert float(row["mean_rms_nm"]) == pytest.approx(one["mean_rms_nm"], rel=1e-12)
    best = results.winner(0, "vibration", "tip")
    assert best is not None and f"{1e3 * best.rms:.2f}" in done.stdout
    refused = CliRunner().invoke(main, ["sweep", "--over", "run.duration=2:1:2"])
    assert refused.exit_code == 2 and refused.stderr.count("\n") == 1


def test_the_verdict_on_a_cell_is_its_winner_and_that_on_all_counts_them(results: SweepResults) -> None:
    cells = range(len(results.sweep.cells))
    for target in ("turbulence", "vibration"):
        verdicts = [it for cell in cells if (it := results.verdict(cell, target, "tip")) is not None]
        winners = [it for cell in cells if (it := results.winner(cell, target, "tip")) is not None]
        assert [it.best.observer for it in verdicts] == [it.name for it in winners] and len(verdicts) == len(cells)
        said = sentence_of_several(verdicts, [1e3] * len(cells), "nm")
        for kind, heading in (("nothing", "Without prior knowledge"), ("peaks", "With known peak frequencies")):
            best = [place for it in verdicts if (place := it.best_with(kind))]
            counts = re.search(rf"{heading}: smallest error of (.*?) of (\d+) scenarios", said)
            assert (counts is None) == (not best)
            if counts:
                assert sum(map(int, re.findall(r" in (\d+)", counts[1]))) == int(counts[2]) == len(best)
                assert f"{row_label(best[0].observer)} in " in counts[1]


def test_an_error_is_at_the_limit_where_its_interval_is_narrow_and_none_is_better(results: SweepResults) -> None:
    """Of 40 nm with the limit in its interval: this must be narrow, and no other may be better over the same records."""
    found = results.verdict(0, "turbulence", "tip")
    assert found is not None
    for low, high, limit, equal in ((0.005, 0.075, 0.01, False), (0.028, 0.052, 0.03, False), (0.032, 0.048, 0.035, True)):
        place = replace(found.best, knowledge="nothing", rms=0.04, interval=(low, high), limit=(limit, "bound-both"))
        above = 0.0 if equal else nan if low <= limit <= high else 0.04 / limit - 1.0
        assert place.above_limit == pytest.approx(above, nan_ok=True)
        for is_tie in (False, True):
            said = sentence_of_several([replace(found, places=(replace(place, is_tie=is_tie),))], [1e3], "nm")
            assert said.endswith(f"40.0 to 40.0 nm{', at the theoretical limit in 1' * (is_tie and equal)}.")
