"""Streams over a network: the same numbers as in shared memory, and no message that is not a frame."""

import json
import pickle
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
import zmq
from click.testing import CliRunner

import wfsobs
from tests.patience import ENOUGH
from tests.streams.conftest import LONGEST, started, wait_until
from tests.streams.test_attach import measurements, stepped
from wfsobs.cli import main
from wfsobs.stepping import design
from wfsobs.streams import network
from wfsobs.streams.attach import Attachment
from wfsobs.streams.network import BURST, LARGEST, Publication, Subscription
from wfsobs.streams.shared_image import SharedImage, StreamError
from wfsobs.streams.wiring import Safety, Wiring

ANYWHERE = "tcp://127.0.0.1:*"


class Loop:
    """The program at the other end: it publishes modes, written here with zmq alone, and takes estimates."""

    def __init__(self, address: str = ANYWHERE, context: zmq.Context | None = None):
        self.context = context or zmq.Context()
        self.modes, self.estimates = self.context.socket(zmq.XPUB), self.context.socket(zmq.SUB)
        wait_until(lambda: self._bind(address))  # the system may hold the port of one that has ended for a moment
        self.address = self.modes.get_string(zmq.LAST_ENDPOINT)
        self.estimates.subscribe(b"")

    def _bind(self, address: str) -> bool:
        try:
            self.modes.bind(address)
        except zmq.ZMQError:
            return False
        return True

    def wait_for_reader(self) -> None:
        """XPUB tells of who has subscribed."""
        assert self.modes.poll(ENOUGH * 1e3) and self.modes.recv() == b"\x01"

    def send(self, count: int, z: np.ndarray) -> None:
        header = {"frame": count, "dtype": "float64", "n": z.size, "time": 1.5}
        self.modes.send_multipart([json.dumps(header).encode(), z.astype("<f8").tobytes()])

    def receive(self) -> tuple[dict, np.ndarray]:
        assert self.estimates.poll(ENOUGH * 1e3)
        header, values = self.estimates.recv_multipart()
        return json.loads(header), np.frombuffer(values, "<f8")

    def close(self) -> None:
        self.context.destroy(linger=0)


@contextmanager
def subscribed(loop: Loop, say: Callable[[str], None], first: int = 0) -> Iterator[Subscription]:
    """A subscription that has seen a first frame, of two zeros."""
    found: list[Subscription] = []
    thread = Thread(target=lambda: found.append(Subscription(loop.address, say, ENOUGH)))
    thread.start()
    loop.wait_for_reader()
    loop.send(first, np.zeros(2))
    thread.join(ENOUGH)
    with closing(found[0]):
        yield found[0]


@pytest.mark.slow
def test_the_numbers_of_the_run_over_the_record_through_the_command() -> None:
    """Modes 3 and 1 of five; nm; frames are lost on the way; a message that is none is counted."""
    z = measurements(1000)
    lost = [600, 601, 602]
    with closing(Loop()) as loop:
        options = ["--preset", "paper", "--set", "run.warm_up=0.5", "--observer", "kf-lgs", "--modes", "3,1", "--unit", "nm"]
        attach = [sys.executable, "-m", "wfsobs", "attach", "--in", loop.address, "--out", ANYWHERE, *options]
        with started(*attach, "--stuck", LONGEST, "--json") as ours:
            loop.wait_for_reader()
            loop.send(0, np.zeros(5))
            assert ours.stderr is not None
            loop.estimates.connect(ours.stderr.readline().removeprefix("wfsobs: attach: ").split(": ")[0])
            before = 1  # frames of zeros until the answers are heard: whoever subscribes late misses the first ones
            loop.send(before, np.zeros(5))
            while not loop.estimates.poll(200):
                before += 1
                loop.send(before, np.zeros(5))
            got = [loop.receive()]
            for k, row in enumerate(z):
                if k == 700:
                    loop.modes.send(b"no frame")
                if k not in lost:
                    loop.send(before + 1 + k, 1e3 * np.array([0.0, row[1], 0.0, row[0], 0.0]))
                    got.append(loop.receive())
            ours.send_signal(signal.SIGTERM)
            last = loop.receive()
            out, err = ours.communicate(timeout=ENOUGH)
    assert ours.returncode == 0 and "messages refused: 1\n" in err, err
    seen = np.vstack([np.zeros((before, 2)), z])
    seen[[before + k for k in lost]] = np.nan
    expected = 1e3 * np.delete(stepped(seen, "kf-lgs", 1), [before + k for k in lost], axis=0)[before:]
    values = np.array([values for _, values in got[1:]])
    assert not values[:, [0, 2, 4]].any()
    np.testing.assert_allclose(values[500:, [3, 1]], expected[500:], rtol=0, atol=1e-12 * np.abs(expected).max())
    counts = [header["frame"] for header, _ in got]
    assert counts == list(range(counts[0], counts[0] + len(got))) and not last[1].any(), "the last thing sent is safe"
    assert last[0] == {"frame": counts[-1] + 1, "dtype": "float64", "n": 5}
    summary = json.loads(out)
    assert summary["frames"] == before + len(z) - len(lost) and summary["refused"] == 1
    assert summary["missing"] == len(lost) and summary["fallbacks"] == 0


