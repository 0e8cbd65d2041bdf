"""The page of the live loop: a job that goes on until it is stopped, true to the loop, at rest while hidden."""

from __future__ import annotations

import re
import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bokeh.document import Document
from bokeh.models import ColumnDataSource
from bokeh.plotting import figure

from tests.patience import ENOUGH, is_running, wait
from wfsobs.app.dashboard import Dashboard
from wfsobs.app.jobs import FAILED, RUNNING, Job
from wfsobs.app.limits import NONE
from wfsobs.app.live_work import record_saves
from wfsobs.app.pages.live import LivePage, events_html, peaks_html, ranking
from wfsobs.app.pages.live_figures import LiveMarks
from wfsobs.app.pages.pages import EXPLORE, LIVE
from wfsobs.app.render import number
from wfsobs.app.serve import opens_on_live
from wfsobs.app.service import IDLE, Service
from wfsobs.app.sources import LoadedRecord
from wfsobs.app.store import Store
from wfsobs.app.style import look
from wfsobs.app.views.plots import new_figure
from wfsobs.live.board import NEXT, SHARED, SharedView
from wfsobs.live.finding import Change, Finding, MinuteSpectrum, PeakFinding
from wfsobs.live.loop import LiveLoop, LiveOrder
from wfsobs.live.ring import Recorder, Ring
from wfsobs.live.simulated import SimulatedLoop
from wfsobs.live.source import ALARM, LiveEvent
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.stepping import sampling_of
from wfsobs.telemetry.records import load_record


@pytest.fixture
def page(dashboard: Dashboard) -> LivePage:
    dashboard.pages.current = LIVE
    page = dashboard.pages.by_name[LIVE]
    assert isinstance(page, LivePage)
    page.controls.running.value = ["kf-multi", "gp-both"]
    page.controls.controllers.value = ["none", "integrator"]
    return page


def begin(page: LivePage, loop: Any) -> LiveLoop:
    page.buttons["Start"].param.trigger("clicks")
    loop.until(lambda: page.loop is not None)
    live = page.loop
    assert live is not None
    wait(lambda: live.count > 400)
    return live


@pytest.mark.usefixtures("quick")
def test_a_loop_from_start_to_the_end_of_the_session(page: LivePage, dashboard: Dashboard, loop: Any) -> None:
    assert page.picture is None and page.loop is None and not page.draw(), "nothing before it is asked for"
    live = begin(page, loop)
    assert page.draw() and page.picture is not None
    assert set(live.board.active()) == {"kf-multi", "gp-both"}
    page.buttons["Pause"].param.trigger("clicks")
    wait(lambda: not live.is_playing and live.count == live.newest)
    assert (page.buttons["Pause"].label, page.buttons["Pause"].icon) == ("Play", "play_arrow")
    page.draw()
    view = live.view(page.controls.window.value)
    best, rms = ranking(view, live.board.active(), "turbulence", 0)[0]
    assert rms == pytest.approx(np.sqrt(np.mean(view.error(best, "turbulence")[:, 0] ** 2)), rel=1e-12)
    rows = re.findall(r'data-name="([^"]+)".*?</tr>', page.picture.table.html, re.S)
    assert rows[0] == best and number(1e3 * rms) in page.picture.table.html
    assert f"{live.count} frames · 0 lost" in page.status.html
    assert f"{live.count * 0.001:.1f} s" in page.status.html
    check_controllers(page, live)
    # a change in the drawer is one in the loop; what it cannot take is said
    dashboard.store.change("turbulence.wind_speed", 20.0)
    dashboard.store.change("sensors.exposure_ratio", 10)
    wait(lambda: any("Wind speed" in event.line for event in live.events))
    assert live.scenario.turbulence.wind_speed == 20.0 and live.scenario.sensors.exposure_ratio == 5
    page.draw()
    assert "modes and rates cannot change" in page.picture.news.html and "Wind speed" in page.picture.news.html
    # the page is left, the loop goes on; the session ends, nothing is left
    page.show(False)
    assert not page.draw() and page.work.state == RUNNING
    pids = [process.pid for process in live._processes.processes]
    assert len(pids) == 5 and all(map(is_running, pids))
    dashboard.store.session.leave()
    wait(lambda: not any(map(is_running, pids)))


