"""The page of sweeps: true to the core, one run at a time, behind whoever clicks, within limits."""

from __future__ import annotations

import csv
import io
import threading
from dataclasses import replace
from html import unescape
from typing import Any

import numpy as np
import pytest

from tests.patience import ENOUGH
from wfsobs.app.dashboard import Dashboard
from wfsobs.app.idle_work import SeedScores
from wfsobs.app.jobs import CANCELLED, DONE, FAILED, RUNNING, Job
from wfsobs.app.limits import NONE, Limits
from wfsobs.app.pages import sweep as sweep_work
from wfsobs.app.pages.pages import EXPLORE, SWEEP
from wfsobs.app.pages.sweep import EVERY, SweepPage, SweepTask, sweep_settings
from wfsobs.app.pages.sweep_views import FULL_MARGIN, GROUNDS, mix
from wfsobs.app.render import number
from wfsobs.app.service import Service
from wfsobs.app.sources import SimulatedRecord
from wfsobs.app.style import look
from wfsobs.campaign.sweep import SweepResults, parse_axis, plan_sweep, run_sweep
from wfsobs.campaign.usual_values import usual_values
from wfsobs.evaluation.scores import Score
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.scenario.scenario import idle_settings, why_idle_at
from wfsobs.settings.values import SettingError

"""As long as one run is waited for elsewhere [s]."""

WIND, RATIO = "turbulence.wind_speed", "sensors.exposure_ratio"


@pytest.fixture
def short(short: Scenario) -> Scenario:
    """Of few peaks, which settings are copied with for each value that is planned, and observers have models of."""
    return short.replace({"vibration.peaks": [peak.to_dict() for peak in short.vibration.peaks[-2:]]})


@pytest.fixture
def page(dashboard: Dashboard) -> SweepPage:
    dashboard.pages.current = SWEEP
    page = dashboard.pages.by_name[SWEEP]
    assert isinstance(page, SweepPage)
    return page


def finish(page: SweepPage, loop: Any) -> None:
    page.starter.start.param.trigger("clicks")
    loop.until(lambda: page.work.state != RUNNING, 4 * ENOUGH)  # several runs
    assert page.work.state == DONE, page.work.message


def cell(page: SweepPage, index: int, target: str) -> dict[str, Any]:
    return next(c for row in page.maps[target].grid["cells"] for c in row if c["index"] == index)


@pytest.mark.usefixtures("quick")
def test_a_map_is_what_the_core_finds(page: SweepPage, dashboard: Dashboard, loop: Any) -> None:
    store = dashboard.store
    store.change("run.duration", 1.0)
    page.axes[0].values.value, page.axes[1].values.value, page.seeds.value = "5,20", "5,10", "3"
    said = f'<p class="text" role="status">2 × 2 scenarios × 3 seeds = 12 runs, about {page.plan().seconds:.0f} s'
    assert page.estimate.html.startswith(said)
    sweep = page.plan()
    assert "kf-multi" in sweep.observers
    finish(page, loop)
    last = replace(sweep, axes=tuple(replace(axis, values=axis.values[1:]) for axis in sweep.axes))
    results, expected = page.results, run_sweep(last)
    assert results is not None
    rows = [row for row in results.rows() if (row[WIND], row[RATIO]) == (20.0, 10)]
    for row, one in zip(rows, expected.rows(), strict=True):
        assert {k: v for k, v in row.items() if not isinstance(v, float)} == {
            k: v for k, v in one.items() if not isinstance(v, float)
        }
        # The same computation; rounding may depend on the threads of BLAS.
        assert row["mean_rms_nm"] == pytest.approx(one["mean_rms_nm"], rel=1e-6)
    grid = page.maps["vibration"].grid
    assert (grid["columns"], grid["rows"]) == (["5", "20"], ["10", "5"]), "the smallest value is at the bottom"
    assert [[c["index"] for c in row] for row in grid["cells"]] == [[1, 3], [0, 2]]
    for index in range(4):
        for target in ("turbulence", "vibration"):
            best, shown = results.winner(index, target, "tip"), cell(page, index, target)
            assert best is not None and best.margin is not None
            assert shown["text"] == number(1e3 * best.rms)
            assert shown["state"] == ("decided" if best.is_significant else "open")
            assert f"{100 * best.margin:.0f} % before the next" in shown["title"] and shown["title"].endswith("; 3 seeds")
    dashboard.display.unit = "mas"
    best = results.winner(0, "vibration", "tip")
    mas_per_um = 4e-6 / store.scenario.telescope.diameter * np.degrees(1.0) * 3.6e6
    assert best is not None and cell(page, 0, "vibration")["text"] == number(mas_per_um * best.rms)
    save = page.saves()["Sweep as CSV"]
    assert save is not None
    saved = list(csv.DictReader(io.StringIO(save.content().decode())))
    assert [float(row["mean_rms_nm"]) for row in saved] == [row["mean_rms_nm"] for row in results.rows()]
    a_cell_is_loaded_and_undone(page, dashboard, loop)


