"""The simulated loop as a source: one process makes blocks ahead of time, another sends their frames by the clock.

The simulation is endless, in constant memory, of records that fade into each other. Records of equal length overlap by half,
weighted by a sine of half a period, the squares of which add up to one. So the sum of two independent Gaussian records has their
variance at every step, and at a lag tau their covariance times cos(pi tau / length): there is no seam, and lines are wider by 1 /
(2 length).

Its settings and losses change by the events of its scenario, over and over, and by hand (`Programme`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from math import prod
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from multiprocessing.queues import Queue
from queue import Empty, Full
from threading import Lock
from typing import Any

import numpy as np

from wfsobs.live.source import (
    SIMULATION,
    SOURCE,
    Command,
    Desk,
    LiveSource,
    Worker,
    enter_process,
    may_go_first,
    receive,
    send_frames,
)
from wfsobs.priors_from.scenario import as_sampled
from wfsobs.record import Sampling
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.events import FRAMES, LASER, PEAK, WIND, Event, during, shift, strength, wind
from wfsobs.settings.group import SettingError
from wfsobs.simulation.disturbance import make_disturbance, peak_events
from wfsobs.simulation.loop import record_settings
from wfsobs.simulation.sensing import measure_open_loop
from wfsobs.stepping import sampling_of
from wfsobs.typing import Array

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
        frames = f"{sensor.upper()} frames"
        words[sensor] = f"{100.0 * shares[sensor]:.0f} % of {frames} lost" if shares[sensor] else f"all {frames}"
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
    ('lasers out, 10 % of frames lost', 'all frames arrive')
    """
    parts = [(not lgs, "lasers out"), (not ngs, "no NGS frames"), (loss > 0, f"{100.0 * loss:.0f} % of frames lost")]
    return ", ".join(line for holds, line in parts if holds) or "all frames arrive"


LENGTH = 40.0
"""Length of a record [s]; a block is half as long."""


def endless_blocks(scenario: Scenario, rng: np.random.Generator, length: float = LENGTH) -> Iterator[Array]:
    """Yield blocks of frames of a scenario for ever.

    Parameters
    ----------
    scenario : Scenario
        Settings; their events are left out.
    rng : numpy.random.Generator
        LiveSource of all random numbers.
    length : float
        Length of the records [s].

    Yields
    ------
    Array
        Half a record: a row per frame of z, ngs, turbulence and vibration, (n, 4 n_modes) [um], ngs NaN in frames without one.
        Frame 0 of all is one with an NGS measurement, but for the first.

    Raises
    ------
    SettingError
        The settings exclude each other.
    """
    scenario = scenario.before_events
    scenario.validate()
    ratio = scenario.sensors.exposure_ratio
    half = max(1, round(0.5 * length / scenario.dt / ratio)) * ratio
    weight = np.sin(0.5 * np.pi * np.arange(half) / half)[:, None]
    before = _record(scenario, 2 * half, rng)
    while True:
        after = _record(scenario, 2 * half, rng)
        block = np.sqrt(1.0 - weight**2) * before[half:]
        block[1:] += weight[1:] * after[1:half]  # the first sample of a record may have no NGS measurement
        yield block
        before = after


def _record(scenario: Scenario, n_steps: int, rng: np.random.Generator) -> Array:
    disturbance_rng, sensor_rng = rng.spawn(2)
    disturbance = make_disturbance(scenario, n_steps, disturbance_rng)
    seen = measure_open_loop(scenario, disturbance, sensor_rng)
    return np.hstack([seen.lgs, seen.ngs, disturbance.turbulence, disturbance.vibration])


AHEAD = 40.0
"""Time whose frames are ready beside those that are sent [s]."""
PIECE = 1 << 15
"""Bytes of a piece of a block at most. A pipe holds one, so that its frames wait for no other process."""
GLANCE = 4
"""Pieces that are taken in one frame at most, each in a tenth of a millisecond."""
FADE = 0.5
"""Time in which frames of changed settings fade in [s]."""

Piece = tuple[int, Array]
"""Generation of the settings, and rows of a block."""


