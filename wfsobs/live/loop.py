"""A live loop and its controls: source, observers, changes while it runs, what is made beside it, and what is read of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from datetime import UTC, datetime
from math import isnan
from threading import Event, Lock, Thread
from typing import Any, Final, TypeVar
from weakref import ReferenceType, finalize, ref

import numpy as np

from wfsobs.live.board import NEXT, LiveView, SharedView, read_view, rms_of_known
from wfsobs.live.checks import check_slot, check_speed, make_design
from wfsobs.live.crew import ControlView
from wfsobs.live.finding import Bounds, Change, Finding, bounds_of, identify_frames, peak_changes
from wfsobs.live.processes import LiveProcesses
from wfsobs.live.ring import LiveFrame, Recorder
from wfsobs.live.simulated import Programme, scenario_on
from wfsobs.live.source import ALARM, FAILURE, SIMULATION, STREAM, LiveEvent, LiveSource
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.record import Record, Sampling
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import to_toml
from wfsobs.settings.group import SettingError
from wfsobs.stepping import sampling_of
from wfsobs.telemetry.records import save_record
from wfsobs.typing import Array

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
            self.do(
                make_design,
                name,
                settings,
                self._sampling,
                then=lambda design: self._processes.tell({"id": design.id, "design": design}),
            )

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


MISSING = 0.01
"""Part of the frames of a second that may be missing."""
RISE, SPREADS = 1.5, 6.0
"""Noise, or the error of the next measurement, may rise to so many times its median of the minute before, and by so many standard
deviations of a second from the median."""
CALM = 0.5
"""Part of that rise below which an alarm is over."""
NORMAL = 1.4826
"""Standard deviation of normal numbers over the median of their distances from the median."""
HISTORY = 60
"""Seconds of which the medians are taken."""
FEWEST = 10
"""Seconds before the first alarm of a median."""


class Alarms:
    """What is not as it was; an alarm is told once when it begins, and once when it is over.

    Parameters
    ----------
    say : callable
        Receives the fields of an event but its frame.
    """

    def __init__(self, say: Callable[..., None]):
        self._say = say
        self._history: dict[tuple[str, str], list[float]] = {}
        self._active: set[tuple[str, str]] = set()
        self._findings: list[Finding] = []

    def look_at(self, frames: LiveFrame, first: int, ratio: int | None) -> None:
        """Judge a second of frames.

        Parameters
        ----------
        frames : LiveFrame
            The frames, each part (n, n_modes) [um].
        first : int
            Number of the first one.
        ratio : int or None
            Every so many frames an NGS measurement is due, but with the first of all; None without an NGS.
        """
        numbers = first + np.arange(len(frames.z))
        self._miss("LGS", frames.z)
        if ratio is not None:
            self._miss("NGS", frames.ngs[(numbers % ratio == 0) & (numbers > 0)])
        self._judge("noise", noise_of(frames.z))

    def judge(self, second: LiveView, observers: Sequence[str]) -> None:
        """Judge what observers of both targets have expected of a second of frames."""
        for name in observers:
            self._judge("error of {}", float(np.sqrt(np.mean(rms_of_known(second.error(name, NEXT)) ** 2))), name)

    def compare(self, finding: Finding) -> None:
        """Judge an identification against those before."""
        self._findings = [*self._findings[-3:], finding]
        for what, detail in peak_changes(self._findings):
            self._say(what, detail=detail, kind=ALARM)

    def _miss(self, sensor: str, due: Array) -> None:
        """Judge what has come of the measurements that were due, (n, n_modes)."""
        if len(due):
            missing = float(np.isnan(due).any(axis=1).mean())
            self._set(f"{sensor} frames missing", missing > MISSING, f"{100.0 * missing:.1f} % of {sensor} frames missing")

    def _judge(self, what: str, value: float, about: str = "") -> None:
        """Judge a number, of an observer if `about` it, by what it has been so far; while it is raised it does not count."""
        if isnan(value):
            return
        history = self._history.setdefault((what, about), [])
        usual = float(np.median(history)) if len(history) >= FEWEST else value
        spread = NORMAL * float(np.median(np.abs(np.subtract(history, usual)))) if history else 0.0
        rise = max((RISE - 1.0) * usual, SPREADS * spread)
        is_active = value > usual + rise * (CALM if (what, about) in self._active else 1.0)
        self._set(what, is_active, f"{what} up", about, f": {1e3 * value:.1f} nm, it was {1e3 * usual:.1f} nm")
        if not is_active:
            history.append(value)
            del history[:-HISTORY]

    def _set(self, what: str, is_active: bool, now: str, about: str = "", detail: str = "") -> None:
        key = what, about
        if is_active and key not in self._active:
            self._active.add(key)
            self._say(now, about=about, detail=detail, kind=ALARM)
        elif not is_active and key in self._active:
            self._active.discard(key)
            self._say(f"over: {what}", about=about)


def noise_of(z: Array) -> float:
    """Estimate the white noise of frames, (n, n_modes), from their third differences [um]: slow signals leave nothing in them."""
    d = np.diff(z, n=3, axis=0)
    known = d[~np.isnan(d)]
    return float(np.sqrt(np.mean(known**2) / 20.0)) if known.size else float("nan")  # 1 + 9 + 9 + 1


SECOND, MINUTE = 1.0, 60.0


class Shadow:
    """Called by its loop a few times a second."""

    def __init__(self, say: Callable[..., None], processes: LiveProcesses):
        """Say : receives the fields of an event but its frame; processes : of its loop."""
        self._alarms, self._processes = Alarms(say), processes
        self._next_second, self._next_minute = SECOND, MINUTE
        self._identification: Future[Finding] | None = None

    def __call__(self, loop: LiveLoop) -> None:
        """Judge what has come since the last call."""
        now = loop.newest * loop.sampling.dt
        if now >= self._next_second:
            self._next_second = now + SECOND
            first, frames = self._processes.frames(SECOND)
            self._alarms.look_at(frames, first, loop.sampling.ratio)
            for view, observers in self._processes.views(SECOND):
                both = [name for name in observers if len(OBSERVERS[name].targets) == len(TARGETS)]
                self._alarms.judge(view, both)
        if now >= self._next_minute:
            self._next_minute = now + MINUTE
            if self._identification is None or self._identification.done():  # many peaks may take more than a minute
                self._identification = self._identify(loop)

    def _identify(self, loop: LiveLoop) -> Future[Finding] | None:
        """Have the last minute identified and compared; return what is found in time, None where nothing has come."""
        try:
            record = loop.recorder.look_back(MINUTE, loop.scenario)
        except SettingError:
            return None

        def take(finding: Finding) -> None:
            loop.workshop.keep(finding)
            self._alarms.compare(finding)

        return loop.workshop.do(identify_frames, record, loop.scenario.to_dict(), then=take)


def append_line(path: str, seconds: float, line: str) -> None:
    """Append a line to a log: the time in UTC, that of the loop, what has happened. Raises OSError."""
    with open(path, "a", encoding="utf-8") as file:
        file.write(f"{datetime.now(UTC).isoformat(timespec='milliseconds')} {seconds:.3f} {line}\n")


TICK = 0.2
"""Pause between two looks at the processes [s]."""
MOST_EVENTS = 200
"""Events that are kept."""


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
    n_frames : int, optional
        Frames until the source ends; by default it has no end of its own.

    Raises
    ------
    SettingError
        An observer is unknown or does not run frame by frame, or an event cannot be played.

    Attributes
    ----------
    is_playing : bool
        Whether frames come, or will once the observers are ready.
    """

    is_playing: bool
    source: LiveSource
    readings: SharedView

    def __init__(
        self, source: LiveSource, scenario: Scenario, observers: Sequence[str], *, speed: float = 1.0, n_frames: int | None = None
    ):
        for name in observers:
            check_slot(name)
        self.source = source
        self.sampling: Final = source.sampling
        told = scenario_on(source, scenario)
        self.speed: float = check_speed(speed)
        self.is_playing, self._has_begun = False, False
        self.events: deque[LiveEvent] = deque(maxlen=MOST_EVENTS)
        self.controllers: set[str] = set()
        self._shadow: Shadow | None = None
        self._log_file, self.readings, self._tending = "", SharedView(), Lock()
        self._processes = LiveProcesses(source, told.before_events, tuple(dict.fromkeys(observers)), speed, n_frames)
        self.feed: Final = self._processes.feed
        self.board: Final = self._processes.board
        self.delivery: Final = self._processes.delivery
        self.programme: Programme = Programme(told, self.feed.tell)
        self.recorder: Recorder = Recorder(self.feed.ring, self.sampling, self.say, source.name == SIMULATION)
        self.workshop: Workshop = Workshop(self._processes, self.sampling, self.say)
        self._release = finalize(self, self._processes.release)
        Thread(target=_keep, args=(ref(self), self._processes.is_over), daemon=True, name="wfsobs-live").start()

    @property
    def is_ready(self) -> bool:
        """Whether the observers are ready for the first frame."""
        return self._processes.are_ready

    @property
    def count(self) -> int:
        """Frames that every observer has taken, or lost."""
        return self.delivery.count

    @property
    def newest(self) -> int:
        """Frames that the source has sent."""
        return self.feed.ring.count

    @property
    def scenario(self) -> Scenario:
        """The present settings; no events."""
        return self.programme.present

    def play(self) -> None:
        """Have frames come by the clock, once the observers are ready."""
        self.is_playing, self._has_begun = True, self.is_ready
        if self._has_begun:
            self.feed.tell({"play": True})

    def pause(self) -> None:
        """Have no more frames come."""
        self.is_playing = False
        self.feed.tell({"play": False})

    def step(self, frames: int = 1) -> None:
        """Have so many frames come, and then no more."""
        self.pause()
        self.feed.tell({"step": frames})

    def set_speed(self, speed: float) -> None:
        """Set the speed. Raises SettingError."""
        self.speed = check_speed(speed)
        self.feed.tell({"speed": speed})

    def change(self, settings: Mapping[str, Any]) -> None:
        """Change settings, path -> value, of the simulation. Raises SettingError as `become` does."""
        self.become(self.programme.scenario.replace(settings), ", ".join(f"{path} = {value}" for path, value in settings.items()))

    def become(self, scenario: Scenario, line: str) -> None:
        """Change the settings of the simulation: it fades into that of the new ones; the observers keep their designs.

        Parameters
        ----------
        scenario : Scenario
            New settings, and their events.
        line : str
            For the list of events.

        Raises
        ------
        SettingError
            Modes or rates would change, or an event cannot be played; or the source is no simulation.
        """
        if self.source.name != SIMULATION:
            raise SettingError(f"a {self.source.name} has no settings to change")
        if sampling_of(scenario) != self.sampling:
            raise SettingError("modes and rates cannot change while the loop runs: start another")
        self.programme.become(scenario, line)

    def lose(self, *, lgs: bool = True, ngs: bool = True, loss: float = 0.0) -> None:
        """Switch lasers and NGS sensor on and off, and lose a part of the frames."""
        self.programme.lose(lgs, ngs, loss)

    def switch(self, name: str, on: bool) -> None:
        """Switch an observer or a controller off, or on with a design for the present settings. Raises SettingError."""
        check_slot(name)
        if on:
            self.redesign([name])
        else:
            self._processes.tell({"id": name, "design": None})

    def control(self, controller: str, on: bool) -> None:
        """Switch a controller beside the loop off, or on with a design for the present settings. Raises SettingError."""
        self.switch(controller, on)
        (self.controllers.add if on else self.controllers.discard)(controller)

    def redesign(self, names: Sequence[str] | None = None) -> None:
        """Design observers and controllers, all that run or `names`, anew for the present settings.

        That is done beside the loop; each goes on where the one before is.
        """
        self.workshop.redesign(self.running_ids() if names is None else names, self.scenario)

    def identify(self, names: Sequence[str] | None = None) -> None:
        """Identify the last minute beside the loop, and design all that run for it, or `names`. Raises SettingError."""
        record = self.recorder.look_back(MINUTE, self.scenario)
        self.workshop.identify(record, self.scenario, self.running_ids() if names is None else names)

    def running_ids(self) -> list[str]:
        """Return the ids of the observers and controllers that run."""
        return [*self.board.active(), *sorted(self.controllers)]

    def say(self, what: str, **fields: str) -> None:
        """Add an event of the newest frame; fields : further ones of `LiveEvent`."""
        self._add(LiveEvent(self.newest, what, **fields))

    def _add(self, event: LiveEvent) -> None:
        self.events.append(event)
        if self._log_file:
            try:
                append_line(self._log_file, event.frame * self.sampling.dt, event.line)
            except OSError as error:
                line, self._log_file = f"{self._log_file}: {error.strerror or error}: the log ends", ""
                self.say(line, kind=ALARM)
                self._complain(line)

    def watch(self, log_file: str = "", complain: Callable[[str], None] = lambda _: None) -> None:
        """Raise alarms from now on; append them, and all events, to a file.

        complain : receives why that cannot be written, once; the loop goes on without it
        """
        self._log_file, self._complain, self._shadow = log_file, complain, Shadow(self.say, self._processes)

    def view(self, seconds: float) -> LiveView:
        """Return the last so many seconds of frames and estimates."""
        return read_view(self.feed.ring, self._processes.traces(), self.sampling, seconds)

    def control_view(self, seconds: float) -> ControlView | None:
        """Return what the controllers leave of the last so many seconds that they have taken; None before the first one."""
        return self._processes.control_view(seconds)

    def tend(self) -> None:
        """Look after the processes; called a few times a second."""
        with self._tending:
            if self.is_playing and self.is_ready and not self._has_begun:
                self._has_begun = True
                self.feed.tell({"play": True})
            self.programme.play(self.newest * self.sampling.dt)
            for event in self._processes.news():
                self._add(event)
            self.delivery.collect()
            self.recorder.collect()
            if self._shadow is not None:
                self._shadow(self)

    def failure(self) -> str:
        """Return why the loop cannot go on, in one line; "" while it can: a process was killed, an observer has no design."""
        if (line := self._processes.failure()) or self._processes.observers_are_alive:
            return line
        self.tend()
        events = list(self.events)  # others may append
        last = [*(event for event in events if event.kind == FAILURE), *events[-1:]]
        return last[0].line if last else "the processes of the loop have ended"

    def stop(self) -> None:
        """End the processes and give the memory back."""
        self._release()


