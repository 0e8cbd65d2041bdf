"""What the GPR predict for a controller, on a vibration whose future is known."""

from __future__ import annotations

import numpy as np
import pytest

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.priors_from.controllers import controller_arguments, own_settings, plant_of, prior_for
from wfsobs.progress import QUIET
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import simulate

LINE = Scenario().replace(
    {  # one pure line in the middle of its band-pass, next to no noise
        "turbulence.source": "none",
        "vibration.source": "peaks",
        "vibration.peaks": [{"frequency": 40.0, "damping": 0.0, "rms": [0.05, 0.05]}],
        "butterworth.frequencies": [40.0],
        "butterworth.bandwidth_offline": 20.0,
        "butterworth.bandwidth_online": 5.0,
        "sensors.lgs_count": 1,
        "sensors.lgs_noise": 1e-4,
        "sensors.lgs_low_frequency_rms": 0.0,
        "run.duration": 1.0,
        "run.warm_up": 0.3,
        "gpr_offline.training_size": 300,
        "gpr_offline.depth": 30,
        "gpr_offline.noise_std": 1e-3,
        "gpr_online.training_size": 100,
        "gpr_online.depth": 30,
        "gpr_online.noise_std": 1e-3,
    }
)


@pytest.fixture(scope="module", name="record")
def _record() -> Record:
    return simulate(LINE)


@pytest.mark.slow
@pytest.mark.parametrize("delay", [1.0, 2.0, 2.5])
@pytest.mark.parametrize("name", ["integrator+gpr-offline", "integrator+gpr-online"])
def test_a_prediction_is_the_vibration_while_the_command_acts(name: str, delay: float, record: Record) -> None:
    """A command held for a frame acts from `delay` - 1 to `delay` steps after its own: the mean of a line over that time."""
    assert record.vibration is not None
    scenario, controller = LINE.replace({"control.delay": delay, "control.integrator": "manual"}), CONTROLLERS[name]
    settings, plant = own_settings(controller, scenario), plant_of(scenario)
    measured, prior = controller_arguments(controller, record, settings, prior_for(controller, scenario))
    assert controller.predict is not None
    got = controller.predict(measured, prior, plant, settings, QUIET)
    command = np.zeros(20)
    command[0] = 1.0
    wanted = np.zeros_like(record.vibration)
    for later, share in enumerate(plant.mirror.correction(command)):
        wanted += share * np.roll(record.vibration, -later, axis=0)
    settled = slice(500, -20)  # the online band-pass has forgotten its start; what `roll` brings round is left out
    error = np.std((got - wanted)[settled], axis=0) / np.std(wanted[settled], axis=0)
    # The band-pass keeps a line at its centre as it is, to a few per cent at the ends of the training record. One step of 1 ms
    # is a quarter of a radian of this line.
    assert np.all(error < 0.08)