def check_controllers(page: LivePage, live: LiveLoop) -> None:
    """In the table: rms of the last seconds in the unit, Strehl of both modes; and a detector beside that of the star."""
    assert page.picture is not None
    wait(lambda: (left := live.control_view(1.0)) is not None and left.first + len(left.residual("integrator")) == live.newest)
    rms = seen(page, live, "integrator")
    page.controls.whose.value = "none"
    assert page.controls.names_to_design == ["none"]
    mas = 4e-6 / 8.0 * np.degrees(1.0) * 3.6e6  # per micrometre of a Noll tip on 8 m
    lost = (2 * np.pi / 2.2) ** 2 * np.sum(rms**2)
    for unit, scale in (("mas", mas), ("nm", 1e3)):
        page.display.unit = unit
        page.draw()
        assert f"Residual [{unit}]" in page.picture.control_table.html
        cells = re.findall(r'data-controller="integrator".*?</tr>', page.picture.control_table.html, re.S)[0]
        assert all(f"<td>{value}</td>" in cells for value in (number(scale * rms[0]), f"{np.exp(-lost):.4f}"))
    assert len(page.picture.stars.row) == 2 and set(live.controllers) == {"none", "integrator"}
    page.controls.controllers.value = ["integrator"]
    assert live.controllers == {"integrator"} and page.controls.names_to_design is None, "who runs no more is not designed anew"


def seen(page: LivePage, live: LiveLoop, controller: str) -> Any:
    left = live.control_view(page.controls.window.value)
    return np.array([np.nan]) if left is None else left.rms(controller)


