"""Tuning: never worse than the start, on records that share nothing, the same every time."""

from __future__ import annotations

from functools import reduce

import pytest

from wfsobs import configfile
from wfsobs.pipeline import run
from wfsobs.presets import PRESETS
from wfsobs.scenario import Scenario
from wfsobs.settings import SettingError
from wfsobs.tuning import Evaluation, tune
from wfsobs.tuning.report import toml
from wfsobs.watch import Cancelled, Watch


def short(preset: str = "paper", **more: object) -> Scenario:
    return PRESETS[preset]().replace({"run.duration": 4.0, "run.warm_up": 0.5, **more})


@pytest.fixture(scope="module")
def tuned():
    return tune(short(), "kf-lgs", evaluations=12)


def test_better_on_validation_and_the_same_every_time(tuned) -> None:
    assert tuned.after.validation.rms <= tuned.before.validation.rms
    assert tuned.after.validation.rms == min(e.rms for e in tuned.history)
    assert tuned.history == tune(short(), "kf-lgs", evaluations=12).history
    assert 4 < len(tuned.history) <= 12


def test_before_and_after_on_test_are_what_a_run_prints(tuned) -> None:
    for stage in (tuned.before, tuned.after):
        scores = run(stage.scenario, observers=["kf-lgs"]).scores
        assert stage.test.modes == {s.mode: s.rms for s in scores if s.target == "vibration" and s.observer == "kf-lgs"}


def test_saved_settings_give_the_tuned_scenario(tuned) -> None:
    text = toml(tuned)
    assert configfile.from_toml(text) == tuned.scenario
    assert f"frequency = {tuned.scenario.kalman.frequency}  # tuned, 47.4969 before" in text


@pytest.mark.parametrize(("observer", "names", "says"), [
    ("kf-lgs", ["kalman.frequenc"], "no such setting"),
    ("kf-lgs", ["kalman.process_noise"], "not one number"),
    ("kf-lgs", ["butterworth.frequencies"], "not one number"),
    ("kf-lgs", ["gpr_online.depth"], "not a setting of kf-lgs"),
    ("kf-lgs", ["turbulence.wind_speed"], "not a setting of kf-lgs"),
    ("kf-lgs", ["kalman.damping", "kalman.damping"], "twice"),
    ("kf-lgs", [], "one setting at least"),
    ("gpr-online", ["gpr_online.highpass"], "is not read while"),
    ("zero", None, "no settings to tune"),
    ("kf", None, "no such observer"),
])
def test_what_cannot_be_tuned_is_refused(observer: str, names: list[str] | None, says: str) -> None:
    with pytest.raises(SettingError, match=says):
        tune(short(), observer, names)


def test_every_evaluation_is_told_until_it_is_cancelled() -> None:
    seen: list[Evaluation] = []
    fractions: list[float] = []
    with pytest.raises(Cancelled):
        tune(short(), "kf-lgs", watch=Watch(fractions.append, lambda: len(seen) == 3), told=seen.append)
    assert len(seen) == 3 and fractions == sorted(fractions) and seen[0].changes == {}
    best = min(seen, key=lambda e: e.rms)
    assert all(reduce(getattr, path.split("."), short().replace(best.changes)) == v for path, v in best.changes.items())
