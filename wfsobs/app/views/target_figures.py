"""What the traces and the spectra have in common: a figure per target, which rests while it is hidden."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import panel as pn
from bokeh.plotting import figure

from wfsobs.app.display import Display
from wfsobs.app.jobs import BackgroundTask
from wfsobs.app.views.plots import FigureLines
from wfsobs.app.work import TRUTH, RunResults


class Drawing(Protocol):
    """One figure and its lines, by observer."""

    figure: figure
    lines: FigureLines


class TargetFigures:
    """A figure per target, drawn when results or switches change while the page shows them."""

    def __init__(self, run: BackgroundTask, display: Display, drawings: Mapping[str, Drawing], switches: Sequence[str]):
        """Watch the results and the switches of the display; drawings : target -> its figure."""
        self.run, self.display, self._drawings = run, display, drawings
        self.visible, self._behind = True, False
        run.param.watch(self._redraw, "result")
        display.param.watch(self._redraw, [*switches, "dark", "hidden_lines"])

    def pane(self, target: str) -> pn.pane.Bokeh:
        """Return the figure of one target."""
        self._drawings[target].figure.sizing_mode = "stretch_both"
        return pn.pane.Bokeh(self._drawings[target].figure, sizing_mode="stretch_both", margin=0)

    def show(self, visible: bool) -> None:
        """Draw what has come meanwhile, and go on while visible."""
        self.visible = visible
        if visible and self._behind:
            self._redraw()

    def _redraw(self, *_: object) -> None:
        results = self.run.result
        self._behind = not self.visible
        if results is not None and self.visible:
            with pn.io.hold():
                for target, drawing in self._drawings.items():
                    drawing.lines.restyle(self.display.dark, self.display.hidden_lines.get(target, []))
                self._draw(results)

    def _draw(self, results: RunResults) -> None:
        """Send the data of every figure, whose lines are shown or hidden by now."""
        raise NotImplementedError


def shows_error(results: RunResults, target: str, display: Display) -> bool:
    """Whether errors are drawn: as chosen, where there is a truth to compare with."""
    return display.error and results.values(TRUTH, target) is not None
