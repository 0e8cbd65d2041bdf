"""The button that pins the result shown, and the legend of the runs that it is compared with."""

from __future__ import annotations

import panel as pn
import panel_material_ui as pmui
from markupsafe import Markup

from wfsobs.app.change_names import name_of_difference
from wfsobs.app.compared import ComparedRun
from wfsobs.app.display import Display
from wfsobs.app.history import History
from wfsobs.app.jobs.task import BackgroundTask
from wfsobs.app.render import macro
from wfsobs.app.style import asset, run_swatch
from wfsobs.scenario import Scenario

PIN, UNPIN = "Pin this run to compare others with it", "Unpin: compare with no other run"


class Pinning:
    """Pin and unpin, one button: the result shown is the first one that is compared, or none is any more."""

    def __init__(self, run: BackgroundTask, display: Display, history: History):
        self.run, self.display, self.history = run, display, history
        self.button = pmui.Button(
            label="Pin", icon="push_pin", size="small", variant="outlined", margin=0, disabled=True, description=PIN
        )
        self.note = pn.pane.HTML("", margin=0, visible=False, stylesheets=[asset("style.css")])
        self.button.on_click(self._on_press)
        run.param.watch(self._refresh, "result")
        history.param.watch(self._refresh, "current")
        display.param.watch(self._refresh, ["compared_runs", "dark"])

    def view(self) -> list[object]:
        """Return the button and the legend."""
        return [self.button, self.note]

    def _on_press(self, _event: object) -> None:
        if self.display.compared_runs:
            self.history.compare_none()
        else:
            self.history.compare(self.history.current)

    def _refresh(self, *_: object) -> None:
        runs, shown = self.display.compared_runs, self.run.result
        if (self.button.label == "Unpin") != bool(runs):
            self.button.param.update(label="Unpin" if runs else "Pin", description=UNPIN if runs else PIN)
            self.note.visible = bool(runs)
        self.button.disabled = not (runs or self.history.current)
        if runs and shown is not None:
            self.note.object = str(macro("compared", [self._item(run, shown.scenario) for run in runs]))

    def _item(self, run: ComparedRun, now: Scenario) -> tuple[Markup, str, str]:
        """Describe a run: its mark, its name, and what has changed since."""
        return run_swatch(run.letter, self.display.dark), run.name, name_of_difference(run.scenario, now)
