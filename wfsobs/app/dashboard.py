"""The page: drawer, switches, figures and table of one session, wired to one store."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from html import escape
from typing import Any, Final
from uuid import uuid4

import panel as pn
import panel_material_ui as pmui
import param
from panel.util.parameters import edit_readonly

from wfsobs.app.actions import Actions
from wfsobs.app.controls.panel import Controls, waiting_text
from wfsobs.app.display import Display
from wfsobs.app.glossary import Help
from wfsobs.app.history import History, HistorySheet
from wfsobs.app.idle_work import SeedRuns
from wfsobs.app.jobs import FAILED
from wfsobs.app.pages.explore import Explore
from wfsobs.app.pages.pages import AWAY, EXPLORE, LIVE, SHOWN, Pages, ViewState
from wfsobs.app.pages.parts import ON_ONE_LINE, warning
from wfsobs.app.service import Post, Session
from wfsobs.app.store import Store
from wfsobs.app.style import NO_ROOM, THEME, WIDE, Component, labels, script, sheets, theme
from wfsobs.app.upload import Upload
from wfsobs.app.views.errors import effect_line
from wfsobs.app.views.switches import ModeSwitch, UnitSwitch
from wfsobs.scenario import Scenario
from wfsobs.scenario.names import name_settings

MOST = 1000
"""Changes that are taken at once."""


class Connection(Component):
    """The banner in the browser: questions {ask} and unsent changes {changes} up, the last question that has arrived down."""

    session: param.String[str] = param.String("", doc="A name of the session, to tell it from one made anew.")
    last_arrival: param.Integer[int] = param.Integer(0, doc="Number of the last question that has arrived, and all before it.")

    _esm = script("page", "connection")
    _stylesheets = sheets("base", "connection")

    def __init__(self, take: Callable[[dict[str, Any]], None], **params: Any):
        """Connect a page. take : makes a change again that did not arrive."""
        self._take = take
        super().__init__(self._hear, session=uuid4().hex, **params)

    def _hear(self, data: dict[str, Any]) -> None:
        if isinstance(data.get("ask"), int):
            self.last_arrival = data["ask"]
        changes = data.get("changes")
        for change in changes[:MOST] if isinstance(changes, list) else []:
            if isinstance(change, dict):
                self._take(change)


class Readout(Component):
    """Follows the pointer, and the arrow keys in a figure that has the focus; one for all figures of the page."""

    labels: param.Dict[dict[str, str]] = param.Dict({}, doc="Name of a line in the figures -> what it is called.")

    _esm = script("page", "readout")
    _stylesheets = sheets("base", "readout")

    def __init__(self, **params: Any):
        super().__init__(labels=labels(), **NO_ROOM, **params)


HEADER = """
:host { position: static !important; align-items: center; gap: 8px; min-width: 0; padding-left: 16px; }
.run { flex: 1 1 240px; }
.pages { flex: 0 1 auto; width: auto !important; min-width: 0; }
@media (max-width: 1239.95px) {
  .pages { position: absolute !important; left: 16px; right: 16px; bottom: 8px; }
}
@media (max-width: 600px) { :host { padding-left: 0; } }
"""
"""Run and pages beside each other, or, where the window is narrow, one below the other over the whole width of the bar."""

PAGES = """
:host { gap: 8px; align-items: center; justify-content: space-between; }
.tabs { flex: 0 1 auto !important; width: auto !important; min-width: 0 !important; overflow: auto hidden; }
"""
"""The pages scroll where there is no room for all of them."""

BODY = ":host { gap: 10px; max-height: none !important; } .scroll-button { display: none; }"
"""As long as its contents: the toolkit's limit is the window, which all boxes inside take over, and longer ones overlap."""

STALE = "These results are not those of the settings."

UNSEEN = {"position": "absolute", "width": "1px", "height": "1px", "overflow": "hidden", "clip-path": "inset(50%)"}
"""Of the page's heading: for screen readers."""


class Frame(Component):
    """Closes the drawer of a phone, tells the theme that is wanted and when the first picture stands, and fades stale results."""

    wants_dark: param.Boolean[bool] = param.Boolean(
        False, doc="Whether the visitor's system has a dark theme, unless one was chosen here."
    )
    preferred_theme = param.Selector(
        default="", objects=["", "dark", "light"], doc="The theme that was chosen, for the browser to keep."
    )
    stale: param.Boolean[bool] = param.Boolean(False, doc="Whether to fade the results.")
    dark: param.Boolean[bool] = param.Boolean(False, doc="Whether the page is dark.")
    complete: param.Boolean[bool] = param.Boolean(False, doc="Whether what the first picture does not need is there.")

    _esm = script("page", "frame")


class Keyboard(Component):
    """What the keyboard needs, and a first stop that leads to what is after it."""

    _esm = script("page", "keyboard")


class Idle(param.Parameterized):
    """Never busy."""

    busy: param.Boolean[bool] = param.Boolean(default=False, constant=True)


