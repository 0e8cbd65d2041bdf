"""What the page is made of: its own components, whose parameters go down to the browser and messages up; texts, buttons, colours.

Colours of observers and controllers are `wfsobs.plot.looks`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from importlib.resources import files
from typing import Any

import panel as pn
import panel_material_ui as pmui
import param
from markupsafe import Markup
from panel.custom import JSComponent

from wfsobs.app.render import Row, macro
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.result import NO_ESTIMATE
from wfsobs.evaluation.scores import BOUND, BOUND_BOTH
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS, Look
from wfsobs.plot.looks import LOOKS as LOOKS
from wfsobs.plot.looks import TERM_COLOURS as TERM_COLOURS
from wfsobs.plot.looks import look as look
from wfsobs.record import TOTAL


class Component(JSComponent):
    """A component of the page in JavaScript.

    on_message : gets the messages {name: value, ...} of the browser, and may change figures. Panel answers a message without the
    lock of the document while a changed property is on its way; held changes need none. Until the page has been drawn Panel drops
    held changes, so that messages wait.
    """

    __abstract = True

    def __init__(self, on_message: Callable[[dict[str, Any]], object] | None = None, **params: Any):
        self.on_message: Callable[[dict[str, Any]], object] = on_message or (lambda _message: None)
        super().__init__(**params)

    def _handle_msg(self, data: object) -> None:
        if isinstance(data, dict):
            answer = partial(self._answer, data)
            answer() if pn.state.loaded else pn.state.onload(answer)

    def _answer(self, message: dict[str, Any]) -> None:
        with pn.io.hold():
            self.on_message(message)


class HtmlComponent(Component):
    """A component whose contents are HTML that is made here."""

    __abstract = True

    html: param.String[str] = param.String("", doc="What is in it.")


RUNS: Mapping[str, Look] = {
    "A": Look("A", "#0072B2", "#6CB8E6", (6, 3)),
    "B": Look("B", "#B84A00", "#FF9A57", (2, 2)),
    "C": Look("C", "#007A58", "#4FD1AE", (10, 3, 2, 3)),
    "D": Look("D", "#9C3F78", "#E79AC6", (12, 4)),
    "E": Look("E", "#6B5B00", "#D9C64A", (4, 2, 1, 2)),
}
"""Runs that are compared with the one shown, by their letters."""

BOUND_MARKS: Mapping[str, tuple[str, str, str]] = {
    BOUND: ("#D64533", "dashed", "theoretical limit using LGS"),
    BOUND_BOTH: ("#7A4FBF", "dotted", "theoretical limit using LGS and NGS"),
}
"""Bound -> its colour, its dash, and how it is called beside an error budget."""

HEARD = ".MuiFormLabel-root { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); }"
"""Style of a switch whose name is heard but not seen."""


def asset(name: str) -> str:
    """Text of a file of the package's assets."""
    return files("wfsobs.assets").joinpath(name).read_text(encoding="utf-8")


THEME: Mapping[str, Any] = tomllib.loads(asset("theme.toml"))
"""Colours in light and dark mode, what is common to both, and the style of the bar."""

PRIMARY: str = THEME["light"]["palette"]["primary"]["main"]


def theme() -> dict[str, Any]:
    """Return the page's theme in light and dark mode."""
    return {mode: THEME[mode] | THEME["common"] for mode in ("light", "dark")}


def labels() -> dict[str, str]:
    """Every line's name in legends."""
    return {name: look(name).label for name in (*LOOKS, *OBSERVERS, *CONTROLLERS)}


def observers_of(target: str, with_zero: bool = False) -> list[str]:
    """List the observers that estimate a target, or both for TOTAL, in the order of the registry.

    with_zero : also no estimate at all, a row of tables; its line is the axis
    """
    wanted = set(TARGETS if target == TOTAL else (target,))
    return [o.id for o in OBSERVERS.values() if wanted <= set(o.targets) and (with_zero or o.id != NO_ESTIMATE)]


def script(*names: str) -> str:
    """Join scripts of the assets, by name."""
    return "".join(asset(f"{name}.js") for name in names)


def sheets(*names: str) -> list[str]:
    """Read style sheets of the assets, by name."""
    return [asset(f"{name}.css") for name in names]


WIDE: Mapping[str, Any] = {"sizing_mode": "stretch_width", "margin": 0}
NO_ROOM: Mapping[str, Any] = {"width": 0, "height": 0, "margin": 0}


class HtmlText(HtmlComponent):
    """HTML that is updated in place, so that focus and open definitions survive new numbers."""

    _esm = script("markup", "buttons")


def html(content: str = "", **params: Any) -> HtmlText:
    """HTML in the page's style."""
    return HtmlText(html=content, **{**WIDE, "stylesheets": sheets("base", "style"), **params})


def bare(content: str = "", **params: Any) -> HtmlText:
    """HTML in the page's style that is always visible and has no box of its own, so that it costs no layout where it grows."""
    return html(content, **{"stylesheets": sheets("base", "style", "bare"), **params})


def watch(act: Callable[..., object], *sources: tuple[Any, str | list[str]]) -> None:
    """Call a function after every change of parameters: an object or None, and which of its parameters."""
    for of, names in sources:
        if of is not None:
            of.param.watch(act, names)


def follow_html(make: Callable[[], str], *sources: tuple[Any, str | list[str]], **params: Any) -> HtmlText:
    """HTML as `bare`, made anew after every change of what `watch` takes."""
    pane = bare(make(), **params)
    watch(lambda *_: setattr(pane, "html", make()), *sources)
    return pane


def make_button(label: str, act: Callable[[], object], **options: Any) -> pmui.Button:
    """Make a small button. act : called by a click."""
    return pmui.Button(label=label, on_click=lambda _event: act(), **{"size": "small", "margin": 0, **options})


def make_select(label: str, options: Any, value: Any, width: int | None, **more: Any) -> pmui.Select:
    """Make a small list to choose from."""
    return pmui.Select(label=label, options=options, value=value, width=width, **{"size": "small", "margin": 0, **more})


def run_swatch(letter: str, dark: bool) -> Markup:
    """Draw a short line in the dashes and the colour of a compared run, with its letter."""
    return _swatch(RUNS[letter], dark, True) + Markup("<b>{}</b>").format(letter)


def swatch(name: str, dark: bool, with_dash: bool = True) -> Markup:
    """Draw a short line as in the figures, as SVG; solid if not to be dashed."""
    return _swatch(look(name), dark, with_dash)


def named_row(name: str, label: str, dark: bool, cells: Sequence[str], kind: str = "name") -> Row:
    """Make a row of a table of lines. kind : what scripts and tests find it by."""
    return Row(swatch(name, dark) + label, cells, {kind: name})


@cache
def _swatch(look: Look, dark: bool, with_dash: bool) -> Markup:
    return macro("swatch", look, dark, with_dash)
