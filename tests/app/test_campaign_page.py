"""The page of a campaign: there if the server has one, true to the comparison of its rows, a square opens its scenario."""

from __future__ import annotations

import csv
import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.jobs import DONE
from wfsobs.app.pages.campaign import CampaignPage, standings_html
from wfsobs.app.pages.pages import CAMPAIGN, EXPLORE
from wfsobs.app.render import number
from wfsobs.app.service import Session
from wfsobs.app.share import CAMPAIGN as COPIED
from wfsobs.app.share import CopiedTask, to_command, to_python
from wfsobs.campaign.compare import compare
from wfsobs.campaign.follow import CampaignFolder
from wfsobs.campaign.plan import Campaign, parse_plan
from wfsobs.campaign.run import run_rows
from wfsobs.campaign.store import PLAN as PLAN_FILE
from wfsobs.campaign.store import batch_files, open_folder, read_results, write_batch
from wfsobs.cli import main
from wfsobs.scenario import Scenario

PLAN = """
name = "Tiny"
seeds = 2
first_seed = 7
observers = ["kf-lgs", "persistence"]
controllers = ["integrator"]
[settings]
run.duration = 0.3
run.warm_up = 0.1
[grid]
turbulence.wind_speed = [5, 20]
sensors.exposure_ratio = [5, 10]
"""
PLACE = {"host": "here", "process": 1, "written": 1.0}


def add_batch(plan: Campaign, folder: Path, seed: int) -> None:
    write_batch(folder, [row for cell in plan.cells for row in run_rows(cell, seed, plan.observers, plan.controllers)], PLACE)


@pytest.fixture
def plan(tmp_path: Path) -> Campaign:
    plan = parse_plan(PLAN, tmp_path)
    open_folder(plan, tmp_path)
    add_batch(plan, tmp_path, 7)
    return plan


@pytest.fixture
def dashboard(loop: Any, short: Scenario, enter: Callable[..., Session], plan: Campaign, tmp_path: Path) -> Dashboard:
    session = enter()
    session.service.campaign = CampaignFolder(tmp_path)
    dashboard = Dashboard(loop.queue.put, session, short)
    loop.closing.append(dashboard)
    dashboard.page()
    return dashboard


def open_campaign(dashboard: Dashboard, loop: Any) -> CampaignPage:
    dashboard.pages.current = CAMPAIGN
    page = dashboard.pages.by_name[CAMPAIGN]
    assert isinstance(page, CampaignPage)
    loop.until(lambda: page.state is not None)
    return page


def squares(page: CampaignPage) -> dict[int, dict[str, Any]]:
    return {square["index"]: square for row in page.map.grid["cells"] for square in row}


def test_a_campaign_is_followed_and_opened(dashboard: Dashboard, loop: Any, plan: Campaign, tmp_path: Path) -> None:
    page = open_campaign(dashboard, loop)
    assert page.status.text.startswith("Tiny: 4 of 8 runs, 4 scenarios, ")
    assert {square["state"] for square in squares(page).values()} == {"open"}, "one seed decides nothing"
    add_batch(plan, tmp_path, 8)
    page.tick()
    loop.until(lambda: "8 of 8 runs" in page.status.text)
    assert page.status.text.endswith(", finished")
    assert "Persistence" in page.table.html and "interval of 95 %" in page.table.html
    assert page.state is not None
    view = page.view_of(page.state)
    assert view is not None
    looked_at = replace(view, errors=replace(view.errors, level=0.99))
    assert "interval of 99 %" in standings_html(looked_at, page.display), "the level that is tested at"
    page.target.value = "vibration"
    grid = page.map.grid
    assert (grid["columns"], grid["rows"]) == (["5", "20"], ["10", "5"]), "the smallest value is at the bottom"
    best = {c.cell: c for c in compare(read_results(tmp_path)) if (c.target, c.mode, c.is_best) == ("vibration", "tip", True)}
    assert {cell: square["text"] for cell, square in squares(page).items()} == {c: number(one.rms) for c, one in best.items()}
    assert "Persistence" not in page.table.html, "it has no estimate of the vibration"
    assert page.slice.lines is not None
    y = page.slice.lines.sources["kf-lgs"].data["y"]
    rms = {c.cell: c.rms for c in compare(read_results(tmp_path)) if (c.target, c.mode, c.name) == ("vibration", "tip", "kf-lgs")}
    assert y == pytest.approx([(rms[0] * rms[1]) ** 0.5, (rms[2] * rms[3]) ** 0.5]), "geometric mean over the other condition"
    page.target.value = "residual"
    assert "integrator" in page.slice.lines.sources, "the best of every error are shown first"
    page.target.value = "vibration"
    page.filters["sensors.exposure_ratio"].value = "5"
    assert page.slice.lines.sources["kf-lgs"].data["y"] == pytest.approx([rms[0], rms[2]])
    of_states = [[(s["state"], s["title"].rpartition(": ")[2]) for s in row] for row in page.map.grid["cells"]]
    assert of_states[0] == [("left-out", "left out by the fields Only …")] * 2, "not as if they were to be run yet"
    assert {state for state, _ in of_states[1]} <= {"open", "decided"}
    page.map._handle_msg({"action": "load", "key": "3"})
    opened = plan.cells[3].scenario().replace({"run.seed": 7})
    assert dashboard.store.scenario == opened and dashboard.pages.current == EXPLORE
    for nothing in (-1, 4):
        page.load(nothing)
    assert dashboard.store.scenario == opened


