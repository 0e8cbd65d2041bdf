"""What the operator of a server reads: one line per event, `time level event name=value ...` (docs/serving.md)."""

from __future__ import annotations

import logging
import re
import sys
import traceback
from typing import Any, TextIO

from tornado.websocket import WebSocketClosedError

log: logging.Logger = logging.getLogger("wfsobs.serve")

FORMAT = "%(asctime)s %(levelname)s %(message)s"

LONGEST = 200
"""Characters that are kept of what a library says."""

SECRET = re.compile(r"[\w.-]{40,}")
"""The name of a session."""

ADDRESS = re.compile(r" \([\da-f.:]+\)")


def event(name: str, level: int = logging.INFO, **fields: Any) -> None:
    """Log one event. What visitors type or upload has no place in it."""
    log.log(level, " ".join([name, *(f"{key}={_word(value)}" for key, value in fields.items())]))


def to_stream(level: str, requests: bool = False, stream: TextIO | None = None) -> None:
    """Have this package's events of a level and above written, and warnings of the libraries below it.

    requests : also Tornado's line per request, which holds the visitor's address and what was asked for
    """
    logging.basicConfig(format=FORMAT, level=logging.WARNING, stream=stream or sys.stderr, force=True)
    for handler in logging.getLogger().handlers:
        handler.addFilter(without_visitors_data)
    logging.getLogger("wfsobs").setLevel(level.upper())
    for name in ("panel", "bokeh"):  # which come with handlers of their own
        library = logging.getLogger(name)
        library.handlers.clear()
        library.propagate = True
        library.setLevel(logging.WARNING)
    logging.getLogger("tornado.access").setLevel(logging.INFO if requests else logging.ERROR)


def without_visitors_data(record: logging.LogRecord) -> bool:
    """Cuts what Bokeh and Tornado say of a visitor's message or request down to what happened.

    Where no code of this package was under way it is the visitor's mistake: a warning, without a traceback. That a page was
    closed while it was written to is said once, by Panel, and not again with a traceback by the loop of events.
    """
    if record.name == "asyncio" and record.exc_info and isinstance(record.exc_info[1], WebSocketClosedError):
        return False
    if record.name.startswith(("bokeh.", "tornado.")) and record.name != "tornado.access":
        text = " ".join(record.getMessage().split())
        for after in (" HTTPServerRequest(", ": "):
            text = text.partition(after)[0]
        record.msg, record.args = ADDRESS.sub("", SECRET.sub("...", text))[:LONGEST], ()
        if not _is_ours(record.exc_info):
            record.exc_info = record.exc_text = None
            record.levelno, record.levelname = logging.WARNING, logging.getLevelName(logging.WARNING)
    return True


def _is_ours(exc_info: Any) -> bool:
    frames = traceback.walk_tb(exc_info[2]) if exc_info else ()
    return any(str(frame.f_globals.get("__name__")).startswith("wfsobs") for frame, _ in frames)


def _word(value: Any) -> str:
    text = f"{value:.3f}" if isinstance(value, float) else str(value)
    return text if text and not any(c.isspace() or c == '"' for c in text) else f'"{text.replace(chr(34), chr(39))}"'
