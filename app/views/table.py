"""The RMS table, plain HTML."""

from __future__ import annotations

from html import escape

import panel as pn

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.store import Run
from wfsobs.app.style import asset, observers_of, swatch
from wfsobs.app.work import Shown
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.scores import Score

NOTHING = "–"


def number(value: float | None, digits: int = 3) -> str:
    """A number with some significant digits and no exponent where it is of common size."""
    if value is None:
        return NOTHING
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    text = f"{value:#.{digits}g}"
    return (f"{value:.0f}" if "e" in text else text.rstrip(".")).replace("-", "−")


def find(shown: Shown, observer: str, target: str, mode: str) -> Score | None:
    """The score of one observer, target and mode, or None."""
    rows = shown.result.scores
    return next((s for s in rows if (s.observer, s.target, s.mode) == (observer, target, mode)), None)


class Table:
    """Every score of the mode shown, one row per observer and target."""

    def __init__(self, run: Run, display: Display):
        self.run, self.display = run, display
        self.pane = pn.pane.HTML(self.html(), sizing_mode="stretch_width", margin=0, stylesheets=[asset("style.css")])
        run.param.watch(self._refresh, "shown")
        display.param.watch(self._refresh, ["mode", "unit", "dark"])

    def _refresh(self, *_: object) -> None:
        self.pane.object = self.html()

    def html(self) -> str:
        """The table."""
        unit = self.display.unit_label
        columns = (
            "Observer", f"RMS error [{unit}]", f"RMS truth [{unit}]", "error / truth", "Lag [ms]", "Time per step [µs]")
        head = "".join(f"<th scope=col>{name}</th>" for name in columns)
        body = "".join(self._target(target) for target in TARGETS)
        table = f'<table class="rms"><thead><tr>{head}</tr></thead>{body}</table>'
        return f'<div class="scroll" tabindex=0 role=region aria-label="RMS errors">{table}</div>{self._notes()}'

    def _target(self, target: str) -> str:
        rows = "".join(self._row(name, target) for name in observers_of(target, hidden=True))
        title = f"{target.capitalize()}, {self.display.mode}"
        return f'<tbody><tr><th colspan=6 class="target" scope=rowgroup>{title}</th></tr>{rows}</tbody>'

    def _row(self, name: str, target: str) -> str:
        shown = self.run.shown
        score = find(shown, name, target, self.display.mode) if shown else None
        label = escape(OBSERVERS[name].label) + ("" if OBSERVERS[name].causal else " <sup>looks ahead</sup>")
        cells = [NOTHING] * 5
        if shown and score:
            scale = per_micrometre(self.display.unit, shown.scenario.telescope.diameter)
            cells = [
                number(score.rms * scale), number(score.truth_rms * scale), number(score.normalised_rms),
                NOTHING if score.lag is None else f"{1e3 * score.lag:.2f}".replace("-", "−"),
                number(1e6 * score.seconds_per_step),
            ]
        values = "".join(f"<td>{c}</td>" for c in cells)
        head = f"<th scope=row>{swatch(name, self.display.dark)}{label}</th>"
        return f'<tr data-observer="{name}" data-target="{target}">{head}{values}</tr>'

    def _notes(self) -> str:
        shown = self.run.shown
        failures = shown.result.failures if shown else ()
        return "".join(f'<p class="failure">{escape(f.reason)}</p>' for f in failures)
