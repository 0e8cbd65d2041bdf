"""The error of a setting, and values and errors shortened for one line."""

from __future__ import annotations

import reprlib
from typing import Any


class SettingError(ValueError):
    """Error: a setting that cannot be used; one line naming the setting, its value and what is allowed."""


_WORDS = reprlib.Repr()  # stops at a depth, where `repr` would end in a RecursionError
_WORDS.maxlist = _WORDS.maxtuple = _WORDS.maxdict = 40
_WORDS.maxstring = _WORDS.maxother = _WORDS.maxlong = 400


def shorten(value: Any, most: int = 80) -> str:
    """Return a value in at most `most` characters."""
    text = _WORDS.repr(value)
    return text if len(text) <= most else text[: most - 3] + "..."


def error_line(error: BaseException) -> str:
    """Return an error in one line; an error of the code has its type."""
    text = " ".join(str(error).split())
    return text if isinstance(error, (ValueError, AssertionError)) and text else f"{type(error).__name__}: {text}".strip(": ")