@pytest.mark.slow
def test_a_publisher_that_dies_and_comes_back(tmp_path: Path) -> None:
    """Its subscriber finds it by itself: the output is zero meanwhile, and the observer starts anew at its counter."""
    said: list[str] = []
    z = measurements(60)
    sink = SharedImage.create(tmp_path / "out.im.shm", (2,), dtype="float64")
    loop = Loop()
    with subscribed(loop, said.append) as source:
        wiring = Wiring((0, 1), 1.0, 1.0, np.full(2, 0.5), Safety(calm=20), stuck=0.3)
        one = Attachment(source, sink, design("kf-lgs", wfsobs.PRESETS["paper"]()), wiring, said.append)
        ends: list[bool] = []
        thread = Thread(target=one.run, args=(ENOUGH,), kwargs={"stop": lambda: bool(ends)})
        thread.start()
        for k, row in enumerate(z):
            loop.send(k + 1, row)
            wait_until(lambda k=k: sink.count > k)
        address = loop.address
        loop.close()
        wait_until(lambda: any("no frame for 0.3 s" in line for line in said))
        found = sink.read()
        assert found is not None and not found[1].any()
        with closing(Loop(address)) as loop:
            loop.wait_for_reader()
            one._wiring = replace(one._wiring, stuck=ENOUGH)
            before, answers = sink.count, []
            for k, row in enumerate(z):
                loop.send(k + 1, row)
                wait_until(lambda k=k: sink.count > before + k)
                answers.append(sink.read()[1])  # pyright: ignore[reportOptionalSubscript]
            ends.append(True)
            thread.join(ENOUGH)
    assert "the counter went from 60 to 1" in said
    np.testing.assert_allclose(answers[30:], stepped(z, "kf-lgs", 1)[30:], rtol=0, atol=1e-12)
    assert not np.any(answers[:19]), "the 20th good frame is the first that counts"


GOOD = {"frame": 7, "dtype": "float64", "n": 2}


@pytest.mark.parametrize(
    ("header", "values", "reason"),
    [
        (b"[" * 5000, bytes(16), "its header has 5000 bytes, 256 at most"),
        *(
            (header, bytes(16), "its header is not {")
            for header in (b"\xff{", b"[" * 256, b"[1]", b'{"frame": 7, "n": 2}', pickle.dumps(GOOD))
        ),
        *(
            (json.dumps({**GOOD, name: value}).encode(), bytes(16), "its header is not {")
            for name, value in [
                ("frame", True), ("frame", -1), ("frame", 2**64), ("n", 0), ("n", 1e400),
                ("dtype", "object"), ("dtype", ["float64"]),
            ]
        ),
        (json.dumps(GOOD).encode(), bytes(15), "15 bytes are not the float64 numbers"),
        (json.dumps({**GOOD, "n": 3}).encode(), bytes(24), "it has 3 numbers, those before had 2"),
        (json.dumps({**GOOD, "frame": 0}).encode(), bytes(16), "the counter stays 0"),
    ],
)  # fmt: skip
def test_a_message_that_is_no_frame_is_counted_and_said_once(header: bytes, values: bytes, reason: str) -> None:
    said: list[str] = []
    with closing(Loop()) as loop, subscribed(loop, said.append) as source:
        for _ in range(3):
            loop.modes.send_multipart([header, values])
        loop.send(8, np.array([1.0, -2.0]))
        wait_until(lambda: source.count == 8)
        assert source.wait(0, 0.0)
        found = source.read()
        assert found is not None and found[0] == 8 and found[1].tolist() == [1.0, -2.0]
        assert source.n_refused == 3 and len(said) == 1 and reason in said[0], said
    assert said[1].endswith("messages refused: 3")


