"""A record as a source: its frames by the clock, once."""

from __future__ import annotations

from dataclasses import dataclass
from multiprocessing.context import SpawnContext

import numpy as np

from wfsobs.live.source import RECORD, SOURCE, Command, Desk, Staff, enter_process, send_frames
from wfsobs.record import Record, Sampling
from wfsobs.typing import Array


@dataclass(frozen=True)
class Replay:
    """A record as a source.

    Attributes
    ----------
    record : Record
        Measurements and commands, with the truth where it is known.
    """

    record: Record
    name = RECORD

    @property
    def has_truth(self) -> bool:
        """Whether the record has the truth."""
        return self.record.turbulence is not None

    @property
    def sampling(self) -> Sampling:
        """Modes, step and NGS ratio."""
        return self.record.sampling

    def staff(self, context: SpawnContext, desk: Desk) -> Staff:
        """Return its process."""
        rows = frame_rows(self.record)
        return Staff(context.Process(target=_send, args=(rows, self.record.dt, desk), name="the source", daemon=True))


def frame_rows(record: Record) -> Array:
    """Return z, ngs, u, turbulence and vibration of every frame, (n_steps, 5 n_modes) [um]; NaN where there is none."""
    record = record.without_outliers
    nothing = np.full_like(record.z, np.nan)
    ngs = nothing if record.y_ngs is None else record.z_ngs
    truth = [nothing if part is None else part for part in (record.turbulence, record.vibration)]
    return np.hstack([record.z, ngs, record.u, *truth])


def _send(rows: Array, dt: float, desk: Desk) -> None:
    enter_process(turn=SOURCE)
    send_frames(desk, RecordFrames(rows), dt)


class RecordFrames:
    """The frames of a record.

    Parameters
    ----------
    rows : Array
        Of `frame_rows`.
    """

    def __init__(self, rows: Array):
        self._rows = rows

    def next_row(self, number: int) -> Array | None:
        """Return a frame; None after the last one."""
        return self._rows[number] if number < len(self._rows) else None

    def take(self, command: Command, _number: int) -> str:
        """Follow nothing: a record is as it is."""
        return "" if "line" not in command else "a record cannot be changed"
