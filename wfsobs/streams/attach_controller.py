"""A controller between two streams: residual measurements come in, the commands of a supervised controller go out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from time import monotonic
from typing import Any

import numpy as np

from wfsobs.control.supervisor import SupervisedController
from wfsobs.streams.attach import SafeGate
from wfsobs.streams.follower import StreamFollower
from wfsobs.streams.stream import SinkStream, SourceStream
from wfsobs.streams.wiring import Wiring
from wfsobs.typing import Array


class ControllerAttachment(StreamFollower):
    """Closes a loop through streams.

    Where nothing comes in, and at the end, the last command stays; frames that are missing are taken as such.

    Parameters
    ----------
    source : SourceStream
        Residual measurements of the modes, one frame after the other.
    sink : SinkStream
        Where the commands go.
    controller : SupervisedController
        Of the LGS alone, before its first frame. No command exceeds the limits of its mirror.
    gain : float
        What the mirror does of a command, with its sign.
    start : Array
        Command that the mirror has, (n_modes,), in the unit of the stream.
    wiring : Wiring
        Modes, unit, when the stream is stuck, what no measurement can be; limits and gate are those of the controller.
    say : callable
        Receives one line about whatever happens.

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
    ):
        super().__init__(source, sink, wiring, controller.controller.sampling.dt, say)
        self._controller, self._gain = controller, gain
        self._command: Array = np.nan_to_num(start) * wiring.unit * gain
        self._alarms: list[tuple[int, str]] = []
        self._gate = SafeGate(replace(wiring, gate=None))
        self._begin()

    @property
    def reason(self) -> str:
        """Why the integrator closes the loop; "" while the controller does."""
        return self._controller.reason

    @property
    def safe(self) -> Array:
        """What is left to the mirror, (n_modes,) [um]."""
        return self._command / self._gain

    def _fall_back(self, reason: str) -> None:
        self._say(f"{reason}: the last command stays")

    def _begin(self) -> None:
        """Begin with the mirror at rest where the last command has put it."""
        self._controller.reset()
        for _ in self._controller.mirror.taps:
            self._hold()

    def _hold(self) -> None:
        self._controller.update(self._missing)
        self._controller.amend(self._command)

    def _answer(self, arrival: float, measurement: Array, missing: int) -> None:
        before, known = self.reason, len(self._controller.alarms)
        for _ in range(missing):
            self._hold()
        disturbance = measurement - self._controller.controller.correction
        command = self._controller.update(self._gate.accept(measurement))
        if self._send_in_time(command / self._gain):
            self._command = command
        else:
            self._controller.amend(self._command)
        self.tally.add(arrival, monotonic(), missing, disturbance, measurement)
        if before and not self.reason:
            self._say("the controller closes the loop")
        for _, reason in self._controller.alarms[known:]:
            self._alarms.append((self._count, reason))
            self._say(f"{reason}: an integrator closes the loop")

    def summary(self) -> dict[str, Any]:
        """Return counts, latencies [us], medians of measurement and disturbance [nm] so far, as JSON takes them."""
        return {**super().summary(), "alarms": [list(alarm) for alarm in self._alarms]}
