"""What the figures have in common."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, Final

import numpy as np
import panel as pn
from bokeh.core.properties import value
from bokeh.core.validation import silence
from bokeh.core.validation.warnings import MISSING_RENDERERS
from bokeh.events import DoubleTap
from bokeh.models import (
    AllIndices,
    CDSView,
    ColumnDataSource,
    CustomJS,
    DataRange1d,
    GlyphRenderer,
    HoverTool,
    HTMLLabelSet,
    Line,
    LogAxis,
    Range1d,
    UnionRenderers,
    VSpan,
)
from bokeh.plotting import figure
from numpy.typing import ArrayLike

from wfsobs.app.style import RUNS, look
from wfsobs.app.work import TRUTH
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.atmosphere import Peak
from wfsobs.scenario.measured_spectra import measured_spectrum
from wfsobs.typing import Array

Points = tuple[Array, Array]
"""x and y of a line."""

SETTLE_MS = 60
"""A zoom is answered when the window has not moved for this long."""


AFTERWARDS_MS = 500
"""What a change has beside its picture is told this much later: until then the processors are the run's and the browser's."""


def on_settle(axes: Iterable[Range1d], function: Callable[[], None]) -> None:
    """Call a function a little after an axis has moved, once for all moves until then."""
    settled = once(function, SETTLE_MS)

    def moved(_attr: str, _old: object, _new: object) -> None:
        settled()

    for axis in axes:
        axis.on_change("start", moved)
        axis.on_change("end", moved)


def once(function: Callable[[], None], milliseconds: int) -> Callable[..., None]:
    """Return what has a function called a little later, once for all calls until then."""
    waiting = False

    def ask(*_: object) -> None:
        nonlocal waiting
        if not waiting:
            waiting = True
            later(answer, milliseconds)

    def answer() -> None:
        nonlocal waiting
        waiting = False
        function()

    return ask


def in_view(axis: Any) -> tuple[float, float]:
    """Return the ends of what is in view of an axis of numbers, the lower one first."""
    return min(axis.start, axis.end), max(axis.start, axis.end)


def set_ends(axis: Any, start: float, end: float) -> None:
    """Show this much of an axis, now and after a reset."""
    axis.update(start=start, end=end, reset_start=start, reset_end=end)


def zoom_of(axis: Any) -> tuple[float, float] | None:
    """Return what of an axis is in view; None where all of it is."""
    start, end = in_view(axis)
    return None if start <= axis.reset_start and end >= axis.reset_end else (start, end)


def later(function: Any, milliseconds: int) -> None:
    """Call a function a little later on the session's thread; at once where there is no session, or no page in its browser."""
    doc = pn.state.curdoc
    if doc is None or doc.session_context is None or not pn.state.loaded:
        function()
    else:
        doc.add_timeout_callback(function, milliseconds)


FONT = "Roboto, Helvetica, Arial, sans-serif"
HEIGHT = 230

PEAKS, MODEL = "#888888", "#FF6600"
"""Colours of the marks: the scenario's peaks, and the one that the Kalman filters model."""

GREY = {False: "#B4B4B4", True: "#666666"}
"""Dark mode -> the colour of lines that recede."""

MOST_COLOURED = 6
"""Of more lines in a figure those recede that the verdict does not name, until their cards are pointed at."""

ROOM_OF_NAME = (0.08, 0.14)
"""A name of one line of text, and of two, of the height of the lowest axis."""

ROOM_FOR_NAMES = 78
"""Beside a figure, for the names of its lines [px]."""

MARKED_LINE = 0.004
"""Lines of a measured spectrum get a mark above this rms in either axis [um]."""


def new_figure(x: Any = None, y: Any = None, label: str = "", log: str = "", **options: Any) -> figure:
    """Make an empty figure as wide as its room, the scroll wheel left to the page until chosen.

    x, y : both ends of the axes, ranges of Bokeh, or None for what fits itself; label : of x; log : which of "xy" are logarithmic
    """
    fig = figure(
        x_range=x or DataRange1d(),
        y_range=y or DataRange1d(),
        x_axis_label=label,
        x_axis_type="log" if "x" in log else "linear",
        y_axis_type="log" if "y" in log else "linear",
        height=HEIGHT,
        sizing_mode="stretch_width",
        min_width=240,
        tools="xbox_zoom,xpan,xwheel_zoom,reset,save",
        active_drag="xbox_zoom",
        toolbar_location="above",
        toolbar_inner=True,
        title=None,
        min_border_right=16,
        min_border_left=70,
        **options,
    )
    fig.outline_line_color = None  # of which a theme has its own idea, the dark one alone
    fig.toolbar.update(logo=None, autohide=True, stylesheets=[":host(.bk-inner) { background: none; }"])  # white by itself
    return fig


