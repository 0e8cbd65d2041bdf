"""Switches beside the page's figures: mode, unit, lines, seeds, and the run that others are compared with."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final

import panel_material_ui as pmui
import param
from markupsafe import Markup

from wfsobs.app.compared import ComparedRun, name_of_difference
from wfsobs.app.display import UNITS, Display, short_name
from wfsobs.app.history import History
from wfsobs.app.idle_work import SeedRuns
from wfsobs.app.jobs import FAILED
from wfsobs.app.render import macro
from wfsobs.app.service import BackgroundTask
from wfsobs.app.style import HEARD, follow_html, html, make_button, make_select, run_swatch, watch
from wfsobs.scenario import Scenario
from wfsobs.sensors.zernike import TIP_TILT, Mode

BUTTONS: Mapping[str, Any] = {"size": "small", "margin": 0, "variant": "outlined", "stylesheets": [HEARD]}
"""Style of the buttons of a switch."""


def group(display: Display, name: str) -> pmui.RadioButtonGroup:
    """Make the buttons of one switch of the display."""
    return pmui.RadioButtonGroup.from_param(display.param[name], **BUTTONS)


class ModeSwitch:
    """Chooses the mode that is shown among those of the run shown.

    Made before the views, so that they are never asked for a mode that a run does not have.
    """

    def __init__(self, run: BackgroundTask, display: Display):
        self.run: Final = run
        self.display: Final = display
        self._mode_to_show = ""
        options = {_title(mode): mode.name for mode in TIP_TILT}
        self.buttons: Final = pmui.RadioButtonGroup(label="Mode", options=options, value=display.mode, **BUTTONS)
        self.list: Final = make_select("Mode", options, display.mode, 190, visible=False)
        for widget in (self.buttons, self.list):
            widget.param.watch(self._on_choice, "value")
        run.param.watch(self._fit, "result")
        display.param.watch(self._follow, "mode")

    def view(self) -> list[object]:
        """Return the buttons and the list, one of them visible."""
        return [self.buttons, self.list]

    def _on_choice(self, event: Any) -> None:
        self.display.mode = event.new or self.display.mode

    def _fit(self, *_: object) -> None:
        """Offer the modes of the run shown."""
        if (shown := self.run.result) is not None:
            self.offer(shown.scenario.modes[: shown.result.record.n_modes])

    def offer(self, modes: Sequence[Mode]) -> None:
        """Offer modes to choose from."""
        options, names = {_title(mode): mode.name for mode in modes}, [mode.name for mode in modes]
        chosen = next(name for name in (self._mode_to_show, self.display.mode, *names) if name in names)
        self._mode_to_show = ""
        if list(self.list.options) != list(options):
            few = {title: name for title, name in options.items() if name in names[: len(TIP_TILT)]}
            self.buttons.param.update(options=few, value=chosen if chosen in few.values() else names[0])
            self.list.param.update(options=options, value=chosen)
            self.list.visible = len(modes) > len(TIP_TILT)
            self.buttons.visible = not self.list.visible
        self.display.mode = chosen

    def _follow(self, *_: object) -> None:
        """Show the mode in the widgets; one that the run shown does not have (of an address) once there is one that has."""
        mode = self.display.mode
        if mode not in self.list.options.values() and self.run.result is not None:
            self._mode_to_show, self.display.mode = mode, next(iter(self.list.options.values()))
            return
        if mode in self.list.options.values():
            self.list.value = mode
        if mode in self.buttons.options.values():
            self.buttons.value = mode


class UnitSwitch:
    """Chooses among the units of the mode shown, and says why one is missing."""

    def __init__(self, display: Display):
        self.buttons: Final = group(display, "unit")
        self.note: Final = html(NO_MAS, visible=False, margin=0)
        self.buttons.param.watch(self._follow, "options")

    def view(self) -> list[object]:
        """Return the buttons and the note."""
        return [self.buttons, self.note]

    def _follow(self, event: Any) -> None:
        self.note.visible = len(event.new) < len(UNITS)


NO_MAS = '<span style="font-size:12px;opacity:0.75">mas: tip and tilt only</span>'


def _title(mode: Mode) -> str:
    """Write a mode's name in a list, with the short one of the axes."""
    short = short_name(mode)
    return mode.name[0].upper() + mode.name[1:] + (f" ({short})" if short != mode.name else "")


