"""A live loop as it is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from wfsobs.live.loop import LiveLoop
from wfsobs.live.source import STREAM, LiveSource
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import to_toml
from wfsobs.telemetry.records import save_record


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

    def end(self, loop: LiveLoop) -> None:
        """Write what has been recorded. Raises OSError."""
        record = loop.recorder.stop(loop.scenario) if self.record_file else None
        if record is not None:
            save_record(self.record_file, record, to_toml(loop.scenario))
