"""What is made beside a live loop, in a process at low priority: designs, identifications, bounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, TypeVar

from wfsobs.live.beside import Beside
from wfsobs.live.checks import check_slot, make_design
from wfsobs.live.finding import Bounds, Finding, bounds_of, identify_frames
from wfsobs.live.peaks import Change
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
        Receives the fields of an event but its frame.

    Attributes
    ----------
    change : Change or None
        What the last identification has found, beside the one before.
    """

    def __init__(self, processes: LiveProcesses, sampling: Sampling, say: Callable[..., None]):
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
        whose, about = (" for {}", names[0]) if len(names) == 1 else ("", "")

        def take(finding: Finding) -> None:
            self.keep(finding)
            peaks = ", ".join(f"{p.frequency:.1f} Hz" for p in finding.peaks)
            detail = f": {len(finding.peaks)} peaks" + (f" at {peaks}" if peaks else "")
            self._say(f"identified{whose}", about=about, detail=detail)
            if names:
                self.redesign(names, Scenario.from_dict(finding.settings))

        self._say(f"identifying the last {record.n_steps * record.dt:.0f} s{whose}", about=about)
        self.do(identify_frames, record, scenario.to_dict(), then=take)

    def keep(self, finding: Finding) -> None:
        """Have an identification as the last one."""
        self._findings = [*self._findings[-1:], finding]
        self.change = Change(self._findings)

    def _deliver(self, design: StepObserver | Beside) -> None:
        if isinstance(design, Beside):
            self._processes.tell_controllers({"id": design.id, "design": design})
        else:
            self._processes.tell_observers({"id": design.id, "design": design})
