"""One description of a figure for two backends: lines, bars and marks of HoloViews, and their file.

Elements carry the options of Bokeh and of Matplotlib, so that either draws them. Compose them with `+` and `*`; `hv.extension`
chooses what a notebook shows.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import holoviews as hv
import holoviews.plotting.bokeh
import holoviews.plotting.mpl
import matplotlib as mpl
import numpy as np
from bokeh.embed import file_html
from bokeh.resources import INLINE

from wfsobs.files import check_writable, write_text, write_whole
from wfsobs.observers.base import Look
from wfsobs.plot.looks import look
from wfsobs.settings.values import SettingError
from wfsobs.signal.envelope import envelope, envelope_times
from wfsobs.typing import Array


class Quantity(hv.Dimension):
    """What an axis is of, its unit in brackets."""

    unit_format = " [{unit}]"


TIME, FREQUENCY = Quantity("time", unit="s"), Quantity("frequency", unit="Hz")

BINS = 500
"""Pairs of extremes that are drawn of a long line: more than a column of a paper, or half a screen, can show."""

COLUMN, PAGE = 88.0, 180.0
"""Width of one and of two columns of a paper [mm]."""

NARROW = 40.0
"""Least width of one plot in a file [mm], of bars with their names twice that; what does not fit into a row begins another."""

LEAST, MOST = 20.0, 1000.0
"""Least and largest width and height of a file [mm]."""

HEIGHT, LINE = 40.0, 3.3
"""Height of one plot in a file, and of a line of its legend or a bar [mm]."""

PIXELS = (900, 280)
"""Width and height of one plot by Bokeh."""

NOTEBOOK = 200
"""Size of Matplotlib's plots in a notebook, in percent of its usual one."""

PAPER: Any = {
    "font.size": 7,
    "axes.labelsize": 7,
    "axes.titlesize": 7,
    "xtick.labelsize": 6,
    "ytick.labelsize": 6,
    "legend.fontsize": 6,
    "axes.linewidth": 0.6,
    "pdf.fonttype": 42,  # fonts embedded, their text selectable
    "svg.fonttype": "path",
}
"""Matplotlib's settings of a file."""

SUFFIXES = (".pdf", ".svg", ".pgf", ".png", ".html")
"""What a figure can be written as."""


def quantity(name: str, unit: str, label: str = "") -> hv.Dimension:
    """Return what an axis is of; plots that share it are linked."""
    return Quantity((name, label or name), unit=unit or None)


def style(element: Any, *, bokeh: Mapping[str, Any], matplotlib: Mapping[str, Any], **both: Any) -> Any:
    """Return an element of one's own with the options of each backend, and of both."""
    element.opts(**both, **bokeh, clone=False, backend="bokeh")
    element.opts(**both, **matplotlib, clone=False, backend="matplotlib")
    return element


def draw_line(x: Array, y: Array, of: tuple[hv.Dimension, hv.Dimension], name: str | Look) -> hv.Curve:
    """Draw a line in the look of an observer, a controller or the truth; of : its axes."""
    it = look(name) if isinstance(name, str) else name
    dash = {"linestyle": (0, tuple(d / it.width for d in it.dash))} if it.dash else {}
    return style(
        hv.Curve((x, y), *of, label=it.label),
        color=it.light,
        bokeh={"line_width": it.width, "line_dash": list(it.dash) or "solid"},
        matplotlib={"linewidth": 0.5 * it.width, **dash},
    )


def draw_trace(values: Array, dt: float, of: hv.Dimension, name: str | Look, samples: slice) -> hv.Curve:
    """Draw some samples of a signal (n,) every `dt` [s] over time, the extremes of bins where they are many."""
    first, last, _ = samples.indices(values.size)
    return draw_line(envelope_times(first, last, BINS, dt), envelope(values[first:last], BINS), (TIME, of), name)


