"""What the figures have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from bokeh.events import DoubleTap
from bokeh.models import ColumnDataSource, CustomJS, GlyphRenderer, Line
from bokeh.plotting import figure
from numpy.typing import ArrayLike

from wfsobs.app.style import look, run_look
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.vibration import Peak
from wfsobs.scenario.measured_spectra import measured_spectrum

HEIGHT = 230

PEAKS, MODEL = "#888888", "#FF6600"
"""Colours of the marks: the scenario's peaks, and the one that the Kalman filters model."""

MARKED_LINE = 0.004
"""Lines of a measured spectrum get a mark above this rms in either axis [um]."""


def new_figure(**options: Any) -> figure:
    """Make an empty figure as wide as its room, the scroll wheel left to the page until chosen."""
    fig = figure(
        height=HEIGHT,
        sizing_mode="stretch_width",
        min_width=240,
        tools="xbox_zoom,xpan,xwheel_zoom,reset,save",
        active_drag="xbox_zoom",
        toolbar_location="above",
        toolbar_inner=True,
        min_border_right=16,
        min_border_left=70,
        **options,
    )
    fig.outline_line_color = None  # of which a theme has its own idea, the dark one alone
    fig.toolbar.logo = None
    fig.toolbar.autohide = True
    return fig


def call(fig: figure, name: str) -> None:
    """Name a figure, for its file and for those who hear the page."""
    fig.update(name=name, html_attributes={"role": "figure", "aria-label": name})


def make_line(name: str, source: ColumnDataSource, y: str = "y", **options: Any) -> GlyphRenderer:
    """Make a line in the look of an observer or of the truth, without the glyphs of what is selected or muted: nothing is."""
    it = look(name)
    glyph = Line(x="x", y=y, line_color=it.light, line_width=it.width, line_dash=list(it.dash))
    return GlyphRenderer(data_source=source, glyph=glyph, name=name, **options)


def add_line(fig: figure, name: str, source: ColumnDataSource, y: str = "y") -> GlyphRenderer:
    """Draw a line in the look of an observer or of the truth."""
    renderer = make_line(name, source, y)
    fig.renderers.append(renderer)
    return renderer


def marked_peaks(scenario: Scenario) -> list[Peak]:
    """List the peaks in the scenario's vibration; of a measured spectrum, its stronger lines."""
    vibration = scenario.vibration
    if vibration.source == "ar2":
        return list(vibration.peaks)
    peaks = list(vibration.peaks) if vibration.source == "peaks" else []
    if vibration.source == "measured":
        lines = measured_spectrum(vibration.spectrum).lines(MARKED_LINE)
        peaks = [Peak(frequency=line.frequency, damping=0.0, rms=list(line.rms)) for line in lines]
    return [p for p in peaks if p.frequency <= vibration.cutoff]


def send(source: ColumnDataSource, data: dict[str, Any]) -> None:
    """Give a source the columns that it does not have already: each time that one is sent its figure is drawn anew."""
    old: Any = source.data
    if data.keys() != old.keys() or any(len(old[name]) != len(column) for name, column in data.items()):
        source.data = data
    elif changed := {name: column for name, column in data.items() if not _same(old[name], column)}:
        old.update(changed)


def _same(a: Any, b: Any) -> bool:
    if len(a) != len(b):
        return False
    return np.array_equal(a, b, equal_nan=True) if isinstance(b, np.ndarray) else list(a) == list(b)


def restyle(lines: dict[str, GlyphRenderer], dark: bool, hidden_names: list[str]) -> None:
    """Give every line the colour of the mode, and hide those that are to be hidden."""
    for name, line in lines.items():
        line.glyph.line_color = look(name).colour(dark)
        line.visible = name not in hidden_names


def show_all_on_double_click(fig: figure) -> None:
    """Have a double click show all of the horizontal axis, in the browser."""
    show_all = "axis.setv({start: axis.reset_start ?? axis.start, end: axis.reset_end ?? axis.end})"
    fig.js_on_event(DoubleTap, CustomJS(args={"axis": fig.x_range}, code=show_all))


class ExtraLines:
    """Lines beside those of the results in a figure; nothing until there is one."""

    def __init__(self, fig: figure, name: str, **style: Any):
        self.figure, self.name, self.style = fig, name, style
        self.source: ColumnDataSource | None = None

    def draw(self, lines: Mapping[str, tuple[ArrayLike, ArrayLike]], dark: bool) -> None:
        """Show these lines (name -> x, y) in place of those before."""
        self._send([(x, y, look(name).colour(dark)) for name, (x, y) in lines.items()])

    def _send(self, lines: Sequence[tuple[ArrayLike, ArrayLike, str]], **columns: list[Any]) -> None:
        """Show lines (x, y, colour). columns : for the style, an item of each line."""
        names = ("xs", "ys", "colour")
        if self.source is None:
            if not lines:
                return
            self.source = ColumnDataSource({name: [] for name in (*names, *columns)})
            self.figure.multi_line("xs", "ys", line_color="colour", source=self.source, name=self.name, **self.style)
        data: dict[str, Any] = {name: [line[i] for line in lines] for i, name in enumerate(names)}
        data.update(columns)
        self.source.data = data  # type: ignore[assignment]


class ComparedLines(ExtraLines):
    """The lines of the compared runs, faint under those of the one shown, dashed by run."""

    def __init__(self, fig: figure):
        super().__init__(fig, "compared", line_alpha=0.6, line_width=1.2, line_dash="dash", level="underlay")

    def draw_runs(self, lines: Sequence[tuple[str, str, ArrayLike, ArrayLike]], dark: bool) -> None:
        """Show lines (letter of the run, name, x, y); they have the runs' colours where one name is shown alone."""
        alone = len({name for _, name, _, _ in lines}) == 1
        looks = [run_look(letter) for letter, _, _, _ in lines]
        self._send(
            [(x, y, (run if alone else look(name)).colour(dark)) for run, (_, name, x, y) in zip(looks, lines, strict=True)],
            dash=[" ".join(map(str, run.dash)) for run in looks],
        )
