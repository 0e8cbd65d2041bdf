"""An entry in a process of its own, which knows what it is sent and has limits of time and memory.

It is sent measurements, a prior and settings; answers come back as arrays of numbers. The truth stays here.
"""

from __future__ import annotations

import io
import os
import signal
from collections.abc import Mapping
from contextlib import suppress
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from threading import Thread
from time import perf_counter
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from wfsobs.observers.base import Observer
from wfsobs.progress import Watch
from wfsobs.record import NEXT_Z, TOTAL
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.values import error_line
from wfsobs.testing import QUICK, CheckError, check_controller, check_observer
from wfsobs.typing import Array
from wfsobs_arena.entries import ArenaEntry, load_object

READY_TIME = 120.0
"""Time to start a process and import what the entry needs [s]."""

END_TIME = 1.0
"""Time to end once nothing is asked any more [s]."""

CHECK = "check"


class EntryError(ValueError):
    """Error: an entry without an answer; one line with the reason."""


class Answer(NamedTuple):
    """Answer of an entry for one record.

    arrays  : target, "u" or "sd of ..." -> (n_steps, n_modes) [um]
    seconds : computing time [s]
    """

    arrays: dict[str, Array]
    seconds: float


class EntryProcess:
    """Process of an entry; used in a `with`, it ends with it.

    Parameters
    ----------
    entry : ArenaEntry
        What runs.
    memory : float
        Address space [GB].
    """

    def __init__(self, entry: ArenaEntry, memory: float):
        self.entry, self.memory = entry, memory
        self._process: Any = None
        self._connection: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._end()

    def check(self, seconds: float) -> None:
        """Check the rules for all entries in the process. Raises EntryError, also where a run takes more than this time [s]."""
        self._ask(CHECK, seconds)

    def run(self, seconds: float, *arguments: Any) -> Answer:
        """Return the answer for one record. Raises EntryError after this time [s], or with the entry's own reason."""
        return self._ask(arguments, seconds)

    def _ask(self, message: Any, seconds: float) -> Answer:
        if self._process is None:
            self._start()
        try:
            self._connection.send(message)
            return _read(self._receive(seconds))
        except (EOFError, ConnectionError):
            raise EntryError(f"its process ended, with exit status {self._end()}") from None

    def _receive(self, seconds: float) -> bytes:
        """Return the next answer; with an empty message begins another run of the checks, and its time."""
        while self._connection.poll(seconds):
            if data := self._connection.recv_bytes():
                return data
        self._end()
        raise EntryError(f"too slow: no answer after {seconds:g} s")

    def _start(self) -> None:
        os.environ["OPENBLAS_NUM_THREADS"] = "1"  # inherited, and read when it imports numpy
        context = get_context("spawn")
        self._connection, theirs = context.Pipe()
        process = context.Process(target=serve, args=(theirs, self.entry, self.memory))
        process.start()
        self._process = process
        theirs.close()
        _read(self._receive(READY_TIME))

    def _end(self) -> int | None:
        """End the process; return its exit status, None where there was none."""
        process, self._process = self._process, None
        if process is None:
            return None
        self._connection.close()
        process.join(END_TIME)
        _kill_group(process.pid)
        process.kill()
        process.join()
        return process.exitcode


def serve(connection: Connection, entry: ArenaEntry, memory: float) -> None:
    """Answer what is asked until the connection ends; the main function of the process."""
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)
    Thread(target=_end_with_parent, daemon=True).start()
    _limit_memory(memory)

    def begin_run() -> bool:
        connection.send_bytes(b"")
        return False

    algorithm: Any = None
    message: Any = None
    while True:
        try:
            if algorithm is None:
                algorithm = load_object(entry)
                answer = {}
            elif message == CHECK:
                check(algorithm, Watch(is_cancelled=begin_run))
                answer = {}
            else:
                start = perf_counter()
                answer = solve(algorithm, *message)
                answer["seconds"] = np.array(perf_counter() - start)
        except MemoryError:
            answer = {"reason": np.array(f"too large: needs more than {memory:g} GB of memory")}
        except Exception as error:
            answer = {"reason": np.array(error_line(error))}
        file = io.BytesIO()
        np.savez(file, **answer)  # pyright: ignore[reportArgumentType]
        connection.send_bytes(file.getvalue())
        try:
            message = connection.recv()
        except EOFError:
            return


def check(algorithm: Any, watch: Watch) -> None:
    """Check the rules for observers or controllers. Raises CheckError, ValueError."""
    if not isinstance(algorithm, Observer):
        check_controller(algorithm, watch=watch)
        return
    if not algorithm.causal:
        raise CheckError(f"{algorithm.id}: declared as looking ahead")
    check_observer(algorithm, PRESETS["paper"]().replace({**QUICK, "vibration.synthesis": "gaussian"}), watch=watch)


def solve(algorithm: Any, *arguments: Any) -> dict[str, Array]:
    """Return the estimates of an observer and its standard deviations, or the commands of a controller. Raises ValueError."""
    if isinstance(algorithm, Observer):
        found = algorithm.estimate(*arguments)
        known = (*algorithm.targets, TOTAL, NEXT_Z)
        return dict(found) | {f"sd of {name}": np.asarray(sd) for name, sd in found.sd.items() if name in known}
    measured, prior, plant, settings = arguments
    laws = algorithm.laws(prior, plant, settings, measured.n_modes)
    if not all(law.stable for law in laws):
        raise EntryError("a pole of the closed loop is not within the unit circle")
    return {"u": algorithm.commands(laws, measured, prior, plant, settings)[0]}


def _read(data: bytes) -> Answer:
    """Return the arrays of an answer; nothing is unpickled. Raises EntryError."""
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        values: Mapping[str, Array] = {name: file[name] for name in file.files}
    if "reason" in values:
        raise EntryError(str(values["reason"]))
    return Answer({k: v for k, v in values.items() if k != "seconds"}, float(values.get("seconds", 0.0)))


def _kill_group(leader: int) -> None:
    """Kill what the process has started; the group bears its number."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(leader, signal.SIGKILL)


def _end_with_parent() -> None:
    """End the process and what it has started once the arena has ended, however that came."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    _kill_group(os.getpid())
    os._exit(1)


def _limit_memory(gigabytes: float) -> None:
    try:
        import resource
    except ImportError:  # not on Windows
        return
    size = round(gigabytes * 1e9)
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (size if hard == resource.RLIM_INFINITY else min(size, hard), hard))
