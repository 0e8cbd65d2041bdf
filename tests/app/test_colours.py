"""Lines of one figure can be told apart, whatever a reader's eyes tell apart; text has contrast."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from types import MappingProxyType

import numpy as np
import pytest
from numpy.typing import NDArray

from wfsobs.app.style import PRIMARY, look, observers_of
from wfsobs.app.work import TRUTH
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS

Array = NDArray[np.float64]

# Machado, Oliveira and Fernandes 2009, table 1 at severity 1.0, for linear RGB.
SIGHT: Mapping[str, Array] = MappingProxyType(
    {
        "common": np.eye(3),
        "protanopia": np.array(
            [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
        ),
        "deuteranopia": np.array(
            [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
        ),
        "tritanopia": np.array(
            [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
        ),
    }
)
XYZ = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]])

TOGETHER = {**{target: [TRUTH, *observers_of(target)] for target in TARGETS}, "controllers": list(CONTROLLERS)}
"""Lines that share a figure."""

OFTEN_FIRST = (
    "kf-lgs",
    "gpr-online",
    "multirate-optimal",
    "multirate-multi",
    "multirate-adaptive",
    "multirate-coupled",
    "gp-both",
)
"""The references, and those that are the best of most scenarios."""

CLEARLY_APART = 25.0
"""A difference in CIE L*a*b* that lines which cross each other show."""

TOLD_APART = 20.0
"""A difference in CIE L*a*b* that thin lines show as well."""


def linear(colour: str) -> Array:
    """Linear RGB of '#rrggbb'."""
    c = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def lab(rgb: Array) -> Array:
    """CIE L*a*b* of linear RGB."""
    t = XYZ @ np.clip(rgb, 0.0, 1.0) / XYZ.sum(axis=1)
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def contrast(one: str, other: str) -> float:
    """Contrast ratio of WCAG."""
    dim, bright = sorted(float(XYZ[1] @ linear(c)) for c in (one, other))
    return (bright + 0.05) / (dim + 0.05)


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("sight", SIGHT)
@pytest.mark.parametrize("together", TOGETHER.values(), ids=TOGETHER)
def test_lines_differ_in_colour_or_dash(together: list[str], sight: str, dark: bool) -> None:
    alike = []
    for one, other in combinations(together, 2):
        a, b = look(one), look(other)
        difference = np.linalg.norm(lab(SIGHT[sight] @ linear(a.colour(dark))) - lab(SIGHT[sight] @ linear(b.colour(dark))))
        if difference < TOLD_APART and a.dash == b.dash:
            alike.append((one, other, round(float(difference), 1)))
    assert alike == []


@pytest.mark.parametrize(("dark", "background"), [(False, "#FFFFFF"), (True, "#121212")])
def test_lines_stand_out(dark: bool, background: str) -> None:
    faint = {name: contrast(look(name).colour(dark), background) for names in TOGETHER.values() for name in names}
    assert {name: c for name, c in faint.items() if c < 2.9} == {}


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("sight", ["common", "deuteranopia"])
@pytest.mark.parametrize("target", TARGETS)
def test_lines_that_are_shown_at_first_differ_by_colour_alone(target: str, sight: str, dark: bool) -> None:
    """Dashes of thin lines on top of each other run together."""
    seen = {name: lab(SIGHT[sight] @ linear(look(name).colour(dark))) for name in OFTEN_FIRST if name in observers_of(target)}
    close = [(a, b) for a, b in combinations(seen, 2) if np.linalg.norm(seen[a] - seen[b]) < CLEARLY_APART]
    assert close == []


@pytest.mark.parametrize("dark", [False, True])
def test_families_hold_without_green(dark: bool) -> None:
    """For a deuteranope filters of one sensor are yellow, multi-rate ones blue, Gaussian processes grey."""
    blueness = {o.id: -lab(SIGHT["deuteranopia"] @ linear(o.look.colour(dark)))[2] for o in OBSERVERS.values()}
    single, both, processes = (
        [value for name, value in blueness.items() if name.startswith(family) and name != "kf-ngs"]  # the paper's NGS is blue
        for family in ("kf-", "multirate", "gp")
    )
    assert max(single) < min(processes) - 5.0 and max(processes) < min(both) - 5.0


def test_black_and_white_have_the_highest_contrast() -> None:
    assert contrast("#000000", "#FFFFFF") == pytest.approx(21.0)
    assert contrast(PRIMARY, "#FFFFFF") > 4.5
    assert lab(np.ones(3)) == pytest.approx([100.0, 0.0, 0.0], abs=1e-3)
