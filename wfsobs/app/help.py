"""The help: shortcuts, words and a tour of the page."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import param

from wfsobs.app.component import Component
from wfsobs.app.glossary import TERMS
from wfsobs.app.style import asset

SHORTCUTS: Mapping[str, str] = MappingProxyType(
    {
        "?": "This help",
        "/": "Find a setting",
        "H": "The history: every result of the session",
        "Ctrl+Z, Ctrl+Shift+Z": "Undo and redo a change of the settings",
        "Alt+O in a setting": "Sweep this setting",
        "Enter or Space on a row beside the verdict": "Hide or show its line",
        "S on such a row": "Its line alone, and those before again",
        "Double click on a figure": "All of it again, after a zoom",
        "Arrows, Page up and down on a handle": "Move it (Shift: further), change its damping; Escape gives up",
        "Arrow keys": "Choose in a switch, go from line to line in a table",
        "Tab": "The first stop of the page leads to the figures",
    }
)
"""Key -> what it does."""


class Help(Component):
    """The button at the top, and what it opens."""

    shortcuts = param.Dict(dict(SHORTCUTS), doc="Key -> what it does.")
    terms = param.Dict(dict(TERMS), doc="Word -> what it means.")

    _esm = asset("dark.js") + asset("help.js")
    _stylesheets = [asset("help.css")]

    def __init__(self, **params: Any):
        super().__init__(width=36, margin=0, **params)
