"""The base of the page's own components: parameters go down to the browser, messages come up."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import panel as pn
import param
from panel.custom import JSComponent


class Component(JSComponent):
    """A component of the page in JavaScript.

    on_message : gets the messages {name: value, ...} of the browser, and may change figures. Panel answers a message without the
    lock of the document while a changed property is on its way; held changes need none. Until the page has been drawn Panel drops
    held changes, so that messages wait.
    """

    __abstract = True

    def __init__(self, on_message: Callable[[dict[str, Any]], object] | None = None, **params: Any):
        self.on_message: Callable[[dict[str, Any]], object] = on_message or (lambda _message: None)
        super().__init__(**params)

    def _handle_msg(self, data: object) -> None:
        if isinstance(data, dict):
            answer = partial(self._answer, data)
            answer() if pn.state.loaded else pn.state.onload(answer)

    def _answer(self, message: dict[str, Any]) -> None:
        with pn.io.hold():
            self.on_message(message)


class HtmlComponent(Component):
    """A component whose contents are HTML that is made here."""

    __abstract = True

    html: param.String[str] = param.String("", doc="What is in it.")
