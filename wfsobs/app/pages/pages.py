"""The pages of the main area, and the switch between them: a page is made when it is first opened."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final
from urllib.parse import parse_qsl, quote

import panel as pn
import panel_material_ui as pmui
import param

from wfsobs.app.compared import comparison_of
from wfsobs.app.display import Display
from wfsobs.app.idle_work import SeedRuns
from wfsobs.app.pages.campaign import CampaignPage
from wfsobs.app.pages.closed_loop import ClosedLoopPage
from wfsobs.app.pages.explore import Explore
from wfsobs.app.pages.figures import Figures, ModelPage
from wfsobs.app.pages.identify import IdentifyPage, Suggestion
from wfsobs.app.pages.live import LivePage
from wfsobs.app.pages.parts import WIDE, LinkedFields, LinkPart, Page
from wfsobs.app.pages.sweep import SweepPage
from wfsobs.app.pages.sweep_views import report_part
from wfsobs.app.pages.tune import TunePage
from wfsobs.app.store import Store
from wfsobs.app.style import HEARD, PRIMARY
from wfsobs.app.views.plots import on_settle
from wfsobs.app.views.switches import not_known
from wfsobs.evaluation.evidence import Evidence
from wfsobs.evaluation.result import Result

EXPLORE, IDENTIFY, TUNE, SWEEP, LOOP, LIVE = "explore", "identify", "tune", "sweep", "loop", "live"
CAMPAIGN, FIGURES, MODEL = "campaign", "figures", "model"
TITLES: Mapping[str, str] = {
    "Explore": EXPLORE,
    "Identify": IDENTIFY,
    "Tune": TUNE,
    "Sweep": SWEEP,
    "Closed loop": LOOP,
    "Live": LIVE,
    "Campaign": CAMPAIGN,
    "Paper figures": FIGURES,
    "Model": MODEL,
}

TABS = {
    "& .MuiToggleButton-root": {
        "width": "auto",
        "padding": "5px 8px",
        "fontSize": "13px",
        "border": 0,
        "borderRadius": "4px !important",
        "color": "#fff",
        "&:hover:not(.Mui-selected)": {"backgroundColor": "#ffffff30", "color": "#fff"},
        "&.Mui-selected": {"scrollInitialTarget": "nearest"},
        "&.Mui-selected, &.Mui-selected:hover": {"backgroundColor": "#fff !important", "color": f"{PRIMARY} !important"},
        "&.Mui-focusVisible": {"outline": "2px solid #fff", "outlineOffset": "-2px"},
    }
}
"""Pages on the dark bar at the top."""

SHOWN = {"content-visibility": "visible", "height": "auto", "overflow": "visible"}
AWAY = {"content-visibility": "hidden", "height": "0", "overflow": "hidden"}
"""A page that is not shown stays as it was laid out: without `display` each of its figures would be laid out anew."""


class Pages(param.Parameterized):
    """The first page, and others that are made when they are wanted."""

    current = param.Selector(default=EXPLORE, objects=list(TITLES.values()), label="Page")

    def __init__(self, explore: Page, store: Store, display: Display):
        super().__init__()
        self.store = store
        self.display = display
        explored = partial(setattr, self, "current", EXPLORE)
        self.suggestion: Final = Suggestion(store, self._identify_page)
        self._makers: dict[str, Callable[[Store, Display], Page]] = {
            IDENTIFY: lambda *of: self.suggestion.follow(IdentifyPage(*of)),
            TUNE: TunePage,
            SWEEP: partial(SweepPage, explore=explored),
            LOOP: ClosedLoopPage,
            LIVE: LivePage,
            FIGURES: Figures,
            MODEL: ModelPage,
        }
        if store.session.service.campaign is not None:
            self._makers[CAMPAIGN] = partial(CampaignPage, explore=explored)
        known = {title: name for title, name in TITLES.items() if name == EXPLORE or name in self._makers}
        self.param["current"].objects = known
        self.by_name: dict[str, Page] = {EXPLORE: explore}
        self.rooms: Final = {
            EXPLORE: pn.Column(explore.view(), **WIDE),
            **{name: pn.Column(sizing_mode="stretch_width", margin=0, styles=AWAY) for name in self._makers},
        }
        self.switch: Final = pmui.RadioButtonGroup.from_param(
            self.param.current, size="small", margin=0, css_classes=["tabs"], sx=TABS, stylesheets=[HEARD]
        )
        self.view: Final = pn.Column(*self.rooms.values(), **WIDE)
        self.param.watch(self._turn, "current")

    @property
    def page(self) -> Page:
        """The page that is shown."""
        return self.by_name[self.current]

    def complete(self) -> None:
        """Make what the first picture does not need."""
        self.rooms[EXPLORE].insert(0, self.suggestion.view)

    def _identify_page(self) -> IdentifyPage:
        page = self._page_of(IDENTIFY)
        assert isinstance(page, IdentifyPage)
        return page

    def shown_beside(self, result: Result, evidence: Evidence | None) -> dict[str, Any]:
        """Return what a report has of the last sweep, and of the runs that a result is compared with; None for nothing.

        evidence : errors of the result over several seeds
        """
        page = self.by_name.get(SWEEP)
        sweep = report_part(page.results) if isinstance(page, SweepPage) and page.results else None
        return {"sweep": sweep, "comparison": comparison_of(self.display.compared_runs, result, evidence)}

    def _page_of(self, name: str) -> Page:
        """Return a page, made where it has not been opened before."""
        if name not in self.by_name:
            self.by_name[name] = self._makers[name](self.store, self.display)
        return self.by_name[name]

    def _turn(self, _event: object) -> None:
        name = self.current
        with pn.io.hold():
            page = self._page_of(name)
            if name != EXPLORE and not len(self.rooms[name]):
                page.show(True)
                self.rooms[name][:] = [page.view()]
            for other, room in self.rooms.items():
                if other in self.by_name:
                    self.by_name[other].show(other == name)
                room.styles = SHOWN if other == name else AWAY


PREFIX = "view."
SWITCHES = ("mode", "unit", "show", "spectrum")
"""Switches of the display, by their names there."""

PAGE, WINDOW, SEEDS, THEME = "page", "window", "seeds", "theme"
MOST = 50
"""Fields of a query that are read."""


class ViewState(param.Parameterized):
    """The view as a query, kept in step with the page; and the page, brought to the view of a query."""

    query: param.String[str] = param.String("", doc="What the address has of the view, without ?.")

    def __init__(self, display: Display, pages: Pages, explore: Explore, seeds: SeedRuns):
        super().__init__()
        self.display = display
        self.pages = pages
        self.traces: Final = explore.traces
        switches = LinkedFields({PAGE: (pages, "current")} | {name: (display, name) for name in SWITCHES})
        switches.fresh[PAGE] = EXPLORE
        self._parts: list[LinkPart] = [switches, *explore.lines.choices.values(), LinkedFields({SEEDS: (seeds, "count")})]
        self._theme, self._known_pages = "", set[str]()
        for part in self._parts:
            part.watch(self._refresh)
        pages.param.watch(self._turn, "current")
        on_settle([self.traces.x_range], self._refresh)

    def choose_theme(self, dark: bool) -> None:
        """Keep the theme that the visitor has chosen."""
        self._theme = "dark" if dark else "light"
        self._refresh()

    def open(self, query: str) -> list[str]:
        """Bring the page to the view of a query, what it does not name to that of a fresh page; a line for each field refused."""
        fields = {
            key.removeprefix(PREFIX): value
            for key, value in parse_qsl(query.removeprefix("?"), keep_blank_values=True)[:MOST]
            if key.startswith(PREFIX) or key == THEME
        }
        if (theme := fields.pop(THEME, "")) in ("dark", "light"):
            self._theme = theme
        refused = self._open_window(fields.pop(WINDOW, ""))
        for part in self._parts:
            refused += part.open({name: fields.pop(name) for name in part.names if name in fields})
        of_page = f"{self.pages.current}."
        own = {key: fields.pop(key) for key in [*fields] if key.startswith(of_page)}
        refused += [of_page + line for line in self.pages.page.link.open({key.removeprefix(of_page): own[key] for key in own})]
        self._refresh()
        return [PREFIX + line for line in (*refused, *not_known(fields))]

    def _open_window(self, text: str) -> list[str]:
        try:
            start, end = (float(part) for part in text.split(",")) if text else (0.0, 1.0)
            if not 0.0 <= start < end:
                raise ValueError
        except ValueError:
            return [f"{WINDOW} = {text[:80]}: takes two times [s], the first one smaller"]
        self.traces.open_window((start, end) if text else None)
        return []

    def _turn(self, _event: object) -> None:
        if self.pages.current not in self._known_pages:
            self._known_pages.add(self.pages.current)
            self.pages.page.link.watch(self._refresh)
        self._refresh()

    def _refresh(self, *_: object) -> None:
        fields: dict[str, str] = {}
        for part in self._parts[:-1]:
            fields |= part.texts()
        if (window := self.traces.chosen_window()) is not None:
            fields[WINDOW] = f"{window[0]:.4g},{window[1]:.4g}"
        fields |= {f"{self.pages.current}.{name}": text for name, text in self.pages.page.link.texts().items()}
        fields |= self._parts[-1].texts()
        parts = [f"{PREFIX}{key}={quote(value, safe=',:-')}" for key, value in fields.items()]
        self.query = "&".join([*parts, *([f"{THEME}={self._theme}"] if self._theme else [])])
