"""What the pages are put together from: headings, texts, figures with captions, the line of something long that is under way."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from types import MappingProxyType
from typing import Any

import panel as pn
import panel_material_ui as pmui
from bokeh.plotting import figure

from wfsobs.app.controls.field import SOON
from wfsobs.app.controls.names import name_settings
from wfsobs.app.controls.status import Status
from wfsobs.app.copies import EXPLORED, CopiedTask
from wfsobs.app.display import Display
from wfsobs.app.downloads import Save
from wfsobs.app.jobs.job import CANCELLED, DONE, RUNNING
from wfsobs.app.jobs.task import IDLE, BackgroundTask
from wfsobs.app.pages.link import LinkPart, not_known
from wfsobs.app.style import HEARD, asset, swatch
from wfsobs.app.views.plots import call


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
@media (max-height: 560px) {
  [id^="flexbox"] { flex-wrap: nowrap !important; overflow: auto hidden; }
  [id^="flex-item"] > * { flex: none !important; }
}
"""
"""Style of a row of switches that does not wrap where there is no height for it: a window of 1080 pixels at a zoom of 200 %."""

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

TALL: Mapping[str, Any] = MappingProxyType(
    {
        **WIDE,
        "height": 230,
        "stylesheets": [":host { height: clamp(230px, 42vh, 560px) !important; flex-basis: auto !important; }"],
    }
)
"""A figure as high as the window has room for."""

EDITED = ":host { height: calc(clamp(230px, 42vh, 560px) + 120px) !important; }"
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