def overlay(parts: Iterable[Any], *, log: str = "", rows: int = 0, decades: int = 8, **both: Any) -> hv.Overlay:
    """Lay elements over each other.

    log : axes that are logarithmic, of "xy"; rows : number of bars, where they are what is drawn; decades :
    the most that a logarithmic axis of y spans; both : further options
    """
    drawn = hv.Overlay(list(parts))
    both = {"logx": "x" in log, "show_grid": True, "title": ""} | both  # by itself the title is the label of a line alone
    values = np.concatenate([part.dimension_values(1) for part in drawn])
    positive = values[values > 0.0] if "y" in log else values[:0]
    if positive.size:  # what is nothing but zero has no logarithmic axis
        highest = float(positive.max())
        both |= {"logy": True, "ylim": (max(float(positive.min()), highest * 10.0**-decades) / 2.0, 2.0 * highest)}
    width, height = PIXELS
    if rows:
        label = next(iter(drawn)).kdims[0].pprint_label
        both |= {"xlabel": label, "ylabel": "", "invert_yaxis": True, "ylim": (-0.6, rows - 0.4), "show_grid": False}
        height = 90 + 22 * rows
    return style(
        drawn,
        **both,
        legend_position="right",
        bokeh={"width": width, "height": height, "click_policy": "hide"},
        matplotlib={"aspect": width / height, "fig_size": NOTEBOOK},
    )


def stack(figures: Sequence[hv.Overlay]) -> hv.Layout:
    """Place figures below each other, as far apart as legends need."""
    apart = max(0.5, 0.075 * max(map(len, figures)) - 0.8)
    looks = {"sublabel_format": "", "fig_size": NOTEBOOK, "vspace": apart}
    return style(hv.Layout(list(figures)).cols(1), bokeh={}, matplotlib=looks)


Bar = tuple[str, Sequence[float], Sequence[str]]
"""Name of a row, lengths of its pieces from the left, their colours."""


def draw_bars(rows: Sequence[Bar], of: hv.Dimension) -> hv.Rectangles:
    """Draw horizontal bars, each of one or more pieces; `overlay` with `rows` names them."""
    boxes = []
    for i, (_, lengths, colours) in enumerate(rows):
        ends = np.cumsum([0.0, *lengths])
        boxes += [(a, i - 0.38, b, i + 0.38, colour) for a, b, colour in zip(ends[:-1], ends[1:], colours, strict=True)]
    drawn = hv.Rectangles(boxes, [of, f"row of {of.name}", f"end of {of.name}", "top"], "colour")
    ticks = [(i, name) for i, (name, *_) in enumerate(rows)]
    looks = {"color": hv.dim("colour"), "yticks": ticks, "show_legend": False}
    return style(drawn, **looks, bokeh={"line_color": None}, matplotlib={"linewidth": 0})


def draw_intervals(ends: Sequence[tuple[float, float] | None], of: hv.Dimension) -> hv.Segments:
    """Draw the interval of each bar, where there is one."""
    return _segments([(e[0], i, e[1], i) for i, e in enumerate(ends) if e is not None], of)


def draw_marks(at: Sequence[float | None], of: hv.Dimension) -> hv.Segments:
    """Draw a line across each bar, where there is a number."""
    return _segments([(x, i - 0.48, x, i + 0.48) for i, x in enumerate(at) if x is not None], of)


def _segments(lines: Sequence[tuple[float, float, float, float]], of: hv.Dimension) -> hv.Segments:
    drawn = hv.Segments(list(lines), [of, f"row of {of.name}", f"end of {of.name}", "top"])
    return style(drawn, color="black", bokeh={"line_width": 1.2}, matplotlib={"linewidth": 0.8})


def legend_of(colours: Mapping[str, str], of: hv.Dimension) -> list[hv.Curve]:
    """Draw nothing but entries of a legend, label -> colour: neither backend has any of bars."""
    nowhere = np.full(1, np.nan)
    return [
        draw_line(nowhere, nowhere, (of, hv.Dimension(f"row of {of.name}")), Look(label, colour, width=6))
        for label, colour in colours.items()
    ]


def check_suffix(path: str | Path) -> None:
    """Raise SettingError or OSError for a file that `save_figure` could not write."""
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise SettingError(f"{path}: a figure is written as {', '.join(SUFFIXES)}, not {path.suffix or 'without a suffix'}")
    if path.suffix == ".pgf" and shutil.which(mpl.rcParams["pgf.texsystem"]) is None:
        raise SettingError(f"{path}: PGF needs LaTeX, {mpl.rcParams['pgf.texsystem']} on the path, which measures the text")
    check_writable(path)