def new_spectrum(x: Any = (0.5, 500.0), y: Any = (1e-6, 1.0)) -> figure:
    """Make an empty figure of densities over the frequency."""
    return new_figure(x, y, "frequency [Hz]", "xy")


def call(fig: figure, name: str) -> None:
    """Name a figure, for its file and for those who hear the page."""
    fig.update(name=name, html_attributes={"role": "figure", "aria-label": name})


def make_line(name: str, source: ColumnDataSource, y: str, **options: Any) -> GlyphRenderer[Any]:
    """Make a line in the look of an observer or of the truth, without the glyphs of what is selected or muted: nothing is."""
    it = look(name)
    glyph = Line(x="x", y=y, line_color=it.light, line_width=it.width, line_dash=list(it.dash))
    return GlyphRenderer(data_source=source, glyph=glyph, name=name, **options)


def add_line(fig: figure, name: str, source: ColumnDataSource, y: str = "y") -> GlyphRenderer[Any]:
    """Draw a line in the look of an observer or of the truth."""
    renderer = make_line(name, source, y)
    fig.renderers.append(renderer)
    return renderer


def add_marks(fig: figure) -> dict[str, GlyphRenderer[Any]]:
    """Add vertical lines that say what they are: the scenario's peaks, and the one that the Kalman filters model."""
    looks = {"peaks": {"line_color": PEAKS, "line_alpha": 0.4}, "model": {"line_color": MODEL, "line_dash": [4, 3]}}
    marks: dict[str, Any] = {
        name: fig.add_glyph(ColumnDataSource({"x": [], "text": []}), VSpan(x="x", line_width=1.5, **style), name=name)
        for name, style in looks.items()
    }
    fig.add_tools(HoverTool(renderers=[*marks.values()], tooltips="@text"))
    return marks


def peak_marks(scenario: Scenario) -> list[tuple[float, str]]:
    """List the frequencies of the marked peaks, with what they say."""
    return [(p.frequency, f"peak {p.frequency:.5g} Hz, damping {p.damping:.3g}") for p in marked_peaks(scenario)]


def model_mark(scenario: Scenario) -> tuple[float, str]:
    """Return the frequency that the Kalman filters model, with what its mark says."""
    frequency = scenario.kalman.frequency
    return frequency, f"model of the Kalman filters {frequency:.5g} Hz"


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


def send(source: Any, data: dict[str, Any]) -> None:
    """Give a source the columns that it does not have already: each time that one is sent its figure is drawn anew."""
    old = source.data
    if data.keys() != old.keys() or any(len(old[name]) != len(column) for name, column in data.items()):
        source.data = data
    elif changed := {name: column for name, column in data.items() if not _same(old[name], column)}:
        old.update(changed)


def _same(a: Any, b: Any) -> bool:
    if len(a) != len(b):
        return False
    return np.array_equal(a, b, equal_nan=True) if isinstance(b, np.ndarray) else list(a) == list(b)


def show_all_on_double_click(fig: figure) -> None:
    """Have a double click show all of the horizontal axis, in the browser."""
    show_all = "axis.setv({start: axis.reset_start ?? axis.start, end: axis.reset_end ?? axis.end})"
    fig.js_on_event(DoubleTap, CustomJS(args={"axis": fig.x_range}, code=show_all))


class ExtraLines:
    """Lines beside those of the results in a figure; nothing until there is one."""

    def __init__(self, fig: figure, name: str, **style: Any):
        self.figure = fig
        self.name = name
        self.style = style
        self.source: ColumnDataSource | None = None

    def draw(self, lines: Mapping[str, Points], dark: bool) -> None:
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
        self.source.data = data


