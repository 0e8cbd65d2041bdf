"""What is copied of a page does what the page does: the command in a shell, the script as it is, both compared with the page."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import shlex
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.jobs import RUNNING
from wfsobs.app.pages.closed_loop import ClosedLoopPage
from wfsobs.app.pages.identify import IdentifyPage
from wfsobs.app.pages.sweep import SweepPage
from wfsobs.app.pages.tune import TunePage
from wfsobs.app.share import LOOP, OBSERVE, TUNE, CopiedTask, from_query, to_command
from wfsobs.app.sources import LoadedRecord, SimulatedRecord
from wfsobs.app.work import RunResults
from wfsobs.cli import main
from wfsobs.closed_loop.run import rows
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.identification.identification import identification_dict, identification_toml
from wfsobs.record import RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.formats import format_of
from wfsobs.telemetry.records import load_record, record_arrays
from wfsobs.tuning.tuning import tuning_dict

CLOSE = 1e-6
"""Another process may add up in another order, which the GPR magnify; numbers are printed with all digits."""
SIMULATED, LOADED, KEPT = "simulated", "loaded", "kept"
FILE = "the night's record.npz"


def file_of(short: Scenario) -> bytes:
    """A record in nm whose commands are taken off after 3 steps, which does not say so, nor its rate; it has its truth."""
    record = simulate(short.replace({"run.seed": 9}))
    arrays = record_arrays(record)
    for name in ("unit", "command_sign", "delay", "dt"):
        del arrays[name]
    arrays |= {name: 1e3 * values for name, values in arrays.items() if values.ndim == 2}
    arrays |= {name: -np.roll(arrays[name], -1, axis=0) for name in ("u", "training_u")}
    file = io.BytesIO()
    format_of(".npz").write(file, arrays)
    return file.getvalue()


@pytest.fixture
def short(short: Scenario) -> Scenario:
    """All that is copied runs three times: a short record of few peaks."""
    peaks = [peak.to_dict() for peak in short.vibration.peaks[-8:]]
    return short.replace({"run.duration": 1.2, "run.warm_up": 0.3, "adaptive.window": 0.3, "vibration.peaks": peaks})


@pytest.fixture(params=[SIMULATED, LOADED, KEPT])
def board(request: Any, loop: Any, short: Scenario, tmp_path: Path, monkeypatch: Any) -> Dashboard:
    """A dashboard on a record of every source, its files in the current folder; all run on that of the settings."""
    monkeypatch.chdir(tmp_path)
    if request.param != SIMULATED:
        request.getfixturevalue("quick")
    dashboard: Dashboard = request.getfixturevalue("dashboard")
    simulation = short.replace({"run.duration": 6.0} if request.function is test_tune else {})  # a tuning cuts it in three
    if request.param == LOADED:
        content = file_of(simulation)
        upload = dashboard.upload
        upload.handle({"action": "part", "name": FILE, "index": 0, "count": 1, "data": content})
        for widget, value in (
            (upload.fields.unit, "nm"),
            (upload.fields.sign, -1),
            (upload.fields.delay, "3"),
            (upload.fields.rate, "1000"),
        ):
            widget.value = value
        loop.until(lambda: upload._preview is not None)
        upload.confirm()
        assert isinstance(dashboard.store.source, LoadedRecord), upload.picker.message
        (tmp_path / dashboard.store.source.name).write_bytes(content)
        loop.until(lambda: dashboard.store.run.state != RUNNING, 120)
    if request.param == KEPT:
        told = simulation.replace({"turbulence.wind_speed": 11.0, "vibration.peaks": [{"frequency": 33.0}]})
        dashboard.store.run_on(SimulatedRecord(simulation), told)
        loop.until(lambda: dashboard.store.run.state != RUNNING, 120)
    return dashboard


@pytest.fixture
def columns(dashboard: Dashboard, loop: Any, short: Scenario, tmp_path: Path, monkeypatch: Any) -> Dashboard:
    """A dashboard on a record whose columns have names that say nothing, as they are chosen in the form."""
    monkeypatch.chdir(tmp_path)
    record = simulate(short.replace({"run.seed": 9}))
    names = {"y_lgs/tip": "a", "y_lgs/tilt": "b 2", "u/tip": "it's c", "u/tilt": "$d"}
    table = np.column_stack([record.y_lgs, record.u]).tolist()
    text = "\n".join([",".join(names.values()), *(",".join(map(repr, row)) for row in table)])
    upload, content = dashboard.upload, text.encode()
    upload.handle({"action": "part", "name": "odd.csv", "index": 0, "count": 1, "data": content})
    loop.until(lambda: upload.form is not None and upload.form.view.visible)
    for role, name in names.items():
        upload.form.choices[role].value = name
    upload.fields.rate.value = "1000"
    loop.until(lambda: upload._preview is not None)
    upload.confirm()
    (tmp_path / "odd.csv").write_bytes(content)
    loop.until(lambda: dashboard.store.run.state != RUNNING, 120)
    source = dashboard.store.source
    assert isinstance(source, LoadedRecord) and source.declaration.columns == names
    return dashboard


def in_shell(command: str) -> str:
    """What commands print, split into words as a shell does it."""
    out = ""
    for one in command.split("&&"):
        program, *words = shlex.split(one)
        assert program == "wfsobs"
        done = CliRunner().invoke(main, words, catch_exceptions=False)
        assert done.exit_code == 0, f"{command}\n{done.stderr}"
        out += done.stdout
    return out


def shell(dashboard: Dashboard) -> Any:
    """What the command that is copied prints as JSON."""
    return json.loads(in_shell(f"{dashboard.actions.toolbar.command} --json").splitlines()[-1])


def script(dashboard: Dashboard) -> dict[str, Any]:
    """The names that the script leaves."""
    made: dict[str, Any] = {}
    exec(dashboard.actions.toolbar.python, made)
    return made


def of(dashboard: Dashboard) -> RunResults:
    shown = dashboard.store.run.result
    assert shown is not None
    return shown


def test_explore(board: Dashboard) -> None:
    shown = {(s.observer, s.target, s.mode): s.rms for s in of(board).result.scores}
    if board.store.source is not None:  # who observes a record does not know what it is bound by
        shown = {key: value for key, value in shown.items() if key[0] not in BOUNDS}
    assert {(r["observer"], r["target"], r["mode"]): r["rms_um"] for r in shell(board)} == pytest.approx(shown, rel=CLOSE)
    made = script(board)
    assert {(s.observer, s.target, s.mode): s.rms for s in made["result"].scores} == pytest.approx(shown, rel=CLOSE)


def test_columns_that_were_chosen(columns: Dashboard) -> None:
    """Without truth: the errors of predictions of the next measurement."""
    shown = {(s.observer, s.target, s.mode): s.rms for s in of(columns).result.scores}
    assert len(shown) > 10
    assert {(r["observer"], r["target"], r["mode"]): r["rms_um"] for r in shell(columns)} == pytest.approx(shown, rel=CLOSE)
    made = script(columns)
    assert {(s.observer, s.target, s.mode): s.rms for s in made["result"].scores} == pytest.approx(shown, rel=CLOSE)


def test_closed_loop(board: Dashboard, loop: Any) -> None:
    board.pages.current = "loop"
    page = board.pages.by_name["loop"]
    assert isinstance(page, ClosedLoopPage)
    loop.until(lambda: page.results is not None and page.results.complete, 120)
    assert page.results is not None

    def residuals(given: Any) -> dict[tuple[str, str], float]:
        return {(r["controller"], r["mode"]): r["residual_rms_nm"] for r in given if r["residual_rms_nm"] is not None}

    expected = residuals(page.results.rows)
    assert len(expected) > 10
    assert residuals(shell(board)) == pytest.approx(expected, rel=CLOSE)
    assert residuals(rows(script(board)["result"], None)) == pytest.approx(expected, rel=CLOSE)


@pytest.mark.usefixtures("quick")
def test_identify(board: Dashboard, loop: Any) -> None:
    board.pages.current = "identify"
    page = board.pages.by_name["identify"]
    assert isinstance(page, IdentifyPage)
    page.level.value, page.lowest.value = "0.4", "8"
    page.starter.begin()
    loop.until(lambda: page.work.state != RUNNING, 120)
    expected = identification_dict(page.work.result[0])
    for found in (shell(board), identification_dict(script(board)["found"])):
        assert [[p["frequency"] for p in m["peaks"]] for m in found["modes"]] == [
            pytest.approx([p["frequency"] for p in m["peaks"]], rel=CLOSE) for m in expected["modes"]
        ]
        assert [m["noise"] for m in found["modes"]] == pytest.approx([m["noise"] for m in expected["modes"]], rel=CLOSE)


@pytest.mark.usefixtures("quick")
def test_tune(board: Dashboard, loop: Any) -> None:
    board.pages.current = "tune"
    page = board.pages.by_name["tune"]
    assert isinstance(page, TunePage)
    page.observer.value, page.evaluations.value = "kf-lgs", "4"
    page.starter.begin()
    loop.until(lambda: page.work.state != RUNNING, 120)
    expected = tuning_dict(page.work.result)
    for found in (shell(board), tuning_dict(script(board)["tuned"])):
        assert found["settings"] == pytest.approx(expected["settings"], rel=CLOSE)
        for stage in ("before", "after"):
            assert found[stage]["test_um"] == pytest.approx(expected[stage]["test_um"], rel=CLOSE)


@pytest.mark.parametrize(
    "over", [{"turbulence.wind_speed": "5,20"}, {"turbulence.wind_speed": "5,20", "kalman.damping": "0.01,0.1"}]
)
def test_sweep(dashboard: Dashboard, loop: Any, tmp_path: Path, monkeypatch: Any, over: dict[str, str]) -> None:
    monkeypatch.chdir(tmp_path)
    dashboard.pages.current = "sweep"
    page = dashboard.pages.by_name["sweep"]
    assert isinstance(page, SweepPage)
    (first, values), *second = over.items()
    page.axes[0].select.value, page.axes[1].select.value = first, ""
    page.axes[0].values.value, page.seeds.value = values, "1" if second else "2"
    for path, values in second:
        page.axes[1].select.value = path
        page.axes[1].values.value = values
    page.starter.begin()
    loop.until(lambda: page.work.state != RUNNING, 240)
    assert page.results is not None
    expected = page.results.rows()
    assert len(expected) > 20 * 2 ** len(over)
    in_shell(f"{dashboard.actions.toolbar.command} --csv sweep.csv")
    saved = page.saves()["Sweep as CSV"]
    assert saved is not None
    on_page = list(csv.DictReader(io.StringIO(saved.content().decode())))
    for found in (list(csv.DictReader((tmp_path / "sweep.csv").read_text().splitlines())), on_page):
        assert [list(row) for row in found] == [list(row) for row in expected]
        for row, shown in zip(found, expected, strict=True):
            for name, value in shown.items():
                is_number = isinstance(value, float)
                assert (float(row[name]) if is_number else row[name]) == (
                    pytest.approx(value, rel=CLOSE) if is_number else ("" if value is None else str(value))
                )
    for row, shown in zip(script(dashboard)["results"].rows(), expected, strict=True):
        assert row == {name: pytest.approx(v, rel=CLOSE) if isinstance(v, float) else v for name, v in shown.items()}


@pytest.mark.usefixtures("quick")
def test_a_link_has_the_simulation_that_is_kept(dashboard: Dashboard, loop: Any, short: Scenario) -> None:
    store = dashboard.store
    simulation = short.replace({"run.seed": 4, "vibration.peaks": [{"frequency": 20.0}, {"frequency": 30.0}]})
    store.run_on(SimulatedRecord(simulation), short.replace({"turbulence.wind_speed": 11.0}))
    link = from_query(dashboard.actions.toolbar.query)
    assert (link.scenario, link.simulation, link.errors) == (store.scenario, simulation, ())
    store.load(short)
    assert "simulation" not in dashboard.actions.toolbar.query
    dashboard.actions.open_link("?preset=paper&run.duration=2&simulation&simulation.run.duration=2&simulation.loop.gain=9")
    assert isinstance(store.source, type(None)), "what is refused leaves the same settings"
    dashboard.actions.open_link("?run.duration=2&simulation.run.duration=2&simulation.run.seed=3")
    assert isinstance(store.source, SimulatedRecord) and store.source.simulation.run.seed == 3 and store.scenario.run.seed != 3


def test_another_file_of_the_same_name_is_refused(tmp_path: Path, short: Scenario) -> None:
    content = file_of(short)
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    record = LoadedRecord(simulate(short), "a.npz", "key", sha256=hashlib.sha256(content + b".").hexdigest())
    assert f"--sha256 {record.sha256}" in to_command(short, "paper", record)
    with pytest.raises(RecordError, match=r"a\.npz: is another file: its SHA-256 is [0-9a-f]{64}, not [0-9a-f]{64}$"):
        load_record(path, sha256=record.sha256)


def test_names_that_are_no_words_of_a_shell() -> None:
    for name in ("a b.npz", "-x.npz", "$(touch x).npz", "it's.npz"):
        source = LoadedRecord(simulate(PRESETS["paper"]().replace({"run.duration": 1.2})), name, "key")
        for task in (CopiedTask(OBSERVE), CopiedTask(LOOP), CopiedTask(TUNE, {"observer": "kf-lgs"})):
            command = to_command(PRESETS["paper"](), "paper", source, task)
            words = subprocess.run(f"printf '%s\\n' {command}", shell=True, capture_output=True, text=True)
            assert f"./{name}" in words.stdout.splitlines() or name in words.stdout.splitlines()
            assert "-x.npz" not in words.stdout.splitlines()


@pytest.fixture
def sent(dashboard: Dashboard, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    out: list[dict[str, Any]] = []
    monkeypatch.setattr(dashboard.actions.toolbar, "_send_msg", out.append)
    return out


def saved(dashboard: Dashboard, loop: Any, sent: list[dict[str, Any]]) -> dict[str, bytes]:
    """Every file of the page shown, by name."""
    del sent[:]
    names = dashboard.actions.toolbar.saves
    for name in names:
        dashboard.actions.handle({"action": "page", "key": name})
    loop.until(lambda: len(sent) == len(names))
    return {file["name"]: file["content"] for file in sent}


@pytest.mark.usefixtures("quick")
def test_what_pages_have_found_is_saved(dashboard: Dashboard, loop: Any, sent: list[dict[str, Any]]) -> None:
    assert dashboard.actions.toolbar.saves == []
    dashboard.pages.current = "identify"
    dashboard.actions.handle({"action": "page", "key": "Model as TOML"})
    assert dashboard.actions.toolbar.notes == ["Model as TOML: there is none yet."]
    page: Any = dashboard.pages.by_name["identify"]
    page.starter.begin()
    loop.until(lambda: page.work.state != RUNNING, 120)
    files = saved(dashboard, loop, sent)
    result = page.work.result[0]
    assert files["wfsobs-model.toml"].decode() == identification_toml(result, result.scenario(dashboard.store.scenario))

    dashboard.pages.current = "tune"
    page = dashboard.pages.by_name["tune"]
    page.observer.value, page.evaluations.value = "kf-lgs", "3"
    page.starter.begin()
    loop.until(lambda: page.work.state != RUNNING, 120)
    files = saved(dashboard, loop, sent)
    table = [*csv.DictReader(io.StringIO(files["wfsobs-tuning.csv"].decode()))]
    test = {r["name"]: float(r["after"]) for r in table if r["section"] == "test"}
    assert test == {**page.work.result.after.test.modes, "rms over modes": page.work.result.after.test.rms}
    assert tomllib.loads(files["wfsobs-tuned.toml"].decode()) == page.work.result.scenario.to_dict()

    dashboard.pages.current = "loop"
    page = dashboard.pages.by_name["loop"]
    loop.until(lambda: page.results is not None and page.results.complete, 120)
    files = saved(dashboard, loop, sent)
    table = [*csv.DictReader(io.StringIO(files["wfsobs-controllers.csv"].decode()))]
    assert [(r["controller"], r["mode"], r["residual_rms_nm"]) for r in table] == [
        (r["controller"], r["mode"], "" if r["residual_rms_nm"] is None else str(r["residual_rms_nm"])) for r in page.results.rows
    ]
    outcomes = {o.controller: o.residual for o in page.results.result.outcomes if o.residual is not None}
    head, *lines = [x for x in files["wfsobs-residuals.csv"].decode().splitlines() if not x.startswith("#")]
    assert {name.partition("/")[0] for name in head.split(",")[1:]} == outcomes.keys()
    column = head.split(",").index("integrator/tilt_um")
    np.testing.assert_allclose([float(x.split(",")[column]) for x in lines], outcomes["integrator"][:, 1], rtol=1e-8)
    dashboard.pages.current = "explore"
    assert dashboard.actions.toolbar.saves == []
