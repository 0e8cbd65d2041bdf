"""A stream of ImageStreamIO: one frame of numbers in a shared file, with a counter that rises with every frame."""

from __future__ import annotations

import mmap
import os
import struct
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from wfsobs.files import write_whole
from wfsobs.streams.layout import (
    CURRENT,
    LONGEST_NAME,
    SEMAPHORE,
    TIMES,
    Layout,
    Semaphore,
    StreamError,
    new_file,
    open_named,
    read_header,
)
from wfsobs.typing import Array

SUFFIX = ".im.shm"
FOLDERS = ("/milk/shm", "/dev/shm", "/tmp")
"""Where streams are, the first that exists, unless the environment variable MILK_SHM_DIR says another folder."""

ALL = slice(None)
"""Every number of a frame."""
WRITING = 2e-3
"""Time after which a frame that is still being written is given up [s]."""
YIELD = 1e-6
"""Pause while a frame is being written [s]: its writer may need this processor, which who goes first keeps otherwise."""
POLL = 5e-5
"""Pause between two looks at the counter where there is no semaphore [s]."""


def stream_path(name: str) -> Path:
    """Return the file of a stream: NAME.im.shm in the folder of streams, or the path itself where `name` is one."""
    if "/" in name:
        return Path(name)
    given = os.environ.get("MILK_SHM_DIR")
    folder = given or next((folder for folder in FOLDERS if os.path.isdir(folder)), FOLDERS[0])
    return Path(folder) / f"{name.removesuffix(SUFFIX)}{SUFFIX}"


