"""An identification as a dictionary, as rows and lines of text and as a TOML file of settings; spectra to draw of it."""

from __future__ import annotations

from dataclasses import dataclass
from math import isnan, sqrt
from typing import Any

import numpy as np

from wfsobs.identification.process import IdentifiedProcess, Number
from wfsobs.identification.process import format_number as format_number
from wfsobs.identification.result import WHITE_LEVEL, Identification, IdentifiedMode
from wfsobs.identification.result import mode_rows as mode_rows
from wfsobs.record import RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import add_comments, to_toml
from wfsobs.spectral.periodogram import fast_length, periodogram, periodogram_frequencies, taper
from wfsobs.typing import Array


def identification_dict(result: Identification) -> dict[str, Any]:
    """Return the output of `wfsobs identify --json`.

    Every number has its standard deviation as `_std`, null where there is none; rms in um, frequencies in Hz. The rms of a
    peak is that within the record, `ensemble_rms` that of the process, which filters receive.
    """

    def numbers(**values: Number) -> dict[str, float | None]:
        std = {f"{name}_std": None if isnan(n.std) else n.std for name, n in values.items()}
        return {key: (n.value if key == name else std[key]) for name, n in values.items() for key in (name, f"{name}_std")}

    def of(p: IdentifiedProcess) -> dict[str, float | None]:
        return numbers(**{name: n for name, n in vars(p).items() if n is not None})

    return {
        "duration": result.duration,
        "level": result.level,
        "white": result.white,
        "modes": [
            {
                "mode": m.name,
                **numbers(noise=m.noise),
                "outlying": m.outlying,
                "turbulence": None if m.turbulence is None else of(m.turbulence),
                "background": None if m.background is None else of(m.background),
                "ngs_noise": None if m.difference is None else numbers(rms=m.difference.noise),
                "lgs_error": None if m.difference is None or m.difference.error is None else of(m.difference.error),
                "broad": [of(p) for p in m.broad],
                "peaks": [{**of(p), "pure": p.pure} for p in m.peaks],
                "whiteness": {
                    "cumulated_p": m.whiteness.periodogram,
                    "innovations_p": m.whiteness.innovations,
                    "unexplained": m.whiteness.left,
                    "white": m.whiteness.white,
                    "remarks": list(m.whiteness.remarks),
                },
            }
            for m in result.modes
        ],
    }


def whiteness_lines(result: Identification) -> list[str]:
    """Return one line per mode on the residual."""
    out = []
    for m in result.modes:
        w = m.whiteness
        tests = f"cumulative spectrum p = {w.periodogram:.2g}, innovations p = {w.innovations:.2g}"
        rest = f"; {w.left} candidates that no peak explains" if w.left else ""
        outlying = {"samples": m.outlying, "NGS frames": m.difference.outlying if m.difference else 0}
        rest += "".join(f"; outlying {what} taken for missing: {count}" for what, count in outlying.items() if count)
        why = "".join(f"; {remark}" for remark in w.remarks)
        out.append(f"{m.name}: residual is {'white' if w.white else 'NOT white'} at {WHITE_LEVEL:.0%} ({tests}{rest}){why}")
    return out


def identification_toml(result: Identification, scenario: Scenario) -> str:
    """Return the scenario of the result as TOML, with a standard deviation beside every identified number."""
    count = sqrt(scenario.sensors.lgs_count)
    notes = {path: f"+- {_std(number.std)}" for path, number in result.shared_settings(scenario).items()}
    notes["sensors.lgs_noise_per_mode"] = "+- " + ", ".join(_std(count * m.noise.std) for m in result.modes)
    smooth = [(m.name, what, p) for m in result.modes for what, p in _smooth(m)]
    for i, (mode, what, p) in enumerate(smooth):
        notes |= _notes(f"turbulence.processes.{i}", p, f"{mode}, {what}, ")
    for i, (mode, p) in enumerate(result.all_peaks):
        notes |= _notes(f"vibration.peaks.{i}", p, f"{mode}, ")
    head = [f"Identified from {result.duration:.1f} s; +- is one standard deviation.", *whiteness_lines(result)]
    return "\n".join(f"# {line}" for line in head) + "\n\n" + add_comments(to_toml(scenario), notes)


