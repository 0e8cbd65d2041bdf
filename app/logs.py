"""What the operator of a server reads: one line per event, `time level event name=value ...` (docs/serving.md)."""

from __future__ import annotations

import logging
import sys
from typing import Any, TextIO

log = logging.getLogger("wfsobs.serve")

FORMAT = "%(asctime)s %(levelname)s %(message)s"


def event(name: str, level: int = logging.INFO, **fields: Any) -> None:
    """Log one event. What visitors type or upload has no place in it."""
    log.log(level, " ".join([name, *(f"{key}={_word(value)}" for key, value in fields.items())]))


def to_stream(level: str, requests: bool = False, stream: TextIO | None = None) -> None:
    """Have this package's events of a level and above written, and warnings of the libraries below it.

    requests : also Tornado's line per request, which holds the visitor's address and what was asked for
    """
    logging.basicConfig(format=FORMAT, level=logging.WARNING, stream=stream or sys.stderr, force=True)
    logging.getLogger("wfsobs").setLevel(level.upper())
    panel = logging.getLogger("panel")  # comes with a handler of its own, on standard output
    panel.handlers.clear()
    panel.propagate = True
    panel.setLevel(logging.WARNING)
    logging.getLogger("tornado.access").setLevel(logging.INFO if requests else logging.ERROR)


def _word(value: Any) -> str:
    text = f"{value:.3f}" if isinstance(value, float) else str(value)
    return text if text and not any(c.isspace() or c == '"' for c in text) else f'"{text.replace(chr(34), chr(39))}"'
