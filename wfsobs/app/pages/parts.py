"""What the pages are made of: headings, figures with captions, progress of something long, and what of a page an address has."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from html import escape
from types import MappingProxyType
from typing import Any, Protocol

import panel as pn
import panel_material_ui as pmui
from bokeh.plotting import figure

from wfsobs.app.controls.field import SOON
from wfsobs.app.controls.names import name_settings
from wfsobs.app.controls.status import Status
from wfsobs.app.copies import EXPLORED, CopiedTask
from wfsobs.app.display import Display
from wfsobs.app.downloads import Save
from wfsobs.app.jobs import CANCELLED, DONE, IDLE, RUNNING, BackgroundTask
from wfsobs.app.style import HEARD, asset, swatch
from wfsobs.app.views.plots import call

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


class PageActions:
    """What a page has for the row of actions: what it does, to be copied, and what it has found, to be saved."""

    inputs: Sequence[Any] = ()
    """Fields that the task depends on."""

    link: LinkPart | None = None
    """What of the page the address has."""

    @property
    def task(self) -> CopiedTask:
        """What the page does with the record."""
        return EXPLORED

    def saves(self) -> Mapping[str, Save | None]:
        """Offer what can be saved, by its name in the menu; None where it is not there yet."""
        return {}

    def link_fields(self) -> dict[str, str]:
        """Return what of the page the address has beside the settings: name -> text."""
        return self.link.texts() if self.link else {}

    def open_link(self, fields: Mapping[str, str]) -> list[str]:
        """Fill in what an address has, the rest as on a fresh page; return a line for each field refused."""
        return self.link.open(fields) if self.link else not_known(fields)

    def follow_link(self, act: Callable[..., object]) -> None:
        """Call a function after every change of what the address has."""
        if self.link:
            self.link.watch(act)


WIDE: Mapping[str, Any] = MappingProxyType({"sizing_mode": "stretch_width", "margin": 0})


ON_ONE_LINE = """
@media (max-height: 560px), (max-width: 600px) {
  [id^="flexbox"] { flex-wrap: nowrap !important; overflow: auto hidden; }
  [id^="flex-item"] > * { flex: none !important; }
}
"""
"""Style of a row of switches that does not wrap where there is no height for it: on a phone, or at a zoom of 200 %."""

BELOW_FIGURES = "@media (max-height: 560px) { :host { order: 1; } }"
"""Style of what stands above the figures of its box where there is height for both."""


def heading(title: str, about: str = "") -> pn.pane.HTML:
    """Make the title of a box; about : beside it, what is in the box."""
    words = f'<span class="about">{escape(about)}</span>' if about else ""
    return pn.pane.HTML(f'<h2 class="title">{escape(title)}</h2>{words}', margin=0, stylesheets=[asset("style.css")])


def html(content: str = "") -> pn.pane.HTML:
    """HTML in the page's style."""
    return pn.pane.HTML(content, **WIDE, stylesheets=[asset("style.css")])


def text(content: str) -> pn.pane.HTML:
    """Make a paragraph."""
    return html(f'<p class="text">{escape(content)}</p>')


def zoom_buttons(zoom: Callable[[float | None], None], stretches: Mapping[str, float | None]) -> list[pmui.Button]:
    """Make the buttons of stretches of time [s] by their names; None is all of the record."""
    buttons = []
    for label, seconds in stretches.items():
        button = pmui.Button(label=label, size="small", variant="text", margin=0, description=f"Time window: {label.lower()}")
        button.on_click(lambda _event, seconds=seconds: zoom(seconds))
        buttons.append(button)
    return buttons


def box(title: str, *content: Any, about: str = "") -> pn.Column:
    """Lay out a part of a page under its title; about : what is in it, in a few words."""
    return pn.Column(heading(title, about), *content, **WIDE, stylesheets=[asset("box.css")])


def line(*parts: Any) -> pn.FlexBox:
    """Buttons and fields beside each other, in as many lines as they take."""
    return pn.FlexBox(*parts, gap="14px 10px", align_items="center", styles={"padding": "10px 0 4px"}, **WIDE)


SMALL_LABEL = ".MuiFormControlLabel-label.MuiTypography-root { font-size: 0.8125rem; }"
"""As large as that of the buttons beside it."""