class SharedImage:
    """A stream that exists.

    Parameters
    ----------
    path : str or Path
        File, as `stream_path` gives it.

    Raises
    ------
    StreamError
        There is none, or it is of another version, type or size.

    Attributes
    ----------
    path : str
        File.
    header : Header
        What the file says of itself.
    first : int
        The counter when it was opened.
    """

    def __init__(self, path: str | Path):
        self.path: str = str(path)
        try:
            with open(path, "r+b") as file:
                self._map = mmap.mmap(file.fileno(), 0)
                self._inode = os.fstat(file.fileno()).st_ino
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or "the file is empty"
            raise StreamError(f"{path}: no stream: {reason}") from None
        self.header: Final = read_header(self.path, memoryview(self._map))
        layout, n = self.header.layout, int(np.prod(self.header.shape))
        self._values = np.ndarray(n, self.header.dtype, self._map, layout.header)
        self._count = np.ndarray(1, np.uint64, self._map, layout.count)
        self._writing = np.ndarray(1, np.uint8, self._map, layout.writing)
        self._semaphores = self._find_semaphores()
        readers = self.header.readers
        self._readers = None if readers is None else np.ndarray(self.header.n_semaphores, "<i4", self._map, readers)
        self.first: int = self.count

    @classmethod
    def create(cls, path: str | Path, shape: Sequence[int], *, dtype: str = "float32", layout: Layout = CURRENT) -> SharedImage:
        """Make a stream of zeros, in place of one that is there.

        Parameters
        ----------
        path : str or Path
            File.
        shape : sequence of int
            Of the data, one to three axes.
        dtype : str
            "float32" or "float64".
        layout : Layout
            Version of the file.

        Raises
        ------
        OSError
            The file cannot be written.
        """
        name = Path(path).name.removesuffix(SUFFIX)[:LONGEST_NAME]
        made = new_file(name, tuple(shape), np.dtype(dtype).newbyteorder("<"), layout)
        write_whole(path, lambda file: file.write(made))
        return cls(path)

    @property
    def n(self) -> int:
        """Numbers of a frame."""
        return self._values.size

    @property
    def count(self) -> int:
        """Frames that have been written: cnt0."""
        return int(self._count[0])

    @property
    def write_time(self) -> int:
        """When its writer says that it wrote the last frame [ns]; what it was made with where the writer does not say."""
        seconds, rest = struct.unpack_from("<qq", self._map, TIMES + 48)
        return seconds * 10**9 + rest

    @property
    def is_current(self) -> bool:
        """Whether the file at the path is still this one; a program that starts anew may make another."""
        try:
            return os.stat(self.path).st_ino == self._inode
        except OSError:
            return False

    def reopen(self) -> SharedImage:
        """Return the stream of the file that is at the path now. Raises StreamError."""
        return SharedImage(self.path)

    def read(self, patience: float = WRITING) -> tuple[int, Array] | None:
        """Return the counter and the numbers of the last frame, (n,); None where a writer does not end its frame in so long [s].

        A frame is taken only if it was not written to meanwhile: the flag of the writer is down before and after, and the
        counter has not moved.
        """
        until = time.monotonic() + patience
        while True:
            before = self.count
            if not self._writing[0]:
                values = self._values.astype(float)
                if not self._writing[0] and self.count == before:
                    return before, values
            if time.monotonic() > until:
                return None
            time.sleep(YIELD)

    def write(self, values: Array, elements: Array | slice = ALL) -> None:
        """Write a frame, (n,), or these elements of it, raise the counter and wake who waits."""
        self._writing[0] = 1
        self._values[elements] = values
        struct.pack_into("<qq", self._map, TIMES + 48, *divmod(time.time_ns(), 10**9))
        self._count[0] += np.uint64(1)
        self._writing[0] = 0
        for semaphore in self._semaphores:
            semaphore.post()

    def semaphore(self, number: int) -> Semaphore | None:
        """Return one of the semaphores, by number from 0; None where the stream has none. Raises StreamError."""
        if not self._semaphores:
            return None
        if not 0 <= number < len(self._semaphores):
            raise StreamError(f"{self.path}: semaphore {number}: it has 0 to {len(self._semaphores) - 1}")
        return self._semaphores[number]

    def claim(self, number: int) -> int:
        """Claim a semaphore for this process: this one, or the first that no process waits for; return its number.

        Programs that choose theirs as ImageStreamIO does leave it alone until `release`, or until this process has ended.
        Raises StreamError where there is no such semaphore, or none is free.
        """
        self.semaphore(number)
        if self._readers is None:
            return number
        for i in (number, *range(len(self._readers))):
            if not _is_running(int(self._readers[i])):
                self._readers[i] = os.getpid()
                return i
        raise StreamError(f"{self.path}: semaphore {number}: other processes wait for all {len(self._readers)}")

    def release(self, number: int) -> None:
        """Let others have a semaphore that was claimed."""
        if self._readers is not None:
            self._readers[number] = 0

    def catch_up(self) -> int:
        """Return the counter before that of the frame that is read next: none that came before that is missing."""
        return self.first if self.count == self.first else self.count - 1

    def wait(self, after: int, seconds: float, semaphore: Semaphore | None = None) -> bool:
        """Wait until the counter is another than `after`, at most so long [s]; return whether it is."""
        until = time.monotonic() + seconds
        while self.count == after:
            if (left := until - time.monotonic()) <= 0:
                return False
            if semaphore is None:
                time.sleep(min(POLL, left))
            else:
                semaphore.wait(left)
        return True

    def _find_semaphores(self) -> list[Semaphore]:
        n, first = self.header.n_semaphores, self.header.semaphores
        if first is not None:
            start = np.ndarray(1, np.uint8, self._map).ctypes.data
            return [Semaphore(start + first + SEMAPHORE * i) for i in range(n)]
        folder, file = os.path.split(os.path.abspath(self.path))
        stem = f"{folder.replace('/', '.')}.{file.removesuffix(SUFFIX)}"
        return [open_named(f"{stem}_sem{i:02d}") for i in range(n)]


def _is_running(process: int) -> bool:
    """Whether there is such a process; 0 and -1 stand for none."""
    if process <= 0:
        return False
    try:
        os.getpgid(process)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
