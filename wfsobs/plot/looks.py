"""Colours, dashes and names: how an observer or a controller looks wherever it appears.

Observers and controllers say it themselves; here are the other lines. Filters of one sensor are warm, multi-rate ones violet,
Gaussian processes blue-green: families that hold without red or green cones. LGS, NGS, multi-rate and Butterworth have the
paper's colours; its greens of the GPR, one with orange and red for a deuteranope, are bluer here. In dark mode each has a lighter
relative; dashes tell apart what comes close in colour.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.budget import CONE, LAG, LINES, MISMATCH, NOISE
from wfsobs.evaluation.exact_errors import TRUTH
from wfsobs.evaluation.result import NOT_OBSERVERS
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import PLAIN, Look

DASHES = (1, 2), (6, 2, 1, 2), (10, 2, 1, 2, 1, 2), (1, 4), (6, 4, 1, 4), (14, 2, 1, 2, 1, 2)
"""Of the bounds."""

LOOKS: Mapping[str, Look] = MappingProxyType(
    {
        TRUTH: Look("Truth", "#606060", "#C8C8C8", (6, 3)),
        **{name: Look(NOT_OBSERVERS[name], "#202020", "#E8E8E8", dash) for name, dash in zip(BOUNDS, DASHES, strict=True)},
        "measured": Look("Measured", "#606060", "#C8C8C8"),
        "highest": Look("Highest", "#8A8A8A", "#9A9A9A"),
        "fitted": Look("Model", "#E04E00", "#FF8533", width=2.2),
        "tried": Look("Tried", "#606060", "#C8C8C8"),
        "parts": Look("Parts", "#003DE6", "#7AA2FF", (4, 3)),
        "found": Look("Peaks", "#A1260D", "#FFB3A1"),
    }
)
"""Lines that are neither observers' nor controllers'."""

TERM_COLOURS: Mapping[str, str] = MappingProxyType(
    {NOISE: "#8A8F98", LAG: "#3C7FC0", LINES: "#E8912D", MISMATCH: "#B5539C", CONE: "#3F9E6B"}
)
"""Terms of an error budget."""


def look(name: str) -> Look:
    """Return the look of an observer, a controller, the truth or another line; an unknown one is labelled with its id."""
    if name in LOOKS:
        return LOOKS[name]
    entry = OBSERVERS.get(name) or CONTROLLERS.get(name)
    if entry is None:
        return replace(PLAIN, label=name)
    return entry.look if entry.look.label else replace(entry.look, label=entry.label)