def test_colours_and_shades(page: SweepPage, dashboard: Dashboard) -> None:
    """Invented errors: the first cell is decided by some per cent, the second by more than a full colour takes, the third not."""
    results = SweepResults(plan_sweep(dashboard.store.scenario, [parse_axis(f"{WIND}=5,10,15,20")], 4))
    for index, second in enumerate((0.0115, 0.02, 0.0101)):
        for seed, scatter in enumerate((0.0, 0.0004, -0.0003, 0.0002)):
            common = 0.002 * seed  # the same in both, so that it cancels in pairs
            errors = {"kf-lgs": 0.01 + common, "kf-multi": second + common + (scatter if index != 1 else 0.0001 * seed)}
            scores = [Score(name, "vibration", "tip", rms, 0.02, None, None, 0.0) for name, rms in errors.items()]
            results = results.add(index, scores)
    page.work.result = results
    winners = [results.winner(index, "vibration", "tip") for index in range(3)]
    assert [best and (best.name, best.is_significant) for best in winners] == [("kf-lgs", i < 2) for i in range(3)]
    for index, best in enumerate(winners[:2]):
        assert best is not None and best.margin is not None
        share = 0.35 + 0.65 * min(1.0, best.margin / FULL_MARGIN)
        shown = cell(page, index, "vibration")
        assert shown["state"] == "decided" and shown["ground"] == mix(look("kf-lgs").light, GROUNDS[False], share)
    assert cell(page, 1, "vibration")["ground"] == look("kf-lgs").light.lower()
    third = cell(page, 2, "vibration")
    assert third["state"] == "open" and "not significantly different from Multi-peak KF" in third["title"]
    assert cell(page, 3, "vibration")["state"] == "waiting" and cell(page, 3, "vibration")["title"].endswith("not run yet")


def a_cell_is_loaded_and_undone(page: SweepPage, dashboard: Dashboard, loop: Any) -> None:
    store = dashboard.store
    before = store.scenario
    page.maps["vibration"]._handle_msg({"action": "load", "key": "3"})
    assert store.scenario == before.replace({WIND: 20.0, RATIO: 10}) and dashboard.pages.current == EXPLORE
    loop.finish(store)
    assert store.run.result is not None and store.run.result.scenario == store.scenario
    dashboard.pages.current = SWEEP
    assert not page.stale.visible, "the settings of the axes differ, and no others"
    store.change("kalman.frequency", 20.0)
    assert page.stale.visible
    store.undo()
    store.undo()
    assert store.scenario == before and not page.stale.visible
    for nonsense in (
        *({"action": "load", "key": key} for key in ("99", "-1", "x", "", None, 3.5)),
        {"action": "star", "key": "3"},
        {},
        None,
    ):
        page.maps["vibration"]._handle_msg(nonsense)
    assert store.scenario == before