class LineChoice(param.Parameterized):
    """The lines that are hidden: those that do not matter, until a visitor chooses others. A part of a view as texts by name.

    Attributes
    ----------
    names : list of str
        In an address.
    minor : list of str or None
        Lines that do not matter; None until it is known.
    is_chosen : bool
        Whether a visitor has chosen.
    """

    hidden_lines: param.List[list[str]] = param.List([], item_type=str, doc="Names of the lines that are hidden.")

    def __init__(self, name: str, lines: Collection[str]):
        """Hide none yet. name : in an address;  lines : names of all."""
        super().__init__()
        self.names: Final = [name]
        self._lines = lines
        self.minor: list[str] | None = None
        self.is_chosen: bool = False

    def offer(self, main: Collection[str]) -> None:
        """Show these alone, which matter, unless a visitor has chosen."""
        self.minor = [name for name in self._lines if name not in main]
        if not self.is_chosen:
            self.hidden_lines = self.minor

    def choose(self, names: list[str] | None) -> None:
        """Hide these from now on; for None those that do not matter."""
        self.is_chosen = names not in (None, self.minor)
        self.hidden_lines = (self.minor or []) if names is None else names

    def tie(self, cards: Any) -> None:
        """Keep the rows of a legend (`Cards`) in step."""
        cards.on_main = partial(self.choose, None)
        cards.param.watch(lambda event: event.new == self.hidden_lines or self.choose(event.new), "hidden_lines")
        self.watch(lambda event: setattr(cards, "hidden_lines", event.new))

    def texts(self) -> dict[str, str]:
        """Return the lines that are hidden, where a visitor has chosen."""
        return dict.fromkeys(self.names, ",".join(self.hidden_lines)) if self.is_chosen else {}

    def open(self, texts: Mapping[str, str]) -> list[str]:
        """Hide lines; return a line for each that is refused."""
        (own,) = self.names
        text = texts.get(own)
        names = text.split(",") if text else []
        self.choose(None if text is None else [name for name in names if name in self._lines])
        refused = [f"{own} = {name[:80]}: no line of that name" for name in names if name not in self._lines]
        return [*not_known(name for name in texts if name != own), *refused]

    def watch(self, act: Callable[..., object]) -> None:
        """Call a function when other lines are hidden."""
        self.param.watch(act, "hidden_lines")


def not_known(names: Iterable[str]) -> list[str]:
    """Return a line for each name that a page has nothing of."""
    return [f"{name}: there is no such part of a view" for name in names]


NO_STEPPERS = ".MuiIconButton-root { display: none !important; }"
"""The buttons of panel-material-ui beside a number have no names; the arrow keys do the same."""


class SeedSwitch:
    """The number of seeds, to be set, beside the table."""

    def __init__(self, seeds: SeedRuns):
        self.seeds = seeds
        self.field: Final = pmui.IntInput.from_param(
            seeds.param.count, size="small", width=90, margin=(0, 0, 4, 0), stylesheets=[NO_STEPPERS]
        )
        sources = (seeds, ["evidence", "count"]), (seeds.run, ["state", "result"]), (seeds.task, ["state", "message"])
        self.line: Final = follow_html(self.text, *sources, sizing_mode=None)

    def view(self) -> list[Any]:
        """Return the field and what is said beside it."""
        return [self.field, self.line]

    def text(self) -> str:
        """Say how many seeds are done."""
        seeds = self.seeds
        if not seeds.n_known:
            said = ""
        elif seeds.count == 1:
            said = "one record"
        elif not seeds.possible:
            said = "only for simulations that do not take long"
        elif seeds.task.state == FAILED:
            said = f"{seeds.n_known} of {seeds.count} seeds: {seeds.task.message}"
        elif seeds.n_known < seeds.count:
            said = f"{seeds.n_known} of {seeds.count} seeds done, more running in the background"
        else:
            said = f"over {seeds.n_known} seeds"
        return f'<span class="caption seeds">{said}</span>'


PIN, UNPIN = "Pin this run to compare others with it", "Unpin: compare with no other run"


class Pinning:
    """Pin and unpin, one button: the result shown is the first one that is compared, or none is any more."""

    def __init__(self, history: History):
        self.run: Final = history.store.run
        self.display: Final = history.display
        self.history = history
        self.button: Final = make_button("Pin", self._press, icon="push_pin", variant="outlined", disabled=True, description=PIN)
        self.note: Final = html(sizing_mode=None, visible=False)
        watch(self._refresh, (self.run, "result"), (history, "current"), (self.display, ["compared_runs", "dark"]))

    def view(self) -> list[object]:
        """Return the button and the legend."""
        return [self.button, self.note]

    def _press(self) -> None:
        if self.display.compared_runs:
            self.history.compare_none()
        else:
            self.history.compare(self.history.current)

    def _refresh(self, *_: object) -> None:
        runs, shown = self.display.compared_runs, self.run.result
        if (self.button.label == "Unpin") != bool(runs):
            self.button.param.update(label="Unpin" if runs else "Pin", description=UNPIN if runs else PIN)
            self.note.visible = bool(runs)
        self.button.disabled = not (runs or self.history.current)
        if runs and shown is not None:
            self.note.html = str(macro("compared", [self._item(run, shown.scenario) for run in runs]))

    def _item(self, run: ComparedRun, now: Scenario) -> tuple[Markup, str, str]:
        """Describe a run: its mark, its name, and what has changed since."""
        return run_swatch(run.letter, self.display.dark), run.name, name_of_difference(run.scenario, now)
