"""The row of actions and the files it gives."""

from __future__ import annotations

import io
import tomllib
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from tests.patience import ENOUGH
from wfsobs.app import actions as module
from wfsobs.app import downloads
from wfsobs.app.actions import LARGEST, Actions
from wfsobs.app.dashboard import Dashboard
from wfsobs.app.downloads import TooLarge, data_csv, data_npz
from wfsobs.app.share import to_query
from wfsobs.app.work import RunResults, compute
from wfsobs.cli import main
from wfsobs.cost import run_seconds
from wfsobs.progress import QUIET
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import from_toml
from wfsobs.scenario.presets import PRESETS
from wfsobs.telemetry.records import load_record, read_record

WIND = "turbulence.wind_speed"


def row_of(dashboard: Dashboard, monkeypatch: pytest.MonkeyPatch) -> Actions:
    """The row of a dashboard; what it sends is kept in `sent`."""
    sent: list[dict[str, Any]] = []
    monkeypatch.setattr(dashboard.actions.toolbar, "_send_msg", sent.append)
    dashboard.actions.sent = sent  # type: ignore[attr-defined]
    return dashboard.actions


@pytest.fixture
def actions(dashboard: Dashboard, monkeypatch: pytest.MonkeyPatch) -> Actions:
    return row_of(dashboard, monkeypatch)


@pytest.fixture
def shared_actions(shared: Dashboard, monkeypatch: pytest.MonkeyPatch) -> Actions:
    shared.actions.toolbar.param.update(message="", notes=[])
    return row_of(shared, monkeypatch)


@pytest.fixture(scope="module")
def shown() -> RunResults:
    scenario = PRESETS["paper"]().replace(
        {
            "run.duration": 1.0,
            "run.warm_up": 0.2,
            "gpr_offline.training_size": 40,
            "gpr_offline.depth": 20,
            "gpr_online.training_size": 40,
            "gpr_online.depth": 20,
        }
    )
    return compute(scenario, QUIET, lambda **_: None)


@pytest.mark.usefixtures("quick")
def test_texts_follow_the_settings(actions: Actions) -> None:
    toolbar, store = actions.toolbar, actions.store
    store.change(WIND, 20)
    assert toolbar.query == to_query(store.scenario, "paper") and f"{WIND}=20" in toolbar.query
    assert f"--set {WIND}=20.0" in toolbar.command and f'"{WIND}": 20.0' in toolbar.python
    store.choose("ut4")
    assert toolbar.query == "preset=ut4" and toolbar.command == "wfsobs run --preset ut4"


@pytest.mark.usefixtures("quick")
def test_undo_and_redo_by_message(actions: Actions) -> None:
    actions.store.change(WIND, 20)
    actions.handle({"action": "undo"})
    assert actions.store.value(WIND) == 15.0
    actions.handle({"action": "redo"})
    assert actions.store.value(WIND) == 20.0
    actions.handle({"action": "close"})
    actions.handle({})


@pytest.mark.usefixtures("quick")
def test_a_link_is_one_step_and_names_what_it_could_not_use(actions: Actions) -> None:
    before = actions.store.scenario
    actions.open_link(f"?preset=ut4&{WIND}=25&loop.gain=9&run.seed=3")
    store = actions.store
    assert (store.preset, store.value(WIND), store.scenario.run.seed) == ("ut4", 25.0, 3)
    assert actions.toolbar.notes == ["Not used from the link: loop.gain = 9: takes a number from 0 and below 1"]
    store.undo()
    assert store.scenario == before and store.preset == "paper"


@pytest.mark.usefixtures("quick")
def test_a_file_is_one_step(actions: Actions, loop: Any) -> None:
    before = actions.store.scenario
    actions.open_file("mine.toml", 'preset = "ut4"\nloop.gain = 0.2')
    store = actions.store
    loop.until(lambda: actions.toolbar.message.startswith("Opened"))  # on a busy machine it waits in the line first
    assert store.scenario == PRESETS["ut4"]().replace({"loop.gain": 0.2}) and store.preset == "ut4"
    assert actions.toolbar.message == "Opened mine.toml."
    store.undo()
    assert store.scenario == before


