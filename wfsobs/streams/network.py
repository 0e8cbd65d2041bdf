"""Streams over a network, by ZeroMQ: a message is a frame, of two parts, a header in JSON and the numbers (docs/streams.md)."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NoReturn, Self

import numpy as np

from wfsobs.streams.shared_image import StreamError
from wfsobs.typing import Array

if TYPE_CHECKING:
    import zmq

DTYPES: dict[str, np.dtype[Any]] = {"float32": np.dtype("<f4"), "float64": np.dtype("<f8")}
HEADER = 256
"""Longest header [bytes]."""


def written_frame(count: int, values: Array) -> list[bytes]:
    """Return the parts of the message of a frame: its counter, and its numbers, (n,), of one of DTYPES."""
    return [json.dumps({"frame": count, "dtype": values.dtype.name, "n": values.size}).encode(), values.tobytes()]


def parse_frame(parts: list[bytes]) -> tuple[int, Array, int]:
    """Return counter, numbers, (n,), and time [ns], 0 for none, of a message in parts. Raises ValueError where it is no frame."""
    if len(parts) != 2:
        raise ValueError(f"it has {len(parts)} part{'s' * (len(parts) != 1)}, not 2")
    if len(parts[0]) > HEADER:
        raise ValueError(f"its header has {len(parts[0])} bytes, {HEADER} at most")
    try:
        header = json.loads(parts[0])
        count, dtype, n = header["frame"], DTYPES[header["dtype"]], header["n"]
        is_header = type(count) is type(n) is int and 0 <= count < 2**64 and n > 0
    except (ValueError, KeyError, TypeError):
        is_header = False
    if not is_header:
        raise ValueError('its header is not {"frame": counter, "dtype": "float32" or "float64", "n": how many numbers}')
    if len(parts[1]) != n * dtype.itemsize:
        raise ValueError(f"{len(parts[1])} bytes are not the {dtype.name} numbers that its header says")
    sent = header.get("time_ns")
    return count, np.frombuffer(parts[1], dtype), sent if type(sent) is int and sent > 0 else 0


SCHEME = "tcp://"
LARGEST = 2**20
"""Largest part of a message [bytes]; who sends a larger one is disconnected."""
RECONNECT = 1.0
"""Time without a message after which the connection is made anew [s]."""
FIRST = 10.0
"""Longest wait for a first frame, which says how long frames are [s]."""
BURST = 10
"""Frames that may wait to be taken one by one; of more, the newest alone is."""
LARGEST_PORT = 65535
MOST = 1000
"""Messages that are looked at in a row."""


def is_address(name: str) -> bool:
    """Whether a stream is on a network, by its name."""
    return name.startswith(SCHEME)


class Subscription:
    """Frames that a program publishes: the SUB socket of ZeroMQ.

    Parameters
    ----------
    path : str
        Address, such as tcp://host:5555. Where its program ends, another one at the same address is followed.
    say : callable
        Receives one line about the first message that is refused.
    patience : float
        Longest wait for a first frame [s].

    Raises
    ------
    StreamError
        pyzmq is not installed, the address cannot be used, or no frame comes.

    Attributes
    ----------
    first : int
        Counter of the first frame.
    n, dtype : int, str
        Numbers of a frame, all as long as the first one, and their type.
    n_refused : int
        Messages that were no frames.
    is_current : bool
        True: ZeroMQ connects again by itself.
    """

    path: str
    n: int
    dtype: str
    n_refused: int

    is_current = True

    def __init__(self, path: str, say: Callable[[str], None], patience: float = FIRST):
        self.path, self._say = path, say
        self.n, self.dtype, self.n_refused, self._newest = 0, "", 0, -1
        self._waiting: deque[tuple[int, Array, int]] = deque()
        self._time = 0
        self._socket, self._alive = _open_socket(path, "SUB"), time.monotonic()
        if not self.wait(-1, patience):
            self.close()
            raise StreamError(f"{path}: no frame for {patience:g} s")
        self._waiting.clear()
        self.first = self._newest

    @property
    def count(self) -> int:
        """Counter of the newest frame that has come."""
        self._receive()
        return self._newest

    @property
    def write_time(self) -> int:
        """When the next frame was sent, or the last one where none waits, as its header says [ns]; 0: it does not."""
        self._receive()
        return self._waiting[0][2] if self._waiting else self._time

    def catch_up(self) -> int:
        """Take all that has come; return the counter before that of the frame that is read next."""
        while self._receive():
            pass
        return self._waiting[0][0] - 1 if self._waiting else self._newest

    def wait(self, after: int, seconds: float, semaphore: object = None) -> bool:
        """Wait for a frame, at most so long [s]; return whether there is one. All that have come are new, whatever `after` is."""
        until = time.monotonic() + seconds
        while not self._waiting:
            if (left := until - time.monotonic()) <= 0:
                return False
            if self._socket.poll(max(round(1e3 * min(left, RECONNECT)), 1)):
                self._receive()
            elif time.monotonic() - self._alive > RECONNECT:
                self._connect_again()
        return True

    def read(self, patience: float = 0.0) -> tuple[int, Array] | None:
        """Return the counter and the numbers of the next frame, (n,); None where there is none."""
        self._receive()
        if not self._waiting:
            return None
        count, values, self._time = self._waiting.popleft()
        return count, values

    def reopen(self) -> Self:
        """Return this stream."""
        return self

    def claim(self, number: int) -> NoReturn:
        """Raise StreamError."""
        raise StreamError(f"{self.path}: semaphore {number}: a stream of the network has none")

    semaphore = claim

    def release(self, number: int) -> None:
        """Do nothing."""

    def close(self) -> None:
        """End the connection, and say how many messages were refused."""
        if self.n_refused:
            self._say(f"{self.path}: messages refused: {self.n_refused}")
        self._socket.context.destroy(linger=0)

    def _connect_again(self) -> None:
        """Make the connection anew: ZeroMQ does so where a program has ended, but not where it was sent too large a message."""
        import zmq

        self._alive = time.monotonic()
        with suppress(zmq.ZMQError):  # there is none any more
            self._socket.disconnect(self.path)
        self._socket.connect(self.path)

    def _receive(self) -> bool:
        """Take the messages that have come; return whether there may be more."""
        import zmq

        is_empty = False
        for _ in range(MOST):
            try:
                parts = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                is_empty = True
                break
            self._alive = time.monotonic()
            try:
                self._accept(parts)
            except ValueError as error:
                self.n_refused += 1
                if self.n_refused == 1:
                    self._say(f"{self.path}: a message is no frame: {error}; it and others are counted")
        if len(self._waiting) > BURST:
            self._waiting = deque([self._waiting[-1]])
        return not is_empty

    def _accept(self, parts: list[bytes]) -> None:
        count, values, sent = parse_frame(parts)
        if not self.n:
            self.n, self.dtype = values.size, values.dtype.name
        if values.size != self.n:
            raise ValueError(f"it has {values.size} numbers, those before had {self.n}")
        if count == self._newest:
            raise ValueError(f"the counter stays {count}")
        self._newest = count
        self._waiting.append((count, values.astype(float), sent))


class Publication:
    """Frames for who wants them: the PUB socket of ZeroMQ.

    Parameters
    ----------
    path : str
        Address to listen at, such as tcp://*:5556; with the port * the system chooses one.
    n : int
        Numbers of a frame, zeros at first.
    dtype : str
        "float32" or "float64".

    Raises
    ------
    StreamError
        pyzmq is not installed, or the address cannot be used.
    """

    def __init__(self, path: str, n: int, dtype: str = "float32"):
        self._socket = _open_socket(path, "PUB")
        self.path: str = self._socket.get_string(_zmq(path).LAST_ENDPOINT)
        self._values, self._count = np.zeros(n, DTYPES[dtype]), 0

    @property
    def n(self) -> int:
        """Numbers of a frame."""
        return self._values.size

    def write(self, values: Array, elements: Array | slice = slice(None)) -> None:
        """Send a frame with these elements, the others as they were, and a counter that has risen by one."""
        self._values[elements] = values
        self._count += 1
        self._socket.send_multipart(written_frame(self._count, self._values))

    def close(self) -> None:
        """End it, once what was sent is on its way, in a second at most."""
        self._socket.context.destroy(linger=1000)


def _open_socket(path: str, kind: str) -> zmq.Socket[bytes]:
    """Return a socket in a context of its own: SUB connected, PUB bound."""
    zmq = _zmq(path)
    port = path.removeprefix(SCHEME).rpartition(":")[2]
    if port != "*" and not (port.isdecimal() and int(port) <= LARGEST_PORT):  # ZeroMQ would take another one
        raise StreamError(f"{path}: takes a port up to {LARGEST_PORT}, as in {SCHEME}localhost:5555")
    socket = zmq.Context().socket(getattr(zmq, kind))
    try:
        if kind == "PUB":
            socket.bind(path)
        else:
            socket.setsockopt(zmq.MAXMSGSIZE, LARGEST)
            socket.subscribe(b"")
            socket.connect(path)
    except zmq.ZMQError as error:
        socket.context.destroy(linger=0)
        raise StreamError(f"{path}: {zmq.strerror(error.errno)}") from None
    return socket


def _zmq(path: str) -> Any:
    try:
        import zmq
    except ImportError:
        raise StreamError(f'{path}: needs pyzmq: pip install "wfsobs[zmq]"') from None
    return zmq
