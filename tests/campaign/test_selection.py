"""Some scenarios of a campaign: by values and ranges on the command line, refused in one line; bins are copied exactly."""

import csv

import numpy as np
import pyarrow.compute as pc
import pytest
from click.testing import CliRunner

from wfsobs.campaign.plan import cells_where, condition, parse_plan, plan_axes
from wfsobs.campaign.run import run_rows
from wfsobs.campaign.store import open_folder, read_results, write_batch
from wfsobs.cli import main
from wfsobs.cli.campaign import summary_table
from wfsobs.settings.values import SettingError

PLAN = """
name = "Tiny"
seeds = 1
observers = ["kf-lgs", "persistence"]
[settings]
run.duration = 0.3
run.warm_up = 0.1
[[scenario]]
name = "the one"
[[scenario]]
name = "other"
settings = { sensors.lgs_noise = 0.05 }
[grid]
turbulence.wind_speed = [20, 5.5]
"""
"""Scenarios 0 to 3: the one at 20 and 5.5, other at 20 and 5.5."""


@pytest.fixture
def plan(tmp_path):
    return parse_plan(PLAN, tmp_path)


@pytest.mark.parametrize(
    ("only", "cells"),
    [
        ([], [0, 1, 2, 3]),
        (["turbulence.wind_speed=20"], [0, 2]),
        (["turbulence.wind_speed=20.0"], [0, 2]),
        (["turbulence.wind_speed=5..10"], [1, 3]),
        (["turbulence.wind_speed=5.5..20"], [0, 1, 2, 3]),
        (["turbulence.wind_speed=5.5", "turbulence.wind_speed=20"], [0, 1, 2, 3]),
        (["scenario=the one", "turbulence.wind_speed=5.5"], [1]),
    ],
)
def test_scenarios_are_chosen(plan, only, cells):
    assert cells_where(plan, only).tolist() == cells


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("wind=5", "wind=5: takes NAME=VALUE with one of scenario, turbulence.wind_speed"),
        ("scenario", "scenario: takes NAME=VALUE with one of scenario, turbulence.wind_speed"),
        ("scenario=third", "scenario=third: takes one of the one, other"),
        (
            "turbulence.wind_speed=6..9",
            "turbulence.wind_speed=6..9: takes one of 5.5, 20, or a range LOW..HIGH that has some",
        ),
    ],
)
def test_what_is_unknown_is_refused(plan, text, said):
    with pytest.raises(SettingError) as refused:
        cells_where(plan, [text])
    assert str(refused.value) == said


def test_every_value_of_a_field_is_found_again(tmp_path):
    text = """
[grid]
kalman.process_noise = ["matched", "manual"]
[conditions]
file = "nights.csv"
columns = { wind = "turbulence.wind_speed", r0 = "turbulence.r0" }
"""
    rows = [f"{5 + 0.1234567890123 * i},{(0.1, 0.1500001, 0.15)[i // 20]}" for i in range(60)]
    (tmp_path / "nights.csv").write_text("\n".join(["wind,r0", *rows]), encoding="utf-8")
    plan = parse_plan(text, tmp_path)
    axes = plan_axes(plan)
    assert [axis.is_binned for axis in axes] == [True, False, False]
    for axis in axes:
        for i in range(len(axis.values)):
            assert cells_where(plan, [condition(axis, i)]).tolist() == np.flatnonzero(axis.of_cell == i).tolist()
    with pytest.raises(SettingError, match="no scenario has all of these"):  # the strongest winds and the smallest r0
        cells_where(plan, [condition(axes[0], 15), condition(axes[1], 0)])


@pytest.fixture
def folder(plan, tmp_path):
    open_folder(plan, tmp_path)
    rows = [row for cell in plan.cells for row in run_rows(cell, 1, plan.observers, ())]
    write_batch(tmp_path, rows, {"host": "here", "process": 1, "written": 1.0})
    return tmp_path


def table(*arguments):
    return CliRunner().invoke(main, ["campaign", "table", *map(str, arguments)])


