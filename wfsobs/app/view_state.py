"""What of the page is in its address beside the settings: page, mode, unit, switches, lines, window, seeds, theme.

`view.page=tune&view.mode=tilt&view.window=1,3&view.hide.vibration=kf-lgs,truth`; only what differs from a fresh page. What cannot
be used is named, and the rest is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from urllib.parse import parse_qsl, quote

import param

from wfsobs.app.display import Display
from wfsobs.app.pages.live import LivePage
from wfsobs.app.pages.live_controls import CONTROLLERS, OBSERVERS, SPEED
from wfsobs.app.pages.pages import EXPLORE, LIVE, Pages
from wfsobs.app.seeds import SeedRuns
from wfsobs.app.style import observers_of
from wfsobs.app.views.main_lines import MainLines
from wfsobs.app.views.settle import on_settle
from wfsobs.app.views.traces import Traces
from wfsobs.app.work import TRUTH
from wfsobs.observers.base import TARGETS

PREFIX = "view."
SWITCHES = ("mode", "unit", "show", "spectrum")
"""Switches of the display, by their names there."""

PAGE, WINDOW, HIDE, SEEDS, THEME = "page", "window", "hide.", "seeds", "theme"
MOST = 50
"""Fields of a query that are read."""


class ViewState(param.Parameterized):
    """The view as a query, kept in step with the page; and the page, brought to the view of a query."""

    query = param.String("", doc="What the address has of the view, without ?.")

    def __init__(self, display: Display, pages: Pages, lines: MainLines, traces: Traces, seeds: SeedRuns):
        super().__init__()
        self.display, self.pages, self.lines, self.traces, self.seeds = display, pages, lines, traces, seeds
        self._fresh = {name: getattr(display, name) for name in SWITCHES}
        self._theme = ""
        display.param.watch(self._refresh, [*SWITCHES, "hidden_lines"])
        self._knows_live = False
        pages.param.watch(self._turn, "current")
        seeds.param.watch(self._refresh, "count")
        on_settle([traces.x_range], self._refresh)

    def choose_theme(self, dark: bool) -> None:
        """Keep the theme that the visitor has chosen."""
        self._theme = "dark" if dark else "light"
        self._refresh()

    def open(self, query: str) -> list[str]:
        """Bring the page to the view of a query, what it does not name to that of a fresh page; a line for each field refused."""
        fields = {
            key.removeprefix(PREFIX): value
            for key, value in parse_qsl(query.removeprefix("?"), keep_blank_values=True)[:MOST]
            if key.startswith(PREFIX) or key == THEME
        }
        if (theme := fields.pop(THEME, "")) in ("dark", "light"):
            self._theme = theme
        refused = []
        wanted = {PAGE: EXPLORE, **self._fresh, **{key: v for key, v in fields.items() if key in (PAGE, *SWITCHES)}}
        for key, value in wanted.items():
            of, name = (self.pages, "current") if key == PAGE else (self.display, key)
            try:
                setattr(of, name, value)
            except ValueError:
                refused.append(f"{PREFIX}{key} = {value[:80]}: takes one of {', '.join(of.param[name].objects)}")
        refused += self._open_lines(fields)
        refused += self._open_window(fields.get(WINDOW, ""))
        refused += self._open_seeds(fields.get(SEEDS, str(self.seeds.param["count"].default)))
        if (live := self._live) is not None:
            fields, of_loop = _split(fields)
            refused += [f"{PREFIX}{line}" for line in live.open_link(of_loop)]
        known = {PAGE, WINDOW, SEEDS, *SWITCHES, *(HIDE + target for target in TARGETS)}
        refused += [f"{PREFIX}{key}: there is no such part of a view" for key in fields if key not in known]
        self._refresh()
        return refused

    def _open_lines(self, fields: Mapping[str, str]) -> list[str]:
        refused = []
        for target in TARGETS:
            text = fields.get(HIDE + target)
            if text is None:
                self.lines.reset(target)
                continue
            names, known = text.split(",") if text else [], (TRUTH, *observers_of(target))
            self.lines.choose(target, [name for name in names if name in known])
            refused += [f"{PREFIX}{HIDE}{target} = {name[:80]}: no line of that name" for name in names if name not in known]
        return refused

    def _open_window(self, text: str) -> list[str]:
        if not text:
            self.traces.open_window(None)
            return []
        try:
            start, end = (float(part) for part in text.split(","))
            if not 0.0 <= start < end:
                raise ValueError
        except ValueError:
            return [f"{PREFIX}{WINDOW} = {text[:80]}: takes two times [s], the first one smaller"]
        self.traces.open_window((start, end))
        return []

    def _open_seeds(self, text: str) -> list[str]:
        low, high = self.seeds.param["count"].bounds
        try:
            if not low <= int(text) <= high:
                raise ValueError
        except ValueError:
            return [f"{PREFIX}{SEEDS} = {text[:80]}: takes a whole number from {low} to {high}"]
        self.seeds.count = int(text)
        return []

    @property
    def _live(self) -> LivePage | None:
        """The page of the live loop, once it is there."""
        page = self.pages.by_name.get(LIVE)
        return page if isinstance(page, LivePage) else None

    def _turn(self, _event: object) -> None:
        if (live := self._live) is not None and not self._knows_live:
            self._knows_live = True
            for field in live.inputs:
                field.param.watch(self._refresh, "value")
        self._refresh()

    def _refresh(self, *_: object) -> None:
        fields = {} if self.pages.current == EXPLORE else {PAGE: self.pages.current}
        fields |= {name: value for name in SWITCHES if (value := getattr(self.display, name)) != self._fresh[name]}
        fields |= {HIDE + target: ",".join(hidden) for target, hidden in self.lines.choices().items()}
        if (window := self.traces.chosen_window()) is not None:
            fields[WINDOW] = f"{window[0]:.4g},{window[1]:.4g}"
        if (live := self._live) is not None:
            fields |= live.link_fields()
        if self.seeds.count != self.seeds.param["count"].default:
            fields[SEEDS] = str(self.seeds.count)
        parts = [f"{PREFIX}{key}={quote(value, safe=',-')}" for key, value in fields.items()]
        self.query = "&".join([*parts, *([f"{THEME}={self._theme}"] if self._theme else [])])


def _split(fields: Mapping[str, str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return the fields that are not of the live loop, and those that are."""
    of_loop = {key: fields[key] for key in (OBSERVERS, CONTROLLERS, SPEED) if key in fields}
    return {key: value for key, value in fields.items() if key not in of_loop}, of_loop