@pytest.mark.usefixtures("quick")
def test_a_bad_file_changes_nothing_and_has_one_line(actions: Actions, loop: Any, subtests: pytest.Subtests) -> None:
    texts: list[Any] = ["loop.gain = 9", "nonsense", "run.warm_up = 20", "#" * (LARGEST + 1), None, 3]
    for text in texts:
        with subtests.test(str(text)[:20]):
            before = actions.store.scenario
            actions.open_file("mine.toml", text)
            loop.until(lambda: actions.toolbar.notes != [])
            assert actions.store.scenario is before
            (note,) = actions.toolbar.notes
            assert note.startswith("mine.toml: ") and "\n" not in note
            actions.open_file("mine.toml", "loop.gain = 0.2")
            loop.until(lambda: actions.toolbar.notes == [])


@pytest.mark.usefixtures("quick")
def test_the_scenario_file(actions: Actions, loop: Any) -> None:
    actions.store.change(WIND, 20)
    actions.handle({"action": "toml"})
    loop.until(lambda: actions.sent != [])  # type: ignore[attr-defined]
    (file,) = actions.sent  # type: ignore[attr-defined]
    text = file["content"].decode()
    assert file["name"] == "wfsobs.toml" and tomllib.loads(text)["preset"] == "paper"
    assert from_toml(text) == actions.store.scenario


@pytest.mark.parametrize(("action", "make"), [("csv", data_csv), ("npz", data_npz)])
def test_data_is_made_aside_and_sent(shared_actions: Actions, shared_loop: Any, action: str, make: Any) -> None:
    shared_actions.handle({"action": action})
    shared_loop.until(lambda: shared_actions.sent)  # type: ignore[attr-defined]
    (file,) = shared_actions.sent  # type: ignore[attr-defined]
    content = file["content"]
    assert file["name"] == f"wfsobs.{action}" and len(content) == len(make(shared_actions.store.run.result))


