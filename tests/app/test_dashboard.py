"""The page as a whole."""

from __future__ import annotations

import gc
import threading
import weakref
from typing import Any

import pytest
from bokeh.document import Document
from bokeh.models import ImportedStyleSheet
from panel.io.state import set_curdoc

from tests.app.conftest import compute_once
from wfsobs.app import dashboard as module
from wfsobs.app import service
from wfsobs.app.dashboard import Dashboard
from wfsobs.app.serve import session_page
from wfsobs.app.work import RunResults
from wfsobs.scenario import Scenario


def faded(dashboard: Dashboard) -> bool:
    return dashboard.frame.stale


def test_error_page(caplog: pytest.LogCaptureFixture) -> None:
    def build(post: Any) -> Dashboard:
        raise RuntimeError("<no> room")

    html = session_page(build)[0].object
    assert "could not be built" in html and "RuntimeError: &lt;no&gt; room" in html
    assert "no> room" in caplog.text


def test_a_page_that_cannot_be_assembled(monkeypatch: pytest.MonkeyPatch, loop: Any, short: Scenario, enter: Any) -> None:
    def broken(self: Dashboard) -> Any:
        raise ValueError("no page")

    monkeypatch.setattr(module.Dashboard, "page", broken)
    made: list[Dashboard] = []

    def build(post: Any) -> Dashboard:
        made.append(Dashboard(loop.queue.put, enter(), short))
        return made[0]

    assert "ValueError: no page" in session_page(build)[0].object
    assert made[0].store.run.state == "idle"
    made[0].store.session.leave()


def test_a_session_made_anew_needs_no_other_host(loop: Any, short: Scenario, enter: Any) -> None:
    """Where a browser connects so late that the page's session is gone, the next is made without its page."""
    doc = Document()
    with set_curdoc(doc):
        made: list[Dashboard] = []

        def build(post: Any) -> Dashboard:
            made.append(Dashboard(loop.queue.put, enter(), short))
            return made[0]

        session_page(build).server_doc(doc)
        addresses = {str(model.url) for model in doc.models if isinstance(model, ImportedStyleSheet)}
    made[0].store.session.leave()
    assert "static/extensions/panel/css/loading.css" in {address.partition("?")[0] for address in addresses}
    assert not [address for address in addresses if "//" in address]


@pytest.mark.usefixtures("quick")
def test_a_failing_run_shows_inline(loop: Any, short: Scenario, enter: Any) -> None:
    def work(scenario: Scenario, *how: Any) -> RunResults:
        if scenario.loop.gain == 0.1:
            raise RuntimeError("no *such* <luck>")
        return compute_once(scenario, *how)

    dashboard = Dashboard(loop.queue.put, enter(work), short)
    loop.closing.append(dashboard)
    dashboard.page()
    dashboard.start()
    loop.finish(dashboard.store)
    table = dashboard.explore.table.pane.html
    dashboard.store.change("loop.gain", 0.1)
    loop.finish(dashboard.store)
    assert dashboard.alert.visible and "<p>RuntimeError: no *such* &lt;luck&gt;</p>" == dashboard.alert.object
    assert dashboard.stale.visible and faded(dashboard)
    assert dashboard.explore.table.pane.html == table, "the last result stands"
    dashboard.store.change("loop.gain", 0.2)
    loop.finish(dashboard.store)
    assert not dashboard.alert.visible and not dashboard.stale.visible and not faded(dashboard)


@pytest.mark.usefixtures("quick")
def test_results_are_marked_stale_until_new_ones_land(loop: Any, short: Scenario, enter: Any) -> None:
    gate = threading.Event()

    def work(scenario: Scenario, *how: Any) -> RunResults:
        if scenario.loop.gain == 0.1:
            assert gate.wait(20)
        return compute_once(scenario, *how)

    dashboard = Dashboard(loop.queue.put, enter(work), short)
    loop.closing.append(dashboard)
    dashboard.page()
    dashboard.start()
    loop.finish(dashboard.store)
    dashboard.store.change("loop.gain", 0.1)
    assert faded(dashboard) and not dashboard.stale.visible, "no line while it runs"
    gate.set()
    loop.finish(dashboard.store)
    assert not faded(dashboard)


@pytest.mark.usefixtures("quick")
def test_done_is_said_of_what_stands_in_the_table(dashboard: Dashboard, loop: Any) -> None:
    status, table, seen = dashboard.controls.status, dashboard.explore.table, list[tuple[str, str]]()
    status.param.watch(lambda event: seen.append((event.new, table.pane.html)), "text")
    dashboard.store.change("turbulence.wind_speed", 31)
    loop.finish(dashboard.store)
    text, drawn = seen[-1]
    assert text.startswith("Done in") and drawn == table.html()


def test_the_page(dashboard: Dashboard) -> None:
    page = dashboard.page()
    assert page.title == "wfsobs" and page.sidebar and page.main
    page.dark_theme = True
    assert dashboard.display.dark


def test_the_theme_that_the_system_wants(dashboard: Dashboard, loop: Any) -> None:
    page, frame = dashboard.page(), dashboard.frame
    frame.wants_dark = True
    assert not page.dark_theme, "not before the page has been drawn"
    loop.until(lambda: page.dark_theme)
    assert dashboard.display.dark and not frame.preferred_theme, "the system's"
    page.dark_theme = False  # as the button does
    assert not dashboard.display.dark and frame.preferred_theme == "light" and frame.wants_dark


def test_importing_the_package_imports_no_panel() -> None:
    import subprocess
    import sys

    code = "import sys, wfsobs.app, wfsobs; assert not {'panel', 'bokeh', 'holoviews'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_session_that_has_ended_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch, short: Scenario, enter: Any) -> None:
    monkeypatch.setattr(service, "gc", gc)
    monkeypatch.setattr(gc, "unfreeze", lambda: None)  # of what was there before
    dashboard = Dashboard(lambda function: function(), enter(), short)
    page = dashboard.page()
    dashboard.store.session.leave()
    gone = weakref.ref(dashboard), weakref.ref(page)
    del dashboard, page
    gc.collect()
    assert [ref() for ref in gone] == [None, None]
