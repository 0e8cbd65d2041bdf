"""Files of ImageStreamIO: read and written as a C program does, never half a frame, and refused in one line."""

import os
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.patience import ENOUGH
from tests.streams.conftest import started, wait_until
from wfsobs.streams.shared_image import CURRENT, OLDER, Semaphore, SharedImage, StreamError, stream_path

OLD_FORMAT = "32s 80s B3x 3I Q B7x Q 2Q 2Q 2Q 2Q B b B5x Q B1x H4x Q Q Q B1x H 64s4x"
"""Header of the older layout, aligned, field by field as xaosim 1.0.11 documents it."""


def offset(fields: int) -> int:
    """Bytes before a field of the older layout."""
    return struct.calcsize("".join(OLD_FORMAT.split()[:fields]))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("layout", [CURRENT, OLDER])
@pytest.mark.parametrize("shape", [(7,), (3, 5), (2, 3, 4)])
def test_what_is_written_is_read(tmp_path: Path, layout, dtype: str, shape: tuple[int, ...]) -> None:
    path = tmp_path / "aol1_modevalOL.im.shm"
    writer = SharedImage.create(path, shape, dtype=dtype, layout=layout)
    reader = SharedImage(path)
    assert reader.header.shape == shape and reader.header.name == "aol1_modevalOL" and reader.count == 0
    values = np.random.default_rng(1).normal(size=writer.n).astype(dtype)
    for count in (1, 2):
        writer.write(values * count)
        found = reader.read()
        assert found is not None and found[0] == count
        np.testing.assert_array_equal(found[1], (values * count).astype(dtype))


def test_the_older_layout_is_that_of_its_description(tmp_path: Path) -> None:
    path = tmp_path / "old.im.shm"
    stream = SharedImage.create(path, (3, 5), dtype="float64", layout=OLDER)
    stream.write(np.arange(15.0))
    raw = path.read_bytes()
    header = struct.unpack_from(OLD_FORMAT, raw)
    assert struct.calcsize(OLD_FORMAT) == 336 and offset(17) == 240
    assert header[2:7] == (2, 5, 3, 0, 15) and header[7] == 10
    assert header[23] == 1, "cnt0"
    np.testing.assert_array_equal(np.frombuffer(raw, "<f8", 15, 336), np.arange(15.0))


def test_one_axis_of_which_the_size_is_left_out(tmp_path: Path) -> None:
    """As xaosim writes it."""
    path = tmp_path / "one.im.shm"
    SharedImage.create(path, (6,), dtype="float64", layout=OLDER)
    raw = bytearray(path.read_bytes())
    raw[:32] = b"xaosim".ljust(32)
    struct.pack_into("<3I", raw, 116, 0, 0, 0)
    path.write_bytes(raw)
    assert SharedImage(path).n == 6


@pytest.mark.slow
def test_no_frame_is_half_of_one_and_half_of_another(tmp_path: Path, peer: Path) -> None:
    """A C program writes frames of equal numbers, one right after the other: what is read is one number all over."""
    path, seen = tmp_path / "fast.im.shm", set()
    until = time.monotonic() + ENOUGH
    with started(peer, "hammer", path, 20_000):
        wait_until(path.exists)
        stream = SharedImage(path)
        while len(seen) < 1000 and time.monotonic() < until:
            found = stream.read()
            if found is not None:
                count, values = found
                assert values.min() == values.max() == count
                seen.add(count)
    assert len(seen) == 1000


def test_a_frame_without_an_end_is_given_up(tmp_path: Path) -> None:
    stream = SharedImage.create(tmp_path / "a.im.shm", (4,))
    stream._writing[0] = 1
    assert stream.read() is None


def test_who_waits_is_woken_by_the_next_frame_alone(tmp_path: Path) -> None:
    stream = SharedImage.create(tmp_path / "a.im.shm", (4,))
    for semaphore in (None, stream.semaphore(3)):
        assert not stream.wait(stream.count, 0.05, semaphore)
        before = stream.count
        stream.write(np.ones(4))
        assert stream.wait(before, 10, semaphore)
        assert not stream.wait(stream.count, 0.05, semaphore)


