"""What the pages are made of: headings, figures with captions, progress of something long, and what of a page an address has."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from functools import partial
from html import escape
from typing import Any, Final

import panel as pn
import panel_material_ui as pmui
from bokeh.plotting import figure

from wfsobs.app.controls.fields import parse_number
from wfsobs.app.controls.panel import Status
from wfsobs.app.display import Display
from wfsobs.app.downloads import Save
from wfsobs.app.jobs import CANCELLED, DONE, RUNNING
from wfsobs.app.render import render
from wfsobs.app.service import IDLE, BackgroundTask
from wfsobs.app.share import EXPLORED, CopiedTask
from wfsobs.app.store import Store
from wfsobs.app.style import WIDE, HtmlText, bare, html, look, make_button, sheets, swatch, watch
from wfsobs.app.views.plots import call
from wfsobs.app.views.switches import LineChoice, not_known
from wfsobs.app.work import RunResults
from wfsobs.scenario.names import name_settings
from wfsobs.settings.values import SettingError, hint


class LinkedFields:
    """Fields and switches that hold a text, a number or several texts; what they hold when this is made is that of a fresh page.

    What is disabled has no part in a view. `left_alone` returns the names of fields that an address does not change.

    Parameters
    ----------
    fields : dict or None
        Name -> a field, or an object and the name of its parameter; None for fields that are made later, and anew with other
        results: until then the texts of an address wait.
    offers : dict
        Name -> a function that has a field offer a text, if there is such a choice. Raises SettingError.
    """

    def __init__(self, fields: Mapping[str, Any] | None, offers: Mapping[str, Callable[[str], object]] = {}):
        self._offers = offers
        self.left_alone: Callable[[], Collection[str]] = tuple
        self.fresh: dict[str, str] = {}
        self._acts: list[Callable[..., object]] = []
        self._waiting: Mapping[str, str] = {}
        self._fields: dict[str, tuple[Any, str]] | None = None
        if fields is not None:
            self.make(fields)

    def make(self, fields: Mapping[str, Any]) -> list[str]:
        """Take fields, in place of those before, with their texts or those that wait; return a line for each that is refused."""
        before = self.texts()
        self._fields = {name: field if isinstance(field, tuple) else (field, "value") for name, field in fields.items()}
        self.fresh = {name: _text(getattr(*field)) for name, field in self._fields.items()}
        refused = self.open(before) if before else []
        for act in self._acts:
            watch(act, *self._fields.values())
            act()
        return refused

    @property
    def names(self) -> Collection[str]:
        """In an address."""
        return self.fresh

    def texts(self) -> dict[str, str]:
        """Return the texts that differ from those of a fresh page, or those that wait."""
        if self._fields is None:
            return {**self._waiting}
        now = {name: _text(getattr(*field)) for name, field in self._fields.items() if is_active(*field)}
        return {name: text for name, text in now.items() if text != self.fresh[name]}

    def open(self, texts: Mapping[str, str]) -> list[str]:
        """Fill in texts in the order of the fields, of which one may change the next; return a line for each that is refused."""
        if self._fields is None:
            self._waiting = {**texts}
            return []
        refused = not_known(name for name in texts if name not in self._fields)
        for name, field in self._fields.items():
            if is_active(*field) and name not in self.left_alone():
                lines = self._fill_in(name, *field, texts.get(name, self.fresh[name]))
                if lines and not isinstance(getattr(*field), list):
                    self._fill_in(name, *field, self.fresh[name])
                refused += lines
        return refused

    def watch(self, act: Callable[..., object]) -> None:
        """Call a function after every change."""
        self._acts.append(act)
        watch(act, *(self._fields or {}).values())

    def _fill_in(self, name: str, of: Any, attribute: str, text: str) -> list[str]:
        if name in self._offers:
            try:
                self._offers[name](text)
            except SettingError as error:
                return [str(error)]
        now, parameter = getattr(of, attribute), of.param[attribute]
        options = getattr(of, "options", []) if attribute == "value" else getattr(parameter, "objects", [])
        known = {_text(value): value for value in (options.values() if isinstance(options, dict) else options)}
        said = f"{name} = {text[:80]}: takes "
        if isinstance(now, list):
            names = text.split(",") if text else []
            setattr(of, attribute, [known[one] for one in names if one in known])
            return [f"{name} = {one[:80]}: there is none of that name" for one in names if one not in known]
        if known and text not in known:
            return [f"{said}one of {', '.join(known)}"[:300]]
        value: Any = known.get(text, text)
        if isinstance(now, int):
            low, high = parameter.bounds
            if not text.isdecimal() or not low <= int(text) <= high:
                return [f"{said}a whole number from {low} to {high}"]
            value = int(text)
        setattr(of, attribute, value)
        return []


def is_active(of: Any, _attribute: str) -> bool:
    """Whether a field, or what has a parameter, is not disabled."""
    return not getattr(of, "disabled", False)


LinkPart = LinkedFields | LineChoice
"""A part of a view as texts by name."""


def _text(value: Any) -> str:
    """Return what a field holds as one text."""
    return ",".join(value) if isinstance(value, list) else f"{value:g}" if isinstance(value, (int, float)) else value


class Page(ABC):
    """A page of the main area: what it does with the record, what of it an address has, and what it has found.

    Attributes
    ----------
    link : LinkPart
        What of it the address has.
    files : dict
        Entry of the menu -> name of a file, and how it is written of what the page has found.
    visible : bool
        Whether it is seen; what is not is not drawn.
    """

    link: LinkPart = LinkedFields({})
    files: Mapping[str, tuple[str, Callable[[Any], bytes]]] = {}
    visible: bool = False
    _repetition: Any = None

    def __init__(self, store: Store, display: Display, *switches: str):
        """Make it. switches : of the display, after whose changes it is drawn; by default mode, unit and theme."""
        self.store = store
        self.run: BackgroundTask = store.run
        self.display = display
        display.param.watch(self.redraw, [*switches] or ["mode", "unit", "dark"])

    @abstractmethod
    def view(self) -> Any:
        """Return the contents of the page."""

    def show(self, visible: bool) -> None:
        """Bring it up to date, and keep it so while it is visible."""
        self.visible = visible
        self.follow()
        self.redraw()  # what is shown, and how, may have changed

    def follow(self, *_: object) -> None:
        """Begin what is to be computed of what is shown now; most pages compute nothing."""
        return

    def shown_results(self) -> RunResults:
        """Return the results shown. Raises SettingError where there are none."""
        if self.run.result is None:
            raise SettingError("There is no record yet.")
        return self.run.result

    def redraw(self, *_: object) -> None:
        """Draw what has come, as one message, where it is seen."""
        if self.visible:
            with pn.io.hold():
                self.draw()

    def draw(self) -> object:
        """Draw what has come; a page without figures draws nothing."""
        return None

    def repeat(self, act: Callable[[], None], seconds: float) -> None:
        """Call a function again and again while the page `goes_on`."""
        if pn.state.curdoc:
            self._repetition = pn.state.add_periodic_callback(act, round(1e3 * seconds), start=False)

    def pace(self) -> None:
        """Begin or end what is repeated, once the page stands: what comes before that does not reach it."""
        if self._repetition is not None:
            self.store.session.post(self._set_pace)

    def _set_pace(self) -> None:
        if self.goes_on != self._repetition.running:
            (self._repetition.start if self.goes_on else self._repetition.stop)()

    @property
    def goes_on(self) -> bool:
        """Whether what is repeated is to be called."""
        return False

    @property
    def task(self) -> CopiedTask:
        """What the page does with the record, to be copied."""
        return EXPLORED

    @property
    def finding(self) -> Any:
        """What of it can be saved; None for nothing yet."""
        return None

    def saves(self) -> Mapping[str, Save | None]:
        """Offer what can be saved, by its name in the menu; None where it is not there yet."""
        found = self.finding
        return {
            what: None if found is None else Save(name, KINDS.get(name.rpartition(".")[2], BYTES), partial(write, found))
            for what, (name, write) in self.files.items()
        }


BYTES = "application/octet-stream"
KINDS = {"csv": "text/csv", "toml": "application/toml"}
"""Ending of a file -> its type, if it is not BYTES."""


ON_ONE_LINE = """
@media (max-height: 560px), (max-width: 600px) {
  [id^="flexbox"] { flex-wrap: nowrap !important; overflow: auto hidden; }
  [id^="flex-item"] > * { flex: none !important; }
}
"""
"""Style of a row of switches that does not wrap where there is no height for it: on a phone, or at a zoom of 200 %."""

BELOW_FIGURES = "@media (max-height: 560px) { :host { order: 1; } }"
"""Style of what stands above the figures of its box where there is height for both."""


def text(content: str) -> HtmlText:
    """Make a paragraph."""
    return html(f'<p class="text">{escape(content)}</p>')


def example(name: str, results: Any) -> HtmlText:
    """Draw an example of the results of a page, until they are visible themselves."""
    pane = html(render("example.html", name=name))
    pane.visible = not results.visible
    results.param.watch(lambda event: setattr(pane, "visible", not event.new), "visible")
    return pane


def warning(words: str) -> pmui.Alert:
    """Make a warning that is not seen yet."""
    return pmui.Alert(object=words, severity="warning", visible=False, **WIDE)


def zoom_buttons(zoom: Callable[[float | None], None], stretches: Mapping[str, float | None]) -> list[pmui.Button]:
    """Make the buttons of stretches of time [s] by their names; None is all of the record."""
    return [
        make_button(label, partial(zoom, seconds), variant="text", description=f"Time window: {label.lower()}")
        for label, seconds in stretches.items()
    ]


def box(title: str, *content: Any) -> pn.Column:
    """Lay out a part of a page under its title."""
    heading = bare(f'<h2 class="title">{escape(title)}</h2>', sizing_mode=None)
    return pn.Column(heading, *content, **WIDE, stylesheets=sheets("box"))


def boxes(*parts: Any) -> pn.Column:
    """Lay out boxes one below the other."""
    return pn.Column(*parts, **WIDE, stylesheets=[":host { gap: 10px; }"])


def number_field(label: str, value: float, width: int) -> pmui.TextInput:
    """Make a field for a number."""
    return pmui.TextInput(label=label, value=f"{value:g}", size="small", width=width, margin=0)


def read_number(field: pmui.TextInput, low: float, high: float, *, whole: bool = False) -> Any:
    """Read a number that was typed. Raises SettingError."""
    text = str(field.value)
    value = parse_number(text)
    if isinstance(value, str) or (whole and not isinstance(value, int)) or not low <= value <= high:
        what = "whole number" if whole else "number"
        raise SettingError(f"{field.label} = {text[:40]!r}: takes a {what} from {low:g} to {high:g}{hint(text)}")
    return value


def line(*parts: Any) -> pn.FlexBox:
    """Buttons and fields beside each other, in as many lines as they take."""
    return pn.FlexBox(*parts, gap="14px 10px", align_items="center", styles={"padding": "10px 0 4px"}, **WIDE)


SMALL_LABEL = ".MuiFormControlLabel-label.MuiTypography-root { font-size: 0.8125rem; }"
"""As large as that of the buttons beside it."""

HEIGHT = "clamp(300px, min(100vh - 330px, 64vh), 640px)"
"""Of a figure: what a window has room for below what stands above the first one."""

TALL: Mapping[str, Any] = {
    **WIDE,
    "height": 300,
    "stylesheets": [
        f":host {{ height: {HEIGHT} !important; flex-basis: auto !important; }}"
        "@media (max-width: 1000px) { :host { height: clamp(300px, 42vh, 560px) !important; } }"
    ],
}
"""A figure as high as the window has room for."""

EDITED = f":host {{ height: calc({HEIGHT} + 120px) !important; }}"
"""The same with its handles, whose legend stands below it."""


def figure_with_caption(title: str, fig: figure, *, tall: bool = False) -> pn.Column:
    """Lay out a figure under its caption. tall : as high as the window has room for."""
    call(fig, title)
    if tall:
        fig.sizing_mode = "stretch_both"
    return pn.Column(caption(title), pane(fig), **(TALL if tall else WIDE))


def pane(fig: figure) -> pn.pane.Bokeh:
    """Lay out a figure as wide as its room, and as high where the figure is."""
    return pn.pane.Bokeh(fig, sizing_mode=fig.sizing_mode, margin=0)


def grid_style(columns: str, narrow: str = "minmax(0, 1fr)") -> str:
    """Return the style of a Column as a grid of these columns, others on a narrow window; its button to scroll takes no cell."""
    return f"""