HEIGHT = "clamp(230px, min(100vh - 415px, 60vh), 640px)"
"""Of a figure: what a window has room for below what stands above the first one."""

TALL: Mapping[str, Any] = MappingProxyType(
    {
        **WIDE,
        "height": 230,
        "stylesheets": [
            f":host {{ height: {HEIGHT} !important; flex-basis: auto !important; }}"
            "@media (max-width: 1000px) { :host { height: clamp(230px, 42vh, 560px) !important; } }"
        ],
    }
)
"""A figure as high as the window has room for."""

EDITED = f":host {{ height: calc({HEIGHT} + 120px) !important; }}"
"""The same with its handles, whose legend stands below it."""


def figure_with_caption(title: str, fig: figure, *, tall: bool = False) -> pn.Column:
    """Lay out a figure under its caption. tall : as high as the window has room for."""
    call(fig, title)
    if tall:
        fig.sizing_mode = "stretch_both"
    caption = pn.pane.HTML(f'<div class="caption">{escape(title)}</div>', margin=(8, 0, 0, 0), stylesheets=[asset("style.css")])
    return pn.Column(caption, pn.pane.Bokeh(fig, sizing_mode=fig.sizing_mode, margin=0), **(TALL if tall else WIDE))


def grid_style(columns: str, narrow: str = "minmax(0, 1fr)") -> str:
    """Return the style of a Column as a grid of these columns, others on a narrow window; its button to scroll takes no cell."""
    return f"""
:host {{ display: grid !important; grid-template-columns: {columns}; gap: 10px; }}
@media (max-width: 1000px) {{ :host {{ grid-template-columns: {narrow}; }} }}
.scroll-button {{ display: none; }}
"""


HALVES = grid_style("minmax(0, 1fr) minmax(0, 1fr)")
"""Two figures beside each other."""


def group(display: Display, name: str, options: Any) -> pmui.RadioButtonGroup:
    """Make the buttons of one switch of the display."""
    widget = pmui.RadioButtonGroup.from_param(
        display.param[name], options=options, size="small", margin=0, variant="outlined", stylesheets=[HEARD]
    )
    widget._debounce = SOON  # type: ignore[misc]
    return widget


def legend(names: Mapping[str, str], dark: bool) -> str:
    """Swatches of lines, name -> what it is called."""
    marks = "".join(f'<span class="mark">{swatch(name, dark)}{escape(called)}</span>' for name, called in names.items())
    return f'<div class="caption legend">{marks}</div>'


class Starter:
    """The buttons that start, cancel and use something long, and the line on how it is going."""

    def __init__(
        self, work: BackgroundTask, start: str, label: str, detail: Callable[[], str] = str, uses: Sequence[str] = ("Use it",)
    ):
        """Make the buttons. detail : what to add to the line while the work goes on; uses : what can be done with the result."""
        self.work, self._detail = work, detail
        self.start = pmui.Button(label=start, icon="play_arrow", color="primary", size="small", margin=0)
        self.cancel = pmui.Button(label="Stop", icon="stop", variant="outlined", size="small", margin=0, disabled=True)
        self.uses = [
            pmui.Button(label=use, icon="check", variant="outlined", size="small", margin=0, disabled=True) for use in uses
        ]
        self.status = Status(label=label, sizing_mode="stretch_width", margin=(4, 0), visible=False)
        self.cancel.on_click(lambda _event: work.cancel())
        work.param.watch(self.refresh, ["state", "progress", "place", "message", "latest", "result"])

    def view(self) -> list[Any]:
        """Return the row of buttons; the line of progress is `status`."""
        return [self.start, self.cancel, *self.uses]

    def refresh(self, *_: object) -> None:
        """Enable the buttons that can be used, and describe the progress."""
        work = self.work
        running = work.state == RUNNING
        said = {RUNNING: work.line("Computing"), CANCELLED: "Stopped", DONE: "Finished"}.get(work.state, "")
        self.cancel.disabled = not running
        for use in self.uses:
            use.disabled = work.state != DONE or work.result is None
        self.status.param.update(
            progress=work.progress, text=said + self._detail(), note=name_settings(work.message), visible=work.state != IDLE
        )