def _smooth(mode: IdentifiedMode) -> list[tuple[str, IdentifiedProcess]]:
    """Return the processes of a mode in `turbulence.processes`, in its order."""
    named = [("turbulence", mode.turbulence), ("background", mode.background), *(("broad", p) for p in mode.broad)]
    return [(what, p) for what, p in named if p is not None]


def _std(std: float) -> str:
    return "-" if isnan(std) else f"{std:.2g}"


def _notes(path: str, p: IdentifiedProcess, whose: str) -> dict[str, str]:
    """Return comments on the settings of one process or peak."""
    numbers = {"frequency": p.frequency, "damping": p.damping, "rms": p.ensemble_rms or p.rms, "third_corner": p.third_corner}
    notes = {f"{path}.{name}": f"+- {_std(n.std)}" for name, n in numbers.items() if n is not None and n.std}
    if p.pure:
        notes[f"{path}.damping"] = "a pure line"
    return notes | {f"{path}.frequency": f"{whose}+- {_std(p.frequency.std)}"}


BINS = 900
"""Of the measured spectrum over the whole axis, all equally wide on it."""

FEWEST = 100
"""Samples that a spectrum takes."""


@dataclass(frozen=True)
class Fit:
    """The model of one mode on a grid of frequencies [Hz] that has every resonance in it: densities [um^2/Hz].

    parts : noise, turbulence and background where there are any, and the resonances, each by itself
    lines : per pure line, frequency, density under it, and how high the periodogram stands at it
    """

    frequency: Array
    total: Array
    parts: tuple[Array, ...]
    lines: tuple[tuple[float, float, float], ...]


def bin_periodogram(z: Array, dt: float) -> tuple[Array, Array, Array]:
    """Estimate the spectrum of measurements, with the taper that the identification uses, in bins of a logarithmic axis.

    Parameters
    ----------
    z : Array
        Measurements without gaps, (n_steps, n_modes) [um].
    dt : float
        Time step [s].

    Returns
    -------
    frequency : Array
        Of the bins, (bins,) [Hz].
    mean, highest : Array
        Of the periodogram in each, (bins, n_modes) [um^2/Hz].

    Raises
    ------
    RecordError
        There are too few samples.
    """
    z = z[: fast_length(len(z))]
    if len(z) < FEWEST:
        raise RecordError(f"the record has {len(z)} samples, too few for a spectrum")
    f = periodogram_frequencies(len(z), dt)
    start = np.flatnonzero(np.diff(np.floor(np.log(f / f[0]) / np.log(f[-1] / f[0]) * BINS), prepend=-1.0))
    count = np.diff(start, append=len(f))
    density = np.column_stack([periodogram(column - column.mean(), dt) for column in z.T])
    return (
        np.add.reduceat(f, start) / count,
        np.add.reduceat(density, start) / count[:, None],
        np.maximum.reduceat(density, start),
    )


def fitted_spectrum(mode: IdentifiedMode, result: Identification) -> Fit:
    """Compute the spectrum of the model identified in a mode."""
    s, T = mode.spectrum, result.duration
    centres = [(p.frequency, p.damping) for p in s.processes]
    near = [c * (1.0 + max(damping, 1e-5) * np.linspace(-8.0, 8.0, 65)) for c, damping in centres]
    f = np.unique(np.concatenate([np.geomspace(1.0 / T, 0.5 / result.dt, 600), *near]))
    f = f[(f >= 1.0 / T) & (f <= 0.5 / result.dt)]
    parts = (np.full_like(f, 2.0 * s.dt * s.noise**2), *(p.psd(f) for p in s.processes))
    gain = T * float(np.mean(taper(result.n_steps))) ** 2
    lines = []
    for peak in (p for p in mode.peaks if p.pure):
        floor = float(s.psd(np.array([peak.frequency.value]))[0])
        lines.append((peak.frequency.value, floor, floor + gain * peak.rms.value**2))
    return Fit(f, s.psd(f), parts, tuple(lines))
