"""What of a page its address has: the texts of fields, the lines that are hidden."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, Protocol

HIDE = "hide"
"""Name of the lines that are hidden."""


class LinkPart(Protocol):
    """A part of a page as texts by name."""

    def texts(self) -> dict[str, str]:
        """Return what differs from a fresh page."""
        ...

    def open(self, texts: Mapping[str, str]) -> list[str]:
        """Take texts, for the rest what a fresh page has; return a line for each that is refused."""
        ...

    def watch(self, act: Callable[..., object]) -> None:
        """Call a function after every change."""


class LinkedFields:
    """Fields that hold a text or several each; what they hold when this is made is that of a fresh page."""

    def __init__(self, **fields: Any):
        self._fields, self._fresh = fields, {name: _text(field) for name, field in fields.items()}

    def texts(self) -> dict[str, str]:
        """Return the texts that differ from those of a fresh page."""
        return {name: text for name, field in self._fields.items() if (text := _text(field)) != self._fresh[name]}

    def open(self, texts: Mapping[str, str]) -> list[str]:
        """Fill in texts in the order of the fields, of which one may change the next."""
        refused = not_known(name for name in texts if name not in self._fields)
        for name, field in self._fields.items():
            text, several = texts.get(name, self._fresh[name]), isinstance(field.value, list)
            wanted = text.split(",") if several and text else [] if several else [text]
            if set(wanted) <= set(known := _choices(field) or wanted):
                field.value = wanted if several else text
            else:
                refused.append(f"{name} = {text[:80]}: takes {'some' if several else 'one'} of {', '.join(known)}"[:300])
        return refused

    def watch(self, act: Callable[..., object]) -> None:
        """Call a function after every change."""
        for field in self._fields.values():
            field.param.watch(act, "value")


class LinkedLater:
    """Fields that a page makes once it has results, and anew with others; until then the texts of an address wait."""

    def __init__(self) -> None:
        self._part: LinkPart | None = None
        self._waiting: dict[str, str] = {}
        self._acts: list[Callable[..., object]] = []

    def make(self, part: LinkPart) -> list[str]:
        """Fill in fields that are there now, as those before or the address have it; return a line for each text refused."""
        before, self._part = self.texts(), part
        refused = part.open(before)
        for act in self._acts:
            part.watch(act)
            act()
        return refused

    def texts(self) -> dict[str, str]:
        """Return the texts that differ from those of a fresh page, or those that wait."""
        return self._part.texts() if self._part else self._waiting

    def open(self, texts: Mapping[str, str]) -> list[str]:
        """Take texts, now or once there are fields; return a line for each that is refused now."""
        if self._part:
            return self._part.open(texts)
        self._waiting = dict(texts)
        return []

    def watch(self, act: Callable[..., object]) -> None:
        """Call a function after every change."""
        self._acts.append(act)
        if self._part:
            self._part.watch(act)


class LinkedLines:
    """The lines that a visitor has hidden on the cards of a page."""

    def __init__(self, cards: Any, names: Collection[str], is_chosen: Callable[[], bool], show_main: Callable[[], None]):
        """Make it. names : of all lines; is_chosen : whether a visitor has chosen; show_main : shows what a fresh page does."""
        self._cards, self._names, self._is_chosen, self._show_main = cards, names, is_chosen, show_main

    def texts(self) -> dict[str, str]:
        """Return the lines that are hidden, where a visitor has chosen."""
        return {HIDE: ",".join(self._cards.hidden_lines)} if self._is_chosen() else {}

    def open(self, texts: Mapping[str, str]) -> list[str]:
        """Hide lines."""
        refused, hidden = not_known(name for name in texts if name != HIDE), texts.get(HIDE)
        if hidden is None:
            self._show_main()
            return refused
        names = hidden.split(",") if hidden else []
        self._cards.hidden_lines = [name for name in names if name in self._names]
        return [*refused, *(f"{HIDE} = {name[:80]}: no line of that name" for name in names if name not in self._names)]

    def watch(self, act: Callable[..., object]) -> None:
        """Call a function when other lines are hidden."""
        self._cards.param.watch(act, "hidden_lines")


def not_known(names: Iterable[str]) -> list[str]:
    """Return a line for each name that a page has nothing of."""
    return [f"{name}: there is no such part of a view" for name in names]


def _text(field: Any) -> str:
    """Return what a field holds as one text."""
    return ",".join(field.value) if isinstance(field.value, list) else field.value


def _choices(field: Any) -> list[str]:
    """Return the texts that a field offers; none where it takes any."""
    options = getattr(field, "options", [])
    return list(options.values() if isinstance(options, dict) else options)
