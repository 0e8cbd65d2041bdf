"""Controllers over an uncertain plant: each point is the loop of that plant, and the shares are counted as stated."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from tests.records import MATCHED
from wfsobs.cli.group import main
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.envelope import PlantEnvelope, Spread, Uncertainty, plant_envelope, residuals
from wfsobs.closed_loop.run import closed_loop
from wfsobs.control.true_plant import TruePlant
from wfsobs.settings.values import SettingError
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.true_spectra import true_spectra
from wfsobs.tuning import tuned_envelope

NAMES = ["integrator", "lqg-kf-lgs", "lqg-multirate-multi"]
RESONANT = MATCHED.replace({"plant.resonance": 100.0, "plant.damping": 0.6, "plant.gain_error": [-0.5, -0.5]})


@pytest.fixture(scope="module")
def result() -> PlantEnvelope:
    return plant_envelope(RESONANT, controllers=[*NAMES, "integrator+gpr-online"], points=40)


def test_spectra_of_each_plant() -> None:
    """All at once they leave what each does alone, with one sensor and with both."""
    plan = design(MATCHED, ["lqg-kf-lgs", "lqg-multirate-multi"])
    plants = [TruePlant(np.array([[1.0, -turn], [turn, 1.0]]), 2.0 + turn) for turn in (0.05, 0.1, 0.2)]
    scenarios = [MATCHED.replace({"sensors.lgs_noise": noise}) for noise in (0.01, 0.02, 0.03)]
    spectra = [[true_spectra(s, mode) for mode in range(2)] for s in scenarios]
    for designs in plan.laws.values():
        laws = [one.law for one in designs if one.law is not None]
        alone = [residuals(laws, plan.mirror, [plant], [own])[0] for plant, own in zip(plants, spectra, strict=True)]
        together = residuals(laws, plan.mirror, plants, spectra)
        assert np.allclose(together, alone, rtol=1e-9, atol=0) and np.ptp(together, axis=0).min() > 1e-4


@pytest.mark.slow
def test_every_point_is_the_loop_of_its_plant(result: PlantEnvelope) -> None:
    """On fewer frequencies: to 1 % where the loop is stable, and stable where eigenvalues have it."""
    assert set(result.errors) == {"delay", "gain", "rotation", "resonance"}
    seen = set()
    for i in (3, 7, 12, 30):
        changes = {name: float(x[i]) for name, x in result.errors.items()}
        gain = 0.5 * (1.0 + changes["gain"]) - 1.0
        s = RESONANT.replace(
            {
                "plant.delay_error": changes["delay"],
                "plant.gain_error": [gain, gain],
                "plant.rotation": changes["rotation"],
                "plant.resonance": 100.0 * (1.0 + changes["resonance"]),
            }
        )
        plan = design(s, NAMES)
        for spread in result.spreads:
            of = plan.laws[spread.controller]
            stable = all(one.stable for one in of)
            seen.add(stable)
            assert np.isfinite(spread.points[i]).all() == stable
            if stable:
                assert spread.points[i] == pytest.approx([one.predicted_rms for one in of], rel=0.01)
    assert seen == {True, False}, "both kinds are among them"


def test_points_fill_the_box_and_corners_are_its_corners(result: PlantEnvelope) -> None:
    most = {"delay": 0.5, "gain": 0.2, "rotation": 10.0, "resonance": 0.1}
    for name, x in result.errors.items():
        assert np.abs(x).max() < most[name] and abs(x.mean()) < 0.1 * most[name]
        assert x.std() == pytest.approx(most[name] / np.sqrt(3.0), rel=0.05), "uniform; Sobol's points are even"
    corners = np.column_stack([x / most[name] for name, x in result.corner_errors.items()])
    assert len(np.unique(corners, axis=0)) == 16 and (np.abs(corners) == 1.0).all()


def test_caution_divides_an_optimised_gain() -> None:
    one, two = (design(MATCHED.replace({"control.caution": c}), ["integrator"]).laws["integrator"][0].law for c in (1.0, 2.0))
    assert one is not None and two is not None and one.gain is not None
    assert two.gain == pytest.approx(0.5 * one.gain, rel=1e-12)


def test_what_is_not_linear_is_left_out_and_says_so(result: PlantEnvelope) -> None:
    assert [spread.controller for spread in result.spreads] == NAMES
    assert list(result.notes) == ["integrator+gpr-online"]
    with pytest.raises(SettingError, match="an envelope is by theory, for a plant that is linear"):
        plant_envelope(MATCHED.replace({"plant.hysteresis": 0.1}), controllers=NAMES)
    for of in (plant_envelope, tuned_envelope):
        for none in (["none"], "none", iter(["none"])):
            with pytest.raises(SettingError, match=r"controllers: an envelope takes integrator, .*, not none$"):
                of(MATCHED, controllers=none)
    for points in (0, -3):
        with pytest.raises(SettingError, match=rf"points = {points}: takes a whole number from 1"):
            plant_envelope(MATCHED, controllers=NAMES, points=points)
    with pytest.raises(SettingError, match=r"delay: 1.2 - 0.5 frames are below 1"):
        plant_envelope(MATCHED.replace({"control.delay": 1.2}), controllers=NAMES)


def spread(name: str, nominal: float, points: list[float]) -> Spread:
    return Spread(name, np.array([nominal]), np.array(points)[:, None], np.array([[max(points)]]))


def test_shares_and_ranks_are_counted() -> None:
    inf = float("inf")
    bold, safe = spread("lqg-kf-lgs", 1.0, [1.0, 2.0, inf, 3.0]), spread("integrator", 2.0, [2.0] * 4)
    both = PlantEnvelope(MATCHED, Uncertainty(), {"delay": np.zeros(4)}, {}, (bold, safe))
    assert bold.unstable == 1 and bold.summary(0)[0] == 2.0 and np.isinf(bold.worst).all()
    assert safe.unstable_interval == pytest.approx((0.0, 1.0 - 0.025**0.25)), "none of four"
    assert np.isinf(bold.p95) and safe.p95 == 2.0
    assert both.ranking() == ["lqg-kf-lgs", "integrator"] and both.ranking(by_worst=True) == ["integrator", "lqg-kf-lgs"]
    for mode in (0, None):  # there is one mode
        assert both.sentences(1.0, "um", mode) == [
            "With the plant uncertain (delay +-0.5 frames), Integrator leaves least at the worst plant: 2 um, "
            "2 um at the nominal one.",
            "LQG, LGS KF leaves least at the nominal plant: 1 um, unstable at the worst.",
            "LQG, LGS KF is unstable for 25 % of the plants.",
        ]
    alone = PlantEnvelope(MATCHED, Uncertainty(), {"delay": np.zeros(4)}, {}, (bold,))
    assert alone.sentences()[0].endswith("no controller is stable everywhere.")
    assert PlantEnvelope(MATCHED, Uncertainty(), {"delay": np.zeros(4)}, {}, ()).sentences() == []


def test_curves_are_means_and_maxima_of_their_parts() -> None:
    errors, rms = np.linspace(-0.5, 0.5, 160), np.abs(np.linspace(-1.0, 1.0, 160))
    rms[:10], rms[10] = np.inf, np.inf
    of = PlantEnvelope(MATCHED, Uncertainty(), {"delay": errors}, {}, (spread("integrator", 1.0, rms.tolist()),))
    at, mean, most = of.curves("delay", 0)["integrator"]
    assert np.diff(at) == pytest.approx(1.0 / 16.0) and np.isnan(mean[0]) and np.isnan(most[0])
    assert mean[1] == pytest.approx(rms[11:20].mean()) and most[1] == rms[11] and most[-1] == 1.0


@pytest.mark.slow
def test_the_command_prints_table_and_rows(tmp_path) -> None:
    file = tmp_path / "s.toml"
    file.write_text("[sensors]\nlgs_rate = 500.0\n")
    arguments = ["envelope", "--config", str(file), "--controller", "integrator", "--controller", "lqg-kf-lgs", "--points", "16"]
    shown = CliRunner().invoke(main, arguments)
    assert shown.exit_code == 0, shown.output
    assert "at the nominal one." in shown.output and "rotation +-10 deg" in shown.output
    rows = json.loads(CliRunner().invoke(main, [*arguments, "--json"]).output)
    assert [(r["controller"], r["mode"]) for r in rows] == [(n, m) for n in ("integrator", "lqg-kf-lgs") for m in ("tip", "tilt")]
    tuned = json.loads(CliRunner().invoke(main, [*arguments, "--json", "--tune"]).output)
    assert all(after["worst_rms_nm"] <= 1.001 * before["worst_rms_nm"] for after, before in zip(tuned, rows, strict=True))
    refused = CliRunner().invoke(main, ["loop", "--envelope", "--json"])
    assert refused.exit_code == 2 and "`wfsobs envelope --json` has the rows" in refused.output
    assert all(r["corners"] == 8 and r["nominal_rms_nm"] <= r["worst_rms_nm"] for r in rows)


def test_it_draws_residuals_against_the_delay(result: PlantEnvelope) -> None:
    drawn = result.plot.residuals(over="delay", controllers=["integrator", "lqg-multirate-multi"], mode="tilt")
    assert len(drawn) == 4, "mean and worst of each"
    with pytest.raises(ValueError, match="error 'wind'"):
        result.plot.residuals(over="wind")


@pytest.mark.slow
def test_controllers_that_are_not_linear_are_simulated() -> None:
    """Each plant is the loop of it; what comes before the end is what there is by then."""
    s = MATCHED.replace({"run.duration": 3.0, "run.warm_up": 0.5, "gpr_online.training_size": 40, "gpr_online.depth": 20})
    seen = list[int]()
    found = plant_envelope(
        s,
        controllers=["integrator+gpr-online", "integrator"],
        points=8,
        simulation_points=3,
        on_spread=lambda part: seen.append(sum(len(spread.points) for spread in part.spreads)),
    )
    linear, gpr = found.spreads
    assert (linear.controller, len(linear.points), gpr.controller, len(gpr.points)) == (
        "integrator",
        8,
        "integrator+gpr-online",
        3,
    )
    assert seen == [8, 9, 10, 11, 11] and len(gpr.corners) == 8 and not found.notes
    delay, gain, rotation = (float(found.errors[name][2]) for name in ("delay", "gain", "rotation"))
    third = {"plant.delay_error": delay, "plant.gain_error": [gain, gain], "plant.rotation": rotation}
    for rms, changes in ((gpr.points[2], third), (gpr.nominal, {})):
        (outcome,) = closed_loop(simulate(s), design(s.replace(changes), ["integrator+gpr-online"])).outcomes
        assert outcome.residual is not None
        start = round(design(s, ["integrator+gpr-online"]).start / s.dt)
        assert rms == pytest.approx(np.sqrt(np.square(outcome.residual[start:]).mean(axis=0)), rel=1e-6)
    rows = {row["controller"]: row for row in found.rows()}
    assert rows["integrator+gpr-online"]["simulated"] and not rows["integrator"]["simulated"]
    assert set(found.curves("delay", 0)) == {"integrator", "integrator+gpr-online"}
    refused = CliRunner().invoke(main, ["envelope", "--simulate", "2", "--tune"])
    assert refused.exit_code == 2 and "--simulate: not with --tune" in refused.output
