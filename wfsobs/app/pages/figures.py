"""Pages that explain: the paper's figures of the results shown, and the equations with the numbers of the settings."""

from __future__ import annotations

from html import escape
from typing import Final

import panel as pn
from bokeh.models import BoxAnnotation

from wfsobs.app.compared import find_score
from wfsobs.app.display import Display
from wfsobs.app.pages.parts import WIDE, Page, boxes, pane
from wfsobs.app.render import number, render, short
from wfsobs.app.store import Store
from wfsobs.app.style import HtmlText, html, look, sheets, swatch
from wfsobs.app.views.plots import FigureLines, call, new_figure, set_ends
from wfsobs.app.work import TRUTH, RunResults
from wfsobs.evaluation.description import Description, describe
from wfsobs.observers import OBSERVERS
from wfsobs.plot.paper import DECADES, FIGURES, WHOLE, ZOOMED, PaperFigure, Plot, drawn_lines, is_dashed, samples_of
from wfsobs.sensors.zernike import TIP_TILT
from wfsobs.typing import Array


class Figures(Page):
    """The page; redrawn with the results and the unit while it is visible."""

    def __init__(self, store: Store, display: Display):
        super().__init__(store, display, "unit", "dark")
        self.sheets: Final = [_Sheet(it) for it in FIGURES]
        self.run.param.watch(self.redraw, "result")

    def view(self) -> pn.Column:
        """Return the figures, one below the other."""
        return boxes(*(sheet.view() for sheet in self.sheets))

    def draw(self) -> None:
        """Draw every figure."""
        if (shown := self.run.result) is not None:
            for sheet in self.sheets:
                sheet.draw(shown, self.display)


class _Sheet:
    """One figure of the paper: heading, legend, plots, caption."""

    def __init__(self, figure: PaperFigure):
        self.figure = figure
        self.names = (*figure.observers, TRUTH)  # the reference on top
        self.plots = [_PlotLines(plot, self.names, figure) for plot in figure.plots]
        self.head, self.caption = html(), html()

    def view(self) -> pn.Column:
        """Return the contents of the page."""
        panes = [pane(drawn.figure) for drawn in self.plots]
        return pn.Column(self.head, *panes, self.caption, **WIDE, stylesheets=sheets("box"))

    def draw(self, results: RunResults, display: Display) -> None:
        """Every plot and the texts."""
        legend = "".join(
            f'<span class="mark">{swatch(n, display.dark, with_dash=is_dashed(n, self.figure))}{escape(_label(n))}</span>'
            for n in self.names
        )
        title = escape(f"Figure {self.figure.number} of the paper: {self.figure.title}")
        self.head.html = f'<h2 class="title">{title}</h2><div class="caption legend">{legend}</div>'
        self.caption.html = f'<p class="text">{escape(self.figure.caption)} {escape(self._errors(results, display))}</p>'
        for drawn in self.plots:
            drawn.draw(results, display)

    def _errors(self, results: RunResults, display: Display) -> str:
        """List the RMS errors of the lines, mode by mode, behind each the one that the paper states."""
        scale, parts = display.scale(results.scenario), []
        stated = {name: f" (paper {number(error * scale)})" for name, error in self.figure.paper_errors}
        for column in sorted({plot.column for plot in self.figure.plots}):
            mode = TIP_TILT[column].name
            scores = {name: find_score(results.result.scores, name, self.figure.target, mode) for name in self.figure.observers}
            found = [f"{_label(n)} {number(s.rms * scale)}{stated.get(n, '')}" for n, s in scores.items() if s]
            if found:
                parts.append(f"RMS error of {mode} [{display.unit_label}]: {', '.join(found)}.")
        return " ".join(parts)


class _PlotLines(FigureLines):
    """One plot."""

    def __init__(self, plot: Plot, names: tuple[str, ...], of: PaperFigure):
        self.plot, self.of = plot, of
        y, label, log = ((1e-3, 1.0), "frequency [Hz]", "y") if plot.is_spectrum else (None, "time [s]", "")
        fig = new_figure((0.0, 1.0), y, label, log)
        call(fig, f"{of.title}, {TIP_TILT[plot.column].name}, {plot.what}")
        super().__init__(fig, names, line_width=1.6)
        self.restyle(False, [])
        for name, line in self.lines.items():
            if line.renderer and not is_dashed(name, of):
                line.renderer.glyph.line_dash = []
        self.window = BoxAnnotation(left=0, right=0, fill_color="#808080", fill_alpha=0.15, line_width=0, level="underlay")
        if plot.what == WHOLE and any(p.what == ZOOMED for p in of.plots):
            self.figure.add_layout(self.window)

    def draw(self, results: RunResults, display: Display) -> None:
        """Send every line in the colours of the paper."""
        record, warm_up = results.result.record, results.scenario.run.warm_up
        self.figure.visible = self.plot.column < record.n_modes
        shown = drawn_lines(self.of, self.plot, record, warm_up, results.values)
        scale = display.scale(results.scenario) ** (1 + self.plot.is_spectrum)
        self.put({name: (x, scale * y) for name, (x, y) in shown.lines.items()})
        self.restyle(display.dark, [])
        self.figure.yaxis.axis_label = f"{self.plot.label} [{self.plot.unit(display.unit_label)}]"
        set_ends(self.figure.x_range, *shown.ends)
        first, last = samples_of(record, warm_up)[ZOOMED]
        self.window.update(left=first * record.dt, right=last * record.dt)
        top = self.highest([], 0.0)
        if self.plot.is_spectrum and top > 0:
            self.figure.y_range.update(start=top / 10**DECADES, end=2 * top)


def _label(name: str) -> str:
    return "Reference" if name == TRUTH else look(name).label


class ModelPage(Page):
    """The page; follows the settings and the mode while it is visible."""

    def __init__(self, store: Store, display: Display):
        super().__init__(store, display, "mode", "dark")
        self.pane: Final = html(stylesheets=sheets("base", "style", "model"))
        store.param.watch(self.redraw, "scenario")

    def view(self) -> HtmlText:
        """Return the contents of the page."""
        return self.pane

    def draw(self) -> None:
        """Write the equations."""
        scenario = self.store.scenario
        mode = min(self.display.column, len(scenario.modes) - 1)
        self.pane.html = model_html(describe(scenario, mode), self.display.dark)


def model_html(it: Description, dark: bool) -> str:
    """Write the whole page."""
    return render(
        "model.html",
        it=it,
        swatch=lambda name: swatch(name, dark),
        label=lambda name: OBSERVERS[name].label,
        poles=poles,
    )


def poles(poles: Array) -> list[str]:
    """Write poles, a conjugate pair once; count those that are zero to rounding."""
    zero = abs(poles) < 1e-9
    words = [
        short(p.real) if abs(p.imag) < 1e-9 else f"{short(p.real)} ± {short(p.imag)} i" for p in poles[~zero] if p.imag > -1e-9
    ]
    return [*words, *([f"{zero.sum()} at 0"] if zero.any() else [])]
