"""A controller between two streams: residual measurements come in, the commands of a supervised controller go out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from time import monotonic
from typing import Any

import numpy as np

from wfsobs.control.supervisor import SupervisedController
from wfsobs.record import Sampling
from wfsobs.streams.attach import SafeGate
from wfsobs.streams.follower import StreamFollower
from wfsobs.streams.ngs_frames import NgsStream
from wfsobs.streams.stream import SinkStream, SourceStream
from wfsobs.streams.wiring import Wiring
from wfsobs.typing import Array


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
        super().__init__(source, sink, wiring, self._sender, say, ngs)
        self._controller, self._gain = controller, gain
        self._alarms: list[tuple[int, str]] = []
        self._gate, self._ngs_gate = SafeGate(replace(wiring, gate=None)), SafeGate(replace(wiring, gate=None))

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

    def _restart_gates(self) -> None:
        for gate in (self._gate, self._ngs_gate):
            gate.restart()

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
