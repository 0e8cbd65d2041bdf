"""The connection to the browser: answers its questions whether anybody is there, and takes what it kept while nobody was."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from uuid import uuid4

import param

from wfsobs.app.component import Component
from wfsobs.app.style import asset

MOST = 1000
"""Changes that are taken at once."""


class Connection(Component):
    """The banner in the browser: questions {ask} and unsent changes {changes} up, the last question that has arrived down."""

    session = param.String("", doc="A name of the session, to tell it from one made anew.")
    last_arrival = param.Integer(0, doc="Number of the last question that has arrived, and all before it.")

    _esm = asset("connection.js")
    _stylesheets = [asset("connection.css")]

    def __init__(self, take: Callable[[dict[str, Any]], None], **params: Any):
        """Connect a page. take : makes a change again that did not arrive."""
        self._take = take
        super().__init__(self._hear, session=uuid4().hex, **params)

    def _hear(self, data: dict[str, Any]) -> None:
        if isinstance(data.get("ask"), int):
            self.last_arrival = data["ask"]
        changes = data.get("changes")
        for change in changes[:MOST] if isinstance(changes, list) else []:
            if isinstance(change, dict):
                self._take(change)
