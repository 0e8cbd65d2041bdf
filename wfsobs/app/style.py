"""Colours, dashes and names: how an observer or a controller looks wherever it appears.

The colours are the paper's. In dark mode each has a lighter relative; dashes tell apart what comes close in colour.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from types import MappingProxyType
from typing import Any

from wfsobs.app.work import TRUTH
from wfsobs.evaluation.scores import BOUND
from wfsobs.observers import OBSERVERS


@dataclass(frozen=True)
class Look:
    """Name in legends, colour in light and dark mode, dash pattern [px] (empty is solid), line width [px]."""

    label: str
    light: str
    dark: str
    dash: tuple[int, ...] = ()
    width: float = 1.4

    def colour(self, dark: bool) -> str:
        """The colour for the mode."""
        return self.dark if dark else self.light


LOOKS: Mapping[str, Look] = MappingProxyType(
    {
        TRUTH: Look("Truth", "#606060", "#C8C8C8", (6, 3)),
        "kf-lgs": Look("LGS KF", "#FF6600", "#FF8533"),
        "kf-ngs": Look("NGS KF", "#003DE6", "#7AA2FF", (8, 2)),
        "multirate": Look("Multi-rate KF", "#E31FFF", "#F08BFF", (10, 2, 2, 2)),
        "multirate-optimal": Look("Opt. multi-rate", "#7A1FA2", "#C9A0FF", (3, 2)),
        "butterworth-ol": Look("Butterworth OL", "#B40000", "#FF7A70", (2, 2)),
        "butterworth-cl": Look("Butterworth CL", "#B40000", "#FF7A70", (8, 3)),
        "gpr-offline": Look("Offline GPR", "#0A960A", "#4FD64F", (12, 2, 2, 2, 2, 2)),
        "gpr-online": Look("Online GPR", "#004B00", "#A6E3A6", (10, 2, 2, 2)),
        "kf-multi": Look("Multi-peak", "#00707F", "#4DD0E1", (14, 3)),
        "ridge": Look("Ridge", "#6B6B00", "#C8C84D", (4, 2)),
        "ridge-30": Look("30-tap predictor", "#8A5A00", "#D8A44D", (2, 3)),
        "persistence": Look("Persistence", "#707070", "#A8A8A8", (1, 3)),
        "kf-adaptive": Look("Adaptive KF", "#E0006E", "#FF7AB8", (20, 2), width=1.8),
        BOUND: Look("Bound, mean of the LGS", "#202020", "#E8E8E8", (1, 2)),
        "zero": Look("Zero", "#8A8A8A", "#9A9A9A", (2, 4)),
        "measured": Look("Measured", "#606060", "#C8C8C8"),
        "highest": Look("Highest", "#8A8A8A", "#9A9A9A"),
        "fitted": Look("Model", "#E04E00", "#FF8533", width=2.2),
        "tried": Look("Tried", "#606060", "#C8C8C8"),
        "parts": Look("Parts", "#003DE6", "#7AA2FF", (4, 3)),
        "found": Look("Peaks", "#A1260D", "#FFB3A1"),
        "none": Look("No control", "#606060", "#C8C8C8", (6, 3)),
        "integrator": Look("Integrator", "#003DE6", "#7AA2FF"),
        "lqg-kf-lgs": Look("LQG LGS KF", "#FF6600", "#FF8533"),
        "lqg-kf-multi": Look("LQG multi-peak", "#00707F", "#4DD0E1", (14, 3)),
        "lqg-multirate": Look("LQG multi-rate", "#E31FFF", "#F08BFF", (10, 2, 2, 2)),
        "lqg-multirate-optimal": Look("LQG optimal", "#7A1FA2", "#C9A0FF", (3, 2)),
        "lqg-multirate-multi": Look("LQG opt. peaks", "#B40000", "#FF7A70", (8, 3)),
        "integrator+gpr-offline": Look("Int. + offline", "#0A960A", "#4FD64F", (12, 2, 2, 2, 2, 2)),
        "integrator+gpr-online": Look("Int. + online", "#004B00", "#A6E3A6", (10, 2, 2, 2)),
    }
)

HIDDEN = ("ridge", "ridge-30", "persistence", "zero")
"""Observers in the table only: their lines would be the axis, or hide the others."""

HEARD = ".MuiFormLabel-root { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); }"
"""Style of a switch whose name is heard but not seen."""

PRIMARY = "#0B4F6C"

_COMPONENTS = {
    "MuiAppBar": {"styleOverrides": {"root": {"backgroundColor": f"{PRIMARY} !important", "color": "#fff !important"}}},
    "MuiButton": {"styleOverrides": {"root": {"textTransform": "none"}}},
    "MuiToggleButton": {"styleOverrides": {"root": {"textTransform": "none", "whiteSpace": "nowrap"}}},
}


def theme() -> dict[str, Any]:
    """The page's colours in light and dark mode. Units are written as they are, not in capitals."""
    return {
        "light": {"palette": {"primary": {"main": PRIMARY}}, "components": _COMPONENTS},
        "dark": {"palette": {"primary": {"main": "#6FB7D6"}}, "components": _COMPONENTS},
    }


def look(name: str) -> Look:
    """The look of an observer or of the truth; one that is new here has its registered name, in grey."""
    if name in LOOKS:
        return LOOKS[name]
    return Look(OBSERVERS[name].label if name in OBSERVERS else name, "#555577", "#BBBBDD", (4, 2))


def observers_of(target: str, hidden: bool = False) -> list[str]:
    """Observers that estimate a target, in the order of the registry."""
    return [o.id for o in OBSERVERS.values() if target in o.targets and (hidden or o.id not in HIDDEN)]


def asset(name: str) -> str:
    """Text of a file of the package's assets."""
    return files("wfsobs.assets").joinpath(name).read_text(encoding="utf-8")


def swatch(name: str, dark: bool, dashed: bool = True) -> str:
    """A short line as drawn in the figures, as SVG; solid if not to be dashed."""
    it = look(name)
    dash = f' stroke-dasharray="{" ".join(map(str, it.dash))}"' if it.dash and dashed else ""
    return (
        '<svg class="swatch" width="26" height="8" aria-hidden="true">'
        f'<line x1="0" y1="4" x2="26" y2="4" stroke="{it.colour(dark)}" stroke-width="2.5"{dash}/></svg>'
    )
