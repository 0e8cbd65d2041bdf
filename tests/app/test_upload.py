"""A visitor's record: sent in parts, previewed, confirmed, in place of the simulation until it is taken back."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from wfsobs.app import upload as module
from wfsobs.app.dashboard import Dashboard
from wfsobs.app.limits import Limits
from wfsobs.app.render import number
from wfsobs.app.service import Service
from wfsobs.app.session_file import LARGEST
from wfsobs.app.upload import SILENT
from wfsobs.pipeline import observe
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS, paper
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.formats import format_of
from wfsobs.telemetry.records import TEMPLATE, read_record, record_arrays


def file_of(short: Scenario, ending: str = ".csv", **changes: Any) -> bytes:
    record = simulate(short.replace({"run.seed": 9, "run.duration": 1.5, "sensors.lgs_rate": 500.0}))
    file = io.BytesIO()
    format_of(ending).write(file, record_arrays(replace(record, **{"turbulence": None, "vibration": None} | changes)))
    return file.getvalue()


def sent(dashboard: Dashboard, content: bytes, name: str = "night.csv", part: int = 50_000) -> None:
    count = max(1, -(-len(content) // part))
    for i in range(count):
        data = content[i * part : (i + 1) * part]
        dashboard.upload.handle({"action": "part", "name": name, "index": i, "count": count, "data": data})


def previewed(dashboard: Dashboard, loop: Any, content: bytes, name: str = "night.csv") -> None:
    sent(dashboard, content, name)
    loop.until(lambda: not dashboard.upload.picker.message.startswith(("Reading", "Waiting")))


@pytest.mark.usefixtures("quick")
def test_what_was_refused_before_is_not_said_once_a_record_is_used(dashboard: Dashboard, loop: Any, short: Scenario) -> None:
    dashboard.upload.handle({"action": "scenario", "name": "broken.toml", "text": "[run"})
    loop.until(lambda: dashboard.actions.toolbar.notes)
    assert dashboard.actions.toolbar.notes[0].startswith("broken.toml: ")
    previewed(dashboard, loop, b"time_s,a\n0,1\n", "none.csv")
    previewed(dashboard, loop, file_of(short))
    dashboard.upload.confirm()
    assert dashboard.actions.toolbar.notes == [] and dashboard.upload.picker.message == ""


def test_a_record_takes_the_place_of_the_simulation(dashboard: Dashboard, loop: Any, short: Scenario) -> None:
    content = file_of(short)
    before = dashboard.store.run.result
    previewed(dashboard, loop, content)
    assert "750 steps at 500 Hz, 1.5 s, 0 missing" in dashboard.upload.content.text.html and dashboard.upload.room.visible
    assert dashboard.store.run.result is before  # nothing runs before it is confirmed
    dashboard.upload.confirm()
    loop.finish(dashboard.store)
    shown = dashboard.store.run.result
    assert dashboard.store.run.state == "done", dashboard.store.run.message
    scenario = dashboard.store.scenario
    assert (scenario.sensors.lgs_rate, scenario.run.duration, scenario.run.warm_up) == (500.0, 1.5, pytest.approx(0.3))
    assert not dashboard.store.stale and not dashboard.upload.room.visible
    expected = observe(read_record(io.BytesIO(content), "night.csv"), scenario)
    assert [(s.observer, s.target, s.mode, s.rms) for s in shown.result.scores] == [
        (s.observer, s.target, s.mode, s.rms) for s in expected.scores
    ]
    table = dashboard.explore.table.html()
    assert "Next measurement, tip, with the mean over each NGS frame from the NGS where the record has one" in table
    assert "Residual, tip, what the recorded loop left" in table
    assert "nan" not in table
    line = dashboard.explore.traces.traces["vibration"].source.data
    assert np.isfinite(line["kf-lgs"]).all() and np.isnan(line["truth"]).all()
    spectrum = dashboard.explore.spectra.spectra["vibration"].sources["kf-lgs"].data
    assert len(spectrum["y"]) and np.isfinite(spectrum["y"]).all()
    assert (
        dashboard.explore.spectra.spectra["vibration"].marks["peaks"].data_source.data["x"] == []
    )  # of the settings, not of the record
    assert ">peaks<" not in dashboard.explore.rooms["vibration"][0].html
    cards = dashboard.explore.strips["vibration"].items()
    notes, values = ({card["name"]: card[key] for card in cards} for key in ("note", "value"))
    found = {s.observer: number(1e3 * s.rms) for s in expected.scores if s.mode == "tip"}
    assert "truth" not in values and found["loop"] not in values.values(), "what the recorded loop left is no prediction error"
    assert values["kf-lgs"] == found["kf-lgs"] and values["gpr-online"] == "–"
    dashboard.history.compare(dashboard.history.current)
    pinned = dashboard.explore.table.html()
    rows = re.findall(r"<tr data-observer.*?</tr>", pinned)
    assert len(rows) == len(found) and all('"range">+0.0 %</span>' in row for row in rows)
    least = min(x.rms for x in expected.scores if x.mode == "tip")
    assert pinned.count("tag smallest") == sum(x.rms == least for x in expected.scores if x.mode == "tip")
    assert dashboard.explore.strips["vibration"].cards.heads["value"] == "Prediction error [nm]"
    assert re.fullmatch(r"\d\.\d+", notes["kf-lgs"]) and notes["gpr-online"] == "no truth"
    assert notes["butterworth-ol"] in ("no result", "no truth")
    dashboard.display.show = "error"  # there is none, and nothing breaks
    assert not any(s.calibration for s in expected.scores), "of the mean over an NGS frame none states a deviation"
    assert pinned.count("it predicts no sigma of this error") == len(found)
    assert "The record has no truth" in dashboard.explore.verdicts["vibration"].pane.html
    faint = [
        figures["vibration"].faint.source for figures in (dashboard.explore.traces.traces, dashboard.explore.spectra.spectra)
    ]
    assert all(len(source.data["xs"]) for source in faint), "signals beside signals"

    dashboard.upload.handle({"action": "simulate"})
    loop.finish(dashboard.store)
    assert dashboard.store.run.result.result.record.turbulence is not None and dashboard.upload.picker.source_title == ""
    assert not any(len(source.data["xs"]) for source in faint), "and none beside errors"


@pytest.mark.usefixtures("quick")
def test_a_preset_beside_a_record_keeps_its_rate_and_length(dashboard: Dashboard, loop: Any, short: Scenario) -> None:
    """And what the simulation had comes back, of the preset, and of a record that the history gave back."""
    previewed(dashboard, loop, file_of(short))
    dashboard.upload.confirm()
    loop.finish(dashboard.store)
    key = dashboard.history.current
    dashboard.store.choose("ut4")
    it = dashboard.store.scenario
    assert (it.sensors.lgs_rate, it.run.duration, dashboard.store.preset) == (500.0, 1.5, "ut4") and it.run.warm_up < 1.5
    dashboard.store.simulate()
    assert dashboard.store.scenario == PRESETS["ut4"]()
    dashboard.store.choose("paper")
    dashboard.store.change("run.duration", 3.0)
    dashboard.history.restore(key)
    assert dashboard.store.scenario.run.duration == 1.5
    dashboard.store.simulate()
    assert dashboard.store.scenario.run.duration == 3.0 and dashboard.store.scenario.sensors.lgs_rate == 1000.0


@pytest.mark.usefixtures("quick")
def test_a_record_of_one_mode_offers_no_other(dashboard: Dashboard, loop: Any, short: Scenario) -> None:
    dashboard.display.mode = "tilt"
    record = simulate(short.replace({"run.seed": 9}))
    np.savez(file := io.BytesIO(), y_lgs=record.y_lgs[:, :1], u=record.u[:, :1], dt=record.dt)
    previewed(dashboard, loop, file.getvalue(), "one.npz")
    assert "1 mode, in um" in dashboard.upload.content.text.html
    dashboard.upload.confirm()
    loop.finish(dashboard.store)
    assert dashboard.display.mode == "tip" and dashboard.modes.buttons.options == {"Tip": "tip"}
    dashboard.actions.handle({"action": "view", "query": "view.mode=tilt"})  # back in the browser
    assert dashboard.display.mode == "tip" == dashboard.modes.buttons.value
    dashboard.store.simulate()
    loop.finish(dashboard.store)
    assert dashboard.display.mode == "tilt" == dashboard.modes.buttons.value


@pytest.mark.usefixtures("quick")
def test_settings_change_what_runs_on_the_record(dashboard: Dashboard, loop: Any, short: Scenario) -> None:
    previewed(dashboard, loop, file_of(short))
    dashboard.upload.confirm()
    loop.finish(dashboard.store)
    first = dashboard.store.run.result.result
    dashboard.store.change("kalman.vibration_rms", 0.2)
    loop.finish(dashboard.store)
    second = dashboard.store.run.result.result
    np.testing.assert_array_equal(first.record.y_lgs, second.record.y_lgs)
    assert first.scores[0].rms != second.scores[0].rms


@pytest.mark.usefixtures("quick")
def test_what_is_said_of_it(dashboard: Dashboard, loop: Any, short: Scenario) -> None:
    content = file_of(short).replace(b"_um", b"").replace(b"# unit: um\n", b"").replace(b"# command_sign: 1\n", b"")
    content = content.replace(b"# delay: 2\n", b"")
    previewed(dashboard, loop, content)
    plain = dashboard.upload._preview.rms["z"]
    for widget, value in (
        (dashboard.upload.fields.unit, "nm"),
        (dashboard.upload.fields.sign, -1),
        (dashboard.upload.fields.delay, "3"),
    ):
        widget.value = value
        loop.until(lambda: not dashboard.upload.picker.message.startswith(("Reading", "Waiting")))
    found = dashboard.upload._preview
    assert found.record.origin == "unit nm, command sign -1" and found.record.delay == 3
    assert found.rms["y_lgs"][0] < 1e-2 * plain[0]
    dashboard.upload.fields.unit.value = "mas"
    loop.until(lambda: not dashboard.upload.picker.message.startswith(("Reading", "Waiting")))
    on_eight = dashboard.upload._preview.rms["y_lgs"][0]
    dashboard.store.change("telescope.diameter", 10.0)
    loop.until(lambda: "aperture 10 m" in dashboard.upload.content.text.html)
    assert dashboard.upload._preview.rms["y_lgs"][0] == pytest.approx(1.25 * on_eight)
    dashboard.upload.fields.delay.value = "soon"
    assert dashboard.upload.picker.message == "Delay of commands [steps] = 'soon': takes a number from 1 to 1e+06"
    assert dashboard.upload.use.disabled
    dashboard.upload.fields.delay.value = ""
    loop.until(lambda: not dashboard.upload.picker.message.startswith(("Reading", "Waiting")))
    assert not dashboard.upload.use.disabled and dashboard.upload.fields.unit.value != SILENT


def test_what_is_said_of_the_mirror(shared: Dashboard, shared_loop: Any, short: Scenario) -> None:
    """A measurement alone is a record in open loop; of commands, parts of a step, a gain and a rail can be said."""
    content = file_of(short).replace(b"# delay: 2\n", b"")
    previewed(shared, shared_loop, content)
    fields = shared.upload.fields
    for widget, value in ((fields.delay, "1.5"), (fields.gain, "1.2"), (fields.rail, "0.1"), (fields.trust, True)):
        widget.value = value
        shared_loop.until(lambda: not shared.upload.picker.message.startswith(("Reading", "Waiting")))
    found = shared.upload._preview
    assert re.fullmatch(r"\d+ commands beyond the rail of 0\.1, delay 1\.5, command gain 1\.2", found.record.origin)
    assert np.abs(found.record.u).max() == pytest.approx(0.12)
    assert "a command is seen 1.5 steps later" in shared.upload.content.text.html
    fields.open_loop.value = True
    shared_loop.until(lambda: not shared.upload.picker.message.startswith(("Reading", "Waiting")))
    assert not shared.upload._preview.record.u.any() and not shared.upload.use.disabled
    previewed(shared, shared_loop, content)
    assert "a command is seen 2 steps later" in shared.upload.content.text.html, "what was said of the file before is gone"
    assert not fields.trust.value and shared.upload._preview.record.u.any()


def test_a_statement_that_is_refused_leaves_the_preview(shared: Dashboard, shared_loop: Any, short: Scenario) -> None:
    """The refusal names the field that would take it, not the option of a command."""
    previewed(shared, shared_loop, file_of(short))
    shown = shared.upload.content.text.html
    shared.upload.fields.delay.value = "3"
    shared_loop.until(lambda: "3 is stated" in shared.upload.picker.message)
    assert shared.upload.picker.message.endswith("delay is 2, but 3 is stated; “Trust sign and delay as stated” takes that")
    assert shared.upload.content.text.html == shown and shared.upload.content.figure.visible and shared.upload.use.disabled
    previewed(shared, shared_loop, b"seeing,airmass\n1,2\n", "log.csv")
    assert "seen" not in shared.upload.content.text.html and not shared.upload.content.figure.visible


@pytest.mark.usefixtures("quick")
def test_a_vibration_spectrum(dashboard: Dashboard, loop: Any) -> None:
    """10 um^2/Hz over 1 Hz about 30 Hz on tip, nothing on tilt; without a unit it is asked for."""
    rows = "29.4,0,0\n29.5,10,0\n30.5,10,0\n30.6,0,0\n"
    previewed(dashboard, loop, f"frequency,tip,tilt\n{rows}".encode(), "lines.csv")
    assert dashboard.upload.picker.message.startswith("lines.csv: has no unit of tip")
    assert "unit" not in dashboard.upload.content.text.html, "it is said once"
    dashboard.upload.fields.unit.value = "nm"
    loop.until(lambda: not dashboard.upload.picker.message.startswith(("Reading", "Waiting")))
    assert "4 frequencies from 29.4 to 30.6 Hz" in dashboard.upload.content.text.html and "3.317 nm rms of tip, 0 nm" in (
        dashboard.upload.content.text.html
    )
    assert dashboard.upload.use.label == "Use this spectrum"
    dashboard.upload.confirm()
    loop.finish(dashboard.store)
    vibration = dashboard.store.scenario.vibration
    assert vibration.source == "psd" and dashboard.store.source is None
    assert vibration.psd.tip == pytest.approx([0.0, 1e-5, 1e-5, 0.0], rel=1e-12)
    assert dashboard.store.run.result.result.record.vibration.std(axis=0) == pytest.approx([np.sqrt(1.1e-5), 0.0], rel=0.02)
    previewed(dashboard, loop, b"seeing,airmass\n1,2\n", "log.csv")
    assert dashboard.upload.picker.message.startswith("log.csv: has no y_lgs")


NAMES = {"wfs_x": "y_lgs/tip_um", "wfs_y": "y_lgs/tilt_um", "dm_x": "u/tip_um", "dm_y": "u/tilt_um"}


def renamed(content: bytes) -> bytes:
    """The same file with columns of other names, and silent on its unit, sign and delay."""
    for name, own in NAMES.items():
        content = content.replace(own.encode(), name.encode())
    for line in (b"# unit: um\n", b"# command_sign: 1\n", b"# delay: 2\n"):
        content = content.replace(line, b"")
    return content


@pytest.mark.usefixtures("quick")
def test_columns_of_other_names(dashboard: Dashboard, loop: Any, short: Scenario) -> None:
    """Names that say enough are read at once; a choice moves a role; the copy names the columns."""
    content = renamed(file_of(short, training=None))
    previewed(dashboard, loop, content)
    loop.until(lambda: not dashboard.upload.picker.message)
    form = dashboard.upload.form
    assert form is not None and form.view.visible and form.view in dashboard.upload.room.objects
    wanted = {own.removesuffix("_um"): name for name, own in NAMES.items()}
    wanted |= {f"y_ngs/{mode}": f"y_ngs/{mode}_um" for mode in ("tip", "tilt")}  # names of a record suggest what they say
    assert form.roles == wanted
    assert "750 steps at 500 Hz" in dashboard.upload.content.text.html

    form.choices["y_lgs/tip"].value = "wfs_y"
    loop.until(lambda: "has the modes tip, tilt; y_lgs has tip" in dashboard.upload.picker.message)
    assert form.roles["y_lgs/tip"] == "wfs_y" and "y_lgs/tilt" not in form.roles and dashboard.upload.use.disabled
    form.choices["y_lgs/tilt"].value = "wfs_x"
    loop.until(lambda: not dashboard.upload.picker.message)
    assert form.roles == wanted | {"y_lgs/tip": "wfs_y", "y_lgs/tilt": "wfs_x"}
    dashboard.upload.confirm()
    loop.finish(dashboard.store)
    record = read_record(io.BytesIO(file_of(short)), "a.csv")
    shown = dashboard.store.run.result.result.record
    np.testing.assert_array_equal(shown.y_lgs, record.y_lgs[:, ::-1])
    assert "--column y_lgs/tip=wfs_y" in dashboard.actions.toolbar.command
    assert "columns={" in dashboard.actions.toolbar.python and not form.view.visible
    previewed(dashboard, loop, file_of(short))
    assert not form.view.visible and dashboard.upload._preview is not None, "the next file has names of its own"


def test_the_data_propose_sign_and_delay(shared: Dashboard, shared_loop: Any, short: Scenario) -> None:
    """A loop of sign -1 and delay 3, written out, in a file that says nothing of either."""
    rng = np.random.default_rng(4)
    k = np.arange(6000)[:, None]
    disturbance = np.sin(2 * np.pi * k / [400.0, 300.0])
    y, u = 0.2 * rng.standard_normal(disturbance.shape) + disturbance, np.zeros_like(disturbance)
    for i in range(3, len(y)):
        y[i] -= u[i - 3]
        u[i] = 0.99 * u[i - 1] + 0.3 * y[i]
    file = io.BytesIO()
    np.savez(file, y_lgs=y, u=u, dt=np.array(1e-3))
    previewed(shared, shared_loop, file.getvalue(), "night.npz")
    text = shared.upload.content.text.html
    assert "command sign +1 is excluded by the data" in text and "explain" not in text, "the response has whole frames alone"
    assert "unit proposed: the numbers are plausible as um (" in text, "on 8 m an arcsec would be 10 um"
    assert shared.upload.take.visible and shared.upload._preview.record.delay == 2
    shared.upload.fields.trust.value = True
    shared_loop.until(lambda: shared.upload._preview is not None and not shared.upload.take.visible)
    assert not shared.upload.use.disabled, "what is trusted is not proposed to be otherwise"
    shared.upload.fields.trust.value = False
    shared_loop.until(lambda: shared.upload.take.visible)
    shared.upload.take_proposals()
    shared_loop.until(lambda: shared.upload._preview is not None and not shared.upload.take.visible)
    found = shared.upload._preview
    assert found.record.delay == 3 and found.record.origin == "command sign -1"
    # the disturbance and the noise of one sample are all that is left of z
    assert found.rms["z"][0] == pytest.approx(np.sqrt(0.5 + 0.04), rel=0.02)
    assert "sign −1: commands move with the measurement" in shared.upload.content.text.html, "of the file, however it is read"


def test_a_record_whose_unit_nobody_knows_waits_for_it(shared: Dashboard, shared_loop: Any) -> None:
    """Of 200 nm rms in um on 8 m as well as in urad, and the same in nm, which nobody would take for um."""
    rng, upload = np.random.default_rng(5), shared.upload
    for scale, right, plausible in ((0.2, "um", True), (200.0, "nm", False)):
        file = io.BytesIO()
        np.savez(file, y_lgs=scale * rng.standard_normal((3000, 2)), u=np.zeros((3000, 2)), dt=np.array(1e-3))
        previewed(shared, shared_loop, file.getvalue(), "night.npz")
        assert upload.use.disabled and "Choose the unit first" in upload.missing.html
        assert ("plausible as um or" in upload.missing.html) == plausible and right in upload.missing.html
        upload.confirm()
        assert shared.store.source is None
        upload.fields.unit.value = right
        shared_loop.until(lambda: not upload.use.disabled)
        assert upload.missing.html == "" and upload._preview is not None
        assert upload._preview.rms["z"][0] == pytest.approx(0.2, rel=0.05)  # 1 / sqrt(2 N) = 1.3 %
        upload.fields.unit.value = SILENT
        upload.discard()


def test_template_and_sample(shared: Dashboard, shared_loop: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[dict[str, Any]] = []
    monkeypatch.setattr(shared.actions.toolbar, "_send_msg", sent.append)
    for count, what in enumerate(("template", "sample"), 1):
        shared.upload.handle({"action": what})
        shared_loop.until(lambda count=count: len(sent) == count)
    files = {it["name"]: it["content"] for it in sent}
    template = read_record(io.BytesIO(files["wfsobs-template.csv"]), "t.csv")
    assert (template.n_steps, template.ratio, template.delay, template.missing) == (6, 5, 2, 1)
    np.testing.assert_allclose(template.y_ngs[5], [0.0089, -0.0016])
    record = read_record(io.BytesIO(files["wfsobs-sample.csv"]), "s.csv")
    np.testing.assert_array_equal(record.u, simulate(paper().replace({"run.duration": 5.0})).u)
    assert record.turbulence is not None and len(files["wfsobs-sample.csv"]) < LARGEST


@pytest.mark.usefixtures("quick")
def test_a_scenario_that_is_dropped(dashboard: Dashboard, loop: Any) -> None:
    dashboard.upload.handle({"action": "scenario", "name": "a.toml", "text": "run.seed = 77\nrun.duration = 2.0"})
    loop.until(lambda: dashboard.store.scenario.run.seed == 77)


def test_what_is_no_record(shared: Dashboard, shared_loop: Any) -> None:
    before = shared.store.run.result
    for content, name, line in (
        (b"hello", "a.npz", "a.npz: not an .npz file"),
        (b"", "a.csv", "a.csv: is empty"),
        (b"# nothing", "a.csv", "a.csv: holds no table"),
        (b"x", "<b>.exe", "_b_.exe: its name ends in none of"),
    ):
        previewed(shared, shared_loop, content, name)
        assert shared.upload.picker.message.startswith(line)
        assert "<b>.exe" not in shared.upload.content.text.html
        shared.upload.confirm()
        assert shared.store.source is None and shared.store.run.result is before


def test_nothing_of_the_file_before_stays_after_a_refusal(
    shared: Dashboard, shared_loop: Any, short: Scenario, subtests: pytest.Subtests
) -> None:
    upload, file = shared.upload, file_of(short)
    refusals: list[dict[str, Any]] = [
        {"action": "large", "name": "a.npz"},
        {"action": "part", "name": "a.npz", "index": 0, "count": 1, "data": "%%%"},
        {"action": "part", "name": "a.npz", "index": 0, "count": 1, "data": b""},
        {"action": "part", "name": "a.npz", "index": 0, "count": 1, "data": bytes(3)},
    ]
    for refused in refusals:
        with subtests.test(str(refused)):
            previewed(shared, shared_loop, file)
            assert upload.room.visible and not upload.use.disabled
            upload.handle(refused)
            shared_loop.until(lambda: not upload.picker.message.startswith(("Reading", "Waiting")))
            assert upload.picker.message.startswith("a.npz") or "choose the file again" in upload.picker.message
            assert not upload.room.visible or ("night.csv" not in upload.content.text.html and upload.use.disabled)
            upload.confirm()
            assert shared.store.source is None


def test_a_record_that_is_too_short_cannot_be_used(shared: Dashboard, shared_loop: Any) -> None:
    """The template as it is: six steps."""
    previewed(shared, shared_loop, TEMPLATE.encode(), "template.csv")
    upload = shared.upload
    assert upload.use.disabled and "Duration = 0.006: takes a number from 0.1" in upload.missing.html
    upload.confirm()
    assert shared.store.source is None


def test_parts_that_make_no_sense(shared: Dashboard, monkeypatch: pytest.MonkeyPatch) -> None:
    upload = shared.upload
    for msg in (
        {"index": 0, "count": 0, "data": bytes(3)},
        {"index": 0, "count": "x", "data": b""},
        {"index": 0, "count": 1, "data": "%%%"},
        {"index": 0, "count": 1, "data": None},
        {"index": 0},
    ):
        upload.handle({"action": "part", "name": "a.csv", **msg})
        assert upload.picker.message == "The upload is incomplete: choose the file again." and upload._content == b""
    upload.handle({"action": "large", "name": "../x.csv"})
    assert upload.picker.message == f"x.csv: larger than {LARGEST // 1_000_000} MB"
    monkeypatch.setattr(module, "LARGEST", 1000)
    sent(shared, bytes(3000), part=400)
    assert upload._content == b"" and upload.picker.message == "night.csv: larger than 0 MB"


def test_reading_is_bounded_on_a_server_with_limits(dashboard: Dashboard, loop: Any, short: Scenario) -> None:
    service = dashboard.store.session.service
    for limits, line in ((Limits(steps=100), "The record has 750 steps; at most 100"), (Limits(seconds=0.0), "more than 0 s")):
        service.limits = limits
        previewed(dashboard, loop, file_of(short))
        assert line in dashboard.upload.picker.message and dashboard.upload.use.disabled


@pytest.mark.usefixtures("quick")
def test_on_a_server_with_limits(loop: Any, short: Scenario) -> None:
    """The line of runs and the limits hold for records as well, and nobody gets the results of another's."""
    service = Service(Limits(duration=2.0), 1, 100_000_000)
    try:
        boards = []
        for seed in (1, 2):
            board = Dashboard(loop.queue.put, service.enter(), short)
            loop.closing.append(board)
            record = simulate(short.replace({"run.seed": seed}))
            previewed(board, loop, file_of(short, y_lgs=record.y_lgs[:750]), "same.csv")
            board.upload.confirm()
            loop.finish(board.store)
            boards.append(board.store.run.result.result)
        assert not np.array_equal(boards[0].record.y_lgs, boards[1].record.y_lgs)
        assert boards[0].scores[0].rms != boards[1].scores[0].rms
        long = simulate(short.replace({"run.duration": 2.5}))
        previewed(board, loop, file_of(short, **{k: getattr(long, k) for k in ("y_lgs", "u", "y_ngs", "open_loop_y")}))
        board.upload.confirm()
        assert "run.duration = 5: at most 2 s on this server" in board.upload.picker.message
        np.testing.assert_array_equal(board.store.run.result.result.record.y_lgs, boards[1].record.y_lgs)
    finally:
        service.close()