class ComparedLines(ExtraLines):
    """The lines of the compared runs, faint under those of the one shown, dashed by run."""

    def __init__(self, fig: figure):
        super().__init__(fig, "compared", line_alpha=0.6, line_width=1.2, line_dash="dash", level="underlay")

    def draw_runs(self, lines: Sequence[tuple[str, str, ArrayLike, ArrayLike]], dark: bool) -> None:
        """Show lines (letter of the run, name, x, y); they have the runs' colours where one name is shown alone."""
        alone = len({name for _, name, _, _ in lines}) == 1
        looks = [RUNS[letter] for letter, _, _, _ in lines]
        self._send(
            [(x, y, (run if alone else look(name)).colour(dark)) for run, (_, name, x, y) in zip(looks, lines, strict=True)],
            dash=[" ".join(map(str, run.dash)) for run in looks],
        )


class EndLabels:
    """The names of the lines beside their right ends, in their colours, moved apart."""

    def __init__(self, fig: figure):
        self.figure = fig
        self.source: Final = ColumnDataSource({name: [] for name in ("x", "y", "text", "colour", "dash")})
        box: dict[str, Any] = {"border_line_color": "colour", "border_line_dash": "dash", "text_baseline": "middle"}
        box |= {"text_font": value(FONT), "text_font_size": "12px"}
        # In the page and not on the canvas, where what is beside the frame would be cut off.
        self.labels: Final = HTMLLabelSet(x="x", y="y", text="text", x_offset=5, source=self.source, **box)
        fig.add_layout(self.labels)
        fig.min_border_right = ROOM_FOR_NAMES

    def draw(self, lines: Mapping[str, Points], dark: bool) -> None:
        """Name lines (name -> x, y) where they leave the axis of x."""
        fig: Any = self.figure
        is_log, end = isinstance(fig.yaxis[0], LogAxis), float(fig.x_range.end)
        scale: Callable[[Any], Any] = np.log10 if is_log else np.asarray
        low, high = (float(scale(y)) for y in (fig.y_range.start, fig.y_range.end))
        places: dict[str, float] = {}
        for name, (x, y) in lines.items():
            values = np.asarray(y)
            seen = values[(np.asarray(x) <= end) & np.isfinite(values) & (not is_log or values > 0)][-LAST:]
            if seen.size:
                places[name] = (float(scale(np.median(seen))) - low) / (high - low)
        names = sorted(places, key=places.__getitem__)
        labels = [look(name).label for name in names]
        texts = [label.replace(" ", "\n", 1) if len(label) > 10 else label for label in labels]
        apart = spread([places[name] for name in names], [ROOM_OF_NAME["\n" in text] for text in texts])
        at = [low + (high - low) * place for place in apart]
        self.labels.update(text_color="#E8E8E8" if dark else "#202020")
        send(
            self.source,
            {
                "x": [end] * len(names),
                "y": [float(10**y) for y in at] if is_log else at,
                "text": texts,
                "colour": [look(name).colour(dark) for name in names],
                "dash": [list(look(name).dash) for name in names],
            },
        )


LAST = 20
"""Samples at the right end of a line whose median says where it ends."""


def spread(places: Sequence[float], sizes: Sequence[float]) -> list[float]:
    """Move places from 0 to 1, in order, as little apart as the sizes of what stands there need.

    >>> [round(place, 3) for place in spread([0.0, 0.5, 0.52, 2.0], [0.1] * 4)]
    [0.05, 0.5, 0.6, 0.95]
    >>> [round(place, 3) for place in spread([0.9, 0.9, 0.9], [0.2, 0.1, 0.1])]
    [0.7, 0.85, 0.95]
    """
    half = [0.5 * size / max(sum(sizes), 1.0) for size in sizes]
    apart = [a + b for a, b in pairwise(half)]
    moved: list[float] = []
    for i, place in enumerate(places):
        moved.append(max(place, moved[-1] + apart[i - 1] if moved else half[0]))
    for i in reversed(range(len(moved))):
        moved[i] = min(moved[i], moved[i + 1] - apart[i] if i + 1 < len(moved) else 1.0 - half[-1])
    return moved


silence(MISSING_RENDERERS)  # of figures whose lines are made when they are first shown


