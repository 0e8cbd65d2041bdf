"""How many seeds are compared, and how many of them are done."""

from __future__ import annotations

from typing import Any

import panel as pn
import panel_material_ui as pmui

from wfsobs.app.jobs.job import FAILED
from wfsobs.app.seeds import SeedRuns
from wfsobs.app.style import asset

NO_STEPPERS = ".MuiIconButton-root { display: none !important; }"
"""The buttons of panel-material-ui beside a number have no names; the arrow keys do the same."""


class SeedSwitch:
    """The number of seeds, to be set, beside the table."""

    def __init__(self, seeds: SeedRuns):
        self.seeds = seeds
        self.field = pmui.IntInput.from_param(
            seeds.param.count, size="small", width=90, margin=(0, 0, 4, 0), stylesheets=[NO_STEPPERS]
        )
        self.line = pn.pane.HTML(self.text(), margin=0, stylesheets=[asset("style.css")])
        seeds.param.watch(self._refresh, ["evidence", "count"])
        seeds.run.param.watch(self._refresh, ["state", "result"])
        seeds.task.param.watch(self._refresh, ["state", "message"])

    def view(self) -> list[Any]:
        """Return the field and what is said beside it."""
        return [self.field, self.line]

    def text(self) -> str:
        """Say how many seeds are done."""
        seeds = self.seeds
        if not seeds.n_known:
            said = ""
        elif seeds.count == 1:
            said = "one record"
        elif not seeds.possible:
            said = "only for simulations that do not take long"
        elif seeds.task.state == FAILED:
            said = f"{seeds.n_known} of {seeds.count} seeds: {seeds.task.message}"
        elif seeds.n_known < seeds.count:
            said = f"{seeds.n_known} of {seeds.count} seeds done, more running in the background"
        else:
            said = f"over {seeds.n_known} seeds"
        return f'<span class="caption seeds">{said}</span>'

    def _refresh(self, *_: object) -> None:
        self.line.object = self.text()
