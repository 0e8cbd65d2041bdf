"""What the events of a scenario do to the disturbance and to the measurements.

A peak is moved through its analytic signal x_a, which holds its positive frequencies alone,

    x'(t) = strength(t) Re(x_a(t) exp(2 pi i integral shift dt)),

so that its spectrum is shifted as it is, and what was before the event stays as it was. A change of the wind is one of the clock
of the turbulence (Taylor's frozen flow): phi'(t) = phi(s(t)), s = integral factor dt, for all that any star sees.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import hilbert

from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.events import FRAMES, LASER, PEAK, WIND, Event
from wfsobs.scenario.timeline import air_time, during, strength, turns
from wfsobs.signal.ar2 import Ar2
from wfsobs.typing import Array

GUARD = 64
"""Periods of an AR(2) peak, by which it is continued to both sides for its analytic signal, as long as the record at most."""


def of_peak(scenario: Scenario, number: int) -> list[Event]:
    """The events of one peak of the vibration."""
    return [event for event in scenario.events if event.kind == PEAK and event.peak == number]


def moved(signal: Array, events: Sequence[Event], dt: float, before: int = 0) -> Array:
    """The signal (n,) of a peak after its events, sampled every `dt` [s], `before` steps of it before the start of the record;
    taken to be periodic, as an inverse DFT is."""
    t = (np.arange(signal.size) - before) * dt
    return strength(events, t) * (hilbert(signal) * np.exp(2j * np.pi * turns(events, t))).real


def moved_process(process: Ar2, x: Array, events: Sequence[Event]) -> Array:
    """The same of a sample x (n,) of an AR(2) process, which is not periodic: on both sides it goes on as the process is
    expected to, and fades out."""
    guard = min(round(GUARD * 2.0 * np.pi / (process.omega * process.dt)), x.size)
    fade = 0.5 + 0.5 * np.cos(np.pi * np.arange(1, guard + 1) / (guard + 1))
    ahead, behind = (fade * process.extrapolate(ends, guard) for ends in (np.resize(x[-2:], 2), np.resize(x[1::-1], 2)))
    return moved(np.concatenate([behind[::-1], x, ahead]), events, process.dt, guard)[guard:-guard]


def clock(scenario: Scenario, n_steps: int) -> Array | None:
    """When each step sees the turbulence [steps], (n_steps,); None where the wind stays as it is."""
    events = [event for event in scenario.events if event.kind == WIND]
    return air_time(events, np.arange(n_steps) * scenario.dt) / scenario.dt if events else None


def steps_of_air(at: Array | None, n_steps: int) -> int:
    """How many steps of turbulence a record takes, by its clock: those of the record at least, so that a wind that falls leaves
    what was before as it was."""
    return n_steps if at is None else max(n_steps, int(np.ceil(at[-1])) + 1, 2)


def read(x: Array, at: Array | None) -> Array:
    """x (n, ...) at the times `at` [steps], between steps by a cubic spline; as it is where `at` is None."""
    return x if at is None else CubicSpline(np.arange(len(x)), x)(at)


def lasers(scenario: Scenario, n_steps: int) -> Array:
    """How many LGS there are at each step, (n_steps,) whole numbers."""
    out, t = np.full(n_steps, scenario.sensors.lgs_count), np.arange(n_steps) * scenario.dt
    for event in scenario.events:
        if event.kind == LASER:
            out[during(event, t)] -= event.lasers
    return np.maximum(out, 0)


def lost_frames(scenario: Scenario, n_steps: int, rng: np.random.Generator) -> dict[str, Array]:
    """Sensor -> whether its measurement at each step is lost, (n_steps,); every event has a random stream of its own."""
    t = np.arange(n_steps) * scenario.dt
    out = {"lgs": np.zeros(n_steps, dtype=bool), "ngs": np.zeros(n_steps, dtype=bool)}
    for event, stream in zip(scenario.events, rng.spawn(len(scenario.events)), strict=True):
        if event.kind == FRAMES:
            out[event.sensor] |= during(event, t) & (stream.random(n_steps) < event.share)
    return out
