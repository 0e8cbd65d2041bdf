"""Measured vibration spectra of the package, with lines separated from a synthetic floor.

A table in `assets` lists the bins that lie off the floor; its head has the floor and the grid, the licence is beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np

from wfsobs.typing import Array

SPECTRA = {"eris-ut4": "eris_ut4.csv"}
"""Name of a spectrum -> its table in `assets`."""

LINES, ALL = "lines", "all"
PARTS = (LINES, ALL)

APART = 0.15
"""Bins off the floor that are nearer to each other than this are one line [Hz]."""


@dataclass(frozen=True)
class MeasuredLine:
    """A measured line: the centroid of its power in both axes [Hz], and its rms in tip and in tilt [um]."""

    frequency: float
    rms: tuple[float, ...]


@dataclass(frozen=True)
class MeasuredSpectrum:
    """A measured spectrum.

    Attributes
    ----------
    frequency : Array
        Evenly spaced, (n,) [Hz].
    density : Array
        One-sided density of tip and tilt, (n, 2) [um^2/Hz].
    above_floor : Array
        The part of it above the floor, the lines, (n, 2) [um^2/Hz].
    """

    frequency: Array
    density: Array
    above_floor: Array

    def part(self, part: str) -> Array:
        """Return the density (n, 2) [um^2/Hz] of all, or of the lines."""
        return self.density if part == ALL else self.above_floor

    def lines(self, least: float = 0.0) -> list[MeasuredLine]:
        """Return the lines of more than `least` [um] rms in either axis."""
        power = self.above_floor * (self.frequency[1] - self.frequency[0])
        bins = np.flatnonzero(power.any(axis=1))
        out = []
        for group in np.split(bins, np.flatnonzero(np.diff(self.frequency[bins]) > APART) + 1):
            rms = np.sqrt(power[group].sum(axis=0))
            if group.size and rms.max() > least:
                centre = np.average(self.frequency[group], weights=power[group].sum(axis=1))
                out.append(MeasuredLine(float(centre), tuple(map(float, rms))))
        return out


@cache
def measured_spectrum(name: str) -> MeasuredSpectrum:
    """Return the spectrum of that name. Raises KeyError for an unknown one."""
    text = files("wfsobs.assets").joinpath(SPECTRA[name]).read_text(encoding="utf-8").splitlines()
    head = dict(line[2:].split(": ", 1) for line in text if line.startswith("# ") and ": " in line)
    table = np.array([line.split(",") for line in text if line[0].isdigit()], dtype=float)
    first, step = float(head["first"]), float(head["step"])
    frequency = first + step * np.arange(int(head["bins"]))
    floor = float(head["floor"]) / frequency**2
    density = np.column_stack([floor, floor])
    density[np.rint((table[:, 0] - first) / step).astype(int)] = table[:, 1:]
    above = np.where(frequency[:, None] >= float(head["lines from"]), np.maximum(density - floor[:, None], 0.0), 0.0)
    um2 = 1e-6  # of a square nanometre
    out = MeasuredSpectrum(frequency, density * um2, above * um2)
    for array in vars(out).values():
        array.setflags(write=False)
    return out
