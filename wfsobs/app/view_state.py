"""What of the page is in its address beside the settings: page and its fields, mode, unit, switches, lines, window, seeds, theme.

`view.page=tune&view.mode=tilt&view.window=1,3&view.hide.vibration=kf-lgs,truth`; only what differs from a fresh page. What cannot
be used is named, and the rest is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from urllib.parse import parse_qsl, quote

import param

from wfsobs.app.display import Display
from wfsobs.app.pages.pages import EXPLORE, Pages
from wfsobs.app.pages.parts import PageActions
from wfsobs.app.seeds import SeedRuns
from wfsobs.app.style import observers_of
from wfsobs.app.views.main_lines import MainLines
from wfsobs.app.views.plots import on_settle
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
        self._known_pages: set[str] = set()
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
        of_page = f"{self.pages.current}."
        if (page := self._page) is not None:
            own = {key.removeprefix(of_page): value for key, value in fields.items() if key.startswith(of_page)}
            fields = {key: value for key, value in fields.items() if not key.startswith(of_page)}
            refused += [f"{PREFIX}{of_page}{line}" for line in page.open_link(own)]
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
    def _page(self) -> PageActions | None:
        """The page that is shown, if an address has something of it."""
        page = self.pages.by_name.get(self.pages.current)
        return page if isinstance(page, PageActions) else None

    def _turn(self, _event: object) -> None:
        if (page := self._page) is not None and self.pages.current not in self._known_pages:
            self._known_pages.add(self.pages.current)
            page.follow_link(self._refresh)
        self._refresh()

    def _refresh(self, *_: object) -> None:
        fields = {} if self.pages.current == EXPLORE else {PAGE: self.pages.current}
        fields |= {name: value for name in SWITCHES if (value := getattr(self.display, name)) != self._fresh[name]}
        fields |= {HIDE + target: ",".join(hidden) for target, hidden in self.lines.choices().items()}
        if (window := self.traces.chosen_window()) is not None:
            fields[WINDOW] = f"{window[0]:.4g},{window[1]:.4g}"
        if (page := self._page) is not None:
            fields |= {f"{self.pages.current}.{name}": text for name, text in page.link_fields().items()}
        if self.seeds.count != self.seeds.param["count"].default:
            fields[SEEDS] = str(self.seeds.count)
        parts = [f"{PREFIX}{key}={quote(value, safe=',:-')}" for key, value in fields.items()]
        self.query = "&".join([*parts, *([f"{THEME}={self._theme}"] if self._theme else [])])