class Dashboard:
    """One session: its store, its controls and its views."""

    def __init__(self, post: Post, session: Session, scenario: Scenario | None = None):
        self._post = post
        self.store: Final = Store(post, session, scenario)
        self.display: Final = Display()
        self._theme_chosen = False
        self.controls: Final = Controls(self.store)
        self.controls.effect_of = partial(effect_line, self.display)
        self.history: Final = History(self.store, self.display)
        self.history_sheet: Final = HistorySheet(self.history, lambda sheet: self.body.append(sheet))
        self.modes: Final = ModeSwitch(self.store.run, self.display)
        self.units: Final = UnitSwitch(self.display)
        self.seeds: Final = SeedRuns(self.store)
        self.explore: Final = Explore(self.history, self.seeds)
        self.pages: Final = Pages(self.explore, self.store, self.display)
        self.view_state: Final = ViewState(self.display, self.pages, self.explore, self.seeds)
        self.actions: Final = Actions(self.store, self.history_sheet, self.view_state, self.seeds)
        self.upload: Final = Upload(self.store, self.actions)
        self.connection: Final = Connection(self.controls.take, **NO_ROOM)
        self.drawer: Final = pn.Column(**WIDE)
        self.frame: Final = Frame(stale=self.store.param.stale, dark=self.display.param.dark, **NO_ROOM)
        self.keyboard: Final = Keyboard(**NO_ROOM, styles={"position": "absolute"})
        self.alert: Final = pmui.Alert(object="", severity="error", visible=False, **WIDE)
        self.stale: Final = warning(STALE)
        self.store.run.param.watch(self._refresh, ["state", "message"])
        self.store.param.watch(self._refresh, ["stale", "waiting"])

    def page(self) -> pmui.Page:
        """Build the whole page."""
        if self.store.session.service.live is not None:
            self.pages.current = LIVE
        self.history.open_view = self.view_state.open
        self.view_state.param.watch(lambda event: self.history.follow_view(event.new), "query")
        self.body = pn.Column(
            self._switches(),
            self.upload.picker,
            self.upload.room,
            self.keyboard,
            self.pages.view,
            self.frame,
            self.connection,
            Readout(styles={"position": "absolute"}),
            sizing_mode="stretch_width",
            margin=12,
            stylesheets=[BODY],
        )
        page = pmui.Page(
            title="wfsobs",
            header=[self._header()],
            sidebar=[self.drawer],
            sidebar_width=340,
            theme_config=theme(),
            sx=THEME["bar"],
            favicon=None,
            main=[pn.pane.HTML("<h1>wfsobs: disturbance observers for adaptive optics</h1>", margin=0, styles=UNSEEN), self.body],
        )
        self.frame.on_message = lambda message: message.get("drawn") and self._post(self._stand)
        if pn.state.curdoc is None:  # nobody will say that it has been drawn
            self.complete()
        with edit_readonly(page):
            # Tied to what all sessions do, each change walks all models of the page, and the page outlives its session.
            page.busy = Idle().param.busy
        self.display.dark = page.dark_theme  # Panel has it from the address
        page.param.watch(self._on_theme, "dark_theme")
        self.frame.param.watch(lambda event: self._post(partial(setattr, page, "dark_theme", event.new)), "wants_dark")
        return page

    def complete(self) -> None:
        """Make what the first picture does not need: the settings, whose drawer has its width, and what is further down."""
        if self.frame.complete:
            return
        with pn.io.hold():
            self.frame.complete = True
            self.explore.complete()
            self.pages.complete()
            there, at = self.body.objects, self.body.index(self.keyboard)
            self.body.objects = [*there[:at], self.alert, self.stale, *there[at:]]
            self.drawer[:] = [self.controls.view()]

    def _stand(self) -> None:
        """Complete a page that has been drawn, which it says until it is heard."""
        if not self.frame.complete:
            self.complete()
            self.store.session.service.keep_page()

    def start(self) -> None:
        """Start the first run, unless settings from a link have brought one or would take long, or the page opens on Live."""
        if self.store.rests and self.pages.current == LIVE:
            self.modes.offer(self.store.scenario.modes)
            self.store.param.watch(lambda event: self.store.rests and self.modes.offer(event.new.modes), "scenario")
            self.pages.param.watch(lambda _: self.store.rests and self.store.wake(), "current")
        else:
            self.store.wake()

    def _on_theme(self, event: Any) -> None:
        self.display.dark = event.new
        if event.new != self.frame.wants_dark:
            self._theme_chosen = True
        if self._theme_chosen:
            self.frame.preferred_theme = "dark" if event.new else "light"
            self.view_state.choose_theme(event.new)

    def _header(self) -> pn.Row:
        """Lay out what stays in sight: the run, the pages and what can be done with them, the help."""
        run = self.controls.bar()
        pages = pn.Row(self.pages.switch, self.actions.toolbar, margin=0, css_classes=["pages"], stylesheets=[PAGES])
        run.css_classes = ["run"]
        return pn.Row(run, pages, Help(), **WIDE, stylesheets=[HEADER])

    def _switches(self) -> pn.FlexBox:
        """Lay out the switches that all pages share, and those of the first."""
        first = self.explore.switches()
        self.pages.param.watch(lambda event: setattr(first, "styles", SHOWN if event.new == EXPLORE else AWAY), "current")
        return pn.FlexBox(
            *self.modes.view(), *self.units.view(), first, gap="8px", align_items="center", **WIDE, stylesheets=[ON_ONE_LINE]
        )

    def _refresh(self, *_: object) -> None:
        run = self.store.run
        failed = run.state == FAILED
        said = escape(" ".join(name_settings(run.message).split()))
        self.alert.param.update(object=f"<p>{said}</p>", visible=failed)  # a paragraph is no Markdown
        texts = [STALE] if self.store.stale else []
        if self.store.waiting:
            texts.append(f"{waiting_text(self.store.waiting)}.")
        self.stale.param.update(object=" ".join(texts), visible=bool(texts) and run.state != "running")