def test_lines_over_one_setting(page: SweepPage, dashboard: Dashboard, loop: Any) -> None:
    page.axes[1].select.value = ""
    assert page.axes[1].values.disabled
    page.axes[0].values.value, page.seeds.value = "20,5", "3"
    finish(page, loop)
    results = page.results
    assert results is not None
    lines = page.lines["vibration"].lines
    assert lines is not None
    data = lines.sources["kf-multi"].data
    assert list(data["x"]) == [5.0, 20.0], "sorted"
    for i, index in enumerate((1, 0)):
        error = results.error(index, ("kf-multi", "vibration", "tip"))
        assert error is not None and error[1] < error[0] < error[2]
        assert [data[name][i] for name in ("y", "low", "high")] == pytest.approx([1e3 * e for e in error])
    assert np.isfinite(lines.sources["bound"].data["y"]).all() and "kf-adaptive" not in lines.sources
    assert lines.figure.xaxis[0].axis_label == "Wind speed V₀ [m/s]"
    assert len(page.maps["vibration"].grid["cells"]) == 1
    assert page.lines["vibration"].view.visible


def test_settings_and_their_usual_values(page: SweepPage, dashboard: Dashboard) -> None:
    scenario = dashboard.store.scenario
    paths = list(sweep_settings(scenario).values())
    assert {WIND, RATIO, "vibration.source", "run.duration"} <= set(paths) and len(set(paths)) == len(paths)
    assert "run.seed" not in paths and not any(path.startswith("vibration.peaks") for path in paths)
    for path in paths:
        axis = parse_axis(f"{path}={usual_values(scenario, path)}")
        assert len(axis.values) >= 2
        group, _, name = path.rpartition(".")
        for value in axis.values:  # each is one that the setting takes
            scenario.lookup(group).replace({name: value})
    assert usual_values(scenario, RATIO) == "1,6,10,15,20"
    page.axes[0].select.value = "gpr_online.length_scale"
    assert "gpr-online" in page.plan().observers and "kf-adaptive" not in page.plan().observers, "its own observer runs"


def test_usual_values_go_with_the_other_settings() -> None:
    """What is suggested of a setting can be run, unless a line says that it changes nothing."""
    scenario = PRESETS["laser-dropout"]()
    idle = idle_settings(scenario)
    events = [f"events.{i}.{name}" for i in range(len(scenario.events)) for name in ("start", "duration", "lasers", "kind")]
    others = [
        "turbulence.source",
        "vibration.source",
        "sensors.lgs_count",
        "run.duration",
        "sensors.spots.pixels",
        "control.gain",
    ]
    for path in (*events, *others, "gp.background_scale", "butterworth.frequencies", "vibration.peaks.3.rms.0"):
        values = usual_values(scenario, path)
        changes_nothing = bool(why_idle_at(path, idle)) or path.startswith("control.")
        said = reason(scenario, path, values)
        assert values and bool(said) == changes_nothing and ("changes no error" in said) == changes_nothing, (path, said)


def reason(scenario: Scenario, path: str, values: str) -> str:
    try:
        plan_sweep(scenario, [parse_axis(f"{path}={values}")], 3, ["kf-lgs"])
    except SettingError as error:
        return str(error)
    return ""


def test_the_address_has_the_fields(page: SweepPage, dashboard: Dashboard) -> None:
    assert dashboard.view_state.open("view.page=sweep&view.sweep.over=vibration.peaks.1.frequency&view.sweep.second=") == []
    page.axes[0].values.value, page.seeds.value = "8:12:3:log", "3"
    query = dashboard.view_state.query
    assert query == (
        "view.page=sweep&view.sweep.over=vibration.peaks.1.frequency&view.sweep.values=8:12:3:log&view.sweep.second="
        "&view.sweep.seeds=3"
    )
    planned = page.plan()
    dashboard.pages.current = EXPLORE
    assert dashboard.view_state.query == "", "the fields of the page shown alone"
    assert dashboard.view_state.open("view.page=sweep") == []
    assert page.axes[0].select.value == WIND and page.axes[1].values.value == "2,5,10,20"
    assert dashboard.view_state.open(query) == [] and page.plan() == planned and dashboard.view_state.query == query
    colour, over = dashboard.view_state.open("view.page=sweep&view.sweep.over=no.such&view.sweep.colour=red")
    assert colour == "view.sweep.colour: there is no such part of a view"
    assert over.startswith("view.sweep.over = no.such: takes one of telescope.diameter, ")


