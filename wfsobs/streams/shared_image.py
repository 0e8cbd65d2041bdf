"""A stream of ImageStreamIO: one frame of numbers in a shared file, with a counter that rises with every frame.

Layouts of the file are those that gcc on x86-64 makes: 2.00, and the older 0.0.01 that xaosim writes too. A file holds a header,
the data, keywords, and in 2.00 the semaphores. All numbers are little-endian.
"""

from __future__ import annotations

import ctypes
import errno
import mmap
import os
import struct
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from math import prod
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from wfsobs.files import write_whole
from wfsobs.typing import Array

SEMAPHORE = 32
"""Bytes of a `sem_t` (glibc, 64 bit)."""

MOST = 10
"""Value up to which a writer raises a semaphore, so that a reader that sleeps does not find a queue when it wakes."""


class _TimeSpec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


@cache
def _library() -> Any:
    if sys.platform != "linux":
        raise OSError(errno.ENOSYS, "streams are read on Linux alone", "ImageStreamIO")
    library = ctypes.CDLL(None, use_errno=True)
    library.sem_open.restype = ctypes.c_void_p
    for name in ("sem_post", "sem_trywait", "sem_close"):
        getattr(library, name).argtypes = (ctypes.c_void_p,)
    library.sem_getvalue.argtypes = (ctypes.c_void_p, ctypes.POINTER(ctypes.c_int))
    library.sem_timedwait.argtypes = (ctypes.c_void_p, ctypes.POINTER(_TimeSpec))
    library.sem_init.argtypes = (ctypes.c_void_p, ctypes.c_int, ctypes.c_uint)
    return library


class Semaphore:
    """A semaphore at an address.

    Parameters
    ----------
    address : int
        Of its `sem_t`, in memory that stays mapped.
    """

    def __init__(self, address: int):
        self._address = address

    def post(self) -> None:
        """Raise it by one, unless it stands at `MOST`."""
        value = ctypes.c_int()
        _library().sem_getvalue(self._address, ctypes.byref(value))
        if value.value < MOST:
            _library().sem_post(self._address)

    def drain(self) -> None:
        """Lower it to 0."""
        while _library().sem_trywait(self._address) == 0:
            pass

    def wait(self, seconds: float) -> bool:
        """Lower it by one, waiting at most so long [s]; return whether it was."""
        whole, rest = divmod(time.time_ns() + int(seconds * 1e9), 10**9)
        until = _TimeSpec(whole, rest)
        while _library().sem_timedwait(self._address, ctypes.byref(until)) != 0:
            if ctypes.get_errno() != errno.EINTR:
                return False
        return True


def open_named(name: str) -> Semaphore:
    """Return the semaphore of this name (without its first "/"), made if there is none.

    Raises
    ------
    OSError
        It cannot be opened.
    """
    address = _library().sem_open(ctypes.c_char_p(f"/{name}".encode()), os.O_CREAT, 0o666, 0)
    if not address:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code), f"semaphore {name}")
    return Semaphore(address)


def new_semaphore() -> bytes:
    """Return the bytes of a semaphore at 0 that processes share."""
    memory = ctypes.create_string_buffer(SEMAPHORE)
    _library().sem_init(ctypes.addressof(memory), 1, 0)
    return memory.raw


VERSION, NAME, AXES, COUNT_OF_ELEMENTS, DATATYPE, TIMES = 0, 32, 112, 128, 136, 152
"""Offsets that both layouts have; the times are those of creation, last access, acquisition and writing."""

LONGEST_NAME = 79
DATATYPES: dict[int, np.dtype[Any]] = {9: np.dtype("<f4"), 10: np.dtype("<f8")}
MATHEMATICAL = 2
"""Type of an image that is a vector or matrix."""

N_SEMAPHORES = 10
"""Semaphores of a file that is made here."""

N_TRACES = 10
TRACE = 64
"""Entries, and bytes of an entry, of the history of writing processes in 2.00."""


class StreamError(ValueError):
    """Error: a stream that cannot be read or written; one line with the reason."""


@dataclass(frozen=True)
class Layout:
    """Offsets of a version [bytes].

    version          : the text at the start of a file
    header           : bytes of the header
    memory, location : "in shared memory" and the device (-1: none)
    semaphores       : number of semaphores
    count, writing   : the counter of frames (cnt0; cnt1 and cnt2 follow), and "is being written"
    n_keywords       : number of keywords, of `keyword` bytes each
    data_size        : size of the data with padding; None where there is none
    """

    version: str
    header: int
    memory: int
    location: int
    semaphores: int
    count: int
    writing: int
    n_keywords: int
    keyword: int
    data_size: int | None = None


CURRENT = Layout("2.00", 384, 224, 240, 258, 264, 288, 290, 128, 312)
OLDER = Layout("0.0.01", 336, 216, 217, 234, 240, 264, 266, 120)
LAYOUTS = {"2.00": CURRENT, "0.0.01": OLDER, "xaosim": OLDER}
"""Text at the start of a file -> layout."""


class Header(NamedTuple):
    """What a file says of itself.

    layout : its layout;  name : of the stream
    shape  : of the data, the slowest axis first;  dtype : of its numbers
    n_semaphores, semaphores : how many there are, and the offset of the first [bytes], None where they are not in the file
    readers : offset of the ids of the processes that wait for them, int32, None where they are not in the file
    """

    layout: Layout
    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    n_semaphores: int
    semaphores: int | None
    readers: int | None


