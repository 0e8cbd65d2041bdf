"""The simulated loop as a source: one process makes blocks ahead of time, another sends their frames by the clock.

An endless simulation in constant memory: records that fade into each other.

Records of equal length overlap by half, weighted by a sine of half a period, the squares of which add up to one. So the sum of
two independent Gaussian records has their variance at every step, and at a lag tau their covariance times cos(pi tau / length):
there is no seam, and lines are wider by 1 / (2 length).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from multiprocessing.queues import Queue
from queue import Empty, Full
from typing import Any

import numpy as np

from wfsobs.live.source import SIMULATION, SOURCE, Command, Desk, Staff, enter_process, may_go_first, receive, send_frames
from wfsobs.record import Sampling
from wfsobs.scenario import Scenario
from wfsobs.simulation.disturbance import make_disturbance
from wfsobs.simulation.sensing import measure_open_loop
from wfsobs.stepping import sampling_of
from wfsobs.typing import Array

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
        yield _fade(before[half:], after[:half], weight)
        before = after


def _record(scenario: Scenario, n_steps: int, rng: np.random.Generator) -> Array:
    disturbance_rng, sensor_rng = rng.spawn(2)
    disturbance = make_disturbance(scenario, n_steps, disturbance_rng)
    seen = measure_open_loop(scenario, disturbance, sensor_rng)
    return np.hstack([seen.lgs, seen.ngs, disturbance.turbulence, disturbance.vibration])


def _fade(before: Array, after: Array, weight: Array) -> Array:
    """Fade from one record to the next; the first sample is that of the one before alone, where the next may have none."""
    out = np.sqrt(1.0 - weight**2) * before
    out[1:] += weight[1:] * after[1:]
    return out


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

    def staff(self, context: SpawnContext, desk: Desk) -> Staff:
        """Return its processes."""
        ready = context.Queue(round(AHEAD / self.scenario.dt) // piece_length(self.scenario) + 1)
        inbox, outbox = context.Pipe(duplex=False)
        settings = self.scenario.to_dict()
        maker = context.Process(target=_make, args=(settings, inbox, ready), name="the simulation", daemon=True)
        sender = context.Process(target=_send, args=(settings, ready, desk), name="the source", daemon=True)
        return Staff(sender, [maker], [outbox], ready)


def piece_length(scenario: Scenario) -> int:
    """Return the frames of a piece, whole exposures of the NGS: whatever follows on it is in step with them."""
    ratio = scenario.sensors.exposure_ratio
    return max(1, PIECE // (8 * 4 * len(scenario.modes) * ratio)) * ratio


def _make(settings: dict[str, Any], inbox: Connection, ready: Queue[Piece]) -> None:
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


def _send(settings: dict[str, Any], ready: Queue[Piece], desk: Desk) -> None:
    enter_process(turn=SOURCE)
    scenario = Scenario.from_dict(settings)
    send_frames(desk, SimulatedFrames(scenario, ready), scenario.dt)


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
            row = self._mix(row, self._next_of(self._new))
            self._new_at += 1
        z, ngs, *truth = row.reshape(4, -1)
        draw = self._rng.random()  # one for both: they are lost together
        z, ngs = (x if draw >= self._losses[name] else self._missing for name, x in (("lgs", z), ("ngs", ngs)))
        return np.concatenate((z, ngs, self._loop.command(z), *truth))

    def take(self, command: Command, number: int) -> str:
        """Follow "settings", for which frames of another generation are to be expected, and "losses"."""
        self._losses = command.get("losses", self._losses)
        if "settings" in command:
            self._loop.take(Scenario.from_dict(command["settings"]))
            self._target += command["is_new"]
        return command.get("line", "")

    def _mix(self, row: Array, new: Array) -> Array:
        """Fade; the first frame is an old one alone, as a first block has no NGS measurement there."""
        weight = self._weight[self._new_at]
        return np.sqrt(1.0 - weight**2) * row + weight * new if self._new_at else row

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