def test_a_semaphore_that_nobody_waits_for_stays_low(tmp_path: Path) -> None:
    stream = SharedImage.create(tmp_path / "a.im.shm", (4,))
    for _ in range(50):
        stream.write(np.ones(4))
    semaphore = stream.semaphore(0)
    assert isinstance(semaphore, Semaphore)
    taken = 0
    while semaphore.wait(0.01):
        taken += 1
    assert taken == 10


def test_two_readers_are_both_woken_by_every_frame(tmp_path: Path) -> None:
    """Each claims a semaphore where ImageStreamIO has the ids of those who wait; one that has ended holds none."""
    path = tmp_path / "a.im.shm"
    writer = SharedImage.create(path, (4,))
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    # 4 float32, 10 semaphores and that of the log, and then the ids; a process of long standing has the first.
    at = 384 + 16 + 11 * 32
    struct.pack_into("<5i", writer._map, at, 1, ended.pid, -1, 0, 1)
    readers = [SharedImage(path), SharedImage(path)]
    numbers = [reader.claim(3) for reader in readers]
    assert numbers == [3, 1]
    assert struct.unpack_from("<10i", writer._map, at) == (1, os.getpid(), -1, os.getpid(), 1, 0, 0, 0, 0, 0)
    for _ in range(5):
        writer.write(np.ones(4))
        for reader, number in zip(readers, numbers, strict=True):
            semaphore = reader.semaphore(number)
            assert semaphore is not None and semaphore.wait(10) and not semaphore.wait(0)
    readers[0].release(3)
    assert readers[1].claim(3) == 3
    struct.pack_into("<10i", writer._map, at, *[1] * 10)
    with pytest.raises(StreamError, match="semaphore 2: other processes wait for all 10"):
        readers[0].claim(2)
    with pytest.raises(StreamError, match="semaphore 10: it has 0 to 9"):
        readers[0].claim(10)


@pytest.mark.parametrize("layout", [CURRENT, OLDER])
def test_a_file_cut_anywhere_is_refused_or_whole(tmp_path: Path, layout) -> None:
    path = tmp_path / "a.im.shm"
    SharedImage.create(path, (5,), layout=layout)
    whole = path.read_bytes()
    needed = layout.header + 20 if layout is OLDER else layout.header + 24 + 32 * 10
    for size in [*range(0, needed, 7), needed - 1]:
        path.write_bytes(whole[:size])
        with pytest.raises(StreamError, match=str(path)):
            SharedImage(path)
    path.write_bytes(whole[:needed])
    assert SharedImage(path).n == 5


@pytest.mark.parametrize(
    ("at", "value", "reason"),
    [
        (0, b"3.00", "version '3.00'"),
        (136, b"\x03", "data type 3"),
        (240, b"\x01", "main memory"),
        (112, b"\x04", "1 to 3 axes"),
        (128, b"\xff" * 8, "its header says"),
        (258, b"\xff\xff", "65535 semaphores"),
    ],
)
def test_what_cannot_be_read_is_said(tmp_path: Path, at: int, value: bytes, reason: str) -> None:
    path = tmp_path / "a.im.shm"
    SharedImage.create(path, (5,))
    raw = bytearray(path.read_bytes())
    raw[at : at + len(value)] = value
    path.write_bytes(raw)
    with pytest.raises(StreamError, match=reason):
        SharedImage(path)


def test_any_byte_of_the_header_may_be_wrong(tmp_path: Path) -> None:
    """Refused in one line or read; nothing else."""
    path = tmp_path / "a.im.shm"
    SharedImage.create(path, (5,))
    whole = path.read_bytes()
    for at in range(330):
        raw = bytearray(whole)
        raw[at] ^= 0xFF
        path.write_bytes(raw)
        try:
            stream = SharedImage(path)
        except StreamError:
            continue
        found = stream.read()
        assert found is None or found[1].shape == (stream.n,)


def test_where_streams_are(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    assert stream_path("aol1_modevalOL") == tmp_path / "aol1_modevalOL.im.shm"
    assert stream_path("aol1_modevalOL.im.shm") == tmp_path / "aol1_modevalOL.im.shm"
    assert stream_path("/elsewhere/x.im.shm") == Path("/elsewhere/x.im.shm")