def test_pages_share_what_was_read_a_moment_ago(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the same window, while the loop plays, until the next picture is due."""
    now, shared = [5.0], SharedView()
    read: list[float] = []
    monkeypatch.setattr("wfsobs.live.board.monotonic", lambda: now[0])

    def look(seconds: float, *, anew: bool = False) -> int:
        view: Any = read.append
        shared.look(view, seconds, anew=anew)
        return len(read)

    assert [look(2.0), look(2.0)] == [1, 1]
    assert look(5.0) == 2 and read[-1] == 5.0, "another window"
    assert look(5.0, anew=True) == 3
    end = SHARED * (now[0] // SHARED + 1)
    now[0] = end - 1e-3
    assert look(5.0) == 3, "pages that are late with this picture"
    now[0] = end + 1e-3
    assert look(5.0) == 4 and look(5.0) == 4


def test_pictures_wait_for_the_browser(page: LivePage, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[int] = []
    monkeypatch.setattr(page, "draw", lambda: drawn.append(1) is None)
    page.tick()
    assert not drawn, "nothing before the page stands"
    page.pulse._handle_msg({"painted": 0})
    page.tick()
    page.tick()
    page.tick()
    assert len(drawn) == 1 and page.pulse.picture == 1, "a page that sleeps is sent nothing more"
    page.pulse._handle_msg({"painted": 1})
    assert len(drawn) == 2 and page.pulse.picture == 2, "the one that has waited for the answer"
    page.pulse._handle_msg({"painted": 2})
    assert len(drawn) == 2, "none has waited"
    page.tick()
    assert len(drawn) == 3
    page.pulse._handle_msg({"painted": "x"})
    assert not page.pulse.is_free


def test_changes_between_two_pictures_are_all_sent(page: LivePage, monkeypatch: pytest.MonkeyPatch) -> None:
    """A change of the unit draws at once, and the next picture soon after; what the first one has changed may not come again."""
    fig, doc, sent = figure(), Document(), list[Any]()
    source = ColumnDataSource({"x": [0.0]})
    for model in (fig, source):
        doc.add_root(model)
    monkeypatch.setattr(page.pulse, "_send_msg", sent.append)
    pulse = page.pulse
    page.pulse._handle_msg({"painted": 0})
    for act in (
        lambda: pulse.draw(fig, source, {"x": np.array([1.0])}),
        lambda: pulse.move(fig, fig.x_range, start=2.0),
        lambda: pulse.draw(fig, source, {"x": np.array([3.0])}),
    ):
        act()
        pulse.flush()
    page.pulse.beat()
    told = [(step[1], step[4], numbers.tolist()) for it in sent[:-1] for [step], numbers in [it["changes"]]]
    assert told == [(source.id, [], [1.0]), (fig.x_range.id, [["start", 2.0]], []), (source.id, [], [3.0])]
    assert sent[-1] == {"picture": page.pulse.picture}, "the answer is to what came before"


def test_one_place_is_kept_for_jobs_that_end() -> None:
    service = Service(NONE, 2, 1000)
    running, end = threading.Semaphore(0), threading.Event()

    def work(watch: Any, _tell: Any) -> None:
        running.release()
        while not end.wait(0.01):
            watch.check()

    done = threading.Event()
    leave = [service.queue.submit(Job("live", work, endless=True), owner, lambda _: None) for owner in (1, 2)]
    assert running.acquire(timeout=ENOUGH)
    service.queue.submit(Job("run", lambda *_: done.set()), 3, lambda _: None)
    assert done.wait(ENOUGH), "a run is done beside"
    assert service.queue.running == 1 and service.queue.length == 1
    leave[0]()
    assert running.acquire(timeout=ENOUGH), "the second loop takes the place of the first"
    leave[1]()
    assert service.close(20)


def test_one_job_at_once_is_too_few(page: LivePage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page.store.session.service.queue, "_threads", [])
    page.start()
    assert page.work.state == FAILED and "--runs 2" in page.status.html


def test_pages_open_with_the_settings_of_the_loop_that_all_watch(loop: Any, enter: Any) -> None:
    """So that a change in the drawer changes that one setting alone."""
    session = enter()
    scenario = PRESETS["night"]().replace({"sensors.lgs_rate": 500.0})
    session.service.live = LiveOrder(SimulatedLoop(scenario), scenario, (), preset="night")
    store = Store(loop.queue.put, session)
    loop.closing.append(store)
    assert store.scenario == scenario and store.preset == "night" and store.changed_paths() == ["sensors.lgs_rate"]


def test_a_page_that_opens_on_live_has_its_first_run_when_another_page_needs_it(loop: Any, enter: Any) -> None:
    """Until then the modes of the settings are offered, in place of those of a run."""
    scenario = PRESETS["higher-orders"]().replace({"run.duration": 1.0, "run.warm_up": 0.2})
    runs: list[Any] = []
    dashboard = Dashboard(loop.queue.put, enter(lambda asked, *_: runs.append(asked)), PRESETS["paper"]())
    loop.closing.append(dashboard)
    dashboard.store.rests = True
    dashboard.page()
    dashboard.pages.current = LIVE
    dashboard.start()
    dashboard.store.load(scenario)
    assert dashboard.store.run.state == IDLE
    modes = [mode.name for mode in scenario.modes]
    assert list(dashboard.modes.list.options.values()) == modes and len(modes) > 2 and dashboard.modes.list.visible
    dashboard.display.mode = modes[3]
    dashboard.pages.current = EXPLORE
    loop.finish(dashboard.store)
    assert runs == [scenario] and dashboard.display.mode == modes[3]
    dashboard.pages.current = LIVE
    dashboard.store.change("turbulence.wind_speed", 21.0)  # from now on as everywhere
    loop.finish(dashboard.store)
    assert len(runs) == 2


@pytest.mark.parametrize(
    ("query", "is_shared", "is_live"),
    [
        ("", False, False),
        ("", True, True),
        ("?theme=dark", True, True),
        ("?view.page=live", False, True),
        ("?preset=ut4&view.page=live", True, True),
        ("?view.page=explore", True, False),
    ],
)
def test_which_page_an_address_opens_with(query: str, is_shared: bool, is_live: bool) -> None:
    assert opens_on_live(query, is_shared) == is_live


@pytest.mark.usefixtures("quick")
def test_a_record_that_is_loaded_is_played(page: LivePage, dashboard: Dashboard, loop: Any) -> None:
    """Without NGS frames and without truth: those that need them do not run, and the errors are of the next measurement."""
    scenario = dashboard.store.scenario
    made = simulate(scenario)
    record = Record(y_lgs=made.y_lgs, u=made.u, dt=made.dt)
    dashboard.store.run_on(LoadedRecord(record, "mine", "key"), scenario)
    page.controls.running.value = ["kf-multi", "multirate"]
    live = begin(page, loop)
    assert live.source.name == "record" and live.board.active() == ["kf-multi"]
    wait(lambda: live.count > 450)
    view = live.view(0.1)
    np.testing.assert_array_equal(view.frames.z, made.z[view.first : view.first + view.n])
    assert page.draw() and page.picture is not None and "kf-multi" in page.picture.table.html
    c = page.controls
    assert [f.disabled for f in (c.lasers, c.ngs, c.losses, c.target, c.speed)] == [True, True, True, True, False]
    assert c.target.value == NEXT
    page.work.cancel()


@pytest.mark.parametrize("kind", ["NPZ", "AOT"])
def test_a_recording_is_saved_as_a_record_that_is_read(kind: str, short: Scenario, tmp_path: Any) -> None:
    """The file has the frames that the ring had, to the last digit."""
    rows, ring = np.random.default_rng(1).normal(size=(300, 11)), Ring(2)
    rows[:, 5:7] = 0.0
    rows[np.arange(300) % short.sensors.exposure_ratio > 0, 3:5] = np.nan
    for row in rows:
        ring.send(row)
    loop: Any = SimpleNamespace(recorder=Recorder(ring, sampling_of(short), lambda _: None, is_simulated=True))
    loop.newest, loop.scenario = ring.count, short
    loop.recorder.start(120.0)
    loop.recorder.stop(short)
    saves = record_saves(loop, 120.0)
    for what in ("Recording", "Last two minutes"):
        save = saves[f"{what} as {kind}"]
        assert save is not None
        (tmp_path / save.name).write_bytes(save.content())
        record = load_record(tmp_path / save.name, short)
        np.testing.assert_allclose(record.z, rows[:, 1:3], atol=1e-12)
        if kind == "NPZ":  # an AOT has no truth
            np.testing.assert_array_equal(record.truth("vibration"), rows[:, 9:11])
    ring.release()


def finding(*frequencies: float, level: float = 1e-6) -> Finding:
    """Return a minute with peaks at these frequencies, found there and in its spectrum."""
    density = np.full((29_999, 2), level)
    density[[round(60 * f) - 1 for f in frequencies]] += 0.02**2 * 60.0
    peaks = tuple(PeakFinding(f, 0.02, 0.0, 0.02) for f in frequencies)
    return Finding(peaks, (0.02, 0.02), {}, MinuteSpectrum(1.0 / 60.0, density))


def test_the_table_of_peaks_says_how_far_each_has_moved() -> None:
    def moves(*minutes: Finding) -> list[str]:
        html = peaks_html(Change(minutes), 1e3, "nm")
        rows = re.findall(r"<tr data.*?</tr>|<tr><th.*?</tr>", html.partition("<tbody>")[2], re.S)
        return [re.findall(r"<td[^>]*>(.*?)</td>", row)[1] for row in rows if "<td" in row]

    assert peaks_html(None, 1e3, "nm") == ""
    assert moves(finding(17.25, 47.5)) == ["–", "–"]
    assert moves(finding(17.25, 50.5), finding(17.20, 47.5, 73.0)) == ["−0.05", "−3.00", "new"]
    before = finding(17.25, 50.5, 73.0)
    assert moves(before, finding(17.246, 50.506, 73.0)) == ["0", "+0.01", "0"]
    # as strong as before, and not found then
    assert moves(replace(before, peaks=before.peaks[:2]), finding(17.246, 50.506, 73.0)) == ["0", "+0.01", "–"]


def test_alarms_stand_out_in_the_list_of_events() -> None:
    html = events_html([LiveEvent(1000, "wind 20 m/s"), LiveEvent(2000, "noise up", detail=": 3 < 4", kind=ALARM)], 1e-3)
    lines = ["<li>2.00 s: <strong>ALARM noise up: 3 &lt; 4</strong></li>", "<li>1.00 s: wind 20 m/s</li>"]
    assert re.findall("<li>.*?</li>", html) == lines


@pytest.mark.parametrize("name", ["kf-multi", "lqg-kf-multi", "none"])
@pytest.mark.parametrize(
    ("what", "kind", "line"),
    [
        ("{} off", "", "NAME off"),
        ("error of {} up", ALARM, "ALARM error of NAME up: 3 nm"),
        ("over: error of {}", "", "over: error of NAME"),
        ("identified for {}", "", "identified for NAME: 3 nm"),
    ],
)
def test_events_name_what_runs_as_the_page_does_and_as_the_log_does(name: str, what: str, kind: str, line: str) -> None:
    event = LiveEvent(0, what, name, ": 3 nm" if "3 nm" in line else "", kind=kind)
    assert event.line == line.replace("NAME", name)
    assert line.replace("NAME", look(name).label) in events_html([event], 1e-3)


def test_words_of_events_in_the_traces_do_not_cover_each_other() -> None:
    fig = new_figure()
    events = [LiveEvent(frame, f"event {frame}") for frame in (1600, 1000, 1200, 1300, 5000)]
    LiveMarks(fig).draw(events, 1e-3, 0.25)
    (source,) = {renderer.data_source for renderer in fig.renderers}
    assert source.data == {"x": [1.0, 1.2, 1.3, 1.6, 5.0], "line": ["event 1000", "", "event 1300", "event 1600", "event 5000"]}
