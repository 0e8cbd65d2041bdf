"""A list of groups of settings, such as the vibration peaks: a table to add to, remove from and edit in place."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import Any, Final

import panel as pn
import param

from wfsobs.app.component import HtmlComponent
from wfsobs.app.controls.fields import TAG, idle_html, parse_number, short_number
from wfsobs.app.controls.names import column_of, name_settings
from wfsobs.app.render import render
from wfsobs.app.store import Store
from wfsobs.app.style import html, script, sheets
from wfsobs.sensors.modes import TIP_TILT
from wfsobs.settings.group import Group
from wfsobs.settings.parameters import Reals, unit_of
from wfsobs.units import unit_text


class RowTable(HtmlComponent):
    """The table in the browser; messages {action, key, name} up, where the key is a row, or a row and a column."""

    _esm = script("patch", "markup", "rows")
    _stylesheets = sheets("base", "rows")

    def __init__(self, on_message: Callable[[dict[str, Any]], object], noun: str, columns: list[dict[str, Any]], **params: Any):
        """Make a table without rows.

        noun : what an item is called; columns : {key, name, doc, choices} of every one
        """
        self.noun = noun
        self.columns = columns
        super().__init__(on_message, **params)

    def show(self, rows: list[list[str | None]], errors: dict[str, dict[str, str]]) -> None:
        """Show rows: a text per column, None for what means nothing in an item. errors : "row.key" -> {text, reason}."""
        self.rows, self.errors = rows, errors
        self.html = render("rows.html", rows=rows, errors=errors, columns=self.columns, noun=self.noun)


class RowEditor:
    """The table of one list of groups, kept in step with the store."""

    def __init__(self, store: Store, path: str, p: param.List):
        self.store = store
        self.path = path
        assert isinstance(p.item_type, type) and issubclass(p.item_type, Group)
        self._kind: type[Group] = p.item_type
        self._texts: dict[str, str] = {}
        self.table: Final = RowTable(
            self.handle,
            self._kind.__name__.lower(),
            _columns(self._kind),
            tags=[TAG + path],
            sizing_mode="stretch_width",
            margin=(0, 0, 8, 0),
        )
        self.label: Final = str(p.label)
        self.idle: str = ""
        self.view: Final = pn.Column(self.table, sizing_mode="stretch_width", margin=0)
        self.refresh()
        store.param.watch(self.refresh, ["scenario", "errors"])

    def rest(self, why: str) -> None:
        """Leave the name of a list without effect, and say why; with an empty text the table comes back."""
        if why != self.idle:
            self.idle = why
            name = f"<b>{escape(self.label)}</b>{idle_html(why)}"
            self.view[:] = [html(name, margin=(8, 0))] if why else [self.table]

    def handle(self, msg: dict[str, Any]) -> None:
        """Do what a message of the table says."""
        action, (row, _, key) = msg.get("action"), str(msg.get("key", "")).partition(".")
        if action == "add":
            self.add()
        elif action == "remove":
            self.remove(int(row))
        elif action == "edit":
            self.edit(int(row), key, str(msg["name"]))

    def add(self) -> None:
        """One more item, with the defaults."""
        self._replace([*self._plain(), self._kind().to_dict()])

    def remove(self, row: int) -> None:
        """One item less."""
        items = self._plain()
        del items[row]
        self._replace(items)

    def edit(self, row: int, key: str, text: str) -> None:
        """Set one cell; `key` is the setting within the item, rms.0 for the first of a list of numbers."""
        path = f"{self.path}.{row}.{key}"
        self._texts[path] = text
        self.store.change(path, parse_number(text))

    def refresh(self, *_: object) -> None:
        """Show the accepted items and what was refused."""
        items = self.store.value(self.path)
        rows = [[None if c["key"] in item.idle() else _cell(item, c["key"]) for c in self.table.columns] for item in items]
        errors: dict[str, dict[str, str]] = {}
        for path, reason in self.store.errors.items():
            if f"{path}.".startswith(f"{self.path}."):
                errors[path.removeprefix(f"{self.path}.")] = {"text": self._texts.get(path, ""), "reason": name_settings(reason)}
        self.table.show(rows, errors)

    def _plain(self) -> list[dict[str, Any]]:
        return [item.to_dict() for item in self.store.value(self.path)]

    def _replace(self, items: list[dict[str, Any]]) -> None:
        self.store.change(self.path, items)


def _columns(kind: type[Group]) -> list[dict[str, Any]]:
    """One column per number or word, one for tip and one for tilt per list of numbers, named from the settings."""
    out = []
    for setting, p in kind.settings().items():
        keys = [setting]
        if isinstance(p, Reals):
            keys = [f"{setting}.{i}" for i, _ in enumerate(TIP_TILT)]
        unit = unit_text(unit_of(p))
        choices = list(p.objects) if isinstance(p, param.Selector) else []
        out += [
            {"key": key, "name": f"{name} [{unit}]" if unit else name, "doc": p.doc or "", "choices": choices}
            for key in keys
            for name in [column_of(key)]
        ]
    return out


def _cell(item: Group, key: str) -> str:
    name, _, mode = key.partition(".")
    value = getattr(item, name)
    if mode:
        value = value[int(mode)] if int(mode) < len(value) else 0.0
    return value if isinstance(value, str) else short_number(value)
