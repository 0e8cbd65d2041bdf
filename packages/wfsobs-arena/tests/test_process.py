"""A cheating entry is refused with the reason; its process ends."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from wfsobs_arena.definition import Arena, load_arena
from wfsobs_arena.entries import find_entries
from wfsobs_arena.process import EntryError, EntryProcess
from wfsobs_arena.run import run_arena

from wfsobs.prior import Prior
from wfsobs.record import Measurements
from wfsobs.settings.values import SettingError

pytestmark = pytest.mark.slow

HERE = Path(__file__).parent

pytestmark = pytest.mark.slow


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(HERE)
    monkeypatch.syspath_prepend(str(HERE))


@pytest.fixture
def process(here: None) -> Iterator[EntryProcess]:
    with EntryProcess(find_entries(["cheats:MISBEHAVES"])[0], memory=4.0) as found:
        yield found


def test_limits_and_answers(process: EntryProcess) -> None:
    given = Measurements(np.ones((8, 2)), np.zeros((8, 2)), 1e-3)

    def run(how: str, seconds: float = 60.0) -> dict[str, np.ndarray]:
        return process.run(seconds, given, Prior(), how).arrays

    np.testing.assert_array_equal(run("well")["vibration"], np.zeros((8, 2)))
    with pytest.raises(EntryError, match=r"^too large: needs more than 4 GB of memory$"):
        run("large")
    with pytest.raises(EntryError, match=r"^RuntimeError: a line and another$"):
        run("error")
    child = process._process
    with pytest.raises(EntryError, match=r"^too slow: no answer after 0\.2 s$"):
        run("slow", 0.2)
    assert not child.is_alive()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("cheats:LOOKS_AHEAD", "looks ahead: measurements after step"),
        ("cheats:READS_TRUTH", "in a fresh process, with measurements and prior alone, it gives another result"),
    ],
)
def test_checks_come_first(here: None, tmp_path: Path, name: str, said: str) -> None:
    arena = load_arena(quick=True)
    (outcome,) = run_arena(Arena(1, arena.cases[:1], arena.rules), find_entries([name]), tmp_path)
    assert outcome.refusal.startswith(said) and "\n" not in outcome.refusal and not outcome.trials
    # once: a process that cannot be started is not needed again
    (again,) = run_arena(Arena(1, arena.cases[:1], replace(arena.rules, memory=0.0)), find_entries([name]), tmp_path)
    assert again.refusal == outcome.refusal


def test_what_sleeps_in_the_checks_is_ended(here: None, capfd: pytest.CaptureFixture[str]) -> None:
    with EntryProcess(find_entries(["cheats:SLEEPS"])[0], memory=4.0) as process:
        with pytest.raises(EntryError, match=r"^too slow: no answer after 10 s$"):
            process.check(10.0)
        assert process._process is None
    assert "asleep" in capfd.readouterr().out


ASK = """
from wfsobs_arena.entries import find_entries
from wfsobs_arena.process import EntryProcess
if __name__ == "__main__":
    with EntryProcess(find_entries(["cheats:SLEEPS"])[0], 4.0) as process:
        process.check(600.0)
"""


def test_no_entry_outlives_the_arena(tmp_path: Path) -> None:
    (tmp_path / "ask.py").write_text(ASK)
    arena = subprocess.Popen([sys.executable, str(tmp_path / "ask.py")], cwd=HERE, stdout=subprocess.PIPE, text=True)
    assert arena.stdout is not None and arena.stdout.readline() == "asleep\n"
    arena.kill()
    arena.communicate(timeout=120.0)  # to the end of what its processes print, hence of all of them


def test_a_module_in_the_present_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path.copy())
    (tmp_path / "entry_of_mine.py").write_text((HERE / "cheats.py").read_text())
    assert find_entries(["entry_of_mine:SLEEPS"])[0].id == "sleeps"
    del sys.modules["entry_of_mine"]
    (tmp_path / "broken.py").write_text("1 / 0")
    with pytest.raises(SettingError, match=r"^--entry broken:ME: cannot be imported: ZeroDivisionError: division by zero$"):
        find_entries(["broken:ME"])
