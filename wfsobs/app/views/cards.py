"""Rows that are the legend of a figure as well: what observers or controllers leave, with bars, and which lines are shown."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import param

from wfsobs.app.display import over
from wfsobs.app.glossary import TERMS, sentence_on
from wfsobs.app.render import NOTHING, number, render, with_decimals_of
from wfsobs.app.style import WIDE, HtmlComponent, look, script, sheets
from wfsobs.app.work import TRUTH
from wfsobs.evaluation.result import uncertainty_text


class Cards(HtmlComponent):
    """A row per line; a click on one hides or shows its line, a double click, whose clicks undo each other, shows it alone."""

    hidden_lines: param.List[list[Any]] = param.List([], doc="Names of the rows whose lines are hidden.")

    _esm = script("page", "markup", "strip")
    _stylesheets = sheets("base", "style", "strip", "bare")

    def __init__(self, kind: str = "observers"):
        """Make the table. kind : what the rows are of."""
        self.kind = kind
        self.on_main: Callable[[], None] = lambda: None
        self.on_all: Callable[[], None] = lambda: None
        self.is_open: bool = False
        self._among: list[str] = []
        """What is hidden again once a line is no longer alone."""
        self._own_choice: list[str] = []
        super().__init__(self._take, **WIDE)
        self.show([])

    def show(
        self, items: list[dict[str, Any]], heads: Mapping[str, str] | None = None, legend: Sequence[tuple[str, str]] = ()
    ) -> None:
        """Show rows, as `Strip` makes them.

        heads : headings of the columns value, note, change and bar; legend : (colour, label) of the pieces of bars
        """
        self.items, self.heads, self.legend = items, heads or {}, legend
        self._fold()

    @param.depends("hidden_lines", watch=True)
    def _follow(self) -> None:
        """Mark the rows; a click moves none of them."""
        if self.hidden_lines == self._own_choice:
            self._draw()
        else:
            self._fold()

    def _fold(self) -> None:
        """Fold away the rows that are not of the main lines and not shown."""
        minor = [it for it in self.items if not it.get("main") and (it["name"] in self.hidden_lines or it["value"] == NOTHING)]
        self._minor_rows = [] if self.is_open else [it["name"] for it in minor]
        self._draw()

    def _draw(self) -> None:
        of = {name: getattr(self, name) for name in ("kind", "items", "heads", "legend", "is_open")}
        longest = max((max(it["size"], it["limit"]) for it in self.items if it["name"] not in self._minor_rows), default=0.0)
        values = {"hidden": self.hidden_lines, "folded": self._minor_rows, "longest": longest, "terms": TERMS, "truth": TRUTH}
        self.html = render("strip.html", **of, **values)

    def _take(self, data: dict[str, Any]) -> None:
        """Take a click: on a row, or the wish for the main rows, all rows or all lines."""
        name, names, hidden = str(data.get("name")), [str(it["name"]) for it in self.items], self.hidden_lines
        match data.get("action"):
            case "main" | "all" as rows:
                self.is_open = rows == "all"
                (self.on_all if self.is_open else self.on_main)()
                self._fold()
            case "lines":
                self._hide([])
            case "toggle" if name in names:
                self._hide([it for it in hidden if it != name] if name in hidden else [*hidden, name])
            case "solo" if name in names:
                self._show_alone(name, names)

    def _show_alone(self, name: str, names: list[str]) -> None:
        """Hide all lines but one, or, where it is alone, those that were hidden before; one without a row stays hidden."""
        shown = [it for it in names if it not in self.hidden_lines]
        if shown == [name]:
            return self._hide(self._among)
        if len(shown) != 1:
            self._among = self.hidden_lines
        self._hide([*(it for it in self.hidden_lines if it not in names), *(it for it in names if it != name)])

    def _hide(self, names: list[str]) -> None:
        self._own_choice = self.hidden_lines = names


def card_of(name: str, dark: bool, note: str, value: str = NOTHING, **fields: Any) -> dict[str, Any]:
    """Describe the row of an observer or a controller that has no bar, nor anything it is compared with, but for other fields."""
    it = look(name)
    known = {"name": name, "label": it.label, "colour": it.colour(dark), "dash": it.dash, "about": sentence_on(name)}
    empty = {"unit": "", "half": "", "change": "", "parts": (), "size": 0.0, "limit": 0.0, "compared": ()}
    return {**known, "note": note, "value": value, **empty, **fields}


def error_fields(rms: float, interval: Sequence[float] | None, scale: float, n_seeds: int = 1) -> dict[str, str]:
    """Format an error [um] and its interval; scale : from micrometres to the unit shown; n_seeds : that it is a mean over."""
    value = number(rms * scale)
    half = uncertainty_text(rms, interval, lambda x: with_decimals_of(value, x * scale)) if interval else ""
    return {"value": value, "half": half, "meaning": over(n_seeds)}