def test_rows_are_those_of_some_scenarios_a_target_and_a_mode(folder, plan):
    found = table(folder, "--only", "turbulence.wind_speed=20", "--target", "vibration", "--mode", "tilt", "--csv")
    rows = [(int(r["cell"]), r["name"], float(r["rms_nm"])) for r in csv.DictReader(found.stdout.splitlines())]
    wanted = [
        (r["cell"], r["name"], r["rms_nm"])
        for r in read_results(folder).to_pylist()
        if r["cell"] in (0, 2) and (r["target"], r["mode"]) == ("vibration", "tilt")
    ]
    assert rows == wanted and {cell for cell, *_ in rows} == {0, 2}
    said = table(folder).stdout
    groups = [f"{target:10} │ {mode}" for target in ("turbulence", "vibration", "total") for mode in ("tip", "tilt")]
    places = [said.index(group) for group in groups]
    assert places == sorted(places), "in the order of the dashboard"
    rows = read_results(folder)
    other = rows.set_column(rows.column_names.index("mode"), "mode", pc.replace_substring(rows["mode"], "tilt", "astigmatism"))
    table_of_others = summary_table(plan, other, "")
    assert [m for m in table_of_others.columns[3].cells if m][:2] == ["tip", "astigmatism"], "modes of other scenarios come last"
    short = table(folder, "--only", "scenario=other", "--mode", "tip").stdout
    assert "other" in short and "the one" not in short and "tilt" not in short


@pytest.mark.parametrize("together", [[], ["--together"]])
@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--target", "noise", "--target noise: takes one of total, turbulence, vibration"),
        ("--mode", "focus", "--mode focus: takes one of tilt, tip"),
        ("--only", "wind=5", "--only wind=5: takes NAME=VALUE with one of scenario, turbulence.wind_speed"),
    ],
)
def test_options_say_what_they_take(folder, together, option, value, said):
    found = table(folder, *together, option, value)
    assert found.exit_code != 0 and said in found.stderr and len(found.stderr.strip().splitlines()) == 1


def test_together_has_a_row_per_name(folder):
    found = table(folder, "--together", "--target", "turbulence", "--mode", "tip")
    assert found.exit_code == 0 and "4 of 4 runs, 4 of 4 scenarios" in found.stdout
    assert found.stdout.count("kf-lgs") == found.stdout.count("persistence") == 1
    rows = list(csv.DictReader(table(folder, "--together", "--csv").stdout.splitlines()))
    assert {(r["target"], r["mode"]) for r in rows} >= {("turbulence", "tip"), ("vibration", "tilt")}
    assert table(folder, "--together", "--parquet", folder / "all.parquet").exit_code != 0


@pytest.mark.parametrize(("command", "option"), [("table", "--parquet"), ("report", "--out")])
def test_files_of_a_campaign_are_no_output(folder, command, option):
    """Those that are there, by another name as well, and a name that would be taken for one."""
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    for out in (folder / "plan.json", next(folder.glob("rows/*")), folder / "rows/../rows/all.parquet"):
        found = CliRunner().invoke(main, ["campaign", command, str(folder), option, str(out)])
        assert found.exit_code != 0 and "belongs to the campaign" in found.stderr
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_what_has_no_errors_is_listed_with_the_reason_before_and_after(tmp_path):
    """In the plan for its first run, in the table for the runs that are shown."""
    text = PLAN.replace('"persistence"]', '"persistence", "kf-adaptive"]\ncontrollers = ["lqg-kf-adaptive"]')
    (tmp_path / "plan.toml").write_text(text, encoding="utf-8")
    plan = parse_plan(text, tmp_path)
    open_folder(plan, tmp_path)
    rows = [row for cell in plan.cells for row in run_rows(cell, 1, plan.observers, plan.controllers)]
    write_batch(tmp_path, rows, {"host": "here", "process": 1, "written": 1.0})
    notes = {row["name"]: row["note"].removeprefix("kf-adaptive ") for row in rows if row["rms_nm"] is None}
    line, of_loop = (f"without errors: {name}, {{}}: {notes[name]}\n" for name in ("kf-adaptive", "lqg-kf-adaptive"))
    said = CliRunner().invoke(main, ["campaign", "plan", str(tmp_path / "plan.toml")]).stdout
    assert said.endswith(line.format("1 run") + of_loop.format("1 run")) and "300 steps" in line and "300 steps" in of_loop
    assert table(tmp_path).stderr == "".join(f"wfsobs: {it.format('4 runs')}" for it in (line, of_loop))
    only = "--only", "turbulence.wind_speed=20", "--target", "vibration"
    assert table(tmp_path, *only).stderr == f"wfsobs: {line.format('2 runs')}"
