"""What the tables say that an observer needs is what its estimate depends on, and nothing else of that kind."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.records import ON_PAPER
from wfsobs.execution import run_observer
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import BANDS, LINES, MODEL, TRAINING, Observer
from wfsobs.prior import Training, words_for
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate

OTHER: dict[str, dict[str, Any]] = {
    MODEL: {
        "turbulence.wind_speed": 40.0,
        "kalman.frequency": 31.0,
        "kalman.turbulence_rms": 0.1,
        "sensors.lgs_noise": 0.1,
        "sensors.ngs_noise": 0.1,
    },
    LINES: {"vibration.peaks.0.frequency": 33.0, "vibration.peaks.0.rms": [0.05, 0.05]},
    BANDS: {"butterworth.frequencies": [33.0]},
}
"""Settings that change what an observer is told, by what that is called."""


def scenario() -> Scenario:
    """Short, with a Kalman model set by hand, so that no line is in it but those of the multi-peak one."""
    return PRESETS["paper"]().replace(
        {
            "run.duration": 2.5,
            "run.warm_up": 0.2,
            "adaptive.window": 1.5,
            "kalman.process_noise": "manual",
            "gpr_offline.training_size": 60,
            "gpr_offline.depth": 25,
            "gpr_online.training_size": 60,
            "gpr_online.depth": 25,
        }
    )


@pytest.fixture(scope="module", name="record")
def _record() -> Record:
    return simulate(scenario())


def estimates(observer: Observer, record: Record, s: Scenario) -> np.ndarray:
    return np.concatenate([values.ravel() for values in run_observer(observer.id, record, s).values()])


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_PAPER)
def test_an_observer_depends_on_what_it_is_said_to_need(name: str, record: Record) -> None:
    observer = OBSERVERS[name]
    base = estimates(observer, record, scenario())
    depends = {
        what
        for what, changes in OTHER.items()
        if not np.array_equal(estimates(observer, record, scenario().replace(changes)), base, equal_nan=True)
    }
    assert record.training is not None
    learnt = replace(record, training=replace(record.training, y_lgs=record.training.y_lgs[::-1].copy()))
    if not np.array_equal(estimates(observer, learnt, scenario()), base, equal_nan=True):
        depends.add(TRAINING)
    assert depends == set(words_for(observer.prior))


def test_what_learns_from_a_record_needs_it_in_the_record() -> None:
    for observer in OBSERVERS.values():
        assert (Training in observer.prior) == ("training" in observer.needs)
