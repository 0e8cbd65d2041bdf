"""One setting, one field: the widgets that fit its kind, kept in step with the store; of a list of groups a table.

Numbers are typed as text, so that whatever is typed reaches the setting's own check and its answer can be shown
beside it; a number with a usual range has a slider as well.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from html import escape
from typing import Any, Final

import panel as pn
import panel_material_ui as pmui
import param
from bokeh.models import CustomJSTickFormatter

from wfsobs.app.display import label_of
from wfsobs.app.render import render
from wfsobs.app.store import Store
from wfsobs.app.style import WIDE, HtmlComponent, HtmlText, html, script, sheets
from wfsobs.scenario.names import column_of, name_settings
from wfsobs.sensors.zernike import TIP_TILT
from wfsobs.settings.group import Group
from wfsobs.settings.values import Reals
from wfsobs.units import unit_text

ROOM = {"sizing_mode": "stretch_width", "margin": (4, 0)}

TAG = "setting:"
"""Stands before the path of its setting in the tag of a widget: the browser knows by it what was changed."""


class Field(ABC):
    """The widgets of one setting; `view` is what the page shows."""

    has_help = False
    """Whether its box has a line of help, which says why it has no effect; else a line below does."""
    height: int | None = 45
    """Of its row [px], kept from the first: rows come one after the other, and what is clicked must not move away."""

    def __init__(self, store: Store, path: str, p: param.Parameter[Any]):
        self.store = store
        self.path = path
        self.parameter = p
        self.idle: str = ""
        self._note_html = ""
        self.widgets: Final = self._widgets()
        row = self.widgets[0] if len(self.widgets) == 1 else pn.Row(*self.widgets, **WIDE)
        self.view: Final = pn.Column(row, min_height=self.height, **WIDE)
        self.refresh()
        store.param.watch(self.refresh, ["scenario", "errors"])

    def refresh(self, *_: object) -> None:
        """Show the accepted value, or leave what was refused and say why."""
        reason = self.store.errors.get(self.path, "")
        note = "" if self.has_help else idle_html(self.idle)
        if reason:
            note = f'<div role="alert" style="color:#d93025;font-size:12px">{escape(name_settings(reason))}</div>'
        else:
            self.show(self.store.value(self.path))
        if note != self._note_html:
            self._note_html = note
            self.view[1:] = [html(note, margin=(0, 0, 6, 0))] if note else []
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

    def show(self, value: Any) -> None:
        """Put a value into the widgets."""
        self.widgets[0].value = value

    def enter(self, value: Any) -> None:
        """Do as if a value had been typed or chosen. Raises ValueError where that cannot be."""
        self.widgets[-1].value = value

    @abstractmethod
    def _widgets(self) -> list[Any]: ...

    def _names(self) -> dict[str, Any]:
        return {
            "label": label_of(self.parameter),
            "description": unit_text(self.parameter.doc or ""),
            "tags": [TAG + self.path],
        }


def idle_html(why: str) -> str:
    """Write why a setting has no effect, to stand below it."""
    return f'<div style="font-size:12px;opacity:0.75">{escape(why)}</div>' if why else ""


def heading_html(title: str, why: str = "") -> str:
    """Write the name of settings, and why they have no effect."""
    return f"<b>{escape(title)}</b>{idle_html(why)}"


def heading(title: str, why: str = "", below: int = 0) -> HtmlText:
    """Make such a name. below : room below it [px]."""
    return html(heading_html(title, why), margin=(8, 0, below, 0), styles={"font-size": "13px"})


NUMBER_WIDTH = 92

DECADES = 2
"""A slider whose range spans as many, all of it positive, is logarithmic."""

ROOM_OF_NUMBER = 7
"""Characters for which a small box has room."""

UNNAMED = {
    "& .MuiInputLabel-root": {"clipPath": "inset(50%)", "overflow": "hidden", "width": "1px", "height": "1px"},
    "& legend": {"display": "none"},
    "& fieldset": {"top": 0},
    "& input": {"textOverflow": "ellipsis"},
}
"""A box whose name is heard but not seen: the slider beside it has the same. A number that is too long is seen to be."""


def number_text(value: float) -> str:
    """Write a number as a person would type it."""
    return f"{value:.10g}"


def short_number(value: float) -> str:
    """Write a number for a small box, in as many digits as it has room for; what is not typed over keeps all of its own.

    >>> short_number(18.475123), short_number(0.0123456), short_number(47.0), short_number(1.23456e-7)
    ('18.4751', '0.01235', '47', '1.2e-07')
    """
    texts = [number_text(value), *(number_text(float(f"{value:.{digits}g}")) for digits in (6, 5, 4, 3, 2))]
    return next((text for text in texts if len(text) <= ROOM_OF_NUMBER), texts[-1])


def parse_number(text: str) -> float | str:
    """Read a typed text as a number; other text stays text, for the setting to refuse."""
    text = text.strip().replace("−", "-")
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


class SwitchField(Field):
    """On or off."""

    def _make(self) -> Any:
        return pmui.Switch(**self._names(), **ROOM)

    def _widgets(self) -> list[Any]:
        widget = self._make()
        widget.param.watch(lambda event: self.store.change(self.path, event.new), "value")
        return [widget]


class ChoiceField(SwitchField):
    """One of several words."""

    has_help = True

    def _make(self) -> Any:
        return pmui.Select(options=list(self.parameter.objects), size="small", **self._names(), **ROOM)


class TextField(Field):
    """A number, typed."""

    has_help = True

    def _widgets(self) -> list[Any]:
        return [self._text(**self._names(), **ROOM)]

    def _text(self, **options: Any) -> pmui.TextInput:
        text = pmui.TextInput(size="small", **options)
        text.param.watch(self._on_text, "value")
        return text

    def _on_text(self, event: Any) -> None:
        if self.path in self.store.errors or event.new != self.to_text(self.store.value(self.path)):
            self.store.change(self.path, self.from_text(event.new))

    def show(self, value: Any) -> None:
        """Put a value into the text, unless it stands there: what is being typed over it stays."""
        written, box = self.to_text(value), self.widgets[-1]
        if box.value != written:
            box.param.update(value=written, value_input=written)

    def enter(self, value: Any) -> None:
        """Type a text, or the number that the slider stands at."""
        super().enter(value if isinstance(value, str) else number_text(float(value)))

    def to_text(self, value: Any) -> str:
        """Write the value as text."""
        return number_text(value)

    def from_text(self, text: str) -> Any:
        """Read the value from text."""
        return parse_number(text)


class NumbersField(TextField):
    """A list of numbers, typed with commas between them."""

    def to_text(self, value: Any) -> str:
        """Write the numbers as text."""
        return ", ".join(number_text(v) for v in value)

    def from_text(self, text: str) -> Any:
        """Read the numbers from text."""
        return [parse_number(part) for part in re.split(r"[,;\s]+", text.strip()) if part]


class SliderField(TextField):
    """A number with a usual range: a slider over that range, and the number itself to type.

    A logarithmic slider stands at the logarithm of the value to base 10, and goes to values of three digits.
    """

    has_help = False
    height = 56
    _value: Any = None
    """What the slider stands for, as far as it has said or was told."""

    def _widgets(self) -> list[Any]:
        p: Any = self.parameter
        whole = isinstance(p, param.Integer)
        low, high = p.softbounds
        self.is_log = p.bounds[0] > 0 and low > 0 and high >= low * 10.0**DECADES
        low, high = self._place(low), self._place(high)
        names = self._names()
        kind = pmui.IntSlider if whole and not self.is_log else pmui.FloatSlider
        hundredth = 10.0 ** math.floor(math.log10((high - low) / 100.0))  # a round one, about a two-hundredth of the range
        options: dict[str, Any] = {"step": p.step or (1 if whole else hundredth)}
        if self.is_log:
            options = {"step": 0.01, "format": CustomJSTickFormatter(code="return Number((10 ** tick).toPrecision(3))")}
        slider = kind(start=low, end=high, value=low, show_value=False, size="small", **options, **names, **ROOM)
        slider.param.watch(self._on_release, "value_throttled")
        text = self._text(
            label=names["label"], tags=[TAG + self.path], width=NUMBER_WIDTH, margin=(4, 0, 4, 8), align="end", sx=UNNAMED
        )
        return [slider, text]

    def _place(self, value: float) -> float:
        """Return where the slider stands for a value."""
        return math.log10(value) if self.is_log else value

    def _value_at(self, place: float) -> Any:
        """Return the value for which the slider stands at a place."""
        if not self.is_log:
            return place
        value = float(f"{10.0**place:.3g}")
        return round(value) if isinstance(self.parameter, param.Integer) else value

    def to_text(self, value: Any) -> str:
        """Write the value as text that the box beside the slider has room for."""
        return short_number(value)

    def enter(self, value: Any) -> None:
        """Type a text, or the number for which the slider stands."""
        super().enter(value if isinstance(value, str) else self._value_at(float(value)))

    def _on_release(self, event: Any) -> None:
        if event.new is None or (self._value is not None and event.new == self._place(self._value)):
            return  # put there by `show`
        self._value = self._value_at(event.new)
        if self._value != self.store.value(self.path):
            self.store.change(self.path, self._value)

    def show(self, value: Any) -> None:
        """Put a value into the text and the slider, whose range grows to hold it.

        A value that came from the slider does not go back to it: by then it may have been moved on.
        """
        super().show(value)
        if value == self._value:
            return
        self._value = value
        slider = self.widgets[0]
        low, high, place = (self._place(at) for at in (*self.parameter.softbounds, value))
        with param.edit_constant(slider):  # value_throttled too: releasing at its old value must count as news
            slider.param.update(start=min(low, place), end=max(high, place), value=place, value_throttled=place)


class RowTable(HtmlComponent):
    """The table in the browser; messages {action, key, name} up, where the key is a row, or a row and a column."""

    _esm = script("markup", "rows")
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


class RowEditor(Field):
    """The table of one list of groups, of which only the name is left where the list has no effect."""

    height = None

    def _widgets(self) -> list[Any]:
        self._texts: dict[str, str] = {}
        kind = self.parameter.item_type if isinstance(self.parameter, param.List) else None
        assert isinstance(kind, type) and issubclass(kind, Group)
        self.kind: type[Group] = kind
        options = {"sizing_mode": "stretch_width", "margin": (0, 0, 8, 0)}
        self.table = RowTable(self.enter, self.kind.__name__.lower(), _columns(self.kind), tags=[TAG + self.path], **options)
        return [self.table]

    def rest(self, why: str) -> None:
        """Leave the name of a list without effect, and say why; with an empty text the table comes back."""
        if why != self.idle:
            self.idle = why
            self.view[:] = [heading(str(self.parameter.label), why, 8) if why else self.table]

    def enter(self, value: Any) -> None:
        """Do what a message of the table says. Raises ValueError, TypeError or IndexError where that cannot be."""
        message = dict(value)
        action, (row, _, key) = message.get("action"), str(message.get("key", "")).partition(".")
        items = [item.to_dict() for item in self.store.value(self.path)]
        if action == "edit":  # a cell; of a list of numbers, rms.0 is the first
            path = f"{self.path}.{int(row)}.{key}"
            self._texts[path] = str(message["name"])
            self.store.change(path, parse_number(self._texts[path]))
        elif action == "add":
            self.store.change(self.path, [*items, self.kind().to_dict()])
        elif action == "remove":
            del items[int(row)]
            self.store.change(self.path, items)

    def refresh(self, *_: object) -> None:
        """Show the accepted items and what was refused."""
        self.show(self.store.value(self.path))

    def show(self, value: list[Group]) -> None:
        """Put the items into the table."""
        rows = [[None if c["key"] in item.idle() else _cell(item, c["key"]) for c in self.table.columns] for item in value]
        errors = {
            path.removeprefix(f"{self.path}."): {"text": self._texts.get(path, ""), "reason": name_settings(reason)}
            for path, reason in self.store.errors.items()
            if f"{path}.".startswith(f"{self.path}.")
        }
        self.table.show(rows, errors)


KINDS: Mapping[Any, type[Field]] = {
    param.Boolean: SwitchField,
    param.Selector: ChoiceField,
    Reals: NumbersField,
    param.List: RowEditor,
    param.Number: SliderField,
}
"""Kind of a setting -> its field; others are typed."""


def make_field(store: Store, path: str, p: param.Parameter[Any]) -> Field:
    """Make the field that fits a setting; a number without a usual range is typed."""
    kind = next((field for of, field in KINDS.items() if isinstance(p, of)), TextField)
    return (TextField if kind is SliderField and not p.softbounds else kind)(store, path, p)


def _columns(kind: type[Group]) -> list[dict[str, Any]]:
    """One column per number or word, one for tip and one for tilt per list of numbers, named from the settings."""
    out = []
    for setting, p in kind.settings().items():
        keys = [f"{setting}.{i}" for i, _ in enumerate(TIP_TILT)] if isinstance(p, Reals) else [setting]
        more = {"doc": p.doc or "", "choices": list(p.objects) if isinstance(p, param.Selector) else []}
        out += [{"key": key, "name": label_of(p, column_of(key)), **more} for key in keys]
    return out


def _cell(item: Group, key: str) -> str:
    name, _, mode = key.partition(".")
    value = getattr(item, name)
    if mode:
        value = value[int(mode)] if int(mode) < len(value) else 0.0
    return value if isinstance(value, str) else short_number(value)
