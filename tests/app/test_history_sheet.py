"""The sheet of the history, without a browser: its rows, what it asks for, and the session's file."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import param
import pytest

from tests.app.test_session_history import WIND, change, quick
from wfsobs.app import history as module
from wfsobs.app.actions import Actions
from wfsobs.app.display import Display
from wfsobs.app.history import History, HistorySheet, Sheet
from wfsobs.app.idle_work import SeedRuns
from wfsobs.app.session_file import SUFFIX, read_session
from wfsobs.app.share import EXPLORED


@pytest.fixture
def sheet(make_store: Any, loop: Any) -> HistorySheet:
    """An open sheet of two results."""
    history = History(make_store(quick), Display())
    history.store.start()
    loop.finish(history.store)
    change(history, loop, WIND, 20)
    shown: list[Sheet] = []
    sheet = HistorySheet(history, shown.append)
    assert not shown, "made when it is first opened"
    sheet.toggle()
    assert shown == [sheet.sheet]
    return sheet


def model(sheet: HistorySheet) -> Sheet:
    return sheet.sheet


class NoPages(param.Parameterized):
    """In the place of the pages and of their view: nothing is opened."""

    current = param.String("explore")
    query = param.String("")
    page = SimpleNamespace(task=EXPLORED, saves=dict)

    @property
    def pages(self) -> NoPages:
        return self


@pytest.fixture
def actions(sheet: HistorySheet) -> Actions:
    """The menu that saves and opens the session."""
    view: Any = NoPages()
    return Actions(sheet.history.store, sheet, view, SeedRuns(sheet.history.store))


def saved(actions: Actions, loop: Any, monkeypatch: pytest.MonkeyPatch) -> bytes:
    files: list[dict[str, Any]] = []
    monkeypatch.setattr(actions.toolbar, "_send_msg", files.append)
    actions.handle({"action": "session"})
    loop.until(lambda: files != [])
    assert files[0]["name"].endswith(SUFFIX)
    return files[0]["content"]


def test_rows(sheet: HistorySheet) -> None:
    newest, oldest = sheet.rows
    assert newest["name"] == "Wind speed V₀ 15 → 20 m/s" and newest["current"] and not oldest["current"]
    assert newest["scores"] == "Turbulence 20000 nm (LGS KF)" and oldest["scores"] == "Turbulence 15000 nm (LGS KF)"
    assert (newest["note"], oldest["note"]) == ("", "Restoring runs it again"), "a server of a test keeps nothing"
    sheet.display.mode = "tilt"
    assert sheet.rows[0]["scores"] == ""


def test_what_is_asked_for(sheet: HistorySheet, loop: Any) -> None:
    key = sheet.rows[1]["key"]
    for msg in ({"action": "star"}, {"action": "rename", "name": "mine"}, {"action": "compare", "on": True}):
        sheet.handle({"key": key, **msg})
    row = sheet.rows[1]
    assert (row["star"], row["name"], row["letter"], row["note"]) == (True, "mine", "A", "Its lines are being made again")
    loop.until(lambda: sheet.rows[1]["note"] != "Its lines are being made again")
    sheet.handle({"action": "restore", "key": key})
    loop.finish(sheet.history.store)
    assert sheet.rows[0]["key"] == key and sheet.history.store.value(WIND) == 15.0
    assert sheet.message == "Restored mine."
    sheet.handle({"action": "delete", "key": key})
    assert sheet.history.can_undelete and len(sheet.rows) == 1
    sheet.handle({"action": "undelete"})
    assert not sheet.history.can_undelete and len(sheet.rows) == 2
    for nonsense in ({}, {"action": 3}, {"action": "star"}, {"action": "restore", "key": ["x"]}):
        sheet.handle(nonsense)
    sheet.handle({"action": "close"})
    assert not model(sheet).open and sheet.rows == [], "no rows while it is closed"
    sheet.history.star(key)
    assert sheet.rows == []


def test_save_and_open(sheet: HistorySheet, actions: Actions, loop: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    sheet.history.compare(sheet.rows[1]["key"])
    content = saved(actions, loop, monkeypatch)
    assert [entry.name for entry in read_session(content).entries] == [row["name"] for row in sheet.rows]
    sheet.history.compare_none()
    for key in [row["key"] for row in sheet.rows]:
        sheet.handle({"action": "delete", "key": key})
    change(sheet.history, loop, WIND, 33)
    sheet.close()
    actions.open_session(f"mine{SUFFIX}", content)
    loop.until(lambda: sheet.message.startswith("Opened"))
    loop.finish(sheet.history.store)
    assert model(sheet).open
    assert sheet.message == f"Opened mine{SUFFIX}: 2 results." and sheet.history.store.value(WIND) == 20.0
    assert sorted(entry.scores[0].rms for entry in sheet.history.entries) == [15.0, 20.0, 33.0], "what was here stays"
    assert [run.letter for run in sheet.display.compared_runs] == ["A"]


def test_files_that_are_none(sheet: HistorySheet, actions: Actions, loop: Any) -> None:
    before, step = [*sheet.history.entries], sheet.history.store.step
    actions.open_session("night.npz", b"PK nothing")
    loop.until(lambda: actions.toolbar.notes != [])
    assert actions.toolbar.notes[0].startswith("night.npz: damaged")
    assert sheet.history.entries == before and sheet.history.store.step == step


def test_a_session_too_large_to_be_opened_again(
    sheet: HistorySheet, actions: Actions, loop: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LARGEST", 100)
    actions.handle({"action": "session"})
    loop.until(lambda: any("more than can be opened" in note for note in actions.toolbar.notes))
