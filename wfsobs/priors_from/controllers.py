"""What controllers are told of a scenario and a record: the plant, a prior, settings of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf, pi

import numpy as np

from wfsobs.control.base import Controller, Settings
from wfsobs.control.mirror import Mirror, Plant
from wfsobs.control.supervisor import Supervision
from wfsobs.control.true_plant import TruePlant, true_matrix
from wfsobs.prior import Prior, Spectra, Training
from wfsobs.priors_from.scenario import prior_of
from wfsobs.priors_from.telemetry import training_of
from wfsobs.record import Measurements, Record
from wfsobs.scenario import Scenario
from wfsobs.sensors.zernike import noll


def plant_of(scenario: Scenario) -> Plant:
    """Return the plant of a scenario's closed loop."""
    c = scenario.control
    mirror = Mirror(c.delay, c.stroke or inf, c.rate * scenario.dt * 1e3 or inf)
    return Plant(mirror, scenario.dt, scenario.sensors.exposure_ratio)


def full_plant_of(scenario: Scenario, rotation: float = 0.0) -> TruePlant:
    """Return the plant of a scenario's closed loop as it is, and turned by a further angle [deg]."""
    p, dt = scenario.plant, scenario.dt
    matrix = true_matrix([noll(mode.noll) for mode in scenario.modes], p.gain_error, p.rotation + rotation, p.coupling)
    return TruePlant(
        matrix,
        scenario.control.delay + p.delay_error,
        p.delay_jitter,
        2.0 * pi * p.dynamics.resonance * dt,
        p.dynamics.damping,
        p.lost_commands,
        p.quantum,
        p.hysteresis,
        p.hysteresis_range,
        p.optical_gain_drift * dt,
        p.optical_gain_rms,
        p.optical_gain_time / dt,
        round(p.start / dt),
    )


def true_plant_of(scenario: Scenario) -> TruePlant | None:
    """Return the plant as it is; None where it is the one that the controllers are designed for."""
    out = full_plant_of(scenario)
    is_moved = scenario.plant.delay_error or out.resonance
    is_perfect = replace(out, start=0).time_invariant and not is_moved and np.array_equal(out.matrix, np.eye(len(out.matrix)))
    return None if is_perfect else out


def supervision_of(controller: Controller, scenario: Scenario) -> Supervision | None:
    """Return how a controller is supervised; None where it is not, as are an integrator and control by nothing."""
    c = scenario.control
    is_safe = controller.is_idle or controller.id == "integrator"
    return Supervision(c.fallback_gain, c.leak) if c.supervised and not is_safe else None


def own_settings(controller: Controller, scenario: Scenario) -> Settings:
    """Return copies of the controller's own groups of settings."""
    return Settings(**{name: getattr(scenario, name).copy() for name in controller.groups})


def prior_for(controller: Controller, scenario: Scenario, spectra: Sequence[Spectra] = ()) -> Prior:
    """Return the prior of a controller before there is a record; spectra : one per mode, where already computed.

    Raises ValueError where the scenario has no such prior.
    """
    return prior_of(scenario.before_events, None, controller.parts(own_settings(controller, scenario)), spectra)


def controller_arguments(controller: Controller, record: Record, settings: Settings, prior: Prior) -> tuple[Measurements, Prior]:
    """Return the arguments of a controller from a record: measurements and prior, with the training record where it needs one."""
    return record.measurements(), replace(prior, training=training_of(record) if Training in controller.parts(settings) else None)
