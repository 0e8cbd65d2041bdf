"""Tuning on an uncertain plant: less at the worst, little lost at the nominal plant, and scored on other plants."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
from click.testing import CliRunner

from tests.records import MATCHED
from wfsobs import plant_envelope
from wfsobs.cli import main
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.envelope import Uncertainty
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.priors_from.controllers import own_settings, plant_of, prior_for
from wfsobs.progress import Cancelled, Watch
from wfsobs.record import RecordError
from wfsobs.scenario import Scenario, configfile
from wfsobs.settings.values import SettingError
from wfsobs.tuning import EnvelopeGoal, TuningResult, tune, tuned_envelope
from wfsobs.tuning.records import space
from wfsobs.tuning.tuning import HELD_OUT, SEARCHED, tuning_dict, tuning_toml

FAST = MATCHED.replace({"sensors.lgs_rate": 500.0})
"""Where the filter of the true model is fragile."""


def together(rms: np.ndarray) -> float:
    return float(np.sqrt(np.mean(rms**2)))


@pytest.fixture(scope="module")
def tuned() -> TuningResult:
    return tune(FAST, "lqg-kf-lgs", evaluations=16, envelope=EnvelopeGoal())


@pytest.mark.slow
def test_it_leaves_less_at_the_worst_plant_and_little_more_at_the_nominal_one(tuned: TuningResult) -> None:
    """Of a model that is the truth, none leaves less at the nominal plant: what is won at the worst is paid for there."""
    assert tuned.before.spreads and tuned.after.spreads
    (before, others_before), (after, others) = tuned.before.spreads, tuned.after.spreads
    assert after.caution > 1.0 and tuned.after.scenario.control.caution == after.caution
    assert together(after.worst) < together(before.worst) and together(others.worst) < together(others_before.worst)
    assert together(before.nominal) < together(after.nominal) <= 1.1 * together(before.nominal)
    assert tuned.after.validation and tuned.after.validation.rms == min(e.rms for e in tuned.history)
    assert tuned.after.validation.rms == pytest.approx(together(after.worst), rel=1e-12)
    assert (len(after.points), len(after.corners), len(others.points), len(others.corners)) == (SEARCHED, 8, HELD_OUT, 0)


def test_plants_of_the_search_are_the_first_of_the_envelope(tuned: TuningResult) -> None:
    whole = plant_envelope(tuned.scenario, controllers=["lqg-kf-lgs"], points=SEARCHED + HELD_OUT).spreads[0]
    assert tuned.after.spreads
    seen, others = tuned.after.spreads
    assert whole.points == pytest.approx(np.concatenate([seen.points, others.points]), rel=1e-9)
    assert whole.corners == pytest.approx(seen.corners, rel=1e-9)


@pytest.mark.slow
def test_a_loss_of_nothing_keeps_the_best_nominal_design() -> None:
    kept = tune(FAST, "lqg-kf-lgs", evaluations=8, envelope=EnvelopeGoal(loss=0.0))
    assert kept.scenario == FAST
    assert any("at the nominal plant, above" in e.reason for e in kept.history)


@pytest.mark.slow
def test_a_gain_by_hand_starts_from_the_optimal_one_less_its_caution() -> None:
    s = FAST.replace({"control.caution": 2.0})
    gains = [one.law.gain for one in design(s, ["integrator"]).laws["integrator"] if one.law and one.law.gain]
    found = space(s, "integrator", ["control.gain"], CONTROLLERS)
    assert found.by_hand == {"control.integrator": "manual", "control.gain": pytest.approx(np.mean(gains), rel=1e-4)}
    tuned = tune(s, "integrator", ["control.gain"], evaluations=6, envelope=EnvelopeGoal(by="p95"))
    assert tuned.after.validation and tuned.after.spreads
    assert tuned.after.validation.rms == pytest.approx(together(tuned.after.spreads[0].p95), rel=1e-12)


@pytest.mark.parametrize("name", [c.id for c in CONTROLLERS.values() if c.tunable.usual])
def test_every_tunable_setting_changes_the_law(name: str) -> None:
    """Once nothing is "matched" and the line is narrow; the gain of an integrator where it is set by hand."""
    usual, others = CONTROLLERS[name].tunable
    matched = FAST.replace(
        {"kalman.process_noise": "manual", "kalman.measurement_noise": "manual", "vibration.peaks.0.damping": 1e-6}
    )

    @cache
    def response(scenario: Scenario) -> np.ndarray:
        controller = CONTROLLERS[name]
        law = controller.laws(prior_for(controller, scenario), plant_of(scenario), own_settings(controller, scenario), 2)[0]
        return np.concatenate([np.ravel(part) for step in law.cycle.steps for part in step])

    for path in (*usual, *others):
        by_hand = path.startswith("multirate.")
        base = matched.replace({"multirate.measurement_noise": "manual"}) if by_hand else matched
        found = space(base, name, [path], CONTROLLERS)
        base = base.replace(found.by_hand)
        changed = base.replace(found.changes(np.where(found.start(base) < 0.5, 0.6, 0.4)))
        assert not np.array_equal(response(base), response(changed)), path


def test_what_cannot_be_tuned_is_refused() -> None:
    goal = EnvelopeGoal()
    for name, names, says in (
        ("kf-lgs", None, "no such controller"),
        ("none", None, "controller 'none': has no settings to tune"),
        ("integrator", ["kalman.damping"], "not a setting of integrator"),
        ("integrator", ["control.caution", "control.gain"], "has no effect on an integrator"),
    ):
        with pytest.raises(SettingError, match=says):
            tune(FAST, name, names, envelope=goal)
    with pytest.raises(SettingError, match="takes no record, target or validation"):
        tune(FAST, "integrator", envelope=goal, validation=1.0)
    with pytest.raises(RecordError, match="not stable at every plant"):
        tune(FAST, "lqg-kf-lgs", evaluations=2, envelope=EnvelopeGoal(Uncertainty(rotation=120.0)))
    with pytest.raises(Cancelled):
        tune(FAST, "integrator", envelope=goal, watch=Watch(is_cancelled=lambda: True))


@pytest.mark.slow
def test_the_envelope_of_tuned_controllers_is_that_of_each(tuned: TuningResult) -> None:
    all_of_them = tuned_envelope(FAST, controllers=["integrator", "lqg-kf-lgs", "integrator+gpr-online"], points=16)
    assert [spread.controller for spread in all_of_them.spreads] == ["integrator", "lqg-kf-lgs"]
    assert list(all_of_them.notes) == ["integrator+gpr-online"] and len(all_of_them.errors["delay"]) == 16
    assert all_of_them.spreads[1].caution == pytest.approx(tuned.scenario.control.caution, rel=0.3), "a flat minimum"


@pytest.mark.slow
def test_report_and_command(tuned: TuningResult, tmp_path) -> None:
    said = json.loads(json.dumps(tuning_dict(tuned), allow_nan=False))
    assert said["controller"] == "lqg-kf-lgs" and "observer" not in said
    assert said["after"]["envelope"]["others"]["plants"] == HELD_OUT
    assert configfile.from_toml(tuning_toml(tuned)) == tuned.scenario
    arguments = ["tune", "--set", "sensors.lgs_rate=500", "--evaluations", "2", "--controller", "lqg-kf-lgs"]
    shown = CliRunner().invoke(main, [*arguments, "--envelope", "--rotation", "5"])
    assert shown.exit_code == 0 and "unstable plants" in shown.output and "control.caution" in shown.output, shown.output
    path = tmp_path / "r.npz"
    np.savez(path, y_lgs=np.random.default_rng(1).standard_normal((1500, 2)), u=np.zeros((1500, 2)), dt=1e-3, unit="nm")
    for wrong, says in (
        (arguments, "give --observer, or --envelope and --controller"),
        (["tune", "--observer", "kf-lgs", "--loss", "0.2"], "only with --envelope"),
        ([*arguments, "--envelope", "--record", str(path), "--target", "vibration"], "by theory, and takes no record"),
        (["tune", "--observer", "kf-ngs", "--record", str(path), "--target", "vibration"], "kf-ngs estimates turbulence"),
    ):
        refused = CliRunner().invoke(main, wrong)
        assert refused.exit_code == 2 and says in refused.output
