"""The presets with a line and a picture each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import param

from wfsobs.app.component import Component
from wfsobs.app.controls.names import preset_title
from wfsobs.app.style import asset
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.disturbance import vibration_lines


class Gallery(Component):
    """The button and what it opens; it gets the presets when it is first opened, and says which one was chosen."""

    items = param.List([], doc="{name, title, line, peaks: [Hz, um], events} of every preset.")

    _esm = asset("dark.js") + asset("gallery.js")
    _stylesheets = [asset("gallery.css")]

    def __init__(self, choose: Callable[[str], None], **params: Any):
        """Make the button. choose : starts from the preset of a name."""
        self._choose = choose
        super().__init__(self._take, **params)

    def _take(self, data: dict[str, Any]) -> None:
        if data.get("open") and not self.items:
            self.items = presets_shown()
        elif data.get("choose") in PRESETS:
            self._choose(str(data["choose"]))


def preset_line(name: str) -> str:
    """Say in a line what a preset is: the first of its documentation."""
    return str(PRESETS[name].__doc__).strip().partition("\n")[0]


def presets_shown() -> list[dict[str, Any]]:
    """Describe every preset by a line, the lines of its vibration, and whether it has events."""
    return [
        {
            "name": name,
            "title": preset_title(name),
            "line": preset_line(name),
            "peaks": [[float(frequency), float(rms)] for frequency, _, rms in vibration_lines(scenario, 0)],
            "events": bool(scenario.events),
        }
        for name, make in PRESETS.items()
        for scenario in [make()]
    ]
