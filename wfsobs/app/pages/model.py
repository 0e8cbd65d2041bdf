"""The equations, with the numbers of the present settings in them."""

from __future__ import annotations

from typing import Final

from wfsobs.app.display import Display
from wfsobs.app.pages.parts import Page
from wfsobs.app.render import render, short
from wfsobs.app.store import Store
from wfsobs.app.style import HtmlText, html, sheets, swatch
from wfsobs.evaluation.description import Description, describe
from wfsobs.observers import OBSERVERS
from wfsobs.typing import Array


class ModelPage(Page):
    """The page; follows the settings and the mode while it is visible."""

    def __init__(self, store: Store, display: Display):
        super().__init__(store, display, "mode", "dark")
        self.pane: Final = html(stylesheets=sheets("style", "model"))
        store.param.watch(self.redraw, "scenario")

    def view(self) -> HtmlText:
        """Return the contents of the page."""
        return self.pane

    def draw(self) -> None:
        """Write the equations."""
        scenario = self.store.scenario
        mode = min(self.display.column, len(scenario.modes) - 1)
        self.pane.html = model_html(describe(scenario, mode), self.display.dark)


def model_html(it: Description, dark: bool) -> str:
    """Write the whole page."""
    return render(
        "model.html",
        it=it,
        swatch=lambda name: swatch(name, dark),
        label=lambda name: OBSERVERS[name].label,
        poles=poles,
    )


def poles(poles: Array) -> list[str]:
    """Write poles, a conjugate pair once; count those that are zero to rounding."""
    zero = abs(poles) < 1e-9
    words = [
        short(p.real) if abs(p.imag) < 1e-9 else f"{short(p.real)} ± {short(p.imag)} i" for p in poles[~zero] if p.imag > -1e-9
    ]
    return [*words, *([f"{zero.sum()} at 0"] if zero.any() else [])]
