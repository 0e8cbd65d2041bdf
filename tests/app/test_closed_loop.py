"""The page of the closed loop: what it computes and when, true to the core, at rest while hidden."""

from __future__ import annotations

import re
from functools import partial
from threading import Event
from time import sleep
from typing import Any

import numpy as np
import pytest

from wfsobs.app import loop_work
from wfsobs.app.dashboard import Dashboard
from wfsobs.app.display import per_micrometre
from wfsobs.app.jobs import CANCELLED, DONE
from wfsobs.app.pages.closed_loop import CURVES, ClosedLoopPage
from wfsobs.app.pages.pages import EXPLORE, LOOP
from wfsobs.app.style import look
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.envelope import plant_envelope
from wfsobs.closed_loop.run import closed_loop, label, rows
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.scores import BOUNDS, COMMON_BOUNDS
from wfsobs.signal.envelope import envelope


def opened(dashboard: Dashboard) -> ClosedLoopPage:
    dashboard.pages.current = LOOP
    page = dashboard.pages.by_name[LOOP]
    assert isinstance(page, ClosedLoopPage)
    return page


def done(page: ClosedLoopPage, loop: Any) -> ClosedLoopPage:
    """The page once all controllers have run on the results shown."""
    of = page.run.result
    assert of is not None
    loop.until(lambda: page.results is not None and page.results.complete and page.results.result.scenario is of.scenario)
    loop.until(lambda: page.work.state == DONE)
    return page


def top(page: ClosedLoopPage) -> float:
    """How far the axis of the residuals reaches."""
    return float(page.trace.figure.y_range.end)  # type: ignore[attr-defined]


@pytest.fixture
def page(dashboard: Dashboard, loop: Any) -> ClosedLoopPage:
    return done(opened(dashboard), loop)


def test_it_says_what_the_command_says(page: ClosedLoopPage, dashboard: Dashboard) -> None:
    of = dashboard.store.run.result
    assert of is not None and page.results is not None
    expected = rows(closed_loop(of.result.record, design(of.scenario)), of.scenario.run.seed)
    assert list(page.results.rows) == expected
    cards = {card["name"]: card for card in page.cards.items}
    assert list(cards) == list(CONTROLLERS)
    for row in (r for r in expected if r["mode"] == "tip" and r["controller"] not in BOUNDS):
        assert float(cards[row["controller"]]["value"]) == pytest.approx(row["residual_rms_nm"], rel=5e-3)
        assert f'data-controller="{row["controller"]}"' in page.table.html
    assert page.table.html.count("smallest</span>") == 1
    assert all(f'data-controller="{name}"' in page.table.html for name in COMMON_BOUNDS)
    assert page.margins.html.count("data-controller") == len(CURVES)
    assert page.note.html == ""
    the_lines_are_the_results(page, dashboard)
    page.trace.zoom(0.5)
    middle = 0.5 * (of.scenario.run.warm_up + 2.0)
    x = page.trace.sources["integrator"].data["x"]
    dt = of.result.record.dt  # a sample more at either side, so that a line runs to the edge
    assert (x[0], x[-1]) == (pytest.approx(middle - 0.25, abs=2 * dt), pytest.approx(middle + 0.25, abs=2 * dt))


def the_lines_are_the_results(page: ClosedLoopPage, dashboard: Dashboard) -> None:
    dashboard.display.param.update(mode="tilt", unit="mas")
    shown = page.results
    assert shown is not None
    scale = per_micrometre("mas", 8.0)
    start = round(shown.result.scenario.run.warm_up / shown.result.record.dt)
    for name, source in page.trace.sources.items():
        residual = shown.residual(name)
        assert residual is not None
        assert np.allclose(source.data["y"], scale * envelope(residual[start:, 1], 600), rtol=1e-6)
        density = shown.spectra[name][1][1:, 1]
        assert np.allclose(page.spectrum.sources[name].data["y"], scale**2 * density)
    for name in CURVES:
        L = np.array(page.nyquist.sources[name].data["x"]) + 1j * np.array(page.nyquist.sources[name].data["y"])
        E = 10 ** (np.array(page.response.sources[name].data["y"]) / 20)
        known = ~np.isnan(L)
        assert np.allclose(E[known], np.abs(1 / (1 + L[known])), rtol=1e-6)
    assert page.trace.figure.yaxis.axis_label == "residual tilt [mas]"


