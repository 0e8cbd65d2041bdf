"""POSIX semaphores of the C library: those that lie in shared memory, and those with a name."""

from __future__ import annotations

import ctypes
import errno
import os
import sys
import time
from functools import cache
from typing import Any

SIZE = 32
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
    memory = ctypes.create_string_buffer(SIZE)
    _library().sem_init(ctypes.addressof(memory), 1, 0)
    return memory.raw