def test_a_campaign_that_was_stopped_is_said_to_be(
    dashboard: Dashboard, loop: Any, plan: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def add(cell: int, written: float) -> None:
        write_batch(tmp_path, run_rows(plan.cells[cell], 8, plan.observers, plan.controllers), {**PLACE, "written": written})

    def look_at(now: float) -> None:
        monkeypatch.setattr("wfsobs.campaign.follow.time", lambda: now)
        for at in (page, *others):
            at.tick()
            loop.until(lambda at=at: at.work.state == DONE)

    started, others = (tmp_path / "plan.json").stat().st_mtime, []
    for path in batch_files(tmp_path):
        path.unlink()
    add(0, started + 6.0)
    add(1, started + 14.0)
    monkeypatch.setattr("wfsobs.campaign.follow.time", lambda: started + 14.0)
    page = open_campaign(dashboard, loop)
    usual = "Tiny: 2 of 8 runs, 4 scenarios, 52 rows"
    assert page.status.text == f"{usual}, about 48 s left", "six runs of 8 s"
    look_at(started + 37.0)
    assert page.status.text == f"{usual}, about 48 s left", "23 s are less than three times 8 s"
    look_at(started + 54.0)
    stopped = f"{usual}; no new batch for 40 s: stopped, or slower than before"
    assert page.status.text == stopped
    other = CampaignPage(dashboard.store, dashboard.display, lambda: None)  # as a reload makes it
    others.append(other)
    look_at(started + 54.0)
    assert other.status.text == page.status.text == stopped
    look_at(started + 354.0)
    assert "no new batch for 6 min" in page.status.text
    add(2, started + 354.0)
    add(3, started + 360.0)
    look_at(started + 361.0)
    assert page.status.text == "Tiny: 4 of 8 runs, 4 scenarios, 104 rows, about 24 s left", "four runs of 6 s"


def cells_of(page: CampaignPage, name: str) -> dict[str, str]:
    headings = re.findall(r"<th scope=col>(?:<button[^>]*>)?([^<]*)", page.table.html)
    row = re.search(rf'<tr data-name="{name}">.*</tr>', page.table.html)
    assert row is not None
    return dict(zip(headings[1:], re.findall(r"<td[^>]*>(.*?)</td>", row[0]), strict=True))


def test_what_is_tied_was_tested(dashboard: Dashboard, loop: Any) -> None:
    page = open_campaign(dashboard, loop)
    page.filters["turbulence.wind_speed"].value, page.filters["sensors.exposure_ratio"].value = "20", "5"
    one_seed = cells_of(page, "persistence"), cells_of(page, "kf-lgs")
    assert {cells["Rank"] for cells in one_seed} == {"–"}, "a single seed is no test"
    assert {cells["Wins"] for cells in one_seed} == {"1 (0)", "0 (0)"} and squares(page)[2]["state"] == "open"


def test_a_scenario_alone_is_tested_over_its_seeds(dashboard: Dashboard, loop: Any, plan: Campaign, tmp_path: Path) -> None:
    for path in batch_files(tmp_path):
        path.unlink()
    rms = {("kf-lgs", 7): 10.0, ("kf-lgs", 8): 12.0, ("persistence", 7): 20.0, ("persistence", 8): 22.1}
    rows = [row for seed in plan.seeds for row in run_rows(plan.cells[3], seed, plan.observers, ()) if row["target"]]
    write_batch(tmp_path, [{**row, "rms_nm": rms.get((row["name"], row["seed"]), row["rms_nm"])} for row in rows], PLACE)
    page = open_campaign(dashboard, loop)
    for only in ("", "20"):  # two scenarios have that wind, one of which has results
        page.filters["turbulence.wind_speed"].value = only
        # differences of 10 and 10.1 nm: t = 201, of 1 degree of freedom 12.7 is significant
        assert (cells_of(page, "kf-lgs")["Rank"], cells_of(page, "persistence")["Rank"]) == ("best", "")
        assert cells_of(page, "kf-lgs")["Wins"] == "1 (1)" and squares(page)[3]["state"] == "decided"


def test_observers_without_errors_are_listed(dashboard: Dashboard, loop: Any, plan: Campaign, tmp_path: Path) -> None:
    """Persistence fails in every run at 20 m/s: among all scenarios it has a row, at 20 m/s alone a line below the table."""
    for path in batch_files(tmp_path):
        path.unlink()
    rows = [row for cell in plan.cells for row in run_rows(cell, 7, plan.observers, ())]
    fails = {
        row["key"]: {**row, "target": "", "rms_nm": None, "note": "too short"} for row in rows if row["name"] == "persistence"
    }
    fast = [i for i, cell in enumerate(plan.cells) if cell.changes["turbulence.wind_speed"] == 20]
    kept = [row for row in rows if row["name"] != "persistence" or row["cell"] not in fast]
    write_batch(tmp_path, [*kept, *(row for row in fails.values() if row["cell"] in fast)], PLACE)
    page = open_campaign(dashboard, loop)
    assert cells_of(page, "persistence")["Failed"] == "2" and "Without errors" not in page.table.html
    page.filters["turbulence.wind_speed"].value = "20"
    assert "<p>Without errors: Persistence; <code>wfsobs campaign table</code> says why.</p>" in page.table.html


def test_a_folder_that_is_gone_is_named_without_where_it_was(dashboard: Dashboard, loop: Any, tmp_path: Path) -> None:
    page = open_campaign(dashboard, loop)
    (tmp_path / PLAN_FILE).unlink()
    page.tick()
    loop.until(lambda: page.failure.html)
    assert f">{tmp_path.name}/{PLAN_FILE}: cannot be read: " in page.failure.html


def test_a_reload_returns_to_the_fields(dashboard: Dashboard, loop: Any) -> None:
    said = dashboard.view_state.open(
        "view.page=campaign&view.campaign.target=vibration&view.campaign.only.sensors.exposure_ratio=7"
    )
    page = open_campaign(dashboard, loop)
    assert said == [] and "only.sensors.exposure_ratio = 7: takes one of , 5, 10" in page.failure.html
    assert page.target.value == "vibration" and page.filters["sensors.exposure_ratio"].value == ""
    page.across.value, page.down.value = "sensors.exposure_ratio", ""
    page.filters["turbulence.wind_speed"].value = "20"
    page.lines.value = ["persistence", "bound"]
    query, square = dashboard.view_state.query, squares(page)
    assert "view.campaign.only.turbulence.wind_speed=20" in query and "view.campaign.lines=persistence,bound" in query
    assert dashboard.view_state.open("view.page=campaign") == [], "a fresh page"
    assert page.target.value == "turbulence" and squares(page) != square and dashboard.view_state.query == "view.page=campaign"
    assert dashboard.view_state.open(query) == []
    assert (page.across.value, page.down.value, page.lines.value) == ("sensors.exposure_ratio", "", ["persistence", "bound"])
    assert squares(page) == square and dashboard.view_state.query == query


def test_without_a_campaign_there_is_no_such_page(loop: Any, short: Scenario, enter: Callable[..., Session]) -> None:
    dashboard = Dashboard(loop.queue.put, enter(), short)
    loop.closing.append(dashboard)
    dashboard.page()
    assert CAMPAIGN not in dashboard.pages.switch.options.values()
    assert dashboard.view_state.open("view.page=campaign")[0].startswith("view.page = campaign: takes one of explore, ")


def in_a_shell(command: str) -> str:
    """Return what a command prints, split into words by a shell."""
    words = subprocess.run(f"printf '%s\\0' {command}", shell=True, capture_output=True, text=True, check=True).stdout
    program, *arguments = words.split("\0")[:-1]
    assert program == "wfsobs"
    done = CliRunner().invoke(main, arguments, catch_exceptions=False)
    assert done.exit_code == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("target", "mode", "only", "cells"),
    [
        ("turbulence", "tip", {}, (0, 1, 2, 3)),
        ("vibration", "tilt", {"turbulence.wind_speed": "20"}, (2, 3)),
        ("turbulence", "tilt", {"turbulence.wind_speed": "5", "sensors.exposure_ratio": "10"}, (1,)),
    ],
)
def test_what_is_copied_has_the_numbers_of_the_page(
    dashboard: Dashboard,
    loop: Any,
    plan: Campaign,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    target: str,
    mode: str,
    only: dict[str, str],
    cells: tuple[int, ...],
) -> None:
    add_batch(plan, tmp_path, 8)
    page = open_campaign(dashboard, loop)
    assert "--target turbulence --mode tip" in dashboard.actions.toolbar.command, "once there are results, before a field is used"
    page.target.value = target
    for path, value in only.items():
        page.filters[path].value = value
    dashboard.display.mode = mode
    monkeypatch.chdir(tmp_path.parent)
    printed = in_a_shell(f"{dashboard.actions.toolbar.command} --csv")
    rows = {row["name"]: row for row in csv.DictReader(printed.splitlines())}
    assert [*rows] == re.findall(r'<tr data-name="([^"]*)"', page.table.html), "the same rows in the same order"
    squares: dict[str, list[float]] = {}
    for one in compare(read_results(tmp_path)):
        if (one.target, one.mode) == (target, mode) and one.cell in cells:
            squares.setdefault(one.name, []).append(one.rms)
    assert {*squares} == {*rows}
    for name, row in rows.items():
        assert (row["target"], row["mode"]) == (target, mode)
        # the errors of single scenarios by other code, and their geometric mean; rounding of logarithms
        assert float(row["rms_nm"]) == pytest.approx(np.prod(squares[name]) ** (1 / len(cells)), rel=1e-12)
        shown = cells_of(page, name)
        assert shown["Error [nm]"] == number(float(row["rms_nm"])) and shown["Records"] == row["records"] == str(2 * len(cells))
        assert shown["Error / limit"] == number(float(row["over_bound"]))
        assert shown["Wins"] == (f"{row['wins']} ({row['decided_wins']})" if row["wins"] else "–")
        assert shown["Rank"] == row["rank"].replace("not tested", "–")
    capsys.readouterr()
    exec(dashboard.actions.toolbar.python, {})
    printed = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [(words[0], words[1]) for words in printed] == [(name, row["rms_nm"]) for name, row in rows.items()]
    said = f"Tiny: 8 of 8 runs, {len(cells)} of 4 scenarios"
    assert said in in_a_shell(dashboard.actions.toolbar.command)