@dataclass(frozen=True)
class SimulatedLoop:
    """A scenario as a source.

    Attributes
    ----------
    scenario : Scenario
        Settings; the seed is `run.seed`.
    """

    scenario: Scenario
    name = SIMULATION
    has_truth = True

    @property
    def sampling(self) -> Sampling:
        """Modes, step and NGS ratio."""
        return sampling_of(self.scenario)

    def staff(self, context: SpawnContext, desk: Desk) -> list[Worker]:
        """Begin its processes."""
        ready = context.Queue(round(AHEAD / self.scenario.dt) // piece_length(self.scenario) + 1)
        settings = self.scenario.to_dict()
        maker = Worker(context, "the simulation", _make, settings, ready)
        return [maker, Worker(context, "the source", _send, settings, ready, desk)]


def piece_length(scenario: Scenario) -> int:
    """Return the frames of a piece, whole exposures of the NGS: whatever follows on it is in step with them."""
    ratio = scenario.sensors.exposure_ratio
    return max(1, PIECE // (8 * 4 * len(scenario.modes) * ratio)) * ratio


def _make(settings: dict[str, Any], ready: Queue[Piece], inbox: Connection) -> None:
    """Make blocks ahead of time; when the settings change, those of the new ones.

    It gives way to the other processes of the loop where those cannot go first.
    """
    enter_process(niceness=0 if may_go_first() else 10)
    scenario, generation, is_first = Scenario.from_dict(settings), 0, True
    length = piece_length(scenario)
    rng = np.random.default_rng(scenario.run.seed)
    blocks = endless_blocks(scenario, rng)
    while True:
        changed, block = None, next(blocks)
        for at in range(0, len(block), length):
            # a first block is whole, so that it lasts until the next one
            if not _put(ready, (generation, block[at : at + length]), None if is_first else inbox):
                break
        is_first = False
        while inbox.poll():  # only the newest settings are simulated
            changed, generation, is_first = receive(inbox)["settings"], generation + 1, True
        if changed is not None:
            blocks = endless_blocks(Scenario.from_dict(changed), rng)


def _put(ready: Queue[Piece], piece: Piece, inbox: Connection | None) -> bool:
    """Have a piece ready as soon as there is room for it; return whether there was before something was in the inbox."""
    while inbox is None or not inbox.poll():
        with suppress(Full):
            ready.put(piece, timeout=0.1)
            return True
    return False


def _send(settings: dict[str, Any], ready: Queue[Piece], desk: Desk, inbox: Connection) -> None:
    enter_process(turn=SOURCE)
    scenario = Scenario.from_dict(settings)
    frames = SimulatedFrames(scenario, ready)
    send_frames(desk, inbox, frames.next_row, frames.take, scenario.dt)


class SimulatedFrames:
    """Frames of a simulation whose settings may change.

    Parameters
    ----------
    scenario : Scenario
        Settings at the start.
    ready : queue
        (generation, rows): rows of the same settings are of one generation, the first is 0.
    """

    def __init__(self, scenario: Scenario, ready: Queue[Piece]):
        self._ready, self._ratio, self._dt = ready, scenario.sensors.exposure_ratio, scenario.dt
        self._loop, self._rng = Integrator(scenario), np.random.default_rng(0)
        self._losses = {"lgs": 0.0, "ngs": 0.0}  # shares of the measurements of the two sensors
        self._missing = np.full(len(scenario.modes), np.nan)
        self._target, (self._generation, rows) = 0, ready.get()
        self._old, self._new = deque(rows), None
        self._weight = np.empty(0)
        self._new_at = 0

    def next_row(self, number: int) -> Array:
        """Return the next frame: of the present settings, or fading into those of changed ones."""
        if self._target > self._generation and self._new is None and number % self._ratio == 0:
            self._look_for_new()
        if self._new is not None and self._new_at == len(self._weight):
            self._old, self._new = self._new, None
        row = self._next_of(self._old)
        if self._new is not None:
            new, weight = self._next_of(self._new), self._weight[self._new_at]
            if self._new_at:  # the first frame is an old one alone, as a first block has no NGS measurement there
                row = np.sqrt(1.0 - weight**2) * row + weight * new
            self._new_at += 1
        z, ngs, *truth = row.reshape(4, -1)
        draw = self._rng.random()  # one for both: they are lost together
        z, ngs = (x if draw >= self._losses[name] else self._missing for name, x in (("lgs", z), ("ngs", ngs)))
        return np.concatenate((z, ngs, self._loop.command(z), *truth))

    def take(self, command: Command) -> str:
        """Follow "settings", for which frames of another generation are to be expected, and "losses"."""
        self._losses = command.get("losses", self._losses)
        if "settings" in command:
            self._loop.take(Scenario.from_dict(command["settings"]))
            self._target += command["is_new"]
        return command.get("line", "")

    def _look_for_new(self) -> None:
        """Begin to fade once rows of the newest settings have come; those of the present ones may be needed until then."""
        for _ in range(GLANCE):
            try:
                generation, rows = self._ready.get_nowait()
            except Empty:
                return
            if generation == self._generation:
                self._old.extend(rows)
            elif generation == self._target:
                steps = min(round(FADE / self._dt), len(self._old)) // self._ratio * self._ratio
                self._weight = np.sin(0.5 * np.pi * np.arange(steps) / max(steps, 1))
                self._new, self._new_at, self._generation = deque(rows), 0, generation
                return

    def _next_of(self, queue: deque[Array]) -> Array:
        if not queue:
            self._generation, rows = self._ready.get()
            queue.extend(rows)
        return queue.popleft()


class Integrator:
    """The integrator of the scenario."""

    def __init__(self, scenario: Scenario):
        self._before = self._last = np.zeros(len(scenario.modes))
        self.take(scenario)

    def take(self, scenario: Scenario) -> None:
        """Go on with the gain and the leak of a scenario."""
        loop = scenario.loop
        self._gain, self._leak = (loop.gain, loop.leak) if loop.closed else (0.0, 0.0)

    def command(self, z: Array) -> Array:
        """Return u[k] = leak u[k-1] - g y[k], y[k] = z[k] + u[k-2], (n_modes,) [um]; a missing measurement holds the command."""
        u = self._leak * self._last - self._gain * (z + self._before)
        self._before, self._last = self._last, np.where(np.isnan(z), self._last, u)
        return self._last