def _keep(loop: ReferenceType[LiveLoop], is_over: Event) -> None:
    """Look after a loop as long as there is one; after a fast one as often in its own time: it has events."""
    pause = TICK
    while not is_over.wait(pause):
        if (live := loop()) is None:
            return
        live.tend()
        pause = TICK / max(1.0, live.speed)
        del live


@dataclass(frozen=True)
class LiveOrder:
    """A loop that is to run.

    source    : of the frames
    scenario  : what the observers are told
    observers : ids of those that run from the start
    speed     : 1 is real time
    controllers : ids of those that run beside it
    key       : names the loop, where all pages watch the same
    record_file : where all its frames go when it ends; none if empty
    log_file  : to which events and alarms are appended; none if empty
    preset    : where the settings started; none if empty
    options   : of `wfsobs live`, that name a stream
    """

    source: LiveSource
    scenario: Scenario
    observers: Sequence[str]
    speed: float = 1.0
    controllers: Sequence[str] = ()
    key: str = ""
    record_file: str = ""
    log_file: str = ""
    preset: str = ""
    options: Sequence[str] = ()

    def begin(self, loop: LiveLoop) -> None:
        """Begin what runs beside it, to record and to raise alarms: always of a stream or of events."""
        for name in self.controllers:
            loop.control(name, True)
        if self.log_file or self.source.name == STREAM or loop.programme.scenario.events:
            loop.watch(self.log_file)
        if self.record_file:
            loop.recorder.start()

    def end(self, loop: LiveLoop) -> str:
        """Write what has been recorded; return a line if the file has no place for parts of it. Raises OSError."""
        record = loop.recorder.stop(loop.scenario) if self.record_file else None
        return save_record(self.record_file, record, to_toml(loop.scenario)) if record is not None else ""