def test_a_copy_without_results_has_all_of_them(
    plan: Campaign, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path.parent)
    task = CopiedTask(COPIED, {"folder": tmp_path.name, "target": [], "mode": [], "only": []})
    assert to_command(Scenario(), "paper", task=task) == f"wfsobs campaign table {tmp_path.name} --together"
    exec(to_python(Scenario(), "paper", task=task), {})
    known = {(one.target, one.mode, one.name) for one in compare(read_results(tmp_path))}
    assert len(capsys.readouterr().out.splitlines()) == len(known) > 8


def test_the_fields_stay_where_nothing_has_their_values(
    loop: Any, short: Scenario, enter: Callable[..., Session], tmp_path: Path
) -> None:
    (tmp_path / "nights.csv").write_text("wind,r0\n5,0.1\n20,0.2\n", encoding="utf-8")
    named = 'columns = { wind = "turbulence.wind_speed", r0 = "turbulence.r0" }'
    plan = parse_plan(f'{PLAN.partition("[grid]")[0]}[conditions]\nfile = "nights.csv"\n{named}', tmp_path)
    open_folder(plan, tmp_path)
    add_batch(plan, tmp_path, 7)
    session = enter()
    session.service.campaign = CampaignFolder(tmp_path)
    dashboard = Dashboard(loop.queue.put, session, short)
    loop.closing.append(dashboard)
    dashboard.page()
    page = open_campaign(dashboard, loop)
    page.filters["turbulence.wind_speed"].value, page.filters["turbulence.r0"].value = "5", "0.2"
    assert page.room.visible and page.room[0].visible and "No scenario has all of these values" in page.table.html
    assert [part.visible for part in page.room[2:]] == [False, False]
    page.filters["turbulence.r0"].value = "0.1"
    assert "Persistence" in page.table.html and all(part.visible for part in page.room)
