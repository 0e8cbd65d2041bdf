"""The control loop: from a disturbance and its measurements to a `Record`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import isnan

import numpy as np
from scipy.signal import lfilter

from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, Training, delay_signal, frame_mean
from wfsobs.scenario import Scenario
from wfsobs.simulation.disturbance import make_disturbance
from wfsobs.simulation.sensing import measure
from wfsobs.typing import Array

TRAINING_MARGIN = 0.5
"""What a training record has beyond its last window [s], so that the end of the zero-phase filter stays out of
the targets."""


def integrator(open_loop_y: Array, gain: float, leak: float) -> Array:
    """Commands of the integrator u[k] = leak u[k-1] - g y[k] on y[k] = open_loop_y[k] + u[k-2].

    The loop is linear, so it is one recursive filter of the open-loop measurement,
    u = -g / (1 - leak q^-1 + g q^-2) y_OL. Stable for 0 <= g < 1 and 0 <= leak <= 1. Where y_OL is NaN u stays as it is.
    """
    if np.isnan(open_loop_y).any():
        return np.column_stack([_holding_integrator(y.tolist(), gain, leak) for y in open_loop_y.T])
    return lfilter([-gain], [1.0, -leak, gain], open_loop_y, axis=0)


def _holding_integrator(open_loop_y: Sequence[float], gain: float, leak: float) -> list[float]:
    """The same of one mode, measurement by measurement; one that is lost (NaN) leaves the command as it is."""
    u, before, last = [], 0.0, 0.0
    for y in open_loop_y:
        before, last = last, last if isnan(y) else leak * last - gain * (y + before)
        u.append(last)
    return u


def simulate(scenario: Scenario, *, rng: np.random.Generator | None = None, watch: Watch = QUIET) -> Record:
    """Run the loop over the scenario's duration and return its record, training record included.

    rng : source of every random number; by default one seeded with `scenario.run.seed`.
    Raises SettingError where settings do not go together, Cancelled if `watch` says so.
    """
    scenario.validate()
    rng = np.random.default_rng(scenario.run.seed) if rng is None else rng
    record_rng, training_rng = rng.spawn(2)
    record = _run(scenario, scenario.n_steps, record_rng, watch)
    return replace(record, training=_training(scenario, training_rng, watch))


def _run(scenario: Scenario, n_steps: int, rng: np.random.Generator, watch: Watch) -> Record:
    disturbance_rng, sensor_rng = rng.spawn(2)
    disturbance = make_disturbance(scenario, n_steps, disturbance_rng, watch)
    seen = measure(scenario, disturbance, sensor_rng, watch)
    watch.check()
    u = np.zeros_like(seen.lgs)
    if scenario.loop.closed:
        u = integrator(seen.lgs, scenario.loop.gain, scenario.loop.leak)
    n = scenario.sensors.exposure_ratio
    return Record(
        y_lgs=seen.lgs + delay_signal(u, 2),
        u=u,
        dt=scenario.dt,
        y_ngs=seen.ngs + frame_mean(delay_signal(u, 1), n),
        ratio=n,
        turbulence=disturbance.turbulence,
        vibration=disturbance.vibration,
        open_loop_y=seen.lgs,
    )


def _training(scenario: Scenario, rng: np.random.Generator, watch: Watch) -> Training:
    """A record of the same scenario, without its events, with random numbers of its own, cut to start after the warm-up:
    the loop has settled, and it is as long as the offline GPR needs."""
    g = scenario.gpr_offline
    settle = round(scenario.run.warm_up * scenario.sensors.lgs_rate)
    needed = g.training_size + g.depth + round(TRAINING_MARGIN * scenario.sensors.lgs_rate)
    record = _run(scenario.before_events, settle + needed, rng, watch)
    assert record.open_loop_y is not None
    return Training(record.y_lgs[settle:], record.u[settle:], record.open_loop_y[settle:])
