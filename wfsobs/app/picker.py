"""How a file comes from the browser: a button, and parts that are put together again."""

from __future__ import annotations

import base64
import binascii
from typing import Any

import param

from wfsobs.app.component import HtmlComponent
from wfsobs.app.render import render
from wfsobs.app.style import script, sheets
from wfsobs.telemetry.preview import safe_name

LARGEST = 20_000_000
"""Of a file [bytes]."""

PART = 1_000_000
"""Of what the browser sends at a time [bytes]."""


class Picker(HtmlComponent):
    """The button and what is said beside it; files up in parts."""

    message = param.String("", doc="What there is to say, in one line.")
    source_title = param.String("", doc="What takes the place of the simulation.")
    back = param.String("Back to the simulation", doc="What the button is called that ends it.")
    largest = param.Integer(LARGEST, doc="The largest file that is sent [bytes].")
    part = param.Integer(PART, doc="How much is sent at a time [bytes].")

    _esm = script("patch", "markup", "parts", "upload")
    _stylesheets = sheets("base", "upload")

    @param.depends("message", "source_title", "back", watch=True, on_init=True)
    def _draw(self) -> None:
        self.html = render("upload.html", title=self.source_title, back=self.back, message=self.message)


class PartialFile:
    """A file on its way, in parts that come one after the other; the first part of a file ends the one before."""

    def __init__(self) -> None:
        self.name = ""
        self._parts: list[bytes] | None = None

    def take(self, msg: dict[str, Any]) -> bytes | None:
        """Add a part {name, index, count, data}; the whole file with the last one. Raises ValueError, one line."""
        if msg.get("index") == 0:
            self.name, self._parts = safe_name(str(msg.get("name", ""))), []
        if self._parts is None:  # more of a file that has been given up
            return None
        try:
            return self._add(self._parts, msg)
        except ValueError:
            self.drop()
            raise

    def drop(self) -> None:
        """Give the file up: parts that still come are passed over."""
        self._parts = None

    def _add(self, parts: list[bytes], msg: dict[str, Any]) -> bytes | None:
        try:
            index, count = int(msg["index"]), int(msg["count"])
            part = base64.b64decode(msg["data"], validate=True)
        except (KeyError, TypeError, ValueError, binascii.Error):
            index, count, part = 0, 0, b""
        if index != len(parts) or not index < count:
            raise ValueError("The upload is incomplete: choose the file again.")
        parts.append(part)
        if sum(map(len, parts)) > LARGEST:
            raise ValueError(too_large(self.name))
        if index < count - 1:
            return None
        self.drop()
        return b"".join(parts)


def too_large(name: str) -> str:
    """Says that a file is."""
    return f"{name}: larger than {LARGEST // 1_000_000} MB"
