"""The control loop: from a disturbance and its measurements to a `Record`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import isnan

import numpy as np
import scipy

from wfsobs.progress import QUIET, Watch
from wfsobs.record import DELAY, Measurements, Record, Training, delay_signal, frame_mean
from wfsobs.registry import sections
from wfsobs.scenario import Scenario
from wfsobs.scenario.scenario import used_settings
from wfsobs.settings.values import Plain, check_kind
from wfsobs.simulation.disturbance import make_disturbance
from wfsobs.simulation.sensing import OpenLoop, measure_noise, measure_open_loop
from wfsobs.typing import Array

TOLD = ("kalman", "butterworth", "control", "plant")
"""Groups of what observers and controllers are told, and of their plant, which no simulation of a record reads; nor their own."""

TRAINING_MARGIN = 0.5
"""Time after the last window of a training record [s]; it keeps the end of the zero-phase filter out of the targets."""


def integrate_commands(open_loop_y: Array, gain: float, leak: float) -> Array:
    """Compute the commands of the integrator u[k] = leak u[k-1] - g y[k] on y[k] = open_loop_y[k] + u[k-2].

    The loop is linear, so it is one recursive filter of the open-loop measurement,
    u = -g / (1 - leak q^-1 + g q^-2) y_OL. Stable for 0 <= g < 1 and 0 <= leak <= 1.

    Parameters
    ----------
    open_loop_y : Array
        Open-loop measurements, (n_steps, n_modes) [um]; where NaN, the command does not change.
    gain, leak : float
        Gain g and leak.

    Returns
    -------
    Array
        Commands u, (n_steps, n_modes) [um].
    """
    if np.isnan(open_loop_y).any():
        return np.column_stack([_holding_integrator(y.tolist(), gain, leak) for y in open_loop_y.T])
    return scipy.signal.lfilter([-gain], [1.0, -leak, gain], open_loop_y, axis=0)


def _holding_integrator(open_loop_y: Sequence[float], gain: float, leak: float) -> list[float]:
    """Compute the commands of one mode, measurement by measurement; a missing one (NaN) holds the command."""
    u, before, last = [], 0.0, 0.0
    for y in open_loop_y:
        before, last = last, last if isnan(y) else leak * last - gain * (y + before)
        u.append(last)
    return u


def record_settings(scenario: Scenario) -> Plain:
    """Return the settings that a record depends on without its training data, those with an effect, as plain values."""
    tree = used_settings(scenario)
    for name in (*TOLD, *sections()):
        del tree[name]
    del tree["run"]["warm_up"]
    if scenario.turbulence.source == "frozen-flow":
        del tree["turbulence"]["damping"]  # of what the filters are told of it
    return tree


def training_settings(scenario: Scenario) -> Plain:
    """Return the settings that a record depends on together with its training data, as plain values."""
    g = scenario.gpr_offline
    return {**record_settings(scenario), "training": [scenario.run.warm_up, g.training_size, g.depth]}


def simulate(
    scenario: Scenario, *, rng: np.random.Generator | None = None, watch: Watch = QUIET, like: Record | None = None
) -> Record:
    """Simulate the loop over the scenario's duration.

    Parameters
    ----------
    scenario : Scenario
        Settings of the run.
    rng : numpy.random.Generator, optional
        Source of all random numbers; by default one seeded with `scenario.run.seed`.
    watch : Watch
        Receives the progress, and is asked at every block of work whether to stop.
    like : Record, optional
        A record of the same `record_settings` and generator: it is not simulated again, only its training data.

    Returns
    -------
    Record
        Measurements, commands and truth, with the training record.

    Raises
    ------
    SettingError
        Two settings exclude each other.
    Cancelled
        `watch` asks to stop.
    """
    check_kind("simulate", scenario, Scenario)
    scenario.validate()
    rng = np.random.default_rng(scenario.run.seed) if rng is None else rng
    record_rng, training_rng = rng.spawn(2)
    record = like if like is not None else _run(scenario, scenario.n_steps, record_rng, watch)
    return replace(record, training=_training(scenario, training_rng, watch))


def _run(scenario: Scenario, n_steps: int, rng: np.random.Generator, watch: Watch) -> Record:
    disturbance_rng, sensor_rng = rng.spawn(2)
    disturbance = make_disturbance(scenario, n_steps, disturbance_rng, watch)
    seen = measure_open_loop(scenario, disturbance, sensor_rng, watch)
    watch.check()
    measured = measure_closed_loop(scenario, seen)
    return Record(**vars(measured), turbulence=disturbance.turbulence, vibration=disturbance.vibration)


def measure_closed_loop(scenario: Scenario, open_loop: OpenLoop) -> Measurements:
    """Return the measurements and commands of the scenario's loop on open-loop measurements.

    The loop is linear: those of a sum are the sums of those of its parts, where the same samples are missing.
    """
    u, n = np.zeros_like(open_loop.lgs), scenario.sensors.exposure_ratio
    if scenario.loop.closed:
        u = integrate_commands(open_loop.lgs, scenario.loop.gain, scenario.loop.leak)
    return Measurements(
        y_lgs=open_loop.lgs + delay_signal(u, DELAY),
        u=u,
        dt=scenario.dt,
        y_ngs=open_loop.ngs + frame_mean(delay_signal(u, DELAY - 1), n),
        ratio=n,
        open_loop_y=open_loop.lgs,
        lgs_stars=open_loop.stars,
        y_stars=None if open_loop.each is None else open_loop.each + delay_signal(u, DELAY)[:, None],
    )


def simulate_noise(scenario: Scenario) -> OpenLoop:
    """Return the white sensor noise [um] in the record that `simulate` makes from the scenario's seed."""
    record_rng, _ = np.random.default_rng(scenario.run.seed).spawn(2)
    _, sensor_rng = record_rng.spawn(2)
    return measure_noise(scenario, scenario.n_steps, sensor_rng)


def _training(scenario: Scenario, rng: np.random.Generator, watch: Watch) -> Training:
    """Simulate a training record: the same scenario without its events, with random numbers of its own.

    It starts after the warm-up, when the loop has settled, and has the length that the offline GPR needs.
    """
    g = scenario.gpr_offline
    settle = round(scenario.run.warm_up * scenario.sensors.lgs_rate)
    needed = g.training_size + g.depth + round(TRAINING_MARGIN * scenario.sensors.lgs_rate)
    record = _run(scenario.before_events, settle + needed, rng, watch)
    assert record.open_loop_y is not None
    return Training(record.y_lgs[settle:], record.u[settle:], record.open_loop_y[settle:])
