"""Where the batches of a campaign run: executors on this machine, or of a Dask cluster."""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from time import monotonic
from typing import Any

from wfsobs.settings.values import SettingError

DASK_TIMEOUT = 60.0
"""How long a scheduler may be away before a campaign gives up [s]."""

PATIENCE = 5.0
"""How long there may be no worker before it is told [s]."""

DASK_RETRIES = 10
"""How often a scheduler starts a batch again whose worker died."""


def usable_processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Processes:
    """Processes of this machine, spawned, with one BLAS thread each.

    Parameters
    ----------
    count : int
        Number of processes.
    """

    def __init__(self, count: int):
        self._count = count
        self._executor: ProcessPoolExecutor | None = None

    def count(self) -> int:
        """Return the number of processes."""
        return self._count

    def executor(self) -> Executor:
        """Return a fresh executor; what is left of a broken one is killed."""
        self.close(at_once=True)
        os.environ["OPENBLAS_NUM_THREADS"] = "1"  # inherited by the processes, and read when they import numpy
        self._executor = ProcessPoolExecutor(self._count, mp_context=get_context("spawn"), initializer=_start_worker)
        return self._executor

    def close(self, at_once: bool = False) -> None:
        """End the processes after their batches, or at once by SIGKILL, as they ignore SIGTERM."""
        if self._executor is not None:
            for process in list((self._executor._processes or {}).values()) if at_once else ():
                process.kill()
            self._executor.shutdown(wait=True, cancel_futures=True)


def _start_worker() -> None:
    """Finish a batch when a scheduler ends the job, and do not outlive the campaign."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    wait([sentinel])
    os._exit(1)


class DaskCluster:
    """The workers of a Dask scheduler.

    Parameters
    ----------
    address : str
        Of the scheduler, such as tcp://head:8786.
    tell : callable
        Receives a line when there is no worker, or the scheduler is gone.

    Raises
    ------
    SettingError
        distributed is not installed, the address is none, or there is no scheduler.
    """

    address: str

    def __init__(self, address: str, tell: Callable[[str], None] = lambda _line: None):
        try:
            import distributed
            from distributed.comm.addressing import get_address_host_port
        except ImportError:
            raise SettingError('--scheduler: needs dask: pip install "wfsobs[dask]"') from None
        try:
            get_address_host_port(address, strict=True)
        except ValueError:  # a client would try it for a minute
            raise SettingError(f"--scheduler {address}: takes an address with a port, such as tcp://head:8786") from None
        # What they say of a scheduler that is gone is told here; the last one of callbacks that find its client closed.
        for name in ("distributed", "distributed.client", "tornado.application"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._connect: Callable[[], Any] = lambda: distributed.Client(
            address, timeout=DASK_TIMEOUT, set_as_default=False, name="wfsobs"
        )
        self.address, self._tell = address, tell
        self._client: Any = None
        self._alone_since: float | None = None
        self._is_told = False
        self.executor()

    def count(self) -> int:
        """Return the number of threads of all workers; that there is none is told after a few seconds."""
        try:
            count = sum(self._client.ncores().values())
        except Exception:  # the scheduler is gone: the batches that run will say so
            return 1
        if count:
            if self._is_told:
                self._tell(f"workers have come to {self.address}: going on")
            self._alone_since, self._is_told = None, False
            return count
        self._alone_since = self._alone_since or monotonic()
        if not self._is_told and monotonic() - self._alone_since > PATIENCE:
            self._tell(f"no worker at {self.address}: waiting; start one with: dask worker {self.address} --nthreads 1")
            self._is_told = True
        return 0

    def executor(self) -> Executor:
        """Return a fresh executor, on a fresh connection. Raises SettingError where there is no scheduler."""
        if self._client is not None and self._client.status != "running":
            self._tell(f"the scheduler at {self.address} is gone: waiting {DASK_TIMEOUT:g} s for it; what it ran runs again")
        self.close()
        try:
            self._client = self._connect()
            return self._client.get_executor(retries=DASK_RETRIES, pure=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise SettingError(f"--scheduler {self.address}: no scheduler answers ({error})") from None

    def close(self, at_once: bool = False) -> None:
        """End the connection, which waits for nothing in either case; the workers stay."""
        if self._client is not None:
            self._client.close(timeout=5)
            self._client = None


Workers = Processes | DaskCluster
"""What makes executors: a fresh one after the last one broke."""
