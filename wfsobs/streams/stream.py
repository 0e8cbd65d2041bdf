"""What a stream can do, whatever carries it: shared memory (`SharedImage`) or a network (`Subscription`, `Publication`)."""

from __future__ import annotations

from typing import Protocol, Self

from wfsobs.streams.layout import Semaphore
from wfsobs.typing import Array

# Each is described where it is written, in SharedImage.
# ruff: noqa: D102


class AnyStream(Protocol):
    """Frames of `n` numbers."""

    path: str

    @property
    def n(self) -> int: ...


class FrameStream(AnyStream, Protocol):
    """A stream that is read."""

    first: int

    @property
    def count(self) -> int: ...

    @property
    def write_time(self) -> int: ...

    @property
    def is_current(self) -> bool: ...

    def read(self, patience: float = ..., /) -> tuple[int, Array] | None: ...

    def reopen(self) -> Self: ...


class SourceStream(FrameStream, Protocol):
    """A stream that is read and waited for."""

    def wait(self, after: int, seconds: float, semaphore: Semaphore | None = ..., /) -> bool: ...

    def claim(self, number: int, /) -> int: ...

    def semaphore(self, number: int, /) -> Semaphore | None: ...

    def release(self, number: int, /) -> None: ...


class SinkStream(AnyStream, Protocol):
    """A stream that is written."""

    def write(self, values: Array, elements: Array, /) -> None: ...
