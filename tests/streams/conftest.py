"""The C program on the other side of a stream."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from tests.patience import wait

LONGEST = "60"
"""What --stuck takes at most [s]."""

wait_until = partial(wait, pause=1e-3)
"""A file of another program and a line of another thread do not announce themselves."""


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
