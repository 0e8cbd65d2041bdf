"""The switch between modes: two buttons for tip and tilt, a list where there are more."""

from __future__ import annotations

import panel_material_ui as pmui

from wfsobs.app.display import NO_ANGLE, Display
from wfsobs.app.run import Run
from wfsobs.modes import TIP_TILT


class ModeSwitch:
    """Chooses the mode that is shown among those of the run shown.

    Made before the views, so that they are never asked for a mode that a run does not have.
    """

    def __init__(self, run: Run, display: Display):
        self.run, self.display = run, display
        options = {mode.name.capitalize(): mode.name for mode in TIP_TILT}
        self.buttons = pmui.RadioButtonGroup(options=options, value=display.mode, size="small", margin=0, variant="outlined")
        self.list = pmui.Select(
            label="Mode", options=options, value=display.mode, size="small", margin=0, width=190, visible=False)
        for widget in (self.buttons, self.list):
            widget.param.watch(self._chosen, "value")
        run.param.watch(self._fit, "shown")
        display.param.watch(self._follow, ["mode", "unit"])

    def view(self) -> list[object]:
        """The buttons and the list, one of them visible."""
        return [self.buttons, self.list]

    def _chosen(self, event: object) -> None:
        value = event.new  # type: ignore[attr-defined]
        if value is not None:
            self.display.mode = value

    def _fit(self, *_: object) -> None:
        """Offer the modes of the run shown."""
        shown = self.run.shown
        if shown is None:
            return
        modes = shown.scenario.modes[: shown.result.record.n_modes]
        if self.display.mode not in [mode.name for mode in modes]:
            self.display.mode = modes[0].name
        options = {mode.name[0].upper() + mode.name[1:]: mode.name for mode in modes}
        if list(self.list.options) != list(options):
            self.list.param.update(options=options, value=self.display.mode)
            self.list.visible = len(modes) > len(TIP_TILT)
            self.buttons.visible = not self.list.visible

    def _follow(self, *_: object) -> None:
        """Show the mode in the widgets; what is no tilt of the wavefront has no angle."""
        mode = self.display.mode
        if self.display.unit in NO_ANGLE and mode not in [m.name for m in TIP_TILT]:
            self.display.unit = "nm"
        if mode in self.list.options.values():
            self.list.value = mode
        if mode in self.buttons.options.values():
            self.buttons.value = mode
