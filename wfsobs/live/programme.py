"""What a simulated loop is at each time: settings and losses, by the events of its scenario, over and over, and by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import prod
from threading import Lock
from typing import Any

import numpy as np

from wfsobs.live.source import SIMULATION, Command, LiveSource
from wfsobs.priors_from.scenario import as_sampled
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.events import FRAMES, LASER, PEAK, WIND, Event, during, shift, strength, wind
from wfsobs.settings.group import SettingError
from wfsobs.simulation.events import peak_events
from wfsobs.simulation.loop import record_settings

STAIR = 2.0
"""Shortest stair of a ramp [s]: the simulation of new settings takes time, and fades in."""
STAIRS = 8
"""Most stairs of a ramp."""
WITHOUT_WIND = ("processes", "psd")
"""Sources of turbulence that do not ask for the wind speed."""


@dataclass(frozen=True)
class Act:
    """What a loop is from a time on; the words and the time do not tell one from another.

    scenario : settings, without events
    lgs, ngs : shares of the measurements that are lost, 0 to 1
    start    : since the loop began [s]
    words    : what can change -> what it is
    """

    scenario: Scenario
    lgs: float = 0.0
    ngs: float = 0.0
    start: float = field(default=0.0, compare=False)
    words: Mapping[str, str] = field(default_factory=dict, compare=False)


class Programme:
    """The settings and the losses that a source is told.

    Parameters
    ----------
    scenario : Scenario
        Settings; its events are played from the start, and again after every `run.duration`.
    tell : callable
        Receives commands for the source.

    Attributes
    ----------
    scenario : Scenario
        Settings with their events.

    Raises
    ------
    SettingError
        An event cannot be played, or settings exclude each other.
    """

    scenario: Scenario

    def __init__(self, scenario: Scenario, tell: Callable[[Command], None]):
        self.scenario, self._acts = scenario, acts_of(scenario)
        self._tell, self._lock = tell, Lock()
        self._act, self._seconds = _act(scenario.before_events, -1.0), 0.0
        self._by_hand = (0.0, 0.0)

    @property
    def present(self) -> Scenario:
        """The settings that the source has been told, without events."""
        return self._act.scenario

    def play(self, seconds: float) -> None:
        """Do what is due so long after the start [s]."""
        with self._lock:
            self._seconds, before, act = seconds, self._act, self._due(seconds)
            if act is not before:
                self._enter(act, ", ".join(text for name, text in act.words.items() if before.words.get(name) != text))

    def become(self, scenario: Scenario, line: str) -> None:
        """Go on with other settings and their events; line : for the list of events. Raises SettingError."""
        acts = acts_of(scenario)
        with self._lock:
            self.scenario, self._acts = scenario, acts
            self._enter(self._due(self._seconds), line)

    def lose(self, lgs: bool, ngs: bool, loss: float) -> None:
        """Lose frames by hand, beside those that events lose."""
        with self._lock:
            self._by_hand = (loss if lgs else 1.0, loss if ngs else 1.0)
            self._tell({"losses": self._losses(self._act), "line": loss_line(lgs, ngs, loss)})

    def _due(self, seconds: float) -> Act:
        at = seconds % self.scenario.run.duration
        return max((act for act in self._acts if act.start <= at), key=lambda act: act.start)

    def _enter(self, act: Act, line: str) -> None:
        before, self._act = self._act, act
        if act == before:
            return
        is_new = needs_new_frames(before.scenario, act.scenario)
        command = {"settings": act.scenario.to_dict(), "is_new": is_new, "losses": self._losses(act)}
        self._tell({**command, "line": line})

    def _losses(self, act: Act) -> dict[str, float]:
        lgs, ngs = self._by_hand
        return {"lgs": either(lgs, act.lgs), "ngs": either(ngs, act.ngs)}


def acts_of(scenario: Scenario) -> list[Act]:
    """Return what a loop is one after the other, from the time 0 on; ramps become stairs. Raises SettingError."""
    scenario.validate()
    for i, event in enumerate(scenario.events):
        if event.kind == WIND and (source := scenario.turbulence.source) in WITHOUT_WIND:
            raise SettingError(f"events.{i}.kind = wind: a live loop takes no wind of turbulence.source = {source}")
    return [_act(scenario, t) for t in sorted({0.0, *(t for event in scenario.events for t in _moments(event))})]


def scenario_on(source: LiveSource, scenario: Scenario) -> Scenario:
    """Return a scenario as a source plays it: at its rates, and only a simulation has events. Raises SettingError."""
    told = as_sampled(scenario if source.name == SIMULATION else scenario.before_events, source.sampling)
    acts_of(told)
    return told


def _moments(event: Event) -> list[float]:
    """Return the times at which an event changes something [s]."""
    ramps = event.kind in (PEAK, WIND)
    stairs = min(max(int(event.duration / STAIR), 1), STAIRS) if ramps else 1
    return [float(t) for t in np.linspace(event.start, event.start + event.duration, stairs + 1)]


def _act(scenario: Scenario, t: float) -> Act:
    """Return what a loop is at the time t [s]. Raises SettingError where that is out of range."""
    at, before = np.array(t), scenario.before_events
    changes: dict[str, Any] = {}
    words: dict[str, str] = {}
    if winds := [event for event in scenario.events if event.kind == WIND]:
        speed = before.turbulence.wind_speed * float(wind(winds, at))
        changes["turbulence.wind_speed"], words["wind"] = speed, f"wind {speed:.3g} m/s"
    for i in sorted({event.peak for event in scenario.events if event.kind == PEAK}):
        own, peak = peak_events(scenario, i), before.vibration.peaks[i]
        f, rms = peak.frequency + float(shift(own, at)), [float(strength(own, at)) * one for one in peak.rms]
        # it keeps its width in Hz
        changes[f"vibration.peaks.{i}"] = {"frequency": f, "damping": peak.damping * peak.frequency / f, "rms": rms}
        move = f"peak at {f:.2f} Hz" if f == peak.frequency else f"peak from {peak.frequency:.2f} to {f:.2f} Hz"
        words[f"peak {i}"] = f"{move}, {1e3 * max(rms):.1f} nm"
    count, active = before.sensors.lgs_count, [event for event in scenario.events if during(event, at)]
    left = max(count - sum(event.lasers for event in active if event.kind == LASER), 0)
    shares = {sensor: _share(active, sensor) for sensor in ("lgs", "ngs")}
    if any(event.kind == LASER for event in scenario.events):
        changes["sensors.lgs_count"], words["lasers"] = left or count, f"{left} of {count} lasers"
    for sensor in sorted({event.sensor for event in scenario.events if event.kind == FRAMES}):
        words[sensor] = (
            f"{shares[sensor]:.0%} of {sensor.upper()} frames lost" if shares[sensor] else f"all {sensor.upper()} frames"
        )
    try:
        present = before.replace(changes) if changes else before
        present.validate()
    except SettingError as error:
        raise SettingError(f"events: at {t:g} s {error}") from None
    return Act(present, shares["lgs"] if left else 1.0, shares["ngs"], t, words)


def _share(active: list[Event], sensor: str) -> float:
    """Return the share of the frames of a sensor that is lost, to events that know nothing of each other."""
    return either(*(event.share for event in active if event.kind == FRAMES and event.sensor == sensor))


def either(*shares: float) -> float:
    """Return the share that is lost to one or another of independent losses.

    >>> either(0.5, 0.5), either(1.0, 0.2), either()
    (0.75, 1.0, 0.0)
    """
    return 1.0 - prod(1.0 - share for share in shares) if shares else 0.0


def needs_new_frames(before: Scenario, now: Scenario) -> bool:
    """Return whether the open-loop frames of two scenarios differ in more than their random numbers."""
    trees = [record_settings(scenario) for scenario in (before, now)]
    for tree in trees:
        tree.pop("loop", None)
    return trees[0] != trees[1]


def loss_line(lgs: bool, ngs: bool, loss: float) -> str:
    """Say what of the frames does not arrive.

    >>> loss_line(False, True, 0.1), loss_line(True, True, 0.0)
    ('lasers out, 10% of frames lost', 'all frames arrive')
    """
    parts = [(not lgs, "lasers out"), (not ngs, "no NGS frames"), (loss > 0, f"{loss:.0%} of frames lost")]
    return ", ".join(line for holds, line in parts if holds) or "all frames arrive"
