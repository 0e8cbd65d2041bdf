"""A second, slower sensor of a pyRTC loop: its slopes, from a stream of pyRTC, as pseudo-open-loop modes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wfsobs.streams.layout import StreamError
from wfsobs.streams.ngs_frames import NgsStream
from wfsobs.streams.wiring import STUCK, NgsWiring
from wfsobs.typing import Array


@dataclass(frozen=True)
class SecondSensorOptions:
    """What a loop's configuration says of its second sensor.

    stream : name of the stream of its slopes
    matrix : file of the matrix (.npy) from its slopes to the modes of the loop, (modes, slopes)
    ratio  : frames of the loop per frame of the sensor
    wfc    : name of the stream of commands
    lag    : frames of the loop between the end of an exposure and its slopes, below `ratio`
    """

    stream: str
    matrix: str
    ratio: int
    wfc: str = "wfc"
    lag: int = 0


class SlopeStream:
    """A stream of slopes, read as residual modes. Raises StreamError where there is none, or no matrix for it."""

    def __init__(self, path: str, matrix: Array):
        self.path, self._matrix = path, matrix
        self._stream = open_stream(path)
        self.n, self.first = len(matrix), self.count
        if int(np.prod(self._stream.shape)) != matrix.shape[1]:
            raise StreamError(f"{path}: {int(np.prod(self._stream.shape))} slopes, the matrix takes {matrix.shape[1]}")

    @property
    def count(self) -> int:
        """Frames that have been written."""
        return int(self._stream.count)

    @property
    def write_time(self) -> int:
        """When the last frame was written [ns]."""
        return round(1e9 * self._stream.write_time)

    @property
    def is_current(self) -> bool:
        """Whether no other stream has taken its name."""
        try:
            return open_stream(self.path).instance_id == self._stream.instance_id
        except StreamError:
            return False

    def read(self, patience: float = 0.0) -> tuple[int, Array] | None:
        """Return the counter and the modes of the last frame, (n,)."""
        frame = self._stream.read_publication()
        return int(frame.count), self._matrix @ np.asarray(frame.payload, dtype=float).ravel()

    def reopen(self) -> SlopeStream:
        """Return the stream that has its name now."""
        return SlopeStream(self.path, self._matrix)


class SecondSensor:
    """The frames of the second sensor, less what the mirror did in them.

    Parameters
    ----------
    options : SecondSensorOptions
        Streams, ratio and matrix.
    elements : Array
        Modes of the loop that are wanted.
    unit : float
        Micrometres per unit of the modes.
    delay : int
        Frames from a command to the first measurement that sees it.
    rate : float
        Frames per second of the loop [Hz].
    say : callable
        Receives one line about whatever happens.

    Raises
    ------
    StreamError
        A stream or the matrix cannot be read, or a number is out of range.
    """

    def __init__(
        self, options: SecondSensorOptions, elements: Array, unit: float, delay: int, rate: float, say: Callable[[str], None]
    ):
        if options.ratio < 1 or not 0 <= options.lag < options.ratio:
            raise StreamError(f"ngs: ratio = {options.ratio}, lag = {options.lag}: take 1 or more, and less than that")
        slopes = SlopeStream(options.stream, read_matrix(options.matrix))
        self._commands, self._elements, self._unit, self._delay = open_stream(options.wfc), elements, unit, delay
        self._history: deque[Array] = deque(maxlen=delay + 2 * options.ratio)
        self._count = 0
        self.ratio = options.ratio
        stuck = max(STUCK, 3 * options.ratio / rate)
        wiring = NgsWiring(tuple(map(int, elements)), unit, options.ratio, options.lag, stuck)
        self._frames = NgsStream(slopes, wiring, say)

    def look(self) -> tuple[int, Array] | None:
        """Return what is new: how many frames ago its place was, and the pseudo-open-loop modes [um]; once a frame."""
        self._count += 1
        command = np.asarray(self._commands.read_publication().payload, dtype=float).ravel()
        self._history.append(self._unit * command[self._elements])  # the command of the frame before
        found = self._frames.look(self._count)
        if found is None or len(self._history) < (self._history.maxlen or 0):
            return None
        late, residual = found
        newest = len(self._history) - self._delay - late
        exposure = [self._history[k] for k in range(newest - self.ratio + 1, newest + 1)]
        return late, residual - np.mean(exposure, axis=0)

    @property
    def age(self) -> int | None:
        """Frames of the loop since the last one that a frame of the sensor belongs to, 0 to ratio - 1; None where not known."""
        return None if self._frames.phase is None else (self._count - self._frames.phase) % self.ratio


def open_stream(name: str) -> Any:
    """Open a stream of pyRTC. Raises StreamError where there is none."""
    import pyshmem  # pyright: ignore[reportMissingImports]

    try:
        return pyshmem.open(name)
    except OSError as error:
        raise StreamError(f"{name}: no stream: {error}") from None


def read_matrix(file: str) -> Array:
    """Return a matrix of a .npy file, (modes, slopes). Raises StreamError."""
    try:
        matrix = np.load(Path(file), allow_pickle=False)
    except (OSError, ValueError) as error:
        raise StreamError(f"{file}: no matrix: {error}") from None
    if matrix.ndim != 2 or not np.isfinite(matrix).all():
        raise StreamError(f"{file}: takes a matrix of finite numbers, (modes, slopes), not the shape {matrix.shape}")
    return matrix.astype(float)
