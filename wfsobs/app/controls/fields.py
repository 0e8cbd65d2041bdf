"""One setting, one field: the widgets that fit its kind, kept in step with the store.

Numbers are typed as text, so that whatever is typed reaches the setting's own check and its answer can be shown
beside it; a number with a usual range has a slider as well.
"""

from __future__ import annotations

import math
import re
from typing import Any

import panel as pn
import panel_material_ui as pmui
import param

from wfsobs.app.controls.field import ROOM, TAG, Field
from wfsobs.app.store import Store
from wfsobs.settings.parameters import Reals

NUMBER_WIDTH = 92

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


class ChoiceField(Field):
    """One of several words."""

    has_help = True

    def _widgets(self) -> list[Any]:
        select = pmui.Select(options=list(self.parameter.objects), size="small", **self._names(), **ROOM)
        select.param.watch(self._change, "value")
        return [select]

    def show(self, value: Any) -> None:
        """Put a value into the widget."""
        self.widgets[0].value = value


class SwitchField(Field):
    """On or off."""

    def _widgets(self) -> list[Any]:
        switch = pmui.Switch(**self._names(), **ROOM)
        switch.param.watch(self._change, "value")
        return [switch]

    def show(self, value: Any) -> None:
        """Put a value into the widget."""
        self.widgets[0].value = value


class TextField(Field):
    """A number, typed."""

    has_help = True

    def _widgets(self) -> list[Any]:
        return [self._text(**self._names(), **ROOM)]

    def _text(self, **options: Any) -> pmui.TextInput:
        text = pmui.TextInput(size="small", **options)
        text.param.watch(self._on_text, "value")
        return text

    def _on_text(self, event: param.parameterized.Event) -> None:
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
    """A number with a usual range: a slider over that range, and the number itself to type."""

    has_help = False
    _value: Any = None
    """What the slider stands at, as far as it has said or was told."""

    def _widgets(self) -> list[Any]:
        p: Any = self.parameter
        whole = isinstance(p, param.Integer)
        low, high = p.softbounds
        names = self._names()
        kind = pmui.IntSlider if whole else pmui.FloatSlider
        slider = kind(
            start=low,
            end=high,
            value=low,
            step=p.step or (1 if whole else _step(low, high)),
            show_value=False,
            size="small",
            **names,
            **ROOM,
        )
        slider.param.watch(self._on_release, "value_throttled")
        text = self._text(
            label=names["label"], tags=[TAG + self.path], width=NUMBER_WIDTH, margin=(4, 0, 4, 8), align="end", sx=UNNAMED
        )
        return [slider, text]

    def to_text(self, value: Any) -> str:
        """Write the value as text that the box beside the slider has room for."""
        return short_number(value)

    def _row(self) -> Any:
        return pn.Row(*self.widgets, sizing_mode="stretch_width", margin=0)

    def _on_release(self, event: param.parameterized.Event) -> None:
        self._value = event.new
        if event.new is not None and event.new != self.store.value(self.path):
            self.store.change(self.path, event.new)

    def show(self, value: Any) -> None:
        """Put a value into the text and the slider, whose range grows to hold it.

        A value that came from the slider does not go back to it: by then it may have been moved on.
        """
        super().show(value)
        if value == self._value:
            return
        self._value = value
        slider = self.widgets[0]
        low, high = self.parameter.softbounds
        with param.edit_constant(slider):  # value_throttled too: releasing at its old value must count as news
            slider.param.update(start=min(low, value), end=max(high, value), value=value, value_throttled=value)


def make_field(store: Store, path: str, p: param.Parameter) -> Field:
    """Make the field that fits a setting."""
    if isinstance(p, param.Boolean):
        return SwitchField(store, path, p)
    if isinstance(p, param.Selector):
        return ChoiceField(store, path, p)
    if isinstance(p, Reals):
        return NumbersField(store, path, p)
    if isinstance(p, param.Number) and p.softbounds:
        return SliderField(store, path, p)
    return TextField(store, path, p)


def _step(low: float, high: float) -> float:
    """Choose a round step, about a two-hundredth of the range."""
    return 10.0 ** math.floor(math.log10((high - low) / 100.0))