def test_what_cannot_be_run_is_said_in_one_line(page: SweepPage, dashboard: Dashboard) -> None:
    store = dashboard.store
    for field, text, line in (
        (page.axes[0].values, "20:5:4", "Wind speed V₀=20:5:4: the first number must be below the second"),
        (page.axes[0].values, "5:500:3", "Wind speed V₀ = 252.5: takes a number from 0.1 to 100 m/s"),
        (page.axes[1].values, "", "Exposure ratio n: takes values, such as 5:20:4 or 5,10,20"),
        (page.seeds, "many", "Seeds of each = 'many': takes a whole number from 1 to 100"),
        (page.seeds, "0", "Seeds of each = '0': takes a whole number from 1 to 100"),
    ):
        before = field.value
        field.value = text
        assert line in unescape(page.estimate.html) and 'class="failure"' in page.estimate.html and page.starter.start.disabled
        page.starter.begin()
        assert page.work.state == FAILED and line in page.starter.status.note and "\n" not in page.starter.status.note
        field.value = before
        assert 'class="text"' in page.estimate.html and not page.starter.start.disabled
    store.limits = Limits(sweep_seconds=10.0)
    page.observers.value = EVERY
    seconds = plan_sweep(store.scenario, [parse_axis(f"{WIND}=5:25:5"), parse_axis(f"{RATIO}=2,5,10,20")], 4).seconds
    assert f"80 runs would take about {seconds:.0f} s, at most 10 on this server" in page.estimate.html
    store.limits = Limits(duration=1.0)
    page.seeds.value = "3"
    assert "Duration = 2: at most 1 s on this server" in page.estimate.html
    store.limits = NONE
    store.source = SimulatedRecord(store.scenario)
    assert "go back to the simulation first" in page.estimate.html


@pytest.fixture
def service() -> Any:
    service = Service(NONE, 1, 1_000_000)
    yield service
    service.close(20.0)


def test_a_click_waits_for_one_run_at_most_and_what_was_run_is_kept(
    service: Service, short: Scenario, loop: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, begun, go = [], threading.Event(), threading.Event()

    def compute(_sweep: Any, cell: int, number: int, *_: Any) -> SeedScores:
        log.append((cell, number))
        begun.set()
        go.wait(30)
        return SeedScores((), np.zeros(1))

    monkeypatch.setattr(sweep_work, "compute", compute)
    session = service.enter()
    session.post = loop.queue.put
    task = SweepTask(session)
    task.begin(plan_sweep(short, [parse_axis(f"{WIND}=5,10,15")], 2))
    assert begun.wait(30)
    service.queue.submit(Job("run", lambda *_: log.append("click")), "another", lambda _news: None)
    go.set()
    loop.until(lambda: len(log) >= 4)
    assert log[:3] == [(0, 0), "click", (1, 0)], "one worker: the click came during the first run"
    task.cancel()
    assert task.state == CANCELLED and 2 <= task.result.n_done < 6
    task.begin(plan_sweep(short, [parse_axis(f"{WIND}=5,10,15")], 2))
    loop.until(lambda: task.state == DONE)
    assert task.result.n_done == 6 and task.progress == 1.0
    runs = [entry for entry in log if entry != "click"]
    assert len(runs) - len(set(runs)) <= 1, "what was done before the stop is not done again, but for the run under way"
    session.leave()


@pytest.mark.usefixtures("quick")
def test_a_cell_that_cannot_be_run_says_why(page: SweepPage, loop: Any) -> None:
    """The warm-up is longer than the record in one combination alone."""
    page.axes[0].select.value, page.axes[1].select.value = "run.duration", "run.warm_up"
    page.axes[0].values.value, page.axes[1].values.value, page.seeds.value = "1,0.6", "0.2,0.8", "1"
    finish(page, loop)
    assert page.results is not None and set(page.results.failures) == {3} and page.results.n_done == 4
    shown = cell(page, 3, "vibration")
    assert shown["state"] == "failed" and shown["text"] == "×" and "warm_up" in shown["title"]
    assert cell(page, 0, "vibration")["title"].endswith("; 1 seed")
