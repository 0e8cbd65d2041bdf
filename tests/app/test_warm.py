"""What a server has ready for its first visitor, and how large the first page is."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
from bokeh.document import Document
from panel.io.state import set_curdoc

from tests.patience import wait
from wfsobs.app.dashboard import Dashboard
from wfsobs.app.limits import NONE
from wfsobs.app.service import Service
from wfsobs.app.work import compute
from wfsobs.scenario import Scenario

MODELS = 200
"""The most that the first picture may be made of."""


@pytest.fixture
def service() -> Iterator[Service]:
    service = Service(NONE, 2, 100_000_000, compute)
    yield service
    service.close(20.0)


def test_the_first_picture_comes_with_the_page_and_is_made_of_little(service: Service, short: Scenario) -> None:
    """Results that are known are drawn before anybody is told of the page; the settings and what is further down come later."""
    done: list[str] = []
    service.queue.submit(service.run(short), "before", lambda news: done.append(news.get("state", "")))
    wait(lambda: "done" in done)
    doc = Document()
    with set_curdoc(doc):
        posted: list[Callable[[], None]] = []
        dashboard = Dashboard(posted.append, service.enter(), short)
        page = dashboard.page()
        dashboard.start()
        posted.pop(0)()  # as the page's poster does
        page.server_doc(doc)
        first = list(doc.models)
        assert len(first) < MODELS
        lines = [m for m in first if m.__class__.__name__ == "GlyphRenderer" and m.name == "kf-lgs"]
        assert len(lines) == 2 and all(len(line.data_source.data["x"]) > 100 for line in lines)
        dashboard.complete()
        assert len([m for m in doc.models if m.__class__.__name__ == "GlyphRenderer" and m.name == "kf-lgs"]) == 4
        assert dashboard.controls.preset.label in [getattr(m, "label", "") for m in doc.models]
    dashboard.store.session.leave()
