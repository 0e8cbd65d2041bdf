"""How streams are read: which number of a frame is which mode, and in which unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from wfsobs.signal.gate import GateSettings
from wfsobs.streams.layout import StreamError
from wfsobs.streams.stream import AnyStream
from wfsobs.streams.watchdog import LIMIT, Safety
from wfsobs.typing import Array

STUCK = 0.1
"""Time without a frame after which a stream is stuck [s]."""


@dataclass(frozen=True)
class Wiring:
    """How an observer is attached.

    elements : number in a frame of the stream of each mode of the observer
    unit     : micrometres per unit of the streams
    ahead    : frames from the newest measurement to the one that is to be met
    spread   : rms of a measurement by the prior, (n_modes,) [um]
    stuck    : time without a frame after which the stream is stuck [s]
    semaphore : number of the semaphore that is waited for, where no other process does; None looks at the counter
    gate     : how outliers are kept from the observer; by default not at all
    """

    elements: tuple[int, ...]
    unit: float
    ahead: float
    spread: Array
    safety: Safety = field(default_factory=Safety)
    warm_up: int = 0
    stuck: float = STUCK
    semaphore: int | None = None
    gate: GateSettings | None = None

    @property
    def largest(self) -> Array:
        """Magnitude that no estimate may have, (n_modes,) [um]."""
        told = self.safety.largest
        return LIMIT * self.spread if told is None else np.full(self.spread.size, told)


@dataclass(frozen=True)
class NgsWiring:
    """How the frames of an NGS are read.

    elements : number in a frame of the stream of each mode of the observer
    unit     : micrometres per unit of the stream
    ratio    : LGS frames per NGS frame, by the design
    lag      : LGS frames that come after the one that an NGS frame belongs to, before the NGS frame is there; below `ratio`
    stuck    : time without a frame after which the stream is stuck [s]
    """

    elements: tuple[int, ...]
    unit: float
    ratio: int
    lag: int = 0
    stuck: float = STUCK


def check_elements(stream: AnyStream, elements: Sequence[int]) -> None:
    """Raise StreamError where a frame has not all of these numbers."""
    if max(elements) >= stream.n:
        raise StreamError(f"{stream.path}: mode {max(elements)}: a frame has {stream.n} numbers, 0 to {stream.n - 1}")
