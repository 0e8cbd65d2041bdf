"""Effects of a scenario's events on the disturbance and on the measurements.

A peak is shifted through its analytic signal x_a, which has its positive frequencies alone,

    x'(t) = strength(t) Re(x_a(t) exp(2 pi i integral shift dt)),

so that its spectrum is shifted without change, and the signal before the event is unchanged. A change of the wind is a change of
the clock of the turbulence (Taylor's frozen flow): phi'(t) = phi(s(t)), s = integral factor dt, for all stars.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import hilbert

from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.events import FRAMES, LASER, PEAK, WIND, Event, during, phase_turns, strength, turbulence_time
from wfsobs.signal.ar2 import Ar2
from wfsobs.typing import Array

GUARD = 64
"""Periods by which an AR(2) peak is extended on both sides for its analytic signal; at most the length of the record."""


def peak_events(scenario: Scenario, number: int) -> list[Event]:
    """Return the events of one vibration peak."""
    return [event for event in scenario.events if event.kind == PEAK and event.peak == number]


def shift_peak(signal: Array, events: Sequence[Event], dt: float, before: int = 0) -> Array:
    """Apply events to the signal of a vibration peak.

    Parameters
    ----------
    signal : Array
        Signal without events, (n,), periodic, as an inverse DFT is.
    events : sequence of Event
        Events of the peak.
    dt : float
        Time step [s].
    before : int
        Steps of the signal before the start of the record.

    Returns
    -------
    Array
        Signal with events, (n,).
    """
    t = (np.arange(signal.size) - before) * dt
    return strength(events, t) * (hilbert(signal) * np.exp(2j * np.pi * phase_turns(events, t))).real


def shift_process(process: Ar2, x: Array, events: Sequence[Event]) -> Array:
    """Apply events to a sample x (n,) of an AR(2) process, which is not periodic.

    On both sides it is extended by the expectation of the process, which decays.
    """
    guard = min(round(GUARD * 2.0 * np.pi / (process.omega * process.dt)), x.size)
    fade = 0.5 + 0.5 * np.cos(np.pi * np.arange(1, guard + 1) / (guard + 1))
    ahead, behind = (fade * process.extrapolate(ends, guard) for ends in (np.resize(x[-2:], 2), np.resize(x[1::-1], 2)))
    return shift_peak(np.concatenate([behind[::-1], x, ahead]), events, process.dt, guard)[guard:-guard]


def turbulence_clock(scenario: Scenario, n_steps: int) -> Array | None:
    """Return the time [steps] of the turbulence at each step, (n_steps,); None where the wind is constant."""
    events = [event for event in scenario.events if event.kind == WIND]
    return turbulence_time(events, np.arange(n_steps) * scenario.dt) / scenario.dt if events else None


def turbulence_steps(at: Array | None, n_steps: int) -> int:
    """Return the number of steps of turbulence that a record needs, by its clock.

    At least those of the record, so that a falling wind does not change the turbulence before it.
    """
    return n_steps if at is None else max(n_steps, int(np.ceil(at[-1])) + 1, 2)


def interpolate_steps(x: Array, at: Array | None) -> Array:
    """Interpolate x (n, ...) at the times `at` [steps] by a cubic spline; return x itself where `at` is None."""
    return x if at is None else CubicSpline(np.arange(len(x)), x)(at)


def laser_count(scenario: Scenario, n_steps: int) -> Array:
    """Return the number of LGS at each step, (n_steps,), integers."""
    out, t = np.full(n_steps, scenario.sensors.lgs_count), np.arange(n_steps) * scenario.dt
    for event in scenario.events:
        if event.kind == LASER:
            out[during(event, t)] -= event.lasers
    return np.maximum(out, 0)


def missing_frames(scenario: Scenario, n_steps: int, rng: np.random.Generator) -> dict[str, Array]:
    """Return for each sensor which of its measurements are missing, bool (n_steps,).

    Every event has a random stream of its own.
    """
    t = np.arange(n_steps) * scenario.dt
    out = {"lgs": np.zeros(n_steps, dtype=bool), "ngs": np.zeros(n_steps, dtype=bool)}
    for event, stream in zip(scenario.events, rng.spawn(len(scenario.events)), strict=True):
        if event.kind == FRAMES:
            out[event.sensor] |= during(event, t) & (stream.random(n_steps) < event.share)
    return out
