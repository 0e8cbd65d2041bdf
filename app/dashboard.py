"""The page: drawer, switches, figures and table of one session, wired to one store."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from html import escape
from types import MappingProxyType
from typing import Any

import panel as pn
import panel_material_ui as pmui
import param
from panel.custom import JSComponent
from panel.util.parameters import edit_readonly

from wfsobs.app.actions import Actions
from wfsobs.app.controls.fields import SOON
from wfsobs.app.controls.panel import Controls, waiting_text
from wfsobs.app.display import CUMULATIVE, ERROR, PSD, RUNNING_RMS, SIGNAL, UNITS, Display
from wfsobs.app.pages.pages import Pages
from wfsobs.app.run import FAILED, IDLE, Post
from wfsobs.app.store import Store
from wfsobs.app.style import asset, theme
from wfsobs.app.upload import Upload
from wfsobs.app.views.modes import ModeSwitch
from wfsobs.app.views.pinning import Pinning
from wfsobs.app.views.spectra import MODEL, PEAKS, Spectra
from wfsobs.app.views.strip import Strip
from wfsobs.app.views.table import Table
from wfsobs.app.views.traces import Traces
from wfsobs.app.work import compute
from wfsobs.observers.base import TARGETS, VIBRATION
from wfsobs.scenario import Scenario

WIDE: Mapping[str, Any] = MappingProxyType({"sizing_mode": "stretch_width", "margin": 0})
GRID = """
:host { display: grid !important; grid-template-columns: minmax(0, 3fr) minmax(0, 2fr); gap: 10px; }
@media (max-width: 1000px) { :host { grid-template-columns: minmax(0, 1fr); } }
"""
ACTIONS = """
:host { display: flex !important; flex-wrap: wrap; gap: 8px; }
:host > * { flex: 0 1 auto; width: auto !important; }
"""
BOX = """
:host { border: 1px solid color-mix(in srgb, currentColor 18%, transparent); border-radius: 6px; padding: 8px 10px;
        box-sizing: border-box; min-width: 0; }
