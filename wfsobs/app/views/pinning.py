"""The button that pins a run, and the line that says which one is pinned."""

from __future__ import annotations

from html import escape

import panel as pn
import panel_material_ui as pmui

from wfsobs.app.display import Display
from wfsobs.app.jobs.task import BackgroundTask
from wfsobs.app.pin import name_of_difference, pin
from wfsobs.app.style import asset

PIN, UNPIN = "Pin this run to compare others with it", "Unpin the reference run"


class Pinning:
    """Pin and unpin, one button; in step with the run shown."""

    def __init__(self, run: BackgroundTask, display: Display):
        self.run, self.display = run, display
        self.button = pmui.Button(
            label="Pin", icon="push_pin", size="small", variant="outlined", margin=0, disabled=True, description=PIN
        )
        self.note = pn.pane.HTML("", margin=0, visible=False, stylesheets=[asset("style.css")])
        self.button.on_click(self._on_press)
        run.param.watch(self._refresh, "result")
        display.param.watch(self._refresh, "pinned")

    def view(self) -> list[object]:
        """Return the button and the line."""
        return [self.button, self.note]

    def _on_press(self, _event: object) -> None:
        if self.display.pinned is not None:
            self.display.pinned = None
        elif self.run.result is not None:
            self.display.pinned = pin(self.run.result)

    def _refresh(self, *_: object) -> None:
        kept, shown = self.display.pinned, self.run.result
        if (self.button.label == "Unpin") != (kept is not None):
            self.button.param.update(label="Pin" if kept is None else "Unpin", description=PIN if kept is None else UNPIN)
            self.note.visible = kept is not None
        self.button.disabled = shown is None
        if kept is not None and shown is not None:
            name = escape(name_of_difference(kept.scenario, shown.scenario))
            self.note.object = f'<span class="pinned" role="status">Pinned, faint in the figures: {name}</span>'
