"""The processes of a live loop and their shared memory: made together, ended together."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from threading import Event, Lock

from wfsobs.live.board import Board
from wfsobs.live.observing import TRACE_CAPACITY, Order, observe_frames, trace_width
from wfsobs.live.paced import Command, enter_process
from wfsobs.live.rows import Rows
from wfsobs.live.source import LiveSource, SourceProcess, end_process, take_all
from wfsobs.scenario import Scenario


class LiveProcesses:
    """Source, observers, and a workshop for what is made beside them.

    Parameters
    ----------
    source : LiveSource
        Of the frames.
    scenario : Scenario
        What the observers are told.
    observers : tuple of str
        Ids of those that run from the start.
    speed : float
        1 is real time.

    Attributes
    ----------
    feed : SourceProcess
        The source.
    traces : Rows
        Estimates of the observers.
    board : Board
        What is counted of them.
    workshop : ProcessPoolExecutor
        A process at low priority, which is made when it is first used.
    is_over : threading.Event
        Whether all has ended.
    """

    def __init__(self, source: LiveSource, scenario: Scenario, observers: tuple[str, ...], speed: float):
        n, context = source.sampling.n_modes, get_context("spawn")
        self.feed, self.is_over, self._lock = SourceProcess(source, speed), Event(), Lock()
        self.traces, self.board = Rows(trace_width(n), TRACE_CAPACITY), Board(n)
        inbox, self._outbox = context.Pipe(duplex=False)
        self._news = context.Queue()
        names = self.feed.ring.name, self.traces.name, self.board.name
        order = Order(scenario.to_dict(), observers, source.sampling, *names, inbox, self._news)
        self._observing = context.Process(target=observe_frames, args=(order,), daemon=True)
        self._observing.start()
        self.workshop = ProcessPoolExecutor(1, context, initializer=enter_process, initargs=(10,))

    @property
    def observers_are_alive(self) -> bool:
        """Whether the observers take what comes."""
        return not self.is_over.is_set() and self._observing.is_alive()

    @property
    def pids(self) -> list[int]:
        """Ids of the processes of source and observers."""
        return [*self.feed.pids, *([self._observing.pid] if self._observing.pid else [])]

    def tell_observers(self, command: Command) -> None:
        """Give a command to the observers."""
        with self._lock:
            if not self.is_over.is_set():
                self._outbox.send(command)

    def news(self) -> list[tuple[int, str]]:
        """Return what they have said since the last call: number of the frame, one line."""
        return [*self.feed.news(), *take_all(self._news)]

    def release(self) -> None:
        """End the processes and give the memory back."""
        self.is_over.set()
        end_process(self._observing)
        workers = [*(self.workshop._processes or {}).values()]
        self.workshop.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            end_process(worker)
        self.feed.stop()
        self.traces.release()
        self.board.release()
