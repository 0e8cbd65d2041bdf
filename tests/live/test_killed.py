"""A process of `wfsobs live` is killed: one line that names it, exit status 2, and nothing is left of the others."""

import json
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import wait as wait_for
from multiprocessing import Pipe, get_context

import numpy as np
import psutil
import pytest

import wfsobs
from tests.patience import ENOUGH, wait
from wfsobs.live.board import Board
from wfsobs.live.follow import _row
from wfsobs.live.loop import LiveLoop
from wfsobs.live.processes import compute
from wfsobs.live.simulated import SimulatedLoop
from wfsobs.scenario.presets import paper
from wfsobs.streams.shared_image import SharedImage
from wfsobs.telemetry.records import save_record

pytestmark = pytest.mark.slow

TRACKER, SOURCE, LINEAR = "the resource tracker of Python was killed", "the source", "the observers (linear)"
PROCESSES = {
    "simulation": (TRACKER, "the simulation", SOURCE, LINEAR),
    "record": (TRACKER, SOURCE, LINEAR),
    "stream": (TRACKER, SOURCE, LINEAR),
}
"""Of each source, in the order in which they begin."""


@pytest.fixture
def options(tmp_path):
    """A function that returns the options of a source, which is there until the test ends."""
    is_over, senders = threading.Event(), []

    def send(image):
        while not is_over.wait(1e-2):
            image.write(np.zeros(2))

    def options_of(source):
        if source == "simulation":
            return []
        if source == "record":
            save_record(tmp_path / "night.npz", wfsobs.simulate(paper().replace({"run.duration": 10.0})))
            return ["--replay", str(tmp_path / "night.npz"), "--speed", "0.1"]
        image = SharedImage.create(tmp_path / "modes.im.shm", (2,), dtype="float64")
        senders.append(threading.Thread(target=send, args=(image,)))
        senders[-1].start()
        return ["--in", image.path]

    yield options_of
    is_over.set()
    for sender in senders:
        sender.join()


@pytest.mark.parametrize(
    ("source", "name"), [("record", TRACKER), ("simulation", "the simulation"), ("record", SOURCE), ("stream", LINEAR)]
)
def test_a_process_that_is_killed_ends_the_command_in_one_line_that_names_it(options, source, name):
    names = PROCESSES[source]
    command = [sys.executable, "-m", "wfsobs", "live", "--headless", "--json", "--seconds", "600", "--observer", "kf-lgs"]
    process = subprocess.Popen([*command, *options(source)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        parent = psutil.Process(process.pid)
        # All but the tracker and the simulation read the memory of the loop; earlier each would begin a tracker of its own.
        readers = len(names) - 1 - (source == "simulation")
        wait(lambda: sum(map(has_memory_of_the_loop, parent.children())) == readers, 0.1)  # which takes a while of its own
        children = sorted(parent.children(), key=lambda child: child.pid)
        child = children[names.index(name)]
        child.kill()
        out, errors = process.communicate(timeout=ENOUGH)
    finally:
        process.kill()
        process.communicate()
    line = name if name == TRACKER else f"the process of {name} ({child.pid}) was ended by signal 9 (SIGKILL)"
    told = [line for line in errors.splitlines() if "modes.im.shm" not in line]  # of a stream, what happens to it
    assert (process.returncode, out, told) == (2, "", [f"wfsobs: live: {line}"])
    assert psutil.wait_procs(children, timeout=ENOUGH)[1] == []


def has_memory_of_the_loop(process):
    try:
        return any("psm_" in region.path for region in process.memory_maps())
    except psutil.Error:  # it is being started
        return False


def test_every_process_that_is_killed_is_named():
    """Every kind of process there is, one after the other: observers of every crew, controllers, and what is made beside them."""
    scenario = paper().replace({"run.warm_up": 0.2})
    loop = LiveLoop(SimulatedLoop(scenario), scenario, ["kf-lgs", "gpr-online", "gpr-adaptive"])
    try:
        loop.control("none", True)
        wait(lambda: loop.is_ready and len(loop._processes.processes) == 7)
        workshop, pids = loop._processes.workshop, [p.pid for p in loop._processes.processes]
        assert workshop.submit(abs, -3).result(ENOUGH) == 3
        with pytest.raises(ZeroDivisionError):
            workshop.submit(divmod, 1, 0).result(ENOUGH)
        assert loop.failure() == ""
        of_crews = ("the observers (learning)", "the observers (long)")
        first, *others = ["the controllers", "the designs", *PROCESSES["simulation"][1:], *of_crews]
        process = {process.name: process for process in loop._processes.processes}
        assert process.keys() == {first, *others}
        os.kill(process[first].pid, signal.SIGKILL)
        wait(loop.failure)
        assert loop.failure() == f"live: the process of {first} ({process[first].pid}) was ended by signal 9 (SIGKILL)"
        for _ in range(100):  # no more than a pipe holds waits for the one that is gone
            loop._processes.tell({"id": "none", "design": bytes(4096)})
        for name in others:
            os.kill(process[name].pid, signal.SIGKILL)
        wait(lambda: loop.failure().count("SIGKILL") == len(pids))
        assert "\n" not in loop.failure()
        assert all(f"{name} ({one.pid})" in loop.failure() for name, one in process.items())
        wait_for([workshop.submit(abs, -1)])
        loop.stop()
        wait(lambda: not any(map(psutil.pid_exists, pids)))
        assert workshop.submit(abs, -3).cancelled()
    finally:
        loop.stop()


def test_numbers_that_are_not_known_are_null_in_json():
    """Of an observer that has taken no frame, and of errors whose squares are beyond what a number holds."""
    board = Board(2)
    try:
        row = _row(board["kf-multi"], ("turbulence", "vibration"), ("tip", "tilt"))
        assert row["p50_us"] is row["p99_9_us"] is row["rms_nm"] is row["next_nm"]["tip"] is None and row["late"] == 0
        board["kf-multi"].squares[:] = np.inf
        board["kf-multi"].samples[:] = 1
        row = _row(board["kf-multi"], ("turbulence", "vibration"), ("tip", "tilt"))
        assert row["rms_nm"] is row["errors_nm"]["total"]["tilt"] is None
        json.dumps(row, allow_nan=False)
    finally:
        board.release()


def test_who_waits_for_work_ends_without_a_traceback_once_nobody_is_left(capfd):
    here, there = Pipe()
    process = get_context("spawn").Process(target=compute, args=(there,))
    process.start()
    there.close()
    here.send((divmod, (7, 3)))
    assert here.recv() == (2, 1)
    here.close()
    process.join()
    assert (process.exitcode, capfd.readouterr().err) == (1, "")
