"""The topics of the drawer: each opens below its name, and has nothing on the page while it is closed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import panel as pn

from wfsobs.app.render import render
from wfsobs.app.style import WIDE, HtmlComponent, script, sheets


class Headings(HtmlComponent):
    """Names of topics below each other in the browser; a click on one tells its key."""

    _esm = script("markup", "buttons")
    _stylesheets = sheets("base", "topics")


class TopicList:
    """Names of topics, and the rooms of those that are open.

    A layout of the toolkit has a child for every topic, and lays out the page once for each, again with every change of a name.
    """

    def __init__(self, titles: Mapping[str, str], room_of: Callable[[str], pn.Column]):
        """Show all closed. titles : topic -> title;  room_of : gives the contents of a topic that is opened."""
        self.titles = dict(titles)
        self.open_topics: list[str] = []
        self.view: Final = pn.Column(sizing_mode="stretch_width", margin=(8, 0))
        self._room_of = room_of
        self._headings: list[Headings] = []
        self._draw()

    def open(self, name: str) -> None:
        """Open a topic, unless it is."""
        if name not in self.open_topics:
            self._toggle({"key": name})

    def rename(self, titles: Mapping[str, str]) -> None:
        """Write other titles, of all topics."""
        if titles != self.titles:
            self.titles = dict(titles)
            self._draw()

    def _toggle(self, message: Mapping[str, Any]) -> None:
        name = str(message.get("key"))
        if name in self.titles:
            others = [it for it in self.open_topics if it != name]
            self.open_topics = others if name in self.open_topics else [*others, name]
            self._draw()

    def _draw(self) -> None:
        """Write the names, in one piece up to each topic that is open."""
        pieces: list[list[str]] = [[]]
        for name in self.titles:
            pieces[-1].append(name)
            if name in self.open_topics:
                pieces.append([])
        pieces = [piece for piece in pieces if piece]
        self._headings += [Headings(self._toggle, **WIDE) for _ in pieces[len(self._headings) :]]
        parts: list[Any] = []
        for piece, headings in zip(pieces, self._headings, strict=False):
            is_open = piece[-1] in self.open_topics
            headings.html = render(
                "topics.html", titles={name: self.titles[name] for name in piece}, opened=piece[-1] if is_open else ""
            )
            parts += [headings, self._room_of(piece[-1])] if is_open else [headings]
        if parts != self.view.objects:
            self.view[:] = parts
