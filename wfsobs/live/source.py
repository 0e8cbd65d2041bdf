"""Sources of frames, in processes of their own: a simulation, a record, a stream."""

from __future__ import annotations

import os
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.queues import Queue
from queue import Empty
from typing import Protocol

from wfsobs.live.paced import Command, Desk, LiveEvent, Staff
from wfsobs.live.ring import Ring
from wfsobs.record import Sampling

SIMULATION, RECORD, STREAM = "simulation", "record", "stream"
"""Names of sources."""


class LiveSource(Protocol):
    """A source before it runs: what its processes are told, and nothing that lives."""

    @property
    def name(self) -> str:
        """What it is, in a word or two."""
        ...

    @property
    def has_truth(self) -> bool:
        """Whether its frames have the truth."""
        ...

    @property
    def sampling(self) -> Sampling:
        """Modes, step and NGS ratio."""
        ...

    def staff(self, context: SpawnContext, desk: Desk) -> Staff:
        """Return its processes."""
        ...


class SourceProcess:
    """A source that runs.

    Parameters
    ----------
    source : LiveSource
        Which.
    speed : float
        1 is real time.
    n_frames : int or None
        Frames until it ends; None for no end.

    Attributes
    ----------
    ring : Ring
        Its frames.
    processes : list of BaseProcess
        That which writes the ring is the last one.
    """

    ring: Ring

    def __init__(self, source: LiveSource, speed: float = 1.0, n_frames: int | None = None):
        os.environ["OPENBLAS_NUM_THREADS"] = "1"  # read by the processes
        context = get_context("spawn")
        n_modes = source.sampling.n_modes
        self.ring, self._news = Ring(n_modes), context.Queue()
        inbox, self._outbox = context.Pipe(duplex=False)
        desk = Desk(self.ring.name, n_modes, inbox, self._news, speed, n_frames)
        self._staff = source.staff(context, desk)
        self.processes: list[BaseProcess] = [*self._staff.others, self._staff.sender]
        for process in self.processes:
            process.start()

    def tell(self, command: Command) -> None:
        """Give a command to the process that sends; new settings to the others as well."""
        for pipe in (*self._staff.outboxes, self._outbox) if command.get("is_new") else (self._outbox,):
            send_command(pipe, command)

    def news(self) -> list[LiveEvent]:
        """Return the events since the last call."""
        return take_all(self._news)

    @property
    def is_alive(self) -> bool:
        """Whether frames may follow."""
        return self.processes[-1].is_alive() and not self.ring.is_closed

    def stop(self) -> None:
        """End the processes and give the memory back."""
        for process in self.processes:
            end_process(process)
        self.ring.release()


def send_command(outbox: Connection, command: Command) -> None:
    """Send a command to a process; to one that has ended, nothing."""
    with suppress(OSError):
        outbox.send(command)


def take_all(queue: Queue[LiveEvent]) -> list[LiveEvent]:
    """Return all that is in a queue."""
    out = []
    while True:
        try:
            out.append(queue.get_nowait())
        except Empty:
            return out


def end_process(process: BaseProcess) -> None:
    """End a process, and wait for it."""
    process.terminate()
    process.join(5)
    if process.is_alive():
        process.kill()
        process.join(5)
