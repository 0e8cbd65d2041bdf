"""The values of all lines of a figure at the crosshair."""

from __future__ import annotations

from typing import Any

import param

from wfsobs.app.component import Component
from wfsobs.app.style import asset, labels


class Readout(Component):
    """Follows the pointer, and the arrow keys in a figure that has the focus; one for all figures of the page."""

    labels = param.Dict({}, doc="Name of a line in the figures -> what it is called.")

    _esm = asset("readout.js")
    _stylesheets = [asset("readout.css")]

    def __init__(self, **params: Any):
        super().__init__(labels=labels(), width=0, height=0, margin=0, **params)
