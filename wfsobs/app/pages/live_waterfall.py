"""The waterfall of the live loop: spectra of one second each, beside each other."""

from __future__ import annotations

from functools import partial

import numpy as np
from bokeh.models import ColorBar, ColumnDataSource, Image, LogColorMapper, Range1d
from bokeh.palettes import Viridis256

from wfsobs.app.display import Display
from wfsobs.app.views.plots import new_figure
from wfsobs.live.spectrum_of_minute import bridge_missing
from wfsobs.live.view import LiveView
from wfsobs.signal.welch import welch_psd
from wfsobs.typing import Array

MEASUREMENT = "measurement"
LENGTH, HOP = 1.0, 0.5
"""Time that a spectrum is of, and between two [s]."""
COLUMNS, ROWS = 120, 128
"""Spectra that are kept: a minute. Frequencies of each, in equal steps of the logarithm."""
LOWEST = 1.0
"""Frequency at which it begins [Hz]."""
FLOOR, DECADES = 0.05, 2.0
"""The darkest colour is that below which this part of the spectra is; the colours span so many decades at least."""


class Waterfall:
    """Spectra of a signal over the last minute.

    Attributes
    ----------
    figure : figure
        Time to the right, frequency upwards.
    columns : Array
        Spectra, (ROWS, COLUMNS) [um^2/Hz], the newest last; NaN where there is none.
    """

    def __init__(self) -> None:
        self.figure = new_figure(x_range=Range1d(start=0.0, end=1.0), y_range=Range1d(start=LOWEST, end=500.0), y_axis_type="log")
        self.figure.xaxis.axis_label, self.figure.yaxis.axis_label = "time of the loop [s]", "frequency [Hz]"
        self.figure.grid.visible = False
        self._colours = LogColorMapper(palette=Viridis256, low=1e-6, high=1.0, nan_color="rgba(0, 0, 0, 0)")
        self._source = ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []})
        glyph = Image(image="image", x="x", y="y", dw="dw", dh="dh", color_mapper=self._colours)
        self.figure.add_glyph(self._source, glyph, level="image")
        self._bar = ColorBar(color_mapper=self._colours, width=8, padding=4, title_text_font_style="normal")
        self.figure.add_layout(self._bar, "right")
        self.columns = np.full((ROWS, COLUMNS), np.nan)
        self._of: tuple[str, str, int] = ("", "", 0)
        self._number = 0
        self._sent_in = ("", False)

    def draw(self, view: LiveView, what: str, target: str, display: Display, scale: float) -> None:
        """Take new spectra in, and send them; what : MEASUREMENT, or the observer whose error it is; scale : as for lines."""
        hop = round(HOP / view.dt)
        newest, of = (view.first + view.n) // hop, (what, target, display.column)
        fresh = of != self._of or newest < self._number
        if fresh:
            self.columns[:], self._of, self._number = np.nan, of, max(0, newest - COLUMNS)
        elif newest == self._number and (display.unit, display.dark) == self._sent_in:
            return
        self._take(view, hop, newest)
        self._send(newest * HOP, view.dt, scale, display)

    def _take(self, view: LiveView, hop: int, newest: int) -> None:
        """Move the spectra to the left, and add those of which the view has all frames."""
        step = min(newest - self._number, COLUMNS)
        if step:
            self.columns[:, : -step or None] = self.columns[:, step:] if step < COLUMNS else np.nan
            self.columns[:, COLUMNS - step :] = np.nan
        self._number = newest
        for back in range(step):
            stop = (newest - back) * hop - view.first
            if stop < round(LENGTH / view.dt):
                return
            spectrum = view.once(("second", stop, *self._of), partial(self._spectrum, view, stop))
            self.columns[:, COLUMNS - 1 - back] = spectrum

    def _spectrum(self, view: LiveView, stop: int) -> Array:
        """Return the spectrum of the second before a frame of the view."""
        what, target, column = self._of
        signal = view.frames.z if what == MEASUREMENT else view.error(what, target)
        return second_spectrum(signal[stop - round(LENGTH / view.dt) : stop, column], view.dt)

    def _send(self, end: float, dt: float, scale: float, display: Display) -> None:
        self._sent_in = display.unit, display.dark
        image = (scale**2 * self.columns).astype(np.float32)
        left, top = end - COLUMNS * HOP, 0.5 / dt
        if not np.isfinite(image).any():
            return
        high = float(np.nanmax(image))
        self._colours.update(low=min(float(np.nanquantile(image, FLOOR)), high * 10.0**-DECADES), high=high)
        self._bar.update(
            title=f"{display.unit_label}²/Hz",
            background_fill_alpha=0.0,
            title_text_color="#C8C8C8" if display.dark else "#404040",
            major_label_text_color="#C8C8C8" if display.dark else "#404040",
        )
        # An image is drawn between its corners, in equal steps of the axis: of a logarithmic one, of the logarithm.
        self._source.data = {"image": [image], "x": [left], "y": [LOWEST], "dw": [end - left], "dh": [top - LOWEST]}
        self.figure.x_range.update(start=max(left, 0.0), end=end)  # before the loop there was nothing
        self.figure.y_range.update(start=LOWEST, end=top)
        self.figure.yaxis.axis_label = f"frequency [Hz], {display.mode_label}"


def second_spectrum(x: Array, dt: float) -> Array:
    """Return the spectrum of a second of a signal (n,) [um] in ROWS equal steps of the logarithm of the frequency [um^2/Hz].

    Each is the mean over its band of the spectrum taken as constant around every frequency. NaN where too much is missing.
    """
    whole = bridge_missing(x)
    if whole is None:
        return np.full(ROWS, np.nan)
    frequency, density = welch_psd(whole[:, None], dt, 1.0 / LENGTH)
    half = 0.5 * frequency[1]
    edges = np.geomspace(LOWEST, 0.5 / dt, ROWS + 1)
    power = np.concatenate([[0.0], np.cumsum(density[:, 0] * 2.0 * half)])
    below = np.interp(edges, np.concatenate([[-half], frequency + half]), power)
    return np.diff(below) / np.diff(edges)