"""
ZOOMS: Mapping[str, float | None] = MappingProxyType({"Whole record": None, "2 s": 2.0, "0.2 s": 0.2})
MARKS = (
    f'<span class="mark" style="border-left:2px solid {PEAKS}">peaks</span>'
    f'<span class="mark" style="border-left:2px dashed {MODEL}">peak in the Kalman filters</span>'
)
STALE = "These results are not those of the settings."

PHONE_PX = 600
"""Below this width the drawer lies over the page, and starts closed."""


class Frame(JSComponent):
    """Tells the width of the window, and fades the results above it while they are stale."""

    width_px = param.Integer(0, doc="Width when the page opened [px].")
    stale = param.Boolean(False, doc="Whether to fade the results.")

    _esm = asset("frame.js")


class Idle(param.Parameterized):
    """Never busy."""

    busy = param.Boolean(default=False, constant=True)


class Dashboard:
    """One session: its store, its controls and its views."""

    def __init__(self, post: Post, scenario: Scenario | None = None, work: Any = compute, **store: Any):
        self._post = post
        self.upload = Upload()
        if "held" in store:
            store["held"] = self.upload.unless(store["held"])
        self.store = Store(post, scenario, self.upload.over(work), **store)
        self.upload.attach(self.store)
        self.display = Display()
        self.controls = Controls(self.store)
        self.actions = Actions(self.store)
        self.modes = ModeSwitch(self.store.run, self.display)
        self.traces = Traces(self.store.run, self.display)
        self.spectra = Spectra(self.store.run, self.display)
        self.strips = {target: Strip(target, self.store.run, self.display) for target in TARGETS}
        self.table = Table(self.store.run, self.display)
        self.pinning = Pinning(self.store.run, self.display)
        self.frame = Frame(width=0, height=0, margin=0)
        self.alert = pmui.Alert(
            object="", severity="error", visible=False, **WIDE)
        self.stale = pmui.Alert(
            object=STALE, severity="warning", visible=False,
            **WIDE)
        self.store.run.param.watch(self._refresh, ["state", "message"])
        self.store.param.watch(self._refresh, ["stale", "waiting"])

    def page(self) -> pmui.Page:
        """The whole page."""
        body = pn.Column(
            *(self._section(target) for target in TARGETS), _box("RMS errors", self._best_first(), self.table.pane),
            **WIDE, stylesheets=[":host { gap: 10px; }"])
        explore = pn.Column(self._switches(), body, **WIDE, stylesheets=[":host { gap: 10px; }"])
        self.pages = Pages(explore, self.store, self.display)
        page = pmui.Page(
            title="wfsobs", sidebar=[self.controls.view()], sidebar_width=340, theme_config=theme(), favicon=None,
            main=[_title(), pn.Column(
                self._top(), self._row_of_actions(), self.upload.room, self.alert, self.stale, self.pages.view, self.frame,
                sizing_mode="stretch_width", margin=12, stylesheets=[":host { gap: 10px; }"])],
        )
        self.frame.param.watch(lambda event: self._post(partial(_open_drawer, page, event.new)), "width_px")
        with edit_readonly(page):
            # Tied to what all sessions do, each change walks all models of the page, and the page outlives its session.
            page.busy = Idle().param.busy
        page.param.watch(lambda event: self.display.param.update(dark=event.new), "dark_theme")
        return page

    def start(self) -> None:
        """The first run, unless settings from a link have brought one or would take long."""
        if self.store.run.state == IDLE:
            self.store.follow()

    def close(self) -> None:
        """The session has ended."""
        self.actions.close()
        self.store.close()

    def _group(self, name: str, options: Any) -> pmui.RadioButtonGroup:
        widget = pmui.RadioButtonGroup.from_param(
            self.display.param[name], options=options, size="small", margin=0, variant="outlined")
        widget.label = ""
        widget._debounce = SOON  # type: ignore[misc]
        return widget

    def _top(self) -> pn.FlexBox:
        """The pages, and what holds on all of them."""
        return pn.FlexBox(
            self.pages.switch, *self.modes.view(),
            self._group("unit", {written: unit for unit, written in UNITS.items()}),
            gap="12px", align_items="center", **WIDE)

    def _row_of_actions(self) -> pn.Row:
        return pn.Row(self.actions.toolbar, self.upload.picker, **WIDE, stylesheets=[ACTIONS])

    def _switches(self) -> pn.FlexBox:
        return pn.FlexBox(
            self._group("show", {"Signal": SIGNAL, "Error": ERROR, "Running rms": RUNNING_RMS}),
            self._group("spectrum", {"PSD": PSD, "Cumulative rms": CUMULATIVE}),
            self._zoom_buttons(), *self.pinning.view(), gap="12px", align_items="center", **WIDE)

    def _best_first(self) -> pmui.Checkbox:
        return pmui.Checkbox.from_param(self.display.param.best_first, size="small", margin=(0, 0, 4, 0))

    def _zoom_buttons(self) -> pn.Row:
        buttons = []
        for label, seconds in ZOOMS.items():
            button = pmui.Button(
                label=label, size="small", variant="text", margin=0, description=f"Time window: {label.lower()}")
            button.on_click(lambda _event, seconds=seconds: self.traces.zoom(seconds))
            buttons.append(button)
        return pn.Row(*buttons, margin=0)

    def _section(self, target: str) -> pn.Column:
        """The strip and the two figures of one target."""
        self.traces.traces[target].figure.name = f"{target.capitalize()} time trace"
        self.spectra.spectra[target].figure.name = f"{target.capitalize()} spectrum"
        cards = self.strips[target].cards
        cards.param.watch(lambda event: self._hide(target, event.new), "hidden")
        marks = MARKS if target == VIBRATION else ""
        figures = pn.Column(
            pn.Column(_caption("Time trace"), self.traces.pane(target), **WIDE),
            pn.Column(_caption("Spectrum", marks), self.spectra.pane(target), **WIDE),
            **WIDE, stylesheets=[GRID])
        return _box(target.capitalize(), cards, figures)

    def _hide(self, target: str, names: list[str]) -> None:
        self.display.hidden = {**self.display.hidden, target: list(names)}

    def _refresh(self, *_: object) -> None:
        run = self.store.run
        failed = run.state == FAILED
        self.alert.param.update(object=run.message, visible=failed)
        texts = [STALE] if self.store.stale else []
        if self.store.waiting:
            texts.append(f"{waiting_text(self.store.waiting)}.")
        self.stale.param.update(object=" ".join(texts), visible=bool(texts) and run.state != "running")
        self.frame.stale = self.store.stale


def _title() -> pn.pane.HTML:
    """The heading of the page, for those who hear it."""
    return pn.pane.HTML("<h1>wfsobs: disturbance observers for adaptive optics</h1>", margin=0, styles={
        "position": "absolute", "width": "1px", "height": "1px", "overflow": "hidden", "clip-path": "inset(50%)"})


def _open_drawer(page: pmui.Page, width: int) -> None:
    page.sidebar_open = width >= PHONE_PX


def _box(title: str, *content: Any) -> pn.Column:
    heading = pn.pane.HTML(f'<h2 class="title">{escape(title)}</h2>', margin=0, stylesheets=[asset("style.css")])
    return pn.Column(heading, *content, **WIDE, stylesheets=[BOX])


def _caption(text: str, marks: str = "") -> pn.pane.HTML:
    return pn.pane.HTML(
        f'<div class="caption">{escape(text)}{marks}</div>', sizing_mode="stretch_width", margin=(8, 0, 0, 0),
        stylesheets=[asset("style.css")])
