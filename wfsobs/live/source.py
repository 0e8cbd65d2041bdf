"""The simulated loop as a source of frames, in processes of its own: one makes blocks, one paces frames by the clock."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from multiprocessing import get_context
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Event
from time import monotonic, sleep
from typing import Any

import numpy as np
from scipy.signal import lfilter

from wfsobs.live.blocks import Block, endless_blocks
from wfsobs.live.ring import Ring
from wfsobs.record import DELAY
from wfsobs.scenario import Scenario
from wfsobs.typing import Array

AHEAD = 2
"""Blocks that are ready beside the one that is sent."""


class SimulatedSource:
    """A loop that is simulated by the clock.

    Parameters
    ----------
    scenario : Scenario
        Settings; the seed is `run.seed`.
    speed : float
        1 is real time.
    n_frames : int or None
        Frames until it ends; None for no end.
    """

    def __init__(self, scenario: Scenario, speed: float = 1.0, n_frames: int | None = None):
        context = get_context("spawn")
        self.ring, self._go, self._end = Ring(len(scenario.modes)), context.Event(), context.Event()
        self._ready: Queue[Block] = context.Queue(AHEAD)  # kept: its locks go with it
        settings = scenario.to_dict()
        os.environ["OPENBLAS_NUM_THREADS"] = "1"  # read by the processes
        pace = scenario.dt / speed
        self._processes = [
            context.Process(target=_make, args=(settings, self._ready, self._end), daemon=True),
            context.Process(
                target=_send, args=(settings, self._ready, self.ring.name, pace, n_frames, self._go, self._end), daemon=True
            ),
        ]
        for process in self._processes:
            process.start()

    def start(self) -> None:
        """Send the first frame, once it is made."""
        self._go.set()

    @property
    def is_alive(self) -> bool:
        """Whether frames may follow."""
        return self._processes[1].is_alive() and not self.ring.is_closed

    def stop(self) -> None:
        """End the processes and give the memory back."""
        self._end.set()
        for process in self._processes:
            process.terminate()
            process.join(5)
        self.ring.release()


def _make(settings: dict[str, Any], ready: Queue[Block], end: Event) -> None:
    """Make blocks ahead of time, at low priority."""
    os.nice(10)
    scenario = Scenario.from_dict(settings)
    for block in endless_blocks(scenario, np.random.default_rng(scenario.run.seed)):
        if end.is_set():
            return
        ready.put(block)


def _send(
    settings: dict[str, Any], ready: Queue[Block], ring_name: str, pace: float, n_frames: int | None, go: Event, end: Event
) -> None:
    """Write frames to the ring when they are due."""
    scenario = Scenario.from_dict(settings)
    ring = Ring(len(scenario.modes), ring_name)
    loop = _Loop(scenario)
    rows = _rows(ready, loop)
    row = next(rows)
    gc.collect()
    gc.freeze()
    go.wait()
    start, count = monotonic() + pace, 0
    while not end.is_set() and count != n_frames:
        due = start + count * pace
        if (wait := due - monotonic()) > 0:
            sleep(wait)
        row[0] = due
        ring.write(row)
        count += 1
        row = next(rows)
    ring.close_writer()


def _rows(ready: Queue[Block], loop: _Loop) -> Iterator[Array]:
    """Yield the numbers of one frame after the other; the first is where its due time goes."""
    while True:
        block = ready.get()
        u = loop.commands(block.z)
        whole = np.hstack([np.zeros((len(u), 1)), block.z, block.ngs, u, block.turbulence, block.vibration])
        yield from whole


class _Loop:
    """The integrator of the scenario, which goes on from block to block."""

    def __init__(self, scenario: Scenario):
        loop, n = scenario.loop, len(scenario.modes)
        self.gain, self.leak = (loop.gain, loop.leak) if loop.closed else (0.0, 0.0)
        self._state = np.zeros((DELAY, n))

    def commands(self, z: Array) -> Array:
        """Return u[k] = leak u[k-1] - g y[k], y[k] = z[k] + u[k-2] (n, n_modes) [um]."""
        if self.gain == 0:
            return np.zeros_like(z)
        u, self._state = lfilter([-self.gain], [1.0, -self.leak, self.gain], z, axis=0, zi=self._state)
        return u
