"""A live loop and its controls: source, observers, changes while it runs, and what can be read of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import partial
from threading import Event, Thread
from typing import Any, NamedTuple
from weakref import ReferenceType, finalize, ref

from wfsobs.live.blocks import check_live
from wfsobs.live.checks import check_slot, check_speed, make_design
from wfsobs.live.processes import LiveProcesses
from wfsobs.live.recording import Recording, loop_record
from wfsobs.live.source import LiveSource
from wfsobs.live.view import LiveView, read_view
from wfsobs.observers.step import StepObserver
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError
from wfsobs.stepping import sampling_of

TICK = 0.2
"""Pause between two looks at the processes [s]."""
MOST_EVENTS = 200
"""Events that are kept."""


class LiveEvent(NamedTuple):
    """What has happened: number of the first frame of it, and one line."""

    frame: int
    line: str


class LiveLoop:
    """A source and the observers on it, in processes of their own, until `stop`.

    All that it has is read from shared memory: readers delay neither. It stops by itself when it is thrown away, and its
    processes end with this one.

    Parameters
    ----------
    source : LiveSource
        Of the frames.
    scenario : Scenario
        What the observers are told, and their settings.
    observers : sequence of str
        Ids of those that run from the start.
    speed : float
        1 is real time.

    Raises
    ------
    SettingError
        An observer is unknown or does not run frame by frame, or the scenario has events.
    """

    def __init__(self, source: LiveSource, scenario: Scenario, observers: Sequence[str], speed: float = 1.0):
        check_live(scenario)
        for name in observers:
            check_slot(name)
        self.source, self.scenario, self.sampling = source, scenario, source.sampling
        self._speed, self._is_wanted, self._has_begun = check_speed(speed), False, False
        self.events: deque[LiveEvent] = deque(maxlen=MOST_EVENTS)
        self.watchers: list[Callable[[], None]] = []
        self._recording: Recording | None = None
        self._processes = LiveProcesses(source, scenario, tuple(dict.fromkeys(observers)), self._speed)
        self.board = self._processes.board
        self._release = finalize(self, self._processes.release)
        Thread(target=_keep, args=(ref(self), self._processes.is_over), daemon=True, name="wfsobs-live").start()

    @property
    def is_playing(self) -> bool:
        """Whether frames come, or will once the observers are ready."""
        return self._is_wanted

    @property
    def is_ready(self) -> bool:
        """Whether the observers are ready for the first frame."""
        return bool(self.board.totals[3])

    @property
    def is_alive(self) -> bool:
        """Whether frames may follow, and the observers take them."""
        return self._processes.are_alive

    @property
    def speed(self) -> float:
        """Speed; 1 is real time."""
        return self._speed

    @property
    def count(self) -> int:
        """Frames that every observer has taken, or lost."""
        return self._processes.traces.count

    @property
    def newest(self) -> int:
        """Frames that the source has sent."""
        return self._processes.feed.ring.count

    @property
    def pids(self) -> list[int]:
        """Ids of the processes of source and observers."""
        return self._processes.pids

    def play(self) -> None:
        """Have frames come by the clock, once the observers are ready."""
        self._is_wanted, self._has_begun = True, self.is_ready
        if self._has_begun:
            self._processes.feed.tell({"play": True})

    def pause(self) -> None:
        """Have no more frames come."""
        self._is_wanted = False
        self._processes.feed.tell({"play": False})

    def step(self, frames: int = 1) -> None:
        """Have so many frames come, and then no more."""
        self.pause()
        self._processes.feed.tell({"step": frames})

    def set_speed(self, speed: float) -> None:
        """Set the speed. Raises SettingError."""
        self._speed = check_speed(speed)
        self._processes.feed.tell({"speed": self._speed})

    def change(self, settings: Mapping[str, Any], line: str = "") -> None:
        """Change settings of the simulation: it fades into that of the new ones; the observers keep their designs.

        Parameters
        ----------
        settings : mapping
            Path -> value.
        line : str
            For the list of events; by default the settings themselves.

        Raises
        ------
        SettingError
            A setting is wrong, or would change modes or rates; or the source is no simulation.
        """
        if not self.source.has_truth or self.source.name != "simulation":
            raise SettingError(f"a {self.source.name} has no settings to change")
        scenario = self.scenario.replace(settings)
        check_live(scenario)
        if sampling_of(scenario) != sampling_of(self.scenario):
            raise SettingError("modes and rates cannot change while the loop runs: start another")
        line = line or ", ".join(f"{path} = {value}" for path, value in settings.items())
        is_new = any(not path.startswith("loop.") for path in settings)
        self.scenario = scenario
        self._processes.feed.tell({"settings": scenario.to_dict(), "is_new": is_new, "line": line})

    def lose(self, lgs: bool = True, ngs: bool = True, loss: float = 0.0) -> None:
        """Switch lasers and NGS sensor on and off, and lose a part of the frames."""
        parts = (
            ([] if lgs else ["lasers out"])
            + ([] if ngs else ["no NGS frames"])
            + ([f"{loss:.0%} of frames lost"] if loss else [])
        )
        self._processes.feed.tell(
            {"losses": {"lgs": lgs, "ngs": ngs, "loss": loss}, "line": ", ".join(parts) or "all frames arrive"}
        )

    def switch(self, observer: str, on: bool) -> None:
        """Switch an observer off, or on with a design for the present settings. Raises SettingError."""
        check_slot(observer)
        if on:
            self.redesign([observer])
        else:
            self._processes.tell_observers({"observer": observer, "design": None})

    def redesign(self, observers: Sequence[str] | None = None, scenario: Scenario | None = None) -> None:
        """Design observers anew beside the loop; each goes on where the one before is.

        Parameters
        ----------
        observers : sequence of str, optional
            Ids; by default of all that run.
        scenario : Scenario, optional
            What they are told; by default the present settings.
        """
        settings = (scenario or self.scenario).to_dict()
        for name in observers or self.board.active():
            future = self._processes.workshop.submit(make_design, name, settings)
            future.add_done_callback(partial(self._deliver, name))

    def do_beside(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Have something computed beside the loop, in the process that makes designs."""
        return self._processes.workshop.submit(function, *arguments)

    def _deliver(self, name: str, future: Future[StepObserver]) -> None:
        if future.cancelled() or self._processes.is_over.is_set():
            return
        if (error := future.exception()) is not None:
            self.say(f"{name}: {error}")
        else:
            self._processes.tell_observers({"observer": name, "design": future.result()})

    def say(self, line: str, frame: int | None = None) -> None:
        """Add a line to the list of events."""
        self.events.append(LiveEvent(self.newest if frame is None else frame, line))

    def view(self, seconds: float) -> LiveView:
        """Return the last so many seconds of frames and estimates."""
        return read_view(self._processes.feed.ring, self._processes.traces, self.sampling.dt, seconds)

    def look_back(self, seconds: float) -> Record:
        """Return the last so many seconds as a record, as far back as there are frames. Raises SettingError."""
        return loop_record(self._processes.feed.ring, self.scenario, self.sampling, seconds)

    def start_recording(self, look_back: float = 0.0) -> None:
        """Keep every frame from now on, and those of the last so many seconds."""
        self._recording = Recording(self._processes.feed.ring, self.sampling, look_back)
        self.say("recording on")

    def stop_recording(self) -> Record | None:
        """Return what has been recorded, None where there is nothing."""
        recording, self._recording = self._recording, None
        if recording is None:
            return None
        self.say("recording off")
        return recording.record(self.scenario)

    @property
    def is_recording(self) -> bool:
        """Whether every frame is kept."""
        return self._recording is not None

    def tend(self) -> None:
        """Look after the processes; called a few times a second."""
        if self._is_wanted and self.is_ready and not self._has_begun:
            self._has_begun = True
            self._processes.feed.tell({"play": True})
        for number, line in self._processes.news():
            self.say(line, number)
        if self._recording is not None and not self._recording.collect():
            self.say("recording is full")
        for watch in self.watchers:
            watch()

    def stop(self) -> None:
        """End the processes and give the memory back."""
        self._release()


def _keep(loop: ReferenceType[LiveLoop], is_over: Event) -> None:
    """Look after a loop as long as there is one."""
    while not is_over.wait(TICK):
        if (live := loop()) is None:
            return
        live.tend()
        del live
