"""How results are shown: which mode, signal or error, and in which unit. Nothing here changes a result."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import param

from wfsobs.app.compared import ComparedRun, DrawnLines
from wfsobs.app.glossary import LAG, REAL_TIME, RELATIVE, RMS_ERROR, STATED, TERMS
from wfsobs.evaluation.exact_errors import cumulative_rms
from wfsobs.evaluation.scores import OF_STAR
from wfsobs.scenario import Scenario
from wfsobs.sensors.zernike import HIGHEST_ORDER, TIP_TILT, Mode, modes_up_to
from wfsobs.settings.values import unit_of
from wfsobs.typing import Array
from wfsobs.units import micrometres_per, unit_text

SIGNAL, ERROR, RUNNING_RMS = "signal", "error", "running rms"
PSD, CUMULATIVE = "psd", "cumulative"
UNITS = {"nm": "nm", "mas": "mas", "um": "µm"}
"""Unit -> how it is written."""

IN_MOST = "where the error of an optimal observer lies in 95 % of records"
OVER_SEEDS = "where the mean error over records lies, at 95 % confidence"


def over(n_seeds: int) -> str:
    """Say what the interval of an error is, from so many seeds."""
    return f"{OVER_SEEDS}, {f'{n_seeds} seeds' if n_seeds > 1 else 'from one record'}"


AT_LIMIT = "at the limit"
"""Note on an observer whose error is, within its interval, the bound of what it measures."""

NO_ANGLE = ("mas",)
"""Units that only tip and tilt can be in."""

MODES = [mode.name for mode in modes_up_to(HIGHEST_ORDER)]
"""Every mode that a run can have; it has the first of them."""


def per_micrometre(unit: str, diameter: float) -> float:
    """How many `unit` one micrometre of a tip or tilt coefficient is.

    >>> round(per_micrometre("mas", 8.0), 1)
    103.1
    """
    return 1.0 / micrometres_per(unit, diameter)


def label_of(p: param.Parameter[Any], name: str = "") -> str:
    """Write a setting's label, or another name, with its unit in [brackets]."""
    unit = unit_text(unit_of(p))
    return f"{name or p.label} [{unit}]" if unit else name or str(p.label)


def score_columns(unit: str, base: str = "truth", compared_columns: Mapping[str, str] = {}) -> dict[str, str]:
    """List the headings of a table of scores, and an explanation of each.

    base        : what an error is divided by: "truth", or "z" for a record without truth
    compared_columns : columns that go beside the error
    """
    of_z = f"Of predicting the next measurement, {OF_STAR}; or residual of the recorded loop"
    return {
        "Observer": "",
        f"RMS error [{unit}]": TERMS[RMS_ERROR] if base == "truth" else of_z,
        **compared_columns,
        "Relative error": TERMS[RELATIVE] if base == "truth" else "Error over RMS of what is measured; above 1 worse than zero",
        "Lag [ms]": TERMS[LAG],
        "Time per step [µs]": "Computing time per step and mode",
        "Real-time factor": TERMS[REAL_TIME],
        f"Predicted sigma [{unit}]": TERMS[STATED],
    }


def short_name(mode: Mode) -> str:
    """Shorten a mode's name: a long one becomes Z and Noll's index.

    >>> [short_name(mode) for mode in modes_up_to(2)]
    ['tip', 'tilt', 'defocus', 'Z5', 'Z6']
    """
    return mode.name if len(mode.name) <= len("defocus") else f"Z{mode.noll}"


class Display(param.Parameterized):
    """The switches above the figures."""

    mode: param.Selector[str] = param.Selector(default=MODES[0], objects=MODES, label="Mode")
    show: param.Selector[str] = param.Selector(
        default=ERROR, objects={"Signal": SIGNAL, "Error": ERROR, "Running rms": RUNNING_RMS}, label="Show"
    )
    unit: param.Selector[str] = param.Selector(default="nm", objects={text: unit for unit, text in UNITS.items()}, label="Unit")
    hidden_lines: param.Parameter[dict[str, list[str]]] = param.Parameter({}, doc="Target -> names of its hidden lines.")
    named_lines: param.Parameter[dict[str, list[str]]] = param.Parameter(
        {}, doc="Target -> names of the lines that matter: those that the verdict names."
    )
    dark: param.Boolean[bool] = param.Boolean(False, doc="Dark mode.")
    spectrum: param.Selector[str] = param.Selector(
        default=PSD, objects={"PSD": PSD, "Cumulative rms": CUMULATIVE}, label="Spectrum"
    )
    window_spectra: param.Boolean[bool] = param.Boolean(
        False, label="Spectra of the window", doc="Spectra of the stretch of time in view alone."
    )
    editing: param.Boolean[bool] = param.Boolean(
        False, label="Edit figure", doc="Handles on the spectra, and what theory predicts."
    )
    compared_runs: param.List[list[ComparedRun]] = param.List(
        [], item_type=ComparedRun, doc="The runs to compare with, by their letters."
    )

    @property
    def column(self) -> int:
        """The column of the mode in every array."""
        return MODES.index(self.mode)

    @property
    def mode_label(self) -> str:
        """The mode as axes write it."""
        return short_name(modes_up_to(HIGHEST_ORDER)[self.column])

    @param.depends("mode", watch=True)
    def _offer_units(self) -> None:
        """Offer those that the mode can be in: only tip and tilt are angles."""
        units = {text: unit for unit, text in UNITS.items() if unit not in NO_ANGLE or self.mode in [m.name for m in TIP_TILT]}
        if self.unit not in units.values():
            self.unit = "nm"
        if units != dict(self.param["unit"].names):
            self.param["unit"].objects = units

    @property
    def runs_drawn(self) -> list[tuple[ComparedRun, DrawnLines]]:
        """The compared runs that have lines of the mode shown."""
        return [(run, run.lines) for run in self.compared_runs if run.lines and self.column < len(run.scenario.modes)]

    @property
    def error(self) -> bool:
        """Whether errors are shown, as they are or as their running rms."""
        return self.show != SIGNAL

    @property
    def running(self) -> bool:
        """Whether the time traces are the running rms of the errors."""
        return self.show == RUNNING_RMS

    @property
    def cumulative(self) -> bool:
        """Whether spectra are summed from high to low frequency."""
        return self.spectrum == CUMULATIVE

    @property
    def unit_label(self) -> str:
        """The unit as it is written."""
        return UNITS[self.unit]

    def scale(self, scenario: Scenario) -> float:
        """Return how many of the unit shown one micrometre is."""
        return per_micrometre(self.unit, scenario.telescope.diameter)

    def curve(self, frequency: Array, density: Array, scenario: Scenario) -> Array:
        """Compute what is drawn of a density [um^2/Hz] above zero frequency: itself, or the rms from each frequency on."""
        scale = self.scale(scenario)
        return scale * cumulative_rms(frequency[1:], density[1:]) if self.cumulative else scale**2 * density[1:]

    def curve_label(self, of: str) -> str:
        """Write the axis of such curves. of : what they are of, with a space before it."""
        what, unit = (f"cumulative rms{of}", self.unit_label) if self.cumulative else (f"PSD{of}", f"{self.unit_label}²/Hz")
        return f"{what}, {self.mode_label} [{unit}]"
