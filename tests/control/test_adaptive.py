"""Controllers that identify their model as they run: an integrator first, then minus the prediction of their observer."""

from __future__ import annotations

import numpy as np
import pytest

import wfsobs
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.run import closed_loop, controller_needs
from wfsobs.control.laws import integrator_law
from wfsobs.control.mirror import Mirror
from wfsobs.observers import OBSERVERS
from wfsobs.observers.step import frames_of
from wfsobs.record import Record
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.spectrum import rms
from wfsobs.simulation.loop import simulate
from wfsobs.typing import Array

NAMES = ("lqg-kf-adaptive", "lqg-multirate-adaptive")
SHORT = PRESETS["paper"]().replace({"run.duration": 2.5, "adaptive.window": 1.0, "control.delay": 2.4})
FIRST = 1005
"""Frames until every window is full, of whole NGS frames behind the delay."""


@pytest.fixture(scope="module")
def record() -> Record:
    return simulate(SHORT)


def predictions(name: str, record: Record) -> Array:
    """Minus the mean of turbulence and vibration while the command acts, by the observer alone, (n_steps, n_modes)."""
    observer = wfsobs.design(name, SHORT)
    uses_ngs = "y_ngs" in OBSERVERS[name].needs
    out = []
    for z, ngs, *_ in frames_of(record.measurements()):
        observer.update(z, ngs if uses_ngs else None)
        sums = [sum(observer.predict(k, target)[0] for target in ("turbulence", "vibration")) for k in (1, 2)]
        out.append(-(0.6 * sums[0] + 0.4 * sums[1]))
    return np.array(out)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_it_is_an_integrator_and_then_minus_the_prediction_of_its_observer(name: str, record: Record) -> None:
    (outcome,) = closed_loop(record, design(SHORT, [name])).outcomes
    assert outcome.u is not None
    ahead = predictions(name.removeprefix("lqg-"), record)
    known = ~np.isnan(ahead)
    assert not known[:999].any() and known[FIRST:].all()
    first = [integrator_law(Mirror(2.4), 0.2, 1.0).run(z[:, None]) for z in record.z.T]
    expected = np.where(known, ahead, np.column_stack(first))
    # z is rounded to 1e-9 um, and a model found in it is as far off as its sensitivity to that
    np.testing.assert_allclose(outcome.u, expected, rtol=0, atol=1e-5 * rms(expected))
    steps = np.abs(np.diff(outcome.u[100:], axis=0)).max(axis=1)
    assert steps[FIRST - 110 : FIRST - 90].max() < 2.0 * np.delete(steps, slice(FIRST - 110, FIRST - 90)).max(), "no bump"


@pytest.mark.slow
def test_they_are_told_nothing_and_follow_a_line_that_jumps() -> None:
    """The fixed model has the line at its old place: in the end the adaptive one leaves less, and before it not much more."""
    assert {controller_needs(name, SHORT) for name in NAMES} == {"none"}
    scenario = PRESETS["peak-jump"]().replace({"run.duration": 18.0, "sensors.lgs_low_frequency_rms": 0.0})
    names = ["lqg-multirate-multi", "lqg-multirate-adaptive"]
    fixed, adaptive = closed_loop(simulate(scenario), design(scenario, names)).outcomes
    assert fixed.residual is not None and adaptive.residual is not None
    before, after = slice(5000, 8000), slice(14_000, 18_000)
    assert rms(adaptive.residual[before]) < 1.3 * rms(fixed.residual[before])
    assert rms(adaptive.residual[after]) < 0.8 * rms(fixed.residual[after])


@pytest.mark.slow
def test_they_run_supervised(record: Record) -> None:
    wrong = SHORT.replace({"control.supervised": True, "plant.delay_error": 2.0, "plant.gain_error": [0.5, 0.5]})
    for outcome in closed_loop(record, design(wrong, NAMES)).outcomes:
        assert outcome.residual is not None and outcome.alarms
