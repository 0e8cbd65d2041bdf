"""The C program on the other side of a stream."""

import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

ENOUGH = 60.0
"""Longest wait for another process or thread [s]; nothing is expected to take so long."""


@pytest.fixture(scope="session")
def peer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compile peer.c."""
    program = tmp_path_factory.mktemp("peer") / "peer"
    source = Path(__file__).parent / "peer.c"
    subprocess.run(["gcc", "-O2", "-Wall", "-Werror", "-o", str(program), str(source), "-pthread"], check=True)
    return program


@contextmanager
def started(*command: object) -> Iterator[subprocess.Popen[str]]:
    """Run a program beside the test; it does not outlive it."""
    process = subprocess.Popen([str(x) for x in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def wait_until(condition: Callable[[], bool]) -> None:
    """Look every millisecond: a file of another program and a line of another thread do not announce themselves."""
    until = time.monotonic() + ENOUGH
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.001)