:host {{ display: grid !important; grid-template-columns: {columns}; gap: 10px; }}
@media (max-width: 1000px) {{ :host {{ grid-template-columns: {narrow}; }} }}
.scroll-button {{ display: none; }}
"""


def halves(*parts: Any) -> pn.Column:
    """Lay out parts two by two beside each other, on a narrow window one below the other."""
    return pn.Column(*parts, **WIDE, stylesheets=[HALVES])


HALVES = grid_style("minmax(0, 1fr) minmax(0, 1fr)")


def caption_html(words: str, marks: str = "") -> str:
    """Write what stands above a figure. marks : HTML behind it."""
    return f'<div class="caption above">{escape(words)}{marks}</div>'


def caption(words: str) -> HtmlText:
    """Make what stands above a figure."""
    return bare(caption_html(words))


def tick(display: Display, name: str, **options: Any) -> pmui.Checkbox:
    """Make the box of one switch of the display."""
    return pmui.Checkbox.from_param(display.param[name], size="small", margin=0, **options)


def render_part(template: str, display: Display, **values: Any) -> str:
    """Fill a template of a page, which may draw the swatch of a line."""
    return render(f"pages/{template}.html", display=display, swatch=partial(swatch, dark=display.dark), look=look, **values)


def legend(names: Mapping[str, str], dark: bool) -> str:
    """Swatches of lines, name -> what it is called."""
    marks = "".join(f'<span class="mark">{swatch(name, dark)}{escape(called)}</span>' for name, called in names.items())
    return f'<div class="caption legend">{marks}</div>'


class Starter:
    """The buttons that start, cancel and use something long, and the line on how it is going."""

    def __init__(
        self,
        work: BackgroundTask,
        begin: Callable[[], object],
        start: str,
        label: str,
        detail: Callable[[], str] = str,
        uses: Mapping[str, Callable[[], object]] = {},
    ):
        """Make the buttons.

        begin  : starts the work, or raises SettingError or RecordError with the reason why not
        detail : what to add to the line while the work goes on
        uses   : what can be done with the result
        """
        self.work = work
        self._detail = detail
        self.begin: Final = partial(work.attempt, begin)
        self.start: Final = make_button(start, self.begin, icon="play_arrow", color="primary")
        self.cancel: Final = make_button("Stop", work.cancel, icon="stop", variant="outlined", disabled=True)
        self.uses: Final = [
            make_button(use, partial(work.attempt, act), icon="check", variant="outlined", disabled=True)
            for use, act in uses.items()
        ]
        self.status: Final = Status(label=label, sizing_mode="stretch_width", margin=(4, 0), visible=False)
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
