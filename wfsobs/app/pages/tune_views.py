"""A tuning in a figure and a table."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import numpy as np
from bokeh.models import ColumnDataSource, DataRange1d
from markupsafe import Markup

from wfsobs.app.controls.names import setting_name
from wfsobs.app.display import NO_ANGLE, UNITS, Display, per_micrometre
from wfsobs.app.numerals import NOTHING, change, number
from wfsobs.app.render import Row, macro, table
from wfsobs.app.style import look
from wfsobs.app.tune_work import LIKELIHOOD, OTHER, SETTING, TEST, TOGETHER, VALIDATION, best_so_far, tuning_rows
from wfsobs.app.views.plots import call, new_figure
from wfsobs.sensors.modes import TIP_TILT
from wfsobs.tuning import Evaluation, TuningResult
from wfsobs.tuning.records import MEASURES, NEXT, REFERENCE, TRUTH
from wfsobs.tuning.report import tuning_remarks

TITLES = {
    SETTING: "Settings",
    VALIDATION: "{measure} on the validation record, used in the search [{unit}]",
    TEST: "{measure} on the test record, not used in the search [{unit}]",
    OTHER: "The same for the other target, turbulence or vibration [{unit}]",
    LIKELIHOOD: "Log marginal likelihood of the training targets, for information",
}
LEGEND = {"tried": "evaluations", "fitted": "best so far"}

AXES = {MEASURES[TRUTH]: "rms error", MEASURES[NEXT]: "prediction error", MEASURES[REFERENCE]: "rms distance"}
"""What a tuning makes small, short enough for an axis."""


class HistoryFigure:
    """The error, or what takes its place, on the validation record of every evaluation, and the least so far."""

    def __init__(self) -> None:
        self.figure = new_figure(x_range=DataRange1d(range_padding=0.02), y_range=DataRange1d())
        call(self.figure, "History of the tuning")
        self.figure.xaxis.axis_label = "evaluation"
        self.source = ColumnDataSource({"x": [], "tried": [], "best": []})
        self._trials = self.figure.scatter("x", "tried", source=self.source, size=6, fill_alpha=0.7)
        self._best = self.figure.step("x", "best", source=self.source, mode="after", line_width=2.0)

    def draw(self, history: Sequence[Evaluation], measure: str, unit: str, diameter: float) -> None:
        """Send the evaluations so far; what failed has no point."""
        scale = per_micrometre(unit, diameter)
        tried, best = (scale * np.array(y, dtype=float) for y in ([e.rms for e in history], best_so_far(history)))
        self.source.data = {
            "x": np.arange(1, len(history) + 1),
            "tried": np.where(np.isfinite(tried), tried, np.nan),
            "best": np.where(np.isfinite(best), best, np.nan),
        }
        self.figure.yaxis.axis_label = f"{AXES[measure]}, validation [{UNITS[unit]}]"

    def restyle(self, dark: bool) -> None:
        """Set the colours of light or dark mode."""
        colour = look("tried").colour(dark)
        self._trials.glyph.update(line_color=colour, fill_color=colour)
        self._best.glyph.update(line_color=look("fitted").colour(dark))


def unit_for(result: TuningResult | None, display: Display) -> str:
    """Choose the unit: the one shown, or nm where it is an angle and the modes have none."""
    modes = (result.before.validation or result.after.validation) if result else None
    angles = modes is None or set(modes.modes) <= {mode.name for mode in TIP_TILT}
    return "nm" if display.unit in NO_ANGLE and not angles else display.unit


def tuning_html(result: TuningResult, display: Display, diameter: float) -> str:
    """Write settings, errors and likelihoods before and after."""
    unit = unit_for(result, display)
    scale = per_micrometre(unit, diameter)
    groups = [
        (TITLES[section].format(measure=result.measure, unit=UNITS[unit]), [_row(*row, scale) for row in found])
        for section, found in groupby(tuning_rows(result), key=lambda row: row[0])
    ]
    columns = {"What": "", "Before": "", "After": "", "Change [%]": ""}
    notes = [f"{line[0].upper()}{line[1:]}." for line in tuning_remarks(result) if "likelihood" not in line]
    return f"{table('Before and after', columns, groups)}{macro('texts', 'text', notes)}"


def _row(section: str, name: str, before: float | str | None, after: float | str | None, scale: float) -> Row:
    error, name = section in (VALIDATION, TEST, OTHER), setting_name(name) if section == SETTING else name
    cells = [_cell(x, scale if error else 1.0) for x in (before, after)]
    known = error and isinstance(before, float) and isinstance(after, float)
    cells.append(change(before, after) if known else "")  # type: ignore[arg-type]
    return Row(Markup("<b>{}</b>").format(name) if name == TOGETHER else name, cells, {"section": section})


def _cell(value: float | str | None, scale: float) -> str:
    if isinstance(value, str):
        return value
    return NOTHING if value is None else number(value * scale, 4)
