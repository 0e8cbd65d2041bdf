"""Following a campaign: the arrays say what the comparison of all rows says, and what comes later is added."""

import os

import numpy as np
import pytest

from wfsobs.campaign.compare import CampaignErrors, compare
from wfsobs.campaign.follow import CampaignFolder
from wfsobs.campaign.plan import MOST_VALUES, parse_plan, plan_axes
from wfsobs.campaign.report import write_report
from wfsobs.campaign.run import run_rows
from wfsobs.campaign.store import batch_files, open_folder, read_batch, read_results, write_batch
from wfsobs.settings.values import SettingError

PLAN = """
name = "Tiny"
seeds = 3
observers = ["kf-lgs", "persistence"]
[settings]
run.duration = 0.3
run.warm_up = 0.1
[grid]
turbulence.wind_speed = [20, 5]
sensors.exposure_ratio = [5, 10]
"""


@pytest.fixture
def plan(tmp_path):
    return parse_plan(PLAN, tmp_path)


def add_batch(plan, folder, cells, seeds, written):
    rows = [row for c in cells for s in seeds for row in run_rows(plan.cells[c], s, plan.observers, plan.controllers)]
    write_batch(folder, rows, {"host": "here", "process": 1, "written": written})


@pytest.mark.slow
def test_what_is_followed_is_what_is_compared(plan, tmp_path, monkeypatch):
    open_folder(plan, tmp_path)
    followed = CampaignFolder(tmp_path)
    assert followed.read().n_done == 0 and not followed.read().errors
    add_batch(plan, tmp_path, range(4), (1,), 1000.0)
    first = followed.read()
    assert first.n_done == 4 and followed.read() is first
    monkeypatch.setattr("wfsobs.campaign.follow.time", lambda: 1030.0)
    add_batch(plan, tmp_path, range(4), (2,), 1020.0)
    state = followed.read()
    assert (state.n_done, state.seconds_left) == (8, 20.0), "four runs in 20 s, four are left"
    monkeypatch.setattr("wfsobs.campaign.follow.time", lambda: 9000.0)
    assert np.isnan(followed.read().seconds_left), "nothing was written for long"
    add_batch(plan, tmp_path, range(4), (2, 3), 9001.0)  # one again, by a worker that was taken for dead
    state = followed.read()
    table = read_results(tmp_path)
    assert state.n_done == plan.n_runs and not any(lost.any() for lost in state.failures.values())
    for one in compare(table):
        standings = {s.name: s for s in state.errors[one.target, one.mode].standings([one.cell])}
        mine, best = standings[one.name], next((s for s in standings.values() if s.is_best), None)
        # The same sums in another order: rounding.
        assert mine.rms == pytest.approx(one.rms, rel=1e-12)
        assert (mine.is_best, mine.is_tie) == (one.is_best, one.is_tie)
        if one.difference is not None:
            assert mine.above * best.rms == pytest.approx(one.difference, rel=1e-9)
            assert 0.5 * (mine.high - mine.low) * best.rms == pytest.approx(one.half_width, rel=1e-9)


@pytest.mark.parametrize("newest", [0, 1])
def test_of_rows_of_two_versions_the_newer_ones_count(tmp_path, newest):
    plan = parse_plan('seeds = 1\nobservers = ["kf-lgs"]\n', tmp_path)
    open_folder(plan, tmp_path)
    row = {"cell": 0, "scenario": "paper", "seed": 1, "name": "kf-lgs", "target": "total", "mode": "tip", "apart": False}
    for rms in (1.0, 2.0):
        write_batch(tmp_path, [{**row, "key": f"{rms}", "rms_nm": rms}], {"host": "", "process": 1, "written": 1.0})
    files = batch_files(tmp_path)
    os.utime(files[newest], (2e9, 2e9))
    expected = read_batch(files[newest], ["rms_nm"])["rms_nm"].to_pylist()
    assert CampaignFolder(tmp_path).read().errors["total", "tip"].values.ravel().tolist() == expected


def test_scenarios_that_fail_are_counted(tmp_path):
    plan = parse_plan('seeds = 2\nobservers = ["kf-lgs"]\n[settings]\nrun.duration = 0.3\nrun.warm_up = 0.1', tmp_path)
    open_folder(plan, tmp_path)
    row = {"key": "k", "cell": 0, "scenario": "paper", "seed": 2, "name": "kf-lgs", "target": "", "mode": "", "apart": False}
    write_batch(tmp_path, [{**row, "rms_nm": None, "note": "no"}], {"host": "", "process": 1, "written": 1.0})
    state = CampaignFolder(tmp_path).read()
    assert state.n_done == 1 and state.failures["kf-lgs"].tolist() == [1] and not state.errors
    assert plan_axes(plan) == []