def test_the_lines_that_matter_come_first_until_others_are_chosen(page: ClosedLoopPage, dashboard: Dashboard) -> None:
    def shown() -> set[str]:
        return {name for name, line in page.trace.lines.items() if line.visible} - {"none"}

    def named() -> set[str]:
        return {name for name in CONTROLLERS if re.search(rf"[:.] {label(name)} [\d.]+ ", page.verdict.html)}

    def best(mode: str) -> str:
        rows = [r for r in page.results.rows if r["mode"] == mode and r["controller"] in page.trace.lines]
        return min(rows, key=lambda r: r["residual_rms_nm"])["controller"]

    assert shown() == named() >= {"integrator", "lqg-kf-lgs", best("tip")}
    spectra = [page.spectrum.sources[name].data["y"] for name in shown()]
    assert page.spectrum.figure.y_range.end == pytest.approx(3.0 * max(np.max(y) for y in spectra)), "no room for hidden ones"
    page.cards.hidden_lines = []
    dashboard.display.mode = "tilt"
    assert shown() == set(page.trace.lines) - {"none"}, "chosen lines stay"
    page.cards._handle_msg({"action": "main"})
    assert shown() == named() >= {"integrator", "lqg-kf-lgs", best("tilt")}


@pytest.mark.usefixtures("quick")
def test_marks_hiding_colours_and_reasons(page: ClosedLoopPage, dashboard: Dashboard) -> None:
    the_marks_lie_on_the_curves_where_the_margins_are(page)
    before = top(page)
    page.cards.hidden_lines = [name for name in CONTROLLERS if name != "lqg-multirate-multi"]
    assert not page.trace.lines["integrator"].visible and page.trace.lines["lqg-multirate-multi"].visible
    assert top(page) < before and not len(page.nyquist.marks.data["x"])
    dashboard.display.dark = True
    assert page.trace.lines["integrator"].renderer.glyph.line_color == look("integrator").dark
    page.work.refuse("the record has no truth")
    assert "No closed loop: the record has no truth" in page.note.html
    assert not page.cards.visible and page.results is None, "those of other results"


def the_marks_lie_on_the_curves_where_the_margins_are(page: ClosedLoopPage) -> None:
    marks = page.nyquist.marks.data
    assert set(marks["marker"]) == {"circle", "square"}
    points = np.array(marks["x"]) + 1j * np.array(marks["y"])
    L = np.concatenate([np.array(s.data["x"]) + 1j * np.array(s.data["y"]) for s in page.nyquist.sources.values()])
    for point, marker in zip(points, marks["marker"], strict=True):
        assert np.nanmin(np.abs(L - point)) < 0.05
        assert abs(point) == pytest.approx(1.0) if marker == "square" else -1.0 < point.real < 0.0 == point.imag


@pytest.mark.usefixtures("quick")
def test_it_follows_the_settings_while_it_is_seen(page: ClosedLoopPage, dashboard: Dashboard, loop: Any) -> None:
    dashboard.store.change("control.integrator", "manual")
    dashboard.store.change("control.gain", 1.5)
    loop.finish(dashboard.store)
    done(page, loop)
    assert page.table.html.count("unstable</span>") == sum("integrator" in name for name in CONTROLLERS)
    assert {c["note"] for c in page.cards.items if "integrator" in c["name"]} == {"unstable"}
    assert not len(page.trace.sources["integrator"].data["x"])
    dashboard.pages.current = EXPLORE
    before = page.results
    dashboard.store.change("control.gain", 0.5)
    loop.finish(dashboard.store)
    assert page.results is before
    done(opened(dashboard), loop)
    assert "unstable</span>" not in page.table.html


