"""What the fields of all settings have in common: in step with the store, with the reason why a value or a setting is refused."""

from __future__ import annotations

from html import escape
from typing import Any

import panel as pn
import param

from wfsobs.app.controls.names import name_settings
from wfsobs.app.display import label_of, unit_text
from wfsobs.app.store import Store

ROOM = {"sizing_mode": "stretch_width", "margin": (4, 0)}

SOON = 5
"""How long a change in the browser waits for the next to go with it [ms]: by default 50, a tenth of a redraw."""

TAG = "setting:"
"""Stands before the path of its setting in the tag of a widget: the browser knows by it what was changed."""


class Field:
    """The widgets of one setting; `view` is what the page shows."""

    has_help = False
    """Whether its box has a line of help, which says why it has no effect; else a line below does."""

    def __init__(self, store: Store, path: str, p: param.Parameter):
        self.store, self.path, self.parameter = store, path, p
        self.idle = self._note_html = ""
        self.widgets = self._widgets()
        for widget in self.widgets:
            widget._debounce = SOON
        self.view = pn.Column(self._row(), sizing_mode="stretch_width", margin=0)
        self.refresh()
        store.param.watch(self.refresh, ["scenario", "errors"])

    def refresh(self, *_: object) -> None:
        """Show the accepted value, or leave what was refused and say why."""
        reason = self.store.errors.get(self.path, "")
        if not reason:
            self.show(self.store.value(self.path))
        self._note(error_html(name_settings(reason)) or ("" if self.has_help else idle_html(self.idle)))
        for widget in self.widgets:
            if "error_state" in widget.param:
                widget.error_state = bool(reason)

    def rest(self, why: str) -> None:
        """Grey the widgets of a setting without effect, and say why; with an empty text they can be used again."""
        if why != self.idle:
            self.idle = why
            for widget in self.widgets:
                widget.disabled = bool(why)
            if self.has_help:
                self.widgets[-1].helper_text = why
            self.refresh()

    def _note(self, html: str) -> None:
        """Show a line below the widgets; none where it is empty."""
        if html != self._note_html:
            self._note_html = html
            self.view[1:] = [pn.pane.HTML(html, margin=(0, 0, 6, 0))] if html else []

    def show(self, value: Any) -> None:
        """Put a value into the widgets."""
        raise NotImplementedError

    def enter(self, value: Any) -> None:
        """Do as if a value had been typed or chosen. Raises ValueError where that cannot be."""
        self.widgets[-1].value = value

    def _widgets(self) -> list[Any]:
        raise NotImplementedError

    def _row(self) -> Any:
        return self.widgets[0]

    def _change(self, event: param.parameterized.Event) -> None:
        self.store.change(self.path, event.new)

    def _names(self) -> dict[str, Any]:
        return {
            "label": label_of(self.parameter),
            "description": unit_text(self.parameter.doc or ""),
            "tags": [TAG + self.path],
        }


def error_html(reason: str) -> str:
    """Write the reason of a refusal, to stand beside its setting."""
    return f'<div role="alert" style="color:#d93025;font-size:12px">{escape(reason)}</div>' if reason else ""


def idle_html(why: str) -> str:
    """Write why a setting has no effect, to stand below it."""
    return f'<div style="font-size:12px;opacity:0.75">{escape(why)}</div>' if why else ""
