"""What a server does before its first visitor comes: a page that nobody sees, and the run that every page starts with."""

from __future__ import annotations

import contextlib

from bokeh.document import Document
from panel.io.document import _cleanup_doc
from panel.io.state import set_curdoc

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.service import Service
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.errors import SettingError


def warm_up(service: Service) -> None:
    """Make a page, so that the first visitor does not wait for what is only loaded once, and have the first run begin."""
    with contextlib.suppress(SettingError):  # more than is allowed here
        service.queue.submit(service.run(PRESETS[next(iter(PRESETS))]()), "server", lambda _news: None)
    doc = Document()
    with set_curdoc(doc):
        dashboard = Dashboard(lambda function: function(), service.new_session())
        dashboard.page().server_doc(doc)
        dashboard.complete()
        doc.to_json()
    _cleanup_doc(doc)