def test_a_report_is_made_aside_of_what_is_shown_one_at_a_time(
    shared_actions: Actions,
    shared_loop: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[tuple[Any, str]] = []
    begun, may_end = Event(), Event()

    def make(shown: Any, preset: str, *_: Any, **__: Any) -> bytes:
        asked.append((shown, preset))
        begun.set()
        assert may_end.wait(ENOUGH)
        return b"<!doctype html>"

    monkeypatch.setattr(module, "make", make)
    shown = shared_actions.store.run.result
    shared_actions.handle({"action": "report"})
    assert shared_actions.toolbar.reporting and begun.wait(ENOUGH)
    shared_actions.handle({"action": "report"})
    may_end.set()
    shared_loop.until(lambda: not shared_actions.toolbar.reporting)
    (file,) = shared_actions.sent  # type: ignore[attr-defined]
    assert file["name"] == "wfsobs-report.html" and file["content"] == b"<!doctype html>"
    assert shown is not None and asked == [(shown, "paper")]


@pytest.mark.parametrize(
    ("error", "line"), [(ValueError("no room"), "Report: no room"), (KeyError("x"), "Report: KeyError: 'x'")]
)
def test_a_report_that_fails_is_one_line(
    shared_actions: Actions,
    shared_loop: Any,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    error: Exception,
    line: str,
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(module, "make", fail)
    shared_actions.handle({"action": "report"})
    shared_loop.until(lambda: shared_actions.toolbar.notes)
    assert shared_actions.toolbar.notes == [line] and not shared_actions.toolbar.reporting
    assert ("Traceback" in caplog.text) == isinstance(error, KeyError), "the log says more of what nobody expected"
    assert not shared_actions.sent  # type: ignore[attr-defined]


def test_too_much_data_is_refused_with_a_line(shared_actions: Actions, shared_loop: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(downloads, "MOST", 1000)
    with pytest.raises(TooLarge):
        data_csv(shared_actions.store.run.result)  # type: ignore[arg-type]
    shared_actions.handle({"action": "npz"})
    shared_loop.until(lambda: shared_actions.toolbar.notes)
    assert "wfsobs run --save" in shared_actions.toolbar.notes[0]


def test_what_was_read_is_taken_back_and_nothing_that_came_meanwhile(shared_actions: Actions) -> None:
    toolbar = shared_actions.toolbar
    toolbar.param.update(message="Opened b.toml.", notes=["a.toml: no"])
    shared_actions.handle({"action": "read", "text": "Opened a.toml."})
    assert toolbar.message == "Opened b.toml."
    shared_actions.handle({"action": "read", "text": "Opened b.toml."})
    assert toolbar.message == "" and toolbar.notes == ["a.toml: no"]
    shared_actions.handle({"action": "dismiss"})
    assert toolbar.notes == []


@pytest.mark.usefixtures("quick")
def test_settings_too_long_for_a_link(actions: Actions) -> None:
    many = [1.0 + i / 100 for i in range(3000)]
    actions.store.change("vibration.psd.frequency", many)
    assert not actions.toolbar.has_link and actions.toolbar.query == ""
    actions.handle({"action": "unlinked"})
    assert "save the scenario" in actions.toolbar.notes[0]


def test_csv(shown: RunResults) -> None:
    text = data_csv(shown).decode()
    head = [line for line in text.splitlines() if line.startswith("#")]
    assert from_toml("\n".join(line[1:].strip() for line in head)) == shown.scenario
    names, *lines = text.splitlines()[len(head) :]
    columns = np.loadtxt(io.StringIO("\n".join(lines)), delimiter=",", unpack=True)
    table = dict(zip(names.split(","), columns, strict=True))
    record, estimate = shown.result.record, shown.result.estimate("gpr-online", "vibration")
    assert estimate is not None and columns.shape == (1 + 2 * (6 + len(shown.result.estimates)), record.n_steps)
    np.testing.assert_allclose(table["time_s"], np.arange(record.n_steps) * 1e-3, rtol=1e-8)
    for name, values in (
        ("truth/turbulence", record.turbulence),
        ("y_lgs", record.y_lgs),
        ("y_ngs", record.y_ngs),
        ("u", record.u),
        ("gpr-online/vibration", estimate.values),
    ):
        assert values is not None
        for i, mode in enumerate(("tip", "tilt")):
            np.testing.assert_allclose(table[f"{name}/{mode}_um"], values[:, i], rtol=1e-8)


def test_csv_is_a_record(shown: RunResults) -> None:
    """What was saved is observed again, to nine digits."""
    later = replace(shown, result=replace(shown.result, record=replace(shown.result.record, delay=3)))
    assert read_record(io.BytesIO(data_csv(later)), "wfsobs.csv").delay == 3
    record = read_record(io.BytesIO(data_csv(shown)), "wfsobs.csv")
    kept = shown.result.record
    assert (record.dt, record.ratio) == (kept.dt, kept.ratio)
    for name in ("y_lgs", "u", "y_ngs", "turbulence", "vibration"):
        np.testing.assert_allclose(getattr(record, name), getattr(kept, name), rtol=1e-8)


def test_npz_is_a_record_and_its_estimates(shown: RunResults, tmp_path: Path) -> None:
    path = tmp_path / "wfsobs.npz"
    path.write_bytes(data_npz(shown))
    record = load_record(path)
    np.testing.assert_array_equal(record.y_lgs, shown.result.record.y_lgs)
    with np.load(path, allow_pickle=False) as file:
        assert from_toml(str(file["scenario"])) == shown.scenario
        for estimate in shown.result.estimates:
            np.testing.assert_array_equal(file[f"{estimate.observer}/{estimate.target}"], estimate.values)
    config = tmp_path / "scenario.toml"
    with np.load(path, allow_pickle=False) as file:
        config.write_text(str(file["scenario"]), encoding="utf-8")
    result = CliRunner().invoke(main, ["observe", str(path), "--config", str(config), "--out", str(tmp_path / "e.npz")])
    assert result.exit_code == 0, result.output
    with np.load(path, allow_pickle=False) as file, np.load(tmp_path / "e.npz", allow_pickle=False) as again:
        for name in again.files:
            np.testing.assert_allclose(again[name], file[name], rtol=1e-9, atol=1e-12)


def test_the_page_tells_of_a_long_run(loop: Any, short: Scenario, enter: Any) -> None:
    dashboard = Dashboard(loop.queue.put, enter(), short)
    loop.closing.append(dashboard)
    dashboard.actions.open_link("?run.duration=300")
    dashboard.page()
    dashboard.start()
    assert dashboard.store.run.state == "idle" and dashboard.stale.visible
    expected = run_seconds(PRESETS["paper"]().replace({"run.duration": 300}))
    assert expected > 5 and dashboard.stale.object.startswith(f"About {expected:.0f} s") and "press Run" in dashboard.stale.object
