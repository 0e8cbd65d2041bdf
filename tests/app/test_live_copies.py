"""What is copied of the live loop runs the same loop: in a shell, in Python, from a link."""

from __future__ import annotations

import hashlib
import json
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from tests.app.test_copies import in_shell
from wfsobs.app.dashboard import Dashboard
from wfsobs.app.pages.live import LivePage
from wfsobs.app.pages.pages import LIVE
from wfsobs.app.share import LIVE as LIVE_TASK
from wfsobs.app.share import CopiedTask, to_command, to_python
from wfsobs.app.sources import LoadedRecord
from wfsobs.cli import main
from wfsobs.live.loop import LiveOrder
from wfsobs.live.simulated import SimulatedLoop
from wfsobs.live.source import Replay
from wfsobs.observers.base import TARGETS
from wfsobs.record import TOTAL
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import paper
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.records import load_record, save_record

CHOSEN = {"running": ["kf-multi", "gp-both"], "controllers": ["integrator"], "speed": 2.0}
SHOW = "np.save('z.npy', loop.view(1.0).frames.z); print(loop.speed, sorted(loop.controllers), loop.scenario == scenario)"


@pytest.fixture
def page(quick: None, dashboard: Dashboard, short: Scenario) -> LivePage:
    """Its loop is none of those that are there unless told."""
    dashboard.store.load(short.replace({"run.seed": 3, "turbulence.wind_speed": 11.0, "vibration.peaks": [{"frequency": 33.0}]}))
    dashboard.pages.current = LIVE
    page = dashboard.pages.by_name[LIVE]
    assert isinstance(page, LivePage)
    for name, value in CHOSEN.items():
        getattr(page.controls, name).value = value
    return page


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Any:
    """What `wfsobs live` would serve: words of a shell -> its order."""
    orders: list[LiveOrder] = []
    monkeypatch.setattr("wfsobs.app.serve.serve", lambda _options, order: orders.append(order))

    def order(command: str) -> LiveOrder:
        done = CliRunner().invoke(main, shlex.split(command)[1:], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        return orders[-1]

    return order


def of(order: LiveOrder) -> tuple[object, ...]:
    """What makes a loop what it is."""
    return order.source, order.scenario, tuple(order.observers), tuple(order.controllers), order.speed


def script(folder: Path, code: str) -> str:
    """What a script prints, run as a file; its processes import it."""
    (folder / "copied.py").write_text(code, encoding="utf-8")
    done = subprocess.run([sys.executable, "copied.py"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_command_in_a_shell(
    page: LivePage, dashboard: Dashboard, served: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    command, scenario = dashboard.actions.toolbar.command, dashboard.store.scenario
    order = served(command)
    assert of(order)[1:] == (scenario, ("kf-multi", "gp-both"), ("integrator",), 2.0) and order.source == SimulatedLoop(scenario)
    alone = command.replace(" --controller integrator", "").replace(" --observer gp-both", "")  # controllers run with a page
    told = json.loads(in_shell(f"{alone} --headless --seconds 0.5 --json --record shell.npz").splitlines()[-1])
    assert list(told["observers"]) == ["kf-multi"] and told["frames"] + told["lost"] == 1000  # twice as fast
    made = script(tmp_path, shown_by(dashboard.actions.toolbar.python))
    assert made.splitlines()[-1] == "2.0 ['integrator'] True"
    assert {line.split()[0] for line in made.splitlines()[:-1]} == set(CHOSEN["running"])
    # the frames of the same seed; a record has them with commands, which are taken off again
    np.testing.assert_allclose(np.load(tmp_path / "z.npy")[:1000], load_record("shell.npz", scenario).z[:1000], atol=1e-14)


def shown_by(code: str) -> str:
    """A script that also leaves the first second of its frames, and says what it runs."""
    assert "10_000" in code and "loop.stop()" in code
    code = code.replace("10_000", "1000").replace("loop.count < n", "not (loop.count >= n and loop.pause() is None)")
    return "import numpy as np\n" + code.replace("loop.stop()", f"{SHOW.replace('1.0', '100.0')}\n    loop.stop()")


def test_no_controllers_are_none(page: LivePage, dashboard: Dashboard, served: Any) -> None:
    page.controls.controllers.value = []
    assert served(dashboard.actions.toolbar.command).controllers == ()
    page.controls.controllers.value = ["none"]
    assert served(dashboard.actions.toolbar.command).controllers == ("none",)


def test_the_link(page: LivePage, dashboard: Dashboard, loop: Any) -> None:
    page.controls.target.value, page.controls.window.value = TOTAL, 10.0
    expected, toolbar = of(page.task.arguments["order"]), dashboard.actions.toolbar
    query = f"?{toolbar.query}&{toolbar.view}"
    dashboard.actions.open_link("?preset=paper&run.duration=2")
    dashboard.actions.open_view("?view.page=live")
    usual = of(page.task.arguments["order"])
    assert usual[2:] != expected[2:] and usual[4] == 1.0, "a link that says nothing of the loop is that of a fresh page"
    assert (page.controls.target.value, page.controls.window.value) == (TARGETS[0], 5.0)
    dashboard.actions.open_link(query)
    dashboard.actions.open_view(query)
    assert toolbar.notes == [] and dashboard.pages.current == LIVE
    assert of(page.task.arguments["order"]) == expected
    assert (page.controls.target.value, page.controls.window.value) == (TOTAL, 10.0)
    dashboard.actions.open_view("?view.page=live&view.live.observers=kf-multi,kf-none&view.live.speed=30&view.live.window=3")
    assert page.controls.running.value == ["kf-multi"] and page.controls.speed.value == 1.0
    assert page.controls.window.value == 5.0
    assert toolbar.notes == [
        "Not used from the link: view.live.window = 3: takes one of 2, 5, 10",
        "Not used from the link: view.live.observers = kf-none: there is none of that name",
        "Not used from the link: view.live.speed = 30: takes a number from 0.1 to 20",
    ]


def test_a_record_by_its_name_and_hash(
    short: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, served: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    save_record("a night.npz", simulate(short.replace({"run.duration": 1.2})))
    sha256 = hashlib.sha256(Path("a night.npz").read_bytes()).hexdigest()
    record = load_record("a night.npz", short)
    loaded = LoadedRecord(record, "a night.npz", "key", sha256=sha256)
    task = CopiedTask(LIVE_TASK, {"order": LiveOrder(Replay(record), short, ["kf-multi"], 5.0, [])})
    command = to_command(short, "paper", loaded, task)
    order = served(command)
    assert isinstance(order.source, Replay) and order.controllers == () and order.speed == 5.0
    np.testing.assert_array_equal(order.source.record.z, record.z)
    alone = command.replace(" --no-controllers", "")
    told = json.loads(in_shell(f"{alone} --headless --json").splitlines()[-1])
    assert told["frames"] + told["lost"] == record.n_steps and list(told["observers"]) == ["kf-multi"]
    exec(to_python(short, "paper", loaded, task), {"__name__": "__main__"})
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines] == [["kf-multi", "turbulence"], ["kf-multi", "vibration"]]
    save_record("a night.npz", simulate(short.replace({"run.seed": 8, "run.duration": 1.2})))
    done = CliRunner().invoke(main, shlex.split(command)[1:])
    assert done.exit_code and "is another file: its SHA-256 is" in done.output


def test_a_stream_by_its_address(served: Any) -> None:
    said = "wfsobs live --in /dev/shm/modes.im.shm --modes 1,0 --unit nm --ngs /dev/shm/slow.im.shm --ngs-modes 0,2 --ngs-lag 3"
    first = served(f"{said} --observer kf-multi --controller integrator")
    task = CopiedTask(LIVE_TASK, {"order": replace(first, speed=0.5)})  # a speed that a link has left on the page
    assert of(served(to_command(first.scenario, first.preset, None, task))) == of(first)
    code = to_python(first.scenario, first.preset, None, task)
    made: dict[str, Any] = {"__name__": "__main__"}
    # as far as the source: there is no such stream here
    exec(code.partition("    loop = ")[0], made)
    assert made["source"] == first.source and made["scenario"] == paper()
