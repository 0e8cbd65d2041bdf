"""What is made beside a live loop, in a process at low priority: designs, identifications, bounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from multiprocessing.process import BaseProcess
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar

from wfsobs.control.step import StepController
from wfsobs.live.checks import check_slot, make_design
from wfsobs.live.finding import Bounds, Finding, bounds_of, identify_frames
from wfsobs.live.paced import enter_process
from wfsobs.live.peaks import Change
from wfsobs.live.source import end_process
from wfsobs.observers.step import StepObserver
from wfsobs.record import Record, Sampling
from wfsobs.scenario import Scenario

if TYPE_CHECKING:
    from wfsobs.live.processes import LiveProcesses

T = TypeVar("T")


class Workshop:
    """Makes what a loop takes once it is ready.

    Parameters
    ----------
    processes : LiveProcesses
        Of the loop.
    sampling : Sampling
        Of the loop.
    say : callable
        Receives one line about what happens.

    Attributes
    ----------
    change : Change or None
        What the last identification has found, beside the one before.
    """

    def __init__(self, processes: LiveProcesses, sampling: Sampling, say: Callable[[str], None]):
        self._processes, self._sampling, self._say = processes, sampling, say
        self.change: Change | None = None
        self._findings: list[Finding] = []
        self._bounds: tuple[Scenario | None, Bounds] = (None, {})

    def do(self, function: Callable[..., T], *arguments: Any, then: Callable[[T], None]) -> Future[T]:
        """Have something computed, and then do something with the result; an error becomes a line. Return the result to come."""

        def end(future: Future[T]) -> None:
            if future.cancelled() or self._processes.is_over.is_set():
                return
            if isinstance(error := future.exception(), EOFError):  # its process was killed, of which the loop tells
                return
            if error is not None:
                self._say(str(error) or type(error).__name__)
            else:
                then(future.result())

        future = self._processes.workshop.submit(function, *arguments)
        future.add_done_callback(end)
        return future

    def bounds(self, scenario: Scenario) -> Bounds:
        """Return the bounds of the present settings, as `bounds_of` does; nothing until they are known."""
        if self._bounds[0] is not scenario:
            self._bounds = scenario, {}

            def take(bounds: Bounds) -> None:
                if self._bounds[0] is scenario:
                    self._bounds = scenario, bounds

            self.do(bounds_of, scenario.to_dict(), then=take)
        return self._bounds[1]

    def redesign(self, names: Sequence[str], scenario: Scenario) -> None:
        """Design observers and controllers; each goes on where the one before is, or begins. Raises SettingError."""
        for name in names:
            check_slot(name)
        settings = scenario.to_dict()
        for name in names:
            self.do(make_design, name, settings, self._sampling, then=self._deliver)

    def identify(self, record: Record, scenario: Scenario, names: Sequence[str]) -> None:
        """Identify a record, and design observers and controllers for what is found."""
        whose = f" for {names[0]}" if len(names) == 1 else ""

        def take(finding: Finding) -> None:
            self.keep(finding)
            peaks = ", ".join(f"{p.frequency:.1f} Hz" for p in finding.peaks)
            self._say(f"identified{whose}: {len(finding.peaks)} peaks" + (f" at {peaks}" if peaks else ""))
            if names:
                self.redesign(names, Scenario.from_dict(finding.settings))

        self._say(f"identifying the last {record.n_steps * record.dt:.0f} s{whose}")
        self.do(identify_frames, record, scenario.to_dict(), then=take)

    def keep(self, finding: Finding) -> None:
        """Have an identification as the last one."""
        self._findings = [*self._findings[-1:], finding]
        self.change = Change(self._findings)

    def _deliver(self, design: StepObserver | StepController) -> None:
        if isinstance(design, StepController):
            self._processes.tell_controllers({"controller": design.id, "design": design})
        else:
            self._processes.tell_observers({"observer": design.id, "design": design})


class SideProcess:
    """A process at low priority that computes one thing after the other; it begins with the first.

    Parameters
    ----------
    context : SpawnContext
        By which it is made.

    Attributes
    ----------
    process : BaseProcess or None
        It, once it has begun.
    """

    def __init__(self, context: SpawnContext):
        self.process: BaseProcess | None = None
        self._context, self._lock, self._asker = context, Lock(), ThreadPoolExecutor(1, "wfsobs-live-side")
        self._pipe, self._theirs = context.Pipe()
        self._has_ended = False

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Have a function computed; return the result to come, which is cancelled where all has ended."""
        with self._lock:
            if self._has_ended:
                (ended := Future[Any]()).cancel()
                return ended
            if self.process is None:
                self.process = self._context.Process(target=compute, args=(self._theirs,), name="the designs", daemon=True)
                self.process.start()
                self._theirs.close()
            return self._asker.submit(self._ask, function, arguments)

    def _ask(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        """Return the result of a function. Raises what it raises, and EOFError where the process has ended."""
        try:
            self._pipe.send((function, arguments))
            answer = self._pipe.recv()
        except OSError:
            raise EOFError from None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def stop(self) -> None:
        """End it."""
        with self._lock:
            self._has_ended = True
            self._asker.shutdown(wait=False, cancel_futures=True)
            if self.process is not None:
                end_process(self.process)


def compute(pipe: Connection) -> None:
    """Answer (function, arguments) with the result, or the exception, until the process is ended."""
    enter_process(10)
    while True:
        function, arguments = pipe.recv()
        try:
            answer = function(*arguments)
        except Exception as error:
            answer = error
        pipe.send(answer)
