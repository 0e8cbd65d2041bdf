"""The switch between modes: two buttons for tip and tilt, a list where there are more."""

from __future__ import annotations

from collections.abc import Sequence

import panel as pn
import panel_material_ui as pmui

from wfsobs.app.controls.field import SOON
from wfsobs.app.display import UNITS, Display, short_name
from wfsobs.app.jobs.task import BackgroundTask
from wfsobs.app.style import HEARD
from wfsobs.sensors.modes import TIP_TILT, Mode


class ModeSwitch:
    """Chooses the mode that is shown among those of the run shown.

    Made before the views, so that they are never asked for a mode that a run does not have.
    """

    def __init__(self, run: BackgroundTask, display: Display):
        self.run, self.display = run, display
        options = {_title(mode): mode.name for mode in TIP_TILT}
        self.buttons = pmui.RadioButtonGroup(
            label="Mode", options=options, value=display.mode, size="small", margin=0, variant="outlined", stylesheets=[HEARD]
        )
        self.list = pmui.Select(
            label="Mode", options=options, value=display.mode, size="small", margin=0, width=190, visible=False
        )
        for widget in (self.buttons, self.list):
            widget.param.watch(self._on_choice, "value")
        run.param.watch(self._fit, "result")
        display.param.watch(self._follow, ["mode", "unit"])

    def view(self) -> list[object]:
        """Return the buttons and the list, one of them visible."""
        return [self.buttons, self.list]

    def _on_choice(self, event: object) -> None:
        value = event.new  # type: ignore[attr-defined]
        if value is not None:
            self.display.mode = value

    def _fit(self, *_: object) -> None:
        """Offer the modes of the run shown."""
        if (shown := self.run.result) is not None:
            self.offer(shown.scenario.modes[: shown.result.record.n_modes])

    def offer(self, modes: Sequence[Mode]) -> None:
        """Offer modes to choose from."""
        if self.display.mode not in [mode.name for mode in modes]:
            self.display.mode = modes[0].name
        options = {_title(mode): mode.name for mode in modes}
        if list(self.list.options) != list(options):
            self.list.param.update(options=options, value=self.display.mode)
            self.list.visible = len(modes) > len(TIP_TILT)
            self.buttons.visible = not self.list.visible

    def _follow(self, *_: object) -> None:
        """Show the mode in the widgets; what is no tilt of the wavefront has no angle."""
        mode = self.display.mode
        if self.display.unit not in self.display.units:
            self.display.unit = "nm"
        if mode in self.list.options.values():
            self.list.value = mode
        if mode in self.buttons.options.values():
            self.buttons.value = mode


class UnitSwitch:
    """Chooses among the units of the mode shown, and says why one is missing. Made after the switch between modes."""

    def __init__(self, display: Display):
        self.display = display
        self.buttons = pmui.RadioButtonGroup(
            label="Unit",
            options=self._options(),
            value=display.unit,
            size="small",
            margin=0,
            variant="outlined",
            stylesheets=[HEARD],
        )
        self.buttons._debounce = SOON  # type: ignore[misc]
        self.note = pn.pane.HTML(NO_MAS, visible=False, margin=0)
        self.buttons.param.watch(self._on_choice, "value")
        display.param.watch(self._follow, ["mode", "unit"])

    def view(self) -> list[object]:
        """Return the buttons and the note."""
        return [self.buttons, self.note]

    def _options(self) -> dict[str, str]:
        return {UNITS[unit]: unit for unit in self.display.units}

    def _on_choice(self, event: object) -> None:
        value = event.new  # type: ignore[attr-defined]
        if value in self.display.units:
            self.display.unit = value

    def _follow(self, *_: object) -> None:
        options = self._options()
        if options != self.buttons.options or self.buttons.value != self.display.unit:
            self.buttons.param.update(options=options, value=self.display.unit)
        self.note.visible = len(options) < len(UNITS)


NO_MAS = '<span style="font-size:12px;opacity:0.75">mas: tip and tilt only</span>'


def _title(mode: Mode) -> str:
    """Write a mode's name in a list, with the short one of the axes."""
    short = short_name(mode)
    return mode.name[0].upper() + mode.name[1:] + (f" ({short})" if short != mode.name else "")