def read_header(path: str, buffer: memoryview) -> Header:
    """Return what the header of a file says.

    Raises
    ------
    StreamError
        Another version, numbers other than float32 or float64, data on a GPU, or a file shorter than it says.
    """
    version = bytes(buffer[:32]).split(b"\0")[0].decode("ascii", "replace").strip()
    if version not in LAYOUTS:
        raise StreamError(f"{path}: version {version!r} of ImageStreamIO; takes {', '.join(LAYOUTS)}")
    layout = LAYOUTS[version]
    if len(buffer) < layout.header:
        raise StreamError(f"{path}: {len(buffer)} bytes are less than a header of version {layout.version} ({layout.header})")
    n_axes, datatype = buffer[AXES], buffer[DATATYPE]
    sizes = struct.unpack_from("<3I", buffer, AXES + 4)
    (n_elements,) = struct.unpack_from("<Q", buffer, COUNT_OF_ELEMENTS)
    if datatype not in DATATYPES:
        raise StreamError(f"{path}: data type {datatype}; takes float32 (9) and float64 (10)")
    if struct.unpack_from("<b", buffer, layout.location)[0] not in (-1, 0) or not 1 <= n_axes <= 3:
        raise StreamError(f"{path}: takes data of 1 to 3 axes in main memory")
    dtype, shape = DATATYPES[datatype], tuple(reversed(sizes[:n_axes]))
    if prod(shape) != n_elements:
        shape = (n_elements,)  # one axis, of which xaosim leaves the size out
    end = layout.header + n_elements * dtype.itemsize
    if not 0 < n_elements <= len(buffer) or end > len(buffer):
        raise StreamError(f"{path}: its header says {n_elements} numbers, the file has {len(buffer)} bytes")
    name = bytes(buffer[NAME : NAME + LONGEST_NAME]).split(b"\0")[0].decode("ascii", "replace").strip()
    return Header(layout, name, shape, dtype, *_semaphores(path, layout, buffer, end))


def _semaphores(path: str, layout: Layout, buffer: memoryview, end: int) -> tuple[int, int | None, int | None]:
    """Return how many semaphores there are, where in the file, and where the processes that wait for them are."""
    (n,) = struct.unpack_from("<H", buffer, layout.semaphores)
    if layout.data_size is None:
        return n, None, None
    (data_size,) = struct.unpack_from("<Q", buffer, layout.data_size)
    (n_keywords,) = struct.unpack_from("<H", buffer, layout.n_keywords)
    first = max(layout.header + data_size, end) + layout.keyword * n_keywords
    if first + n * SEMAPHORE > len(buffer):
        raise StreamError(f"{path}: its header says {n} semaphores, the file ends before them")
    readers = first + (n + 1) * SEMAPHORE  # after that of the log
    return n, first, readers if readers + 4 * n <= len(buffer) else None


def new_file(name: str, shape: tuple[int, ...], dtype: np.dtype, layout: Layout) -> bytes:
    """Return the bytes of a new file, zeros for data; whole, as who waits for a file takes it as soon as it is there."""
    code = next(code for code, known in DATATYPES.items() if known == dtype)
    size = -(-prod(shape) * dtype.itemsize // 8) * 8
    n = N_SEMAPHORES if layout.data_size is not None else 0
    traces = n * (SEMAPHORE + 16) + SEMAPHORE + N_TRACES * TRACE if n else 0  # semaphores, who waits, who wrote
    made = bytearray(layout.header + size + traces)
    struct.pack_into("<32s79s", made, VERSION, layout.version.encode(), name.encode())
    axes = (*reversed(shape), 0, 0)[:3]
    struct.pack_into("<B3x3I", made, AXES, len(shape), *axes)
    struct.pack_into("<Q", made, COUNT_OF_ELEMENTS, prod(shape))
    struct.pack_into("<B7xQ", made, DATATYPE, code, MATHEMATICAL)
    struct.pack_into("<B", made, layout.memory, 1)
    struct.pack_into("<b", made, layout.location, -1)
    struct.pack_into("<H", made, layout.semaphores, n)
    if layout.data_size is not None:
        struct.pack_into("<Q", made, layout.data_size, size)
        struct.pack_into("<H", made, 260, N_TRACES)
        first = layout.header + size
        made[first : first + (n + 1) * SEMAPHORE] = new_semaphore() * (n + 1)  # the last one is that of the log
    return bytes(made)


SUFFIX = ".im.shm"
FOLDERS = ("/milk/shm", "/dev/shm", "/tmp")
"""Where streams are, the first that exists, unless the environment variable MILK_SHM_DIR says another folder."""

WRITING = 2e-3
"""Time after which a frame that is still being written is given up [s]."""
YIELD = 1e-6
"""Pause while a frame is being written [s]: its writer may need this processor, which who goes first keeps otherwise."""
POLL = 5e-5
"""Shortest pause between two looks at the counter where there is no semaphore [s]."""


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
    poll : float, optional
        Pause between two looks at the counter where there is no semaphore [s].

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

    def __init__(self, path: str | Path, poll: float = POLL):
        self.path: str = str(path)
        self._poll = poll
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

    def write(self, values: Array, elements: Array | slice = slice(None)) -> None:
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
                time.sleep(min(self._poll, left))
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
