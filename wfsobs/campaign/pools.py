"""Where the batches of a campaign run: executors on this machine, or of a Dask cluster."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from typing import Any, Protocol

from wfsobs.settings.errors import SettingError

DASK_TIMEOUT = 60.0
"""How long a scheduler may be away before a campaign gives up [s]."""

DASK_RETRIES = 10
"""How often a scheduler starts a batch again whose worker died."""


class Workers(Protocol):
    """Makes executors: a fresh one after the last one broke."""

    @property
    def count(self) -> int:
        """Number of batches that run side by side."""
        ...

    def executor(self) -> Executor:
        """Return a fresh executor."""
        ...

    def close(self) -> None:
        """End the workers."""
        ...


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
        self.count = count
        self._executor: ProcessPoolExecutor | None = None

    def executor(self) -> Executor:
        """Return a fresh executor; what is left of a broken one is killed, since workers do not end by a signal to terminate."""
        if self._executor is not None:
            for process in list((self._executor._processes or {}).values()):
                process.kill()
        self.close()
        os.environ["OPENBLAS_NUM_THREADS"] = "1"  # inherited by the processes, and read when they import numpy
        self._executor = ProcessPoolExecutor(self.count, mp_context=get_context("spawn"), initializer=_start_worker)
        return self._executor

    def close(self) -> None:
        """End the processes."""
        if self._executor is not None:
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

    Raises
    ------
    SettingError
        distributed is not installed, or there is no scheduler.
    """

    def __init__(self, address: str):
        try:
            import distributed
        except ImportError:
            raise SettingError('--scheduler: needs dask: pip install "wfsobs[dask]"') from None
        self._connect: Callable[[], Any] = lambda: distributed.Client(
            address, timeout=DASK_TIMEOUT, set_as_default=False, name="wfsobs"
        )
        self.address = address
        self._client: Any = None
        self.executor()

    @property
    def count(self) -> int:
        """Number of threads of all workers."""
        return max(1, sum(self._client.ncores().values()))

    def executor(self) -> Executor:
        """Return a fresh executor, on a fresh connection. Raises SettingError where there is no scheduler."""
        self.close()
        try:
            self._client = self._connect()
            return self._client.get_executor(retries=DASK_RETRIES, pure=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise SettingError(f"--scheduler {self.address}: no scheduler answers ({error})") from None

    def close(self) -> None:
        """End the connection; the workers stay."""
        if self._client is not None:
            self._client.close(timeout=5)
            self._client = None
