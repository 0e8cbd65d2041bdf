"""A cheating entry is refused with the reason; its process ends."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wfsobs.arena.definition import Arena, load_arena
from wfsobs.arena.entries import find_entries
from wfsobs.arena.process import EntryError, EntryProcess
from wfsobs.arena.run import run_arena
from wfsobs.prior import Prior
from wfsobs.record import Measurements

HERE = Path(__file__).parent


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
        ("cheats:LOOKS_AHEAD", "looks-ahead: looks ahead: measurements after step"),
        ("cheats:READS_TRUTH", "reads-truth: in a fresh process, with measurements and prior alone, it gives another result"),
    ],
)
def test_checks_come_first(here: None, tmp_path: Path, name: str, said: str) -> None:
    arena = load_arena(quick=True)
    (outcome,) = run_arena(Arena(1, arena.cases[:1], arena.rules), find_entries([name]), tmp_path)
    assert outcome.refusal.startswith(said) and "\n" not in outcome.refusal and not outcome.trials
    # once: a process that cannot be started is not needed again
    (again,) = run_arena(Arena(1, arena.cases[:1], replace(arena.rules, memory=0.0)), find_entries([name]), tmp_path)
    assert again.refusal == outcome.refusal
