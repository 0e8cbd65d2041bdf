"""`wfsobs loop`: rows, table, what is refused; and the page on it."""

from __future__ import annotations

import json
from math import degrees, log10

import pytest
from click.testing import CliRunner, Result

from wfsobs.cli import main
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.run import LIMITED, NOT_APPLICABLE, closed_loop, label
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.scores import COMMON_BOUNDS
from wfsobs.scenario import configfile
from wfsobs.simulation.loop import simulate

QUICK = ["--set", "run.duration=2", "--set", "adaptive.window=0.8"]
QUICK += ["--set", "gpr_online.training_size=20", "--set", "gpr_offline.training_size=50"]
ASKED = {"controller", "mode", "residual_rms_nm", "residual_rms_mas", "strehl", "stable", "seed"}


def call(*arguments: str) -> Result:
    return CliRunner().invoke(main, ["loop", *arguments], catch_exceptions=False)


@pytest.mark.slow
def test_json_is_the_rows_of_every_controller_mode_and_seed() -> None:
    result = call(*QUICK, "--seeds", "2", "--set", "run.seed=4", "--json")
    assert result.exit_code == 0 and result.stderr == ""
    rows = json.loads(result.stdout, parse_constant=pytest.fail)
    assert all(row.keys() >= ASKED for row in rows)
    assert [(r["seed"], r["controller"], r["mode"]) for r in rows] == [
        (seed, name, mode) for seed in (4, 5) for name in (*CONTROLLERS, *COMMON_BOUNDS) for mode in ("tip", "tilt")
    ]
    for row in rows:
        assert row["stable"] is True and 0 < row["strehl"] < 1
        assert row["residual_rms_mas"] == pytest.approx(row["residual_rms_nm"] * 0.103133, rel=1e-4)  # 10.3133 mas in 100 nm
        has_margins = row["controller"] in ("integrator", "lqg-kf-lgs", "lqg-kf-multi", "h2-fir")
        assert (row["phase_margin_deg"] is not None) == has_margins


def test_rows_are_those_of_the_library() -> None:
    rows = json.loads(call(*QUICK, "--controller", "integrator", "--set", "run.seed=3", "--json").stdout)
    scenario = configfile.scenario_from(None, None, tuple(QUICK[1::2])).replace({"run.seed": 3})
    plan = design(scenario, ["integrator"])
    (outcome,) = closed_loop(simulate(scenario), plan).outcomes
    assert outcome.residual is not None
    squares = (outcome.residual[round(scenario.run.warm_up * 1000) :] ** 2).mean(axis=0)
    for mode in range(2):
        of, margins = plan.laws["integrator"][mode], plan.laws["integrator"][mode].margins
        assert rows[mode]["residual_rms_nm"] == pytest.approx(1e3 * squares[mode] ** 0.5)
        assert margins and margins.gain and margins.phase and margins.delay and of.law and of.predicted_rms
        assert rows[mode]["gain"] == of.law.gain and rows[mode]["predicted_rms_nm"] == pytest.approx(1e3 * of.predicted_rms)
        assert rows[mode]["gain_margin_db"] == pytest.approx(20 * log10(margins.gain))
        assert rows[mode]["phase_margin_deg"] == pytest.approx(degrees(margins.phase))
        assert rows[mode]["delay_margin_ms"] == pytest.approx(1e3 * margins.delay)


def test_an_unstable_gain_is_a_row_and_not_a_warning() -> None:
    set_ = ["--set", "control.integrator=manual", "--set", "control.gain=1.5", "--set", "control.delay=2.5"]
    result = call(*QUICK, *set_, "--controller", "integrator", "--controller", "none", "--json")
    rows = [r for r in json.loads(result.stdout) if r["controller"] == "integrator"]
    assert result.exit_code == 0 and result.stderr == "" and len(rows) == 2
    for row in rows:
        assert row["stable"] is False and row["residual_rms_nm"] is None and row["strehl"] is None and row["gain"] == 1.5
    table = call(*QUICK, *set_, "--controller", "integrator").stdout
    assert "unstable" in table and "nan" not in table


@pytest.mark.slow
def test_the_table_names_every_controller_and_what_it_needs() -> None:
    table = call(*QUICK).stdout
    for name in (*CONTROLLERS, *COMMON_BOUNDS):
        assert label(name) in table
    assert "true spectra, training data" in table and "model, true peaks" in table and "none" in table
    assert "true spectra, training data" not in call(*QUICK, "--set", "control.integrator=manual").stdout
    spread = call(*QUICK, "--controller", "none", "--seeds", "3").stdout
    assert "95 %, nm" in spread and "mean over seeds" in spread


@pytest.mark.slow
def test_where_a_limit_acts_there_is_neither_theory_nor_margins() -> None:
    """A stroke far below the turbulence of 500 nm; one that is never reached changes nothing but the settings."""
    one = [*QUICK, "--controller", "integrator"]
    said = [json.loads(call(*one, "--set", f"control.stroke={stroke}", "--json").stdout) for stroke in (0, 100, 0.1)]
    free, far, near = ([r for r in rows if r["controller"] == "integrator"] for rows in said)
    assert free == far
    of_linear = ("predicted_rms_nm", "gain_margin_db", "phase_margin_deg", "delay_margin_ms")
    for row, limited in zip(free, near, strict=True):
        assert row["limited"] == 0.0 and row["note"] == "" and all(row[key] is not None for key in of_linear)
        assert limited["limited"] > 0.3 and limited["note"] == LIMITED and limited["gain"] == row["gain"]
        assert all(limited[key] is None for key in of_linear)
        assert limited["residual_rms_nm"] > row["residual_rms_nm"]
    table = call(*one, "--set", "control.stroke=0.1").stdout
    cells = [[c.strip() for c in line.strip("│").split("│")] for line in table.splitlines() if label("integrator") in line]
    for row, printed in zip(near, sorted(cells, key=lambda c: c[0]), strict=True):  # tilt, tip
        assert printed.count(NOT_APPLICABLE) == 3
        assert printed[-1] in {f"{100 * r['limited']:.2f}" for r in near} and row["gain"]
    assert "limit of the mirror acts" in " ".join(table.split())
    assert NOT_APPLICABLE not in call(*one).stdout


def test_higher_modes_have_no_angle() -> None:
    order = ["--set", "telescope.radial_order=2", "--controller", "integrator", "--json"]
    rows = json.loads(call(*QUICK, *order).stdout)
    assert {r["mode"]: r["residual_rms_mas"] is None for r in rows if r["controller"] == "integrator"} == {
        "tip": False,
        "tilt": False,
        "defocus": True,
        "oblique astigmatism": True,
        "vertical astigmatism": True,
    }


def test_a_controller_that_is_not_there_is_refused_in_one_line() -> None:
    result = call("--controller", "pid")
    assert result.exit_code == 2 and result.stderr.startswith("wfsobs: controller 'pid': no such controller; there are none, ")
    assert call("--set", "control.delay=0.5").stderr == "wfsobs: control.delay = 0.5: takes a number from 1 to 10 frames\n"
