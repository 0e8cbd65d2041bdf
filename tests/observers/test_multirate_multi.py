"""The multi-rate filter of every peak: the optimal one where there is one peak, and one model for observer and controller."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.execution import run_observer
from wfsobs.observers.base import TARGETS
from wfsobs.prior import Beams, Lines, Model
from wfsobs.priors_from.controllers import own_settings, plant_of
from wfsobs.priors_from.scenario import one_process, prior_of
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.stepping import design

ONE_PEAK = {
    "run.duration": 2.0,
    "vibration.source": "ar2",
    "vibration.peaks": [{"frequency": 47.5, "damping": 0.03, "rms": [0.05, 0.05]}],
    "kalman.frequency": 47.5,
    "kalman.damping": 0.03,
    "kalman.process_noise": "matched",
}


def test_with_one_peak_it_is_the_optimal_filter() -> None:
    scenario = Scenario().replace(ONE_PEAK)
    record = simulate(scenario)
    multi, optimal = (run_observer(name, record, scenario) for name in ("multirate-multi", "multirate-optimal"))
    for target in TARGETS:
        # the same model: rounding alone
        np.testing.assert_allclose(multi[target], optimal[target], rtol=0, atol=1e-12)


def test_it_predicts_what_its_controller_commands() -> None:
    """The command is minus the prediction of the whole disturbance two frames on, that of step k + 1."""
    scenario = PRESETS["paper"]().replace({"run.duration": 2.0})
    record = simulate(scenario)
    assert record.y_ngs is not None
    z = np.column_stack([record.z[:, 0], np.nan_to_num(record.z_ngs[:, 0])])
    prior = prior_of(scenario, record, (Model, Lines, Beams))
    law = CONTROLLERS["lqg-multirate-multi"].law_of(
        prior, 0, plant_of(scenario), own_settings(CONTROLLERS["lqg-multirate-multi"], scenario)
    )
    observer = design("multirate-multi", scenario)
    commands = []
    for k, row in enumerate(record.z):
        due = k and k % 5 == 0
        observer.update(row, record.z_ngs[k] if due else None)
        commands.append(-sum(observer.predict(1, target)[0][0] for target in TARGETS))
    # two ways to run the same recursion: rounding alone
    np.testing.assert_allclose(law.run(z), commands, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", ["multirate-multi", "lqg-multirate-multi"])
@pytest.mark.parametrize("changes", [{"turbulence.source": "none"}, {"turbulence.rms": 0.0}], ids=["none", "rms"])
def test_without_turbulence_its_model_is_the_process_set_by_hand(changes: dict[str, Any], name: str) -> None:
    """There is no spectrum that a model of third order could be fitted to."""
    scenario = PRESETS["paper"]().replace({"multipeak.turbulence_order": 3, "run.duration": 2.0, **changes})
    prior = prior_of(scenario, None, (Lines, Beams))
    for mode in range(2):
        process = one_process(scenario, mode, scenario.dt)
        assert process.rms > 0 and prior.lines[mode].turbulence == prior.beams[mode].common == (process,)
    design(name, scenario).update([0.1, np.nan])