def test_scenarios_are_the_blocks_of_many():
    """Errors of b are 2, 2 and 2 times those of a: certain; the logarithms of those of c differ by -0.6, 0.1 and 0.8."""
    a = np.array([10.0, 20.0, 40.0])
    values = np.stack([a, 2.0 * a * [1.0, 1.001, 0.999], a * np.exp([-0.6, 0.1, 0.8]), 0.5 * a], axis=-1)[:, None, :]
    errors = CampaignErrors(("a", "b", "c", "bound"), values, np.tile([True, True, True, False], (3, 1)))
    found = {s.name: s for s in errors.standings([0, 1, 2])}
    assert found["a"].rms == pytest.approx(20.0) and found["a"].is_best
    assert found["b"].above == pytest.approx(1.0, abs=1e-3) and not found["b"].is_tie
    # Student's t of 2 degrees of freedom at 97.5 % is 4.303; the logarithms have mean 0.1 and deviation 0.7.
    assert found["c"].is_tie and found["c"].high == pytest.approx(np.exp(0.1 + 4.303 * 0.7 / 3**0.5) - 1.0, rel=1e-3)
    assert np.isnan(found["bound"].above) and not found["bound"].is_best
    ratio, low, high = errors.over_bound([0, 1, 2])
    assert ratio[:1] == pytest.approx(2.0) and (low[0], high[0]) == pytest.approx((2.0, 2.0))


def test_nothing_is_tied_without_a_test():
    """Errors of b are 1.0 to 1.2 nm above those of a, of c 3 nm below to 3 nm above; of another scenario a alone is known."""
    a = np.array([10.0, 11.0, 12.0])
    values = np.full((3, 3, 3), np.nan)
    values[0] = a[:, None] + [[0.0, 1.0, -3.0], [0.0, 1.1, 0.2], [0.0, 1.2, 3.0]]
    errors = CampaignErrors(("a", "b", "c"), values, np.ones((3, 3), dtype=bool))
    assert str(errors.standings([0, 1, 2])) == str(errors.standings([0])), "what has no results is no scenario of a test"
    places = [(s.name, s.is_best, s.is_tie, s.is_untested) for s in sorted(errors.standings([0, 1, 2]))]
    assert places == [("a", True, False, False), ("b", False, False, False), ("c", False, True, False)]
    assert (errors.verdict([0, 1, 2]).ties, errors.verdict([0, 1, 2]).is_decided) == (("c",), False)
    values = values[..., :2].copy()
    assert CampaignErrors(("a", "b"), values, np.ones((3, 2), dtype=bool)).winners[0].is_decided
    for count in (1, 3):  # seeds of a second scenario, of a alone: then b has one scenario, and before its test over the seeds
        values[1, :count, 0] = 20.0
        found = CampaignErrors(("a", "b"), values, np.ones((3, 2), dtype=bool))
        assert [(s.is_tie, s.is_untested) for s in sorted(found.standings([0, 1]))] == [(False, False), (False, True)]
        assert found.verdict([0, 1]).ties == () and not found.verdict([0, 1]).is_decided
        assert not found.winners[1].is_decided, "there is nothing beside it"


@pytest.mark.parametrize(("rms", "margin"), [(12.0, 2.0 / 500.0**0.5), (9.0, 0.0)])
def test_the_margin_is_over_the_seeds_that_both_have(tmp_path, rms, margin):
    """The best has 10 nm twice and 30 nm, where the next failed, twice, so an rms of sqrt(500)."""
    values = np.array([[[10.0, rms], [10.0, rms], [30.0, np.nan], [30.0, np.nan]]])
    found = CampaignErrors(("kf-lgs", "kf-multi"), values, np.ones((1, 2), dtype=bool)).winners[0]
    assert found.best.name == "kf-lgs" and found.margin == pytest.approx(margin, rel=1e-12)
    names = '["kf-lgs", "kf-multi"]'
    plan = parse_plan(f"seeds = 4\nobservers = {names}\n[grid]\nturbulence.wind_speed = [5, 20]", tmp_path)
    open_folder(plan, tmp_path)
    row = {"scenario": "paper", "target": "total", "mode": "tip", "apart": False}
    rows = [
        {**row, "key": f"{cell} {i} {name}", "cell": cell, "seed": i + 1, "name": name, "rms_nm": None if np.isnan(it) else it}
        for cell in (0, 1)
        for i, of in enumerate(values[0].tolist())
        for name, it in zip(("kf-lgs", "kf-multi"), of, strict=True)
    ]
    write_batch(tmp_path, rows, {"host": "", "process": 1, "written": 1.0})
    write_report(tmp_path, tmp_path / "report.html")
    assert f"22.4 nm, {100.0 * margin:.0f} % before the next" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_many_values_are_put_into_bins(tmp_path):
    plan = parse_plan("[grid]\nturbulence.wind_speed = " + str([5 + i / 10 for i in range(100)]), tmp_path)
    (axis,) = plan_axes(plan)
    assert axis.is_binned and len(axis.values) == MOST_VALUES
    wind = [cell.changes["turbulence.wind_speed"] for cell in plan.cells]
    assert all(axis.values[i][0] <= w <= axis.values[i][1] for i, w in zip(axis.of_cell, wind, strict=True))
    assert np.bincount(axis.of_cell).min() >= 6, "of 100 values 6 or 7 are in each of 16 bins"


def test_a_folder_without_a_campaign_is_refused(tmp_path):
    with pytest.raises(SettingError, match="holds no campaign"):
        CampaignFolder(tmp_path)