def test_a_message_too_large_does_not_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """ZeroMQ disconnects who sends it, and does not connect again: we do, and the next frame comes."""
    monkeypatch.setattr(network, "RECONNECT", 0.2)
    with closing(Loop()) as loop, subscribed(loop, lambda _: None) as source:
        loop.send(1, np.zeros(LARGEST // 8 + 1))
        assert loop.modes.poll(ENOUGH * 1e3) and loop.modes.recv() == b"\x00", "gone"
        count, until = 2, time.monotonic() + ENOUGH
        while not source.wait(0, 0.01):
            assert time.monotonic() < until
            loop.send(count, np.ones(2))
            count += 1
        assert source.read() is not None and source.n_refused == 0


@pytest.mark.parametrize(("n", "taken"), [(BURST, list(range(1, BURST + 1))), (BURST + 5, [BURST + 5])])
def test_frames_that_wait_are_taken_one_by_one_or_the_newest_alone(n: int, taken: list[int]) -> None:
    with closing(Loop()) as loop, subscribed(loop, lambda _: None) as source:
        accept = source._accept
        found: list[int] = []
        for k in range(1, n + 1):  # as they come, without a look between them
            accept([json.dumps({**GOOD, "frame": k}).encode(), bytes(16)])
        assert source.catch_up() == taken[0] - 1
        while (frame := source.read()) is not None:
            found.append(frame[0])
        assert source.catch_up() == n
    assert found == taken


def test_all_that_has_come_meanwhile_is_taken_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of more messages than one look takes, the newest frame is read next."""
    monkeypatch.setattr(network, "MOST", 2)
    monkeypatch.setattr(network, "BURST", 1)
    with closing(Loop()) as loop, subscribed(loop, lambda _: None) as source:
        parts = [[json.dumps({**GOOD, "frame": k}).encode(), bytes(16)] for k in range(1, 8)]

        def receive(_flags: int) -> list[bytes]:
            if not parts:
                raise zmq.Again
            return parts.pop(0)

        socket, source._socket = source._socket, type("Socket", (), {"recv_multipart": staticmethod(receive)})  # pyright: ignore[reportAttributeAccessIssue]
        assert source.catch_up() == 6
        frame = source.read()
        source._socket = socket
    assert frame is not None and frame[0] == 7


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_what_one_publishes_the_other_reads(dtype: str) -> None:
    """Twice: the elements that are not written stay as they were."""
    with (
        closing(Publication(ANYWHERE, 3, dtype)) as sink,
        heard(sink.path, lambda _: sink.write(np.array([1.0, 2, 3]))) as source,
    ):
        assert (source.n, source.dtype) == (3, dtype)
        sink.write(np.array([np.pi]), np.array([1]))
        read = newest(source, lambda values: values[1] != 2.0)
    assert read[1].tolist() == [1.0, float(np.dtype(dtype).type(np.pi)), 3.0]


def test_the_program_of_the_page_is_understood() -> None:
    page = (Path(__file__).parents[2] / "docs" / "streams.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```$", page, flags=re.M | re.S)
    names: dict[str, Any] = {}
    exec(compile(code.replace("tcp://*:5555", ANYWHERE), "streams.md", "exec"), names)
    with (
        closing(names["socket"]),
        heard(names["socket"].get_string(zmq.LAST_ENDPOINT), lambda k: names["publish"](k, np.zeros(2))) as source,
    ):
        names["publish"](10**6, np.array([0.5, -1.25]))
        assert newest(source, lambda values: bool(values.any()))[0] == 10**6
    names["socket"].context.destroy(linger=0)


@contextmanager
def heard(address: str, publish: Callable[[int], object]) -> Iterator[Subscription]:
    """A subscription to what is published again and again until it is heard."""
    found: list[Subscription] = []
    thread = Thread(target=lambda: found.append(Subscription(address, print, ENOUGH)))
    thread.start()
    count = 0
    while thread.is_alive():
        count += 1
        publish(count)
        thread.join(0.01)
    with closing(found[0]) as source:
        yield source


def newest(source: Subscription, is_wanted: Callable[[np.ndarray], bool]) -> tuple[int, np.ndarray]:
    """Return the first frame with such numbers."""
    read = None
    while read is None or not is_wanted(read[1]):
        assert source.wait(0, ENOUGH)
        read = source.read()
    return read


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--in", "tcp://nowhere", "--shadow"], "tcp://nowhere: takes a port up to 65535, as in tcp://localhost:5555"),
        (
            ["--in", "SHM", "--shadow", "--ngs", "tcp://nowhere", "--observer", "gp-both"],
            "tcp://nowhere: takes a port up to 65535",
        ),
        (["--in", "SHM", "--out", "tcp://nowhere"], "tcp://nowhere: takes a port up to 65535"),
        (["--in", "tcp://localhost:65536", "--shadow"], "tcp://localhost:65536: takes a port up to 65535"),
        (["--in", "SHM", "--out", "tcp://*:70000"], "tcp://*:70000: takes a port up to 65535"),
    ],
)
def test_what_cannot_be_attached_is_said_in_one_line(tmp_path: Path, options: list[str], reason: str) -> None:
    path = SharedImage.create(tmp_path / "in.im.shm", (2,)).path
    done = CliRunner().invoke(main, ["attach", *(path if option == "SHM" else option for option in options)])
    assert done.exit_code == 2 and reason in done.output and done.output.count("\n") == 1, done.output


def test_no_frame_and_an_address_in_use_and_semaphores() -> None:
    with pytest.raises(StreamError, match=r"^tcp://127\.0\.0\.1:1: no frame for 0\.2 s$"):
        Subscription("tcp://127.0.0.1:1", print, 0.2)
    with closing(Loop()) as loop:
        with pytest.raises(StreamError, match=r"^tcp://127\.0\.0\.1:\d+: Address already in use$"):
            Publication(loop.address, 2)
        with subscribed(loop, print) as source, pytest.raises(StreamError, match="semaphore 3: a stream of the network has none"):
            source.claim(3)


def test_without_the_library_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zmq", None)
    done = CliRunner().invoke(main, ["attach", "--in", "tcp://127.0.0.1:5555", "--shadow"])
    assert done.exit_code == 2 and done.output.endswith('tcp://127.0.0.1:5555: needs pyzmq: pip install "wfsobs[zmq]"\n')
    assert done.output.count("\n") == 1
