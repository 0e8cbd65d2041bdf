"""What a run delivers on its way."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from tests.app.conftest import SHORT
from tests.records import ON_PAPER
from wfsobs.app import work
from wfsobs.app.work import TRUTH, RunResults, compute
from wfsobs.dependence import Memo
from wfsobs.evaluation.exact_errors import scored_samples
from wfsobs.progress import QUIET, Cancelled, Watch
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.spectrum import psd


def keys(shown: RunResults) -> set[tuple[str, str]]:
    return {(e.observer, e.target) for e in shown.result.estimates}


@pytest.fixture(scope="module")
def reports() -> list[tuple[float, RunResults | None]]:
    """Everything that a run reports when nothing is held back, the final result last."""
    out: list[tuple[float, RunResults | None]] = []
    watch, scenario = Watch(lambda fraction: out.append((fraction, None))), PRESETS["paper"]().replace(SHORT)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(work, "INTERVAL", 0.0)
        patch.setattr(work, "DELIVERY_INTERVAL", 0.0)
        final = compute(scenario, watch, lambda result: out.append((out[-1][0], result)))
    return [*out, (1.0, final)]


def test_observers_are_delivered_one_after_the_other(reports: Any) -> None:
    grown = [keys(shown) for _, shown in reports if shown is not None]
    assert all(before <= after for before, after in pairwise(grown))
    assert len({len(k) for k in grown}) > 3
    quick = next(i for i, k in enumerate(grown) if ("kf-lgs", "turbulence") in k)
    assert ("gpr-online", "vibration") not in grown[quick]


def test_the_online_gpr_grows(reports: Any) -> None:
    key = ("gpr-online", "vibration")
    known = [np.isfinite(s.partial[key]).sum() for _, s in reports if s is not None and key in s.partial]
    assert len(known) >= 2 and known == sorted(known) and known[0] < known[-1]
    final = reports[-1][1]
    assert key not in final.partial and key in keys(final)
    assert final.values(*key) is final.result.estimate(*key).values


def test_progress_rises_to_one(reports: Any) -> None:
    fractions = [fraction for fraction, _ in reports]
    assert fractions[0] < 0.1 and fractions[-1] == 1.0
    assert fractions == sorted(fractions)


def test_deliveries_are_held_back(short: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work, "INTERVAL", 1000.0)
    told: list[RunResults | None] = []
    compute(short, QUIET, lambda result: told.append(result))
    quick, shown = told
    assert quick is not None and shown is not None
    learning = {"gpr-online", "gpr-adaptive", "kf-adaptive", "multirate-adaptive"}
    for here, missing in ((quick, {"gpr-offline", "ridge", *learning}), (shown, learning)):
        assert {name for name, _ in keys(here)} == set(ON_PAPER) - missing


def test_only_what_depends_runs(short: Scenario) -> None:
    memo, told = Memo(), []
    first = compute(short, QUIET, lambda **_: None, None, memo)
    assert set(first.ran) == set(ON_PAPER)
    changed = short.replace({"kalman.ngs_between_frames": "propagate"})
    shown = compute(changed, QUIET, lambda **news: told.append(news), None, memo)
    assert shown.ran == ("kf-ngs",) and shown.scenario == changed and shown.result.record is first.result.record
    assert not told, "one picture, as there is nothing to wait for"
    assert shown.bounds is first.bounds and shown.spectra["kf-lgs", "vibration"] is first.spectra["kf-lgs", "vibration"]
    whole = compute(changed, QUIET, lambda **_: None)
    assert [replace(s, seconds_per_step=0.0) for s in shown.result.scores] == [
        replace(s, seconds_per_step=0.0) for s in whole.result.scores
    ]
    unused = changed.replace({"gpr_online.highpass": 3.0, "sensors.spots.read_noise": 2.0, "control.gain": 0.1})
    assert compute(unused, QUIET, lambda **_: None, None, memo).ran == ()


@pytest.mark.usefixtures("quick")
def test_another_warm_up_scores_the_same_estimates(short: Scenario) -> None:
    memo = Memo()
    first = compute(short, QUIET, lambda **_: None, None, memo)
    changed = short.replace({"run.warm_up": short.run.warm_up + 0.05})
    shown, whole = (compute(changed, QUIET, lambda **_: None, None, m) for m in (memo, Memo()))
    assert "kf-multi" not in shown.ran and "gpr-offline" in shown.ran, "the training record starts after the warm-up"
    key = "kf-multi", "vibration"
    assert not np.array_equal(shown.spectra[key].signal, first.spectra[key].signal)
    assert np.array_equal(shown.spectra[key].signal, whole.spectra[key].signal)


def test_spectra_are_of_what_is_scored(reports: Any) -> None:
    final: RunResults = reports[-1][1]
    record, key = final.result.record, ("gpr-online", "vibration")
    truth, values = final.values(TRUTH, "vibration"), final.values(*key)
    assert truth is not None and values is not None
    true, value = scored_samples(record, truth[:, 0], values[:, 0], final.scenario.run.warm_up)
    frequency, density = psd(value, record.dt)
    assert np.array_equal(final.spectra[key].frequency, frequency)
    assert np.allclose(final.spectra[key].signal[:, 0], density, rtol=1e-10)
    assert np.allclose(final.spectra[key].error[:, 0], psd(value - true, record.dt)[1], rtol=1e-10)
    assert np.all(final.spectra[TRUTH, "vibration"].error == 0)


def test_a_run_that_is_not_wanted_stops(short: Scenario) -> None:
    with pytest.raises(Cancelled):
        compute(short, Watch(is_cancelled=lambda: True), lambda **_: None)


def test_a_record_too_short_for_an_observer_says_so(short: Scenario) -> None:
    scenario = short.replace({"run.duration": 0.2, "run.warm_up": 0.19, "gpr_online.training_size": 400})
    shown = compute(scenario, QUIET, lambda **_: None)
    assert ("gpr-online", "vibration") not in shown.spectra
