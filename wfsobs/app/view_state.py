"""What of the page is in its address beside the settings: page and its fields, mode, unit, switches, lines, window, seeds, theme.

`view.page=tune&view.mode=tilt&view.window=1,3&view.hide.vibration=kf-lgs,truth`; only what differs from a fresh page. What cannot
be used is named, and the rest is used.
"""

from __future__ import annotations

from collections.abc import Collection
from urllib.parse import parse_qsl, quote

import param

from wfsobs.app.display import Display
from wfsobs.app.pages.pages import EXPLORE, Pages
from wfsobs.app.pages.parts import LinkedFields, LinkedLines, LinkPart, not_known
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
        self.display, self.pages, self.lines, self.traces = display, pages, lines, traces
        switches = LinkedFields({PAGE: (pages, "current")} | {name: (display, name) for name in SWITCHES})
        switches.fresh[PAGE] = EXPLORE
        self._parts: list[tuple[Collection[str], LinkPart]] = [
            ((PAGE, *SWITCHES), switches),
            *(((HIDE + target,), self._lines_of(target)) for target in TARGETS),
            ((SEEDS,), LinkedFields({SEEDS: (seeds, "count")})),
        ]
        self._theme, self._known_pages = "", set[str]()
        for _names, part in self._parts:
            part.watch(self._refresh)
        pages.param.watch(self._turn, "current")
        on_settle([traces.x_range], self._refresh)

    def _lines_of(self, target: str) -> LinkedLines:
        def hide(names: list[str] | None) -> None:
            if names is None:
                self.lines.reset(target)
            else:
                self.lines.choose(target, names)

        known, display = (TRUTH, *observers_of(target)), self.display
        hidden = lambda: self.lines.choices().get(target)  # noqa: E731
        return LinkedLines(HIDE + target, known, hidden, hide, lambda act: display.param.watch(act, "hidden_lines"))

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
        refused = self._open_window(fields.pop(WINDOW, ""))
        for names, part in self._parts:
            refused += part.open({name: fields.pop(name) for name in names if name in fields})
        of_page = f"{self.pages.current}."
        own = {key: fields.pop(key) for key in [*fields] if key.startswith(of_page)}
        refused += [of_page + line for line in self.pages.page.open_link({key.removeprefix(of_page): own[key] for key in own})]
        self._refresh()
        return [PREFIX + line for line in (*refused, *not_known(fields))]

    def _open_window(self, text: str) -> list[str]:
        try:
            start, end = (float(part) for part in text.split(",")) if text else (0.0, 1.0)
            if not 0.0 <= start < end:
                raise ValueError
        except ValueError:
            return [f"{WINDOW} = {text[:80]}: takes two times [s], the first one smaller"]
        self.traces.open_window((start, end) if text else None)
        return []

    def _turn(self, _event: object) -> None:
        if self.pages.current not in self._known_pages:
            self._known_pages.add(self.pages.current)
            self.pages.page.link.watch(self._refresh)
        self._refresh()

    def _refresh(self, *_: object) -> None:
        fields: dict[str, str] = {}
        for _names, part in self._parts[:-1]:
            fields |= part.texts()
        if (window := self.traces.chosen_window()) is not None:
            fields[WINDOW] = f"{window[0]:.4g},{window[1]:.4g}"
        fields |= {f"{self.pages.current}.{name}": text for name, text in self.pages.page.link.texts().items()}
        fields |= self._parts[-1][1].texts()
        parts = [f"{PREFIX}{key}={quote(value, safe=',:-')}" for key, value in fields.items()]
        self.query = "&".join([*parts, *([f"{THEME}={self._theme}"] if self._theme else [])])
