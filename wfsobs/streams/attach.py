"""An observer or a controller on the streams of a loop, frame by frame.

An observer takes pseudo-open-loop modes, and what it expects of the next frame goes to another stream. A supervised controller
takes residual measurements, and its commands go out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from time import monotonic
from typing import Any

import numpy as np

from wfsobs.control.supervisor import SupervisedController
from wfsobs.observers.base import TARGETS
from wfsobs.observers.step import StepObserver
from wfsobs.record import Sampling
from wfsobs.signal.gate import frame_mean_of
from wfsobs.streams.follower import LONGEST_GAP, StreamFollower
from wfsobs.streams.wiring import FrameStream, NgsStream, SinkStream, SourceStream, Watchdog, Wiring, check_elements
from wfsobs.typing import Array


class CommandStream:
    """The commands beside a stream of residual measurements, for their pseudo-open-loop z = y - m.

    One command follows from every measurement. The newest that is there when a measurement comes is that of the one before, in
    most of the first `FIRST` frames; from then on the counters alone say to which a command belongs. Where the newest is older
    than that for `FIRST` frames, commands have been left out, and the counters go on from there.

    Parameters
    ----------
    stream : FrameStream
        Commands, frames with the elements of the measurements.
    elements : sequence of int
        Number in a frame of each mode.
    scale : Array
        Micrometres that the mirror does per unit of a command, with its sign, (n_modes,) or ().
    delay : float
        Frames from a command to the first measurement that sees it, 1 or more: m[k] = (1 - p) u[k-d] + p u[k-d-1].

    Attributes
    ----------
    missing : int
        Measurements whose command was not there.
    """

    def __init__(self, stream: FrameStream, elements: Sequence[int], scale: Array, delay: float):
        check_elements(stream, elements)
        self._stream, self._elements, self._scale = stream, np.array(elements), scale
        self._whole, self._part = int(delay), delay % 1.0
        self._count = stream.first
        self.missing: int = 0
        self.restart()

    def restart(self) -> None:
        """Look anew for which command belongs to which measurement: a counter is another one."""
        self._offset: int | None = None
        self._offsets: list[int] = []
        self._rows: dict[int, Array] = {}

    def open_loop(self, count: int, y: Array) -> Array:
        """Return z of a measurement (n_modes,) [um] with this counter; NaN where its command is not known."""
        if self._stream.count != self._count and (frame := self._stream.read(0.0)) is not None:
            if not 0 < frame[0] - self._count <= LONGEST_GAP:
                self.restart()
            self._count = frame[0]
            self._rows[self._count] = frame[1][self._elements] * self._scale
            self._offsets = [*self._offsets, count - 1 - self._count][-FIRST:]
            if len(self._offsets) == FIRST:
                first = int(np.median(self._offsets)) if self._offset is None else self._offset
                self._offset = max(first, min(self._offsets))
        if self._offset is None:
            return np.full_like(y, np.nan)
        at = count - self._offset
        now, before = (self._rows.get(at - lag, np.full_like(y, np.nan)) for lag in (self._whole, self._whole + 1))
        m = now if self._part == 0.0 else (1.0 - self._part) * now + self._part * before
        for old in [row for row in self._rows if row < at - self._whole]:
            del self._rows[old]
        self.missing += bool(np.isnan(m).any())
        return y - m


FIRST = 9
"""Commands from which their place is found: fewer than the measurements that may be missing."""


class Attachment(StreamFollower):
    """An observer between two streams.

    Parameters
    ----------
    source : SourceStream
        Pseudo-open-loop modes, one frame after the other.
    sink : SinkStream or None
        Where the estimates go, frames as long as those of the source; None writes nothing.
    observer : StepObserver
        Before its first frame.
    wiring : Wiring
        Modes, unit, horizon, limits.
    say : callable
        Receives one line about whatever happens.
    ngs : NgsStream, optional
        The frames of an NGS, for an observer that takes them.
    commands : CommandStream, optional
        Commands, where the source has residual measurements.

    Raises
    ------
    StreamError
        The streams have not the modes of the wiring.
    """

    def __init__(
        self,
        source: SourceStream,
        sink: SinkStream | None,
        observer: StepObserver,
        wiring: Wiring,
        say: Callable[[str], None],
        ngs: NgsStream | None = None,
        commands: CommandStream | None = None,
    ):
        super().__init__(source, sink, wiring, observer, say, ngs)
        self._observer, self._forecast = observer, self._missing
        self._watchdog = Watchdog(wiring.largest, wiring.safety, say, wiring.warm_up)
        self._commands = commands

    @property
    def reason(self) -> str:
        """Why the estimate is not sent; "" while it is."""
        return self._watchdog.reason

    @property
    def safe(self) -> Array:
        """What is sent in place of an estimate, (n_modes,) [um]."""
        return self._watchdog.safe

    def _answer(self, arrival: float, measurement: Array, missing: int) -> None:
        """Take a measurement, and send what is expected of a later one."""
        for _ in range(missing):
            self._frames.update(self._gate.accept(self._missing))
            self._gate.settle()
        if missing:
            self._expect()
        if self._commands is not None:
            with np.errstate(over="ignore", invalid="ignore"):
                measurement = self._commands.open_loop(self._count, measurement)
        ngs, late = self._look_for_ngs()
        z, error = self._gate.accept(measurement), measurement - self._forecast
        if ngs is not None and self._ngs is not None:
            ngs = self._ngs_gate.accept(ngs, frame_mean_of(self._gate.history[late : late + self._ngs.ratio]))
            self._ngs_gate.settle()
        beyond = max(self._gate.beyond, self._ngs_gate.beyond)
        self._send_in_time(self._watchdog.output(self._step(z, ngs, late), z, beyond, missing))
        self.tally.add(arrival, monotonic(), missing, measurement, error, not np.array_equal(z, measurement, equal_nan=True))
        self._observer.settle()
        self._gate.settle()
        self._frames.keep()
        self._expect()

    def _step(self, z: Array, ngs: Array | None, late: int) -> Array:
        self._frames.update(z, ngs, late)
        return sum(
            (self._observer.predict(self._wiring.ahead - 1, target)[0] for target in self._observer.targets), np.zeros_like(z)
        )

    def _expect(self) -> None:
        """Keep what the next measurement should be, for the statistics."""
        observer = self._observer
        if not observer.estimator.horizon and len(observer.targets) == len(TARGETS):
            self._forecast = sum((observer.predict(0, target)[0] for target in observer.targets), np.zeros_like(self._missing))

    def _restart_gates(self) -> None:
        self._forecast = self._missing
        super()._restart_gates()

    def _start_anew(self, count: int, reason: str) -> None:
        if self._commands is not None:
            self._commands.restart()
        super()._start_anew(count, reason)

    def _fall_back(self, reason: str) -> None:
        self._watchdog.fall_back(reason)

    def summary(self) -> dict[str, Any]:
        """Return counts, latencies [us] and errors [nm] so far, as JSON takes them."""
        more = {} if self._ngs is None else {"ngs_outliers": self._ngs_gate.outliers.tolist()}
        more |= {} if self._commands is None else {"commands_missing": self._commands.missing}
        return {**super().summary(), "outliers": self._gate.outliers.tolist(), **more, "fallbacks": self._watchdog.trips}


class SendingController:
    """A controller and the commands that were sent: in every frame the previous one, unless `send` confirms the new one.

    `GoingBack` repeats frames; they are repeated with the commands that were sent.

    Parameters
    ----------
    controller : SupervisedController
        Before its first frame.
    command : Array
        Command at which the mirror rests, (n_modes,) [um].

    Attributes
    ----------
    answer : Array
        Command of the controller after the last frame, (n_modes,) [um].
    command : Array
        Last command that was sent, (n_modes,) [um].
    """

    def __init__(self, controller: SupervisedController, command: Array):
        self.controller, self.command, self.answer = controller, command, command
        self._commands: dict[int, Array] = {}
        self.reset()

    @property
    def frame(self) -> int:
        """Frames so far."""
        return self.controller.frame

    @property
    def sampling(self) -> Sampling:
        """Sampling of the controller."""
        return self.controller.controller.sampling

    def update(self, y: Array, ngs: Array | None = None, /) -> None:
        """Take the measurements of a frame, (n_modes,) [um], as `StepController.update`."""
        self.answer = self.controller.update(y, ngs)
        self.controller.amend(self._commands.setdefault(self.frame, self.command))
        self._commands.pop(self.frame - (self.sampling.ratio or 1), None)

    def send(self) -> None:
        """Record that the answer was sent."""
        self.command = self._commands[self.frame] = self.answer
        self.controller.amend(self.answer)

    def reset(self) -> None:
        """Reset the controller with the mirror at rest at the last command; the next frame is one with an NGS measurement."""
        self.controller.reset()
        self._commands.clear()
        ratio = self.sampling.ratio or 1
        for _ in range(-(-self.controller.mirror.taps.size // ratio) * ratio):
            self.update(np.full(self.sampling.n_modes, np.nan))

    def state_dict(self) -> dict[str, Array]:
        """Return a copy of the state of the controller."""
        return self.controller.state_dict()

    def load_state_dict(self, state: Mapping[str, Array], /) -> None:
        """Go on from a state of `state_dict`."""
        self.controller.load_state_dict(state)


class ControllerAttachment(StreamFollower):
    """Closes a loop through streams.

    The last command stays while no frame comes in, and at the end.

    Parameters
    ----------
    source : SourceStream
        Residual measurements of the modes, one frame after the other.
    sink : SinkStream
        Where the commands go.
    controller : SupervisedController
        Before its first frame. No command exceeds the limits of its mirror.
    gain : float
        Correction per unit of command, with its sign.
    start : Array
        Command of the mirror at the start, (n_modes,), in the unit of the stream.
    wiring : Wiring
        Modes, unit, time after which the stream is stuck, largest measurement; limits and gate are those of the controller.
    say : callable
        Receives one line about whatever happens.
    ngs : NgsStream, optional
        Residual measurements of an NGS, for a controller that takes them.

    Raises
    ------
    StreamError
        The streams have not the modes of the wiring.
    """

    def __init__(
        self,
        source: SourceStream,
        sink: SinkStream | None,
        controller: SupervisedController,
        gain: float,
        start: Array,
        wiring: Wiring,
        say: Callable[[str], None],
        ngs: NgsStream | None = None,
    ):
        self._sender = SendingController(controller, np.nan_to_num(start) * wiring.unit * gain)
        super().__init__(source, sink, replace(wiring, gate=None), self._sender, say, ngs)
        self._controller, self._gain = controller, gain
        self._alarms: list[tuple[int, str]] = []

    @property
    def reason(self) -> str:
        """Why the integrator closes the loop; "" while the controller does."""
        return self._controller.reason

    @property
    def safe(self) -> Array:
        """The last command, (n_modes,), as `_send` takes it [um]."""
        return self._sender.command / self._gain

    def _fall_back(self, reason: str) -> None:
        self._say(f"{reason}: on from the last command")

    def _answer(self, arrival: float, measurement: Array, missing: int) -> None:
        before, known, first = self.reason, len(self._controller.alarms), self._controller.frame
        for _ in range(missing):
            self._frames.update(self._missing)
        ngs, late = self._look_for_ngs()
        disturbance = measurement - self._controller.controller.correction
        self._frames.update(self._gate.accept(measurement), None if ngs is None else self._ngs_gate.accept(ngs), late)
        if self._send_in_time(self._sender.answer / self._gain):
            self._sender.send()
        self.tally.add(arrival, monotonic(), missing, disturbance, measurement)
        self._frames.keep()
        if before and not self.reason:
            self._say("the controller closes the loop")
        for frame, reason in self._controller.alarms[known:]:
            if frame >= first:  # not of a repeated frame
                self._alarms.append((self._count, reason))
                self._say(f"{reason}: an integrator closes the loop")

    def summary(self) -> dict[str, Any]:
        """Return counts, latencies [us], medians of measurement and disturbance [nm] so far, as JSON takes them."""
        return {**super().summary(), "alarms": [list(alarm) for alarm in self._alarms]}