class LazyLine:
    """A line that is in its figure once it has been shown."""

    def __init__(self, make: Callable[[], GlyphRenderer[Any]]):
        self._make = make
        self.renderer: GlyphRenderer[Any] | None = None

    @property
    def visible(self) -> bool:
        """Whether it is shown."""
        return self.renderer is not None and self.renderer.visible

    @property
    def recedes(self) -> bool:
        """Whether it is shown in grey."""
        return self.renderer is not None and bool(self.renderer.tags)

    def show(self, visible: bool, colour: str, own: str = "") -> None:
        """Show it in a colour, or hide it. own : the colour that it has when it is pointed at, where that is another."""
        if self.renderer is None and visible:
            self.renderer = self._make()
        if self.renderer is not None:
            self.renderer.glyph.line_color = colour
            self.renderer.update(visible=visible, tags=[own] if own else [], level="underlay" if own else "glyph")


class FigureLines:
    """A figure with a line per name, each made when it is first shown; those that come first lie below.

    Attributes
    ----------
    sources : dict
        Name -> where the data of the line are.
    lines : dict
        Name -> the line.
    """

    def __init__(self, fig: figure, names: Iterable[str], source: ColumnDataSource | None = None, **style: Any):
        """Make none yet. source : has the y of every line in a column of its name; else each has a source of its own."""
        self.figure = fig
        policy, self._all, self._style = UnionRenderers(), AllIndices(), style
        self.sources: Final = {name: source or ColumnDataSource({"x": [], "y": []}, selection_policy=policy) for name in names}
        self.lines: Final = {name: LazyLine(partial(self._make, name, name if source else "y")) for name in self.sources}

    def put(self, lines: Mapping[str, Points]) -> None:
        """Show these lines (name -> x, y), and nothing of the others."""
        for name, source in self.sources.items():
            x, y = lines.get(name, (np.empty(0), np.empty(0)))
            source.data = {"x": x, "y": y.astype(np.float32)}

    def highest(self, hidden_names: Sequence[str], without: float) -> float:
        """Return the largest magnitude of the visible lines, or `without` where there are none."""
        shown = [source.data["y"] for name, source in self.sources.items() if name not in hidden_names]
        return max((float(np.max(np.abs(y))) for y in shown if len(y)), default=without)

    def restyle(self, dark: bool, hidden_names: Sequence[str], main_names: Sequence[str] = ()) -> None:
        """Show every line but those that are to be hidden, in the colours of light or dark mode.

        main_names : the ones that keep their colours where there are many
        """
        many = len(self.lines) - len({*hidden_names} & {*self.lines}) > MOST_COLOURED and len(main_names) > 0
        for name, line in self.lines.items():
            own = look(name).colour(dark)
            recedes = many and name != TRUTH and name not in main_names
            line.show(name not in hidden_names, GREY[dark] if recedes else own, own if recedes else "")

    def _make(self, name: str, y: str) -> GlyphRenderer[Any]:
        renderer = make_line(name, self.sources[name], y, view=CDSView(filter=self._all))
        renderer.glyph.update(**self._style)
        names, renderers = list(self.lines), self.figure.renderers
        above = [made for other in names[names.index(name) + 1 :] if (made := self.lines[other].renderer)]
        renderers.insert(renderers.index(above[0]) if above else len(renderers), renderer)
        return renderer


class PairedLines(FigureLines):
    """A figure with a strong and a faint line per controller."""

    def __init__(self, fig: figure, names: Iterable[str]):
        super().__init__(fig, names, line_width=2.2)
        self.faint: Final = FigureLines(fig, names, line_alpha=0.45, line_width=1.2)

    def put_both(self, lines: Mapping[str, tuple[Array, Array, Array]]) -> None:
        """Show these lines (name -> x, strong y, faint y), and nothing of the others."""
        self.put({name: (x, y) for name, (x, y, _) in lines.items()})
        self.faint.put({name: (x, y) for name, (x, _, y) in lines.items()})

    def restyle(self, dark: bool, hidden_names: Sequence[str], main_names: Sequence[str] = ()) -> None:
        """Set the colours of light or dark mode, and hide lines."""
        super().restyle(dark, hidden_names, main_names)
        self.faint.restyle(dark, hidden_names, main_names)