def save_figure(figure: Any, path: str | Path, *, width: float = COLUMN, height: float = 0.0) -> None:
    """Write a figure to a file: .pdf, .svg, .pgf or .png by Matplotlib, .html by Bokeh.

    Parameters
    ----------
    figure : HoloViews object
        What `result.plot` and its like return, or a composition of them.
    path : str or Path
        File to write; its suffix says how.
    width : float
        Width [mm]; 88 and 180 are one and two columns of a paper. HTML has its own.
    height : float
        Height [mm]; by default 40 for each row of plots, and what legends and bars need.

    Raises
    ------
    SettingError
        The suffix or the size is none of a figure, or PGF is asked for without LaTeX, by which Matplotlib measures its text.
    OSError
        The file cannot be written.
    """
    path = Path(path)
    check_suffix(path)
    if not (LEAST <= width <= MOST and (height == 0.0 or LEAST <= height <= MOST)):
        raise SettingError(
            f"{path}: a figure takes a width and a height from {LEAST:g} to {MOST:g} mm, not {width:g} and {height:g}"
        )
    if path.suffix == ".html":
        page = file_html(hv.renderer("bokeh").get_plot(figure).state, INLINE, path.stem)
        write_text(path, page)
        return
    drawn = to_matplotlib(figure, width, height)
    with mpl.rc_context(PAPER):
        write_whole(path, lambda file: drawn.savefig(file, format=path.suffix[1:], dpi=300))


@mpl.rc_context(PAPER)
def to_matplotlib(figure: Any, width: float = COLUMN, height: float = 0.0) -> Any:
    """Return a figure of Matplotlib of this width and height [mm]."""
    layout: Any = figure if isinstance(figure, hv.Layout) else stack([figure])
    inches = width / 25.4, HEIGHT / 25.4  # both given, so that the width stays; the height comes below
    sized = layout.opts(fig_inches=inches, fig_size=100, sublabel_format="", clone=True, backend="matplotlib")
    least = 2.0 * NARROW if layout.traverse(specs=[hv.Rectangles]) else NARROW
    sized.cols(min(layout.shape[1], max(1, int(width / least))))
    drawn: Any = hv.renderer("matplotlib").get_plot(sized).state
    rows, columns = sized.shape
    above, heights = None, np.full(rows, HEIGHT)
    every = [axes for axes in drawn.axes if axes.get_subplotspec() is not None]
    for i, axes in enumerate(every):
        axes.set_box_aspect(None)
        axes.set_aspect("auto")
        for axis in (axes.xaxis, axes.yaxis):
            axis.label.set_size(mpl.rcParams["axes.labelsize"])
        tall, loc, x = HEIGHT, "lower center", 0.45
        if axes.yaxis_inverted():  # of bars: a line of text each, beside which little room can be left
            tall, loc, x = LINE * (len(axes.get_yticks()) + 4), "lower right", 1.0
            axes.xaxis.label.set(x=x, horizontalalignment="right")
        if (legend := axes.get_legend()) is not None:
            handles, names = axes.get_legend_handles_labels()
            if width >= PAGE and columns <= 2:
                tall = max(tall, LINE * (len(names) + 2))
            else:  # there is no room beside
                legend.remove()
                if names != above:
                    beside, title = 1 if columns > 1 else 2, axes.get_title() or None
                    axes.legend(handles, names, title=title, loc=loc, bbox_to_anchor=(x, 1.0), ncols=beside, frameon=False)
                    tall = max(tall, HEIGHT) + LINE * -(-len(names) // beside)
                    axes.set_title("")  # which would be below it
                above = names
        heights[i // columns] = max(heights[i // columns], tall)
    for axes, place in zip(every, drawn.add_gridspec(rows, columns, height_ratios=heights), strict=False):
        axes.set_subplotspec(place)  # of a grid that the layout can move
    drawn.set_size_inches(width / 25.4, (height or heights.sum()) / 25.4)
    drawn.set_layout_engine("constrained")
    return drawn
