"""Text that is written anew several times a second."""

from __future__ import annotations

from typing import Any

import panel as pn

from wfsobs.app.pages.parts import WIDE
from wfsobs.app.style import asset


class LiveText(pn.pane.HTML):
    """HTML of which only the text is sent when it changes: as a usual pane does, all else is looked at, for milliseconds."""

    def _update(self, ref: str, model: Any) -> None:
        model.text = self._transform_object(self.object)["object"]


def live_text() -> LiveText:
    """Make one in the page's style."""
    return LiveText("", **WIDE, stylesheets=[asset("style.css")])
