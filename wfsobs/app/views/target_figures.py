"""What the traces and the spectra have in common: a figure per target, which rests while it is hidden."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import panel as pn
from bokeh.models import GlyphRenderer
from bokeh.plotting import figure

from wfsobs.app.display import Display
from wfsobs.app.jobs.task import BackgroundTask
from wfsobs.app.views.plots import restyle
from wfsobs.app.work import RunResults


class Drawing(Protocol):
    """One figure and its lines, by observer."""

    figure: figure
    lines: dict[str, GlyphRenderer]


class TargetFigures:
    """A figure per target, drawn when results or switches change while the page shows them."""

    def __init__(self, run: BackgroundTask, display: Display, drawings: Mapping[str, Drawing], switches: Sequence[str]):
        """Watch the results and the switches of the display; drawings : target -> its figure."""
        self.run, self.display, self._drawings = run, display, drawings
        self.visible, self._behind = True, False
        run.param.watch(self._redraw, "result")
        display.param.watch(self._redraw, [*switches])
        display.param.watch(self._restyle, ["dark", "hidden"])

    def pane(self, target: str) -> pn.pane.Bokeh:
        """Return the figure of one target."""
        return pn.pane.Bokeh(self._drawings[target].figure, sizing_mode="stretch_width", margin=0)

    def show(self, visible: bool) -> None:
        """Draw what has come meanwhile, and go on while visible."""
        self.visible = visible
        if visible and self._behind:
            self._redraw()

    def _redraw(self, *_: object) -> None:
        shown = self.run.result
        self._behind = not self.visible
        if shown is not None and self.visible:
            with pn.io.hold():
                self._draw(shown)

    def _draw(self, results: RunResults) -> None:
        """Send the data of every figure."""
        raise NotImplementedError

    def _restyle(self, *_: object) -> None:
        """Set the colours of light or dark mode, and hide lines."""
        with pn.io.hold():
            for target, drawing in self._drawings.items():
                restyle(drawing.lines, self.display.dark, self.display.hidden.get(target, []))
