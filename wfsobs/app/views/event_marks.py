"""The events of a scenario in a time trace: a line where something jumps, a span while it lasts, and a word at each."""

from __future__ import annotations

import math

from bokeh.models import ColumnDataSource, Text, VSpan, VStrip
from bokeh.plotting import figure

from wfsobs.app.views.plots import send
from wfsobs.app.work import RunResults
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.events import LASER, PEAK, WIND, Event

COLOURS = {False: "#7A1FA2", True: "#E0B3FF"}
"""In light and dark mode."""

LEVELS = 3
"""Words one below the other before they start at the top again."""

LINE_PX = 13
WORD = 0.25
"""How wide a word is at most, as a share of the record."""


def word(event: Event, scenario: Scenario) -> str:
    """Name an event in a word or two.

    >>> word(Event(kind="peak", frequency_shift=3.0), Scenario()), word(Event(kind="laser", lasers=2), Scenario())
    ('47.5 Hz peak +3 Hz', '2 LGS out')
    """
    if event.kind == PEAK:
        moves = f" {event.frequency_shift:+g} Hz" if event.frequency_shift else ""
        grows = f" × {event.strength:g}" if event.strength != 1.0 else ""
        return f"{scenario.vibration.peaks[event.peak].frequency:.3g} Hz peak{moves}{grows}".replace("-", "−")
    if event.kind == WIND:
        return f"wind × {event.wind_factor:g}"
    if event.kind == LASER:
        return f"{event.lasers} LGS out"
    return f"{100 * event.share:g} % {event.sensor.upper()} lost"


def events_of(results: RunResults) -> list[Event]:
    """By their start, of the simulation; a record that was loaded has none."""
    return [] if results.simulation is None else sorted(results.simulation.events, key=lambda e: e.start)


def room(results: RunResults) -> float:
    """Compute the height of the words above the lines, as a share of the axis."""
    return 0.1 * (1 + max(levels(results), default=-1))


def levels(results: RunResults) -> list[int]:
    """How many lines below the top the word of each event stands, so that none stands in the one before."""
    out, before = [], -math.inf
    for event in events_of(results):
        near = event.start - before < WORD * results.scenario.run.duration
        out.append((out[-1] + 1) % LEVELS if near else 0)
        before = event.start
    return out


class EventMarks:
    """The marks in one figure, none until there is an event; words hang from the top of its axis."""

    def __init__(self, fig: figure):
        self.figure, self._marks_exist = fig, False
        self.jumps = ColumnDataSource({"x": []})
        self.spans = ColumnDataSource({"start": [], "end": []})
        self.words = ColumnDataSource({"x": [], "y": [], "text": [], "below": []})
        self._line = VSpan(x="x", line_width=1.5, line_dash=[6, 3])
        self._strip = VStrip(x0="start", x1="end", fill_alpha=0.13, line_width=0)
        self._text = Text(x="x", y="y", text="text", x_offset=4, y_offset="below", text_baseline="top", text_font_size="11px")

    def draw(self, results: RunResults, dark: bool) -> None:
        """Show those of the results."""
        events = events_of(results)
        if not events and not self._marks_exist:
            return
        self._make()
        lasting = [e for e in events if e.duration > 0]
        send(self.jumps, {"x": [e.start for e in events if not e.duration > 0]})
        send(self.spans, {"start": [e.start for e in lasting], "end": [e.start + e.duration for e in lasting]})
        top = float(self.figure.y_range.end)  # type: ignore[attr-defined]
        send(
            self.words,
            {
                "x": [e.start for e in events],
                "y": [top] * len(events),
                "text": [word(e, results.scenario) for e in events],
                "below": [2 + LINE_PX * level for level in levels(results)],
            },
        )
        self.restyle(dark)

    def _make(self) -> None:
        if not self._marks_exist:
            self._marks_exist = True
            self.figure.add_glyph(self.spans, self._strip, level="underlay")
            self.figure.add_glyph(self.jumps, self._line)
            self.figure.add_glyph(self.words, self._text, level="overlay")

    def restyle(self, dark: bool) -> None:
        """Set the colour of light or dark mode."""
        self._line.line_color = self._strip.fill_color = self._text.text_color = COLOURS[dark]