@pytest.mark.usefixtures("quick")
def test_it_comes_back_as_the_switches_are_by_then(page: ClosedLoopPage, dashboard: Dashboard) -> None:
    dashboard.pages.current = EXPLORE
    dashboard.display.param.update(mode="tilt", unit="mas")
    opened(dashboard)
    assert page.trace.figure.yaxis.axis_label == "residual tilt [mas]"


@pytest.mark.usefixtures("quick")
def test_more_modes_than_tip_and_tilt(page: ClosedLoopPage, dashboard: Dashboard, loop: Any) -> None:
    dashboard.store.load(dashboard.store.scenario.replace({"telescope.radial_order": 2, "run.duration": 0.7}))
    loop.finish(dashboard.store)
    done(page, loop)
    dashboard.display.mode = "defocus"
    assert page.trace.figure.yaxis.axis_label == "residual defocus [nm]"
    assert len(page.trace.sources["integrator"].data["x"]) > 100


def test_what_would_take_minutes_is_left_out(dashboard: Dashboard, loop: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    long = dashboard.store.scenario.replace({"run.duration": 60.0, "gpr_online.training_size": 2048})
    assert loop_work.seconds("integrator+gpr-online", long) > loop_work.PATIENCE
    assert loop_work.seconds("integrator+gpr-online", dashboard.store.scenario) < 1.0
    monkeypatch.setattr(loop_work, "PATIENCE", 0.1)
    page = done(opened(dashboard), loop)
    (card,) = [c for c in page.cards.items if c["name"] == "integrator+gpr-online"]
    assert card["note"].startswith("left out") and "integrator+gpr-online" not in page.table.html
    dashboard.store.session.leave()
    assert page.run.session.is_closed, "a session that ends takes its loop with it"


@pytest.mark.usefixtures("quick")
def test_an_uncertain_plant_adds_columns_a_sentence_and_a_figure(page: ClosedLoopPage, dashboard: Dashboard, loop: Any) -> None:
    box, envelope_of = page.uncertain, partial(plant_envelope, controllers=["integrator", "lqg-kf-lgs", "h2-fir"], points=6)
    assert "Worst [" not in page.table.html and not box.room.visible
    with pytest.MonkeyPatch.context() as m:
        m.setattr(loop_work, "plant_envelope", envelope_of)
        box.starter.start.clicks += 1
        loop.until(lambda: box.work.state == DONE)
    assert page.results is not None
    expected = envelope_of(page.results.result.scenario)
    assert box.work.result is not None and box.work.result.rows() == expected.rows()
    assert "Worst [nm]" in page.table.html and box.room.visible
    for line in expected.sentences(1e3, "nm", 0):
        assert line.replace("+-", "±").replace(" deg", "°") in page.verdict.html
    x, _, most = expected.curves("delay", 1)["integrator"]
    dashboard.display.param.update(mode="tilt", unit="mas")
    drawn = box.figure.sources["integrator"].data
    assert np.array_equal(drawn["x"], x)
    assert np.allclose(drawn["y"], per_micrometre("mas", 8.0) * most, equal_nan=True)
    dashboard.store.replace({"turbulence.wind_speed": 9.0})
    loop.until(lambda: page.run.result is not None and page.run.result.scenario.turbulence.wind_speed == 9.0)
    done(page, loop)
    assert box.work.result is None and not box.room.visible and "Worst [" not in page.table.html, "it was of other results"


@pytest.mark.usefixtures("quick")
def test_an_uncertain_plant_stops_when_told(page: ClosedLoopPage) -> None:
    begun, box = Event(), page.uncertain

    def endless(_scenario: Any, *, watch: Any, **_: Any) -> Any:
        begun.set()
        while True:
            watch.check()
            sleep(0.01)

    with pytest.MonkeyPatch.context() as m:
        m.setattr(loop_work, "plant_envelope", endless)
        box.starter.start.clicks += 1
        assert begun.wait(60.0)
        box.starter.cancel.clicks += 1
    assert box.work.state == CANCELLED and box.work.result is None
