"""Result of an identification, every number with its standard deviation, and the scenario of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan, pi, sqrt
from typing import TYPE_CHECKING, Any, ClassVar

from wfsobs.identification.both_sensors import SensorDifference, error_of_a_star, without_error
from wfsobs.identification.one_mode import BROAD, OneMode, is_continuum
from wfsobs.identification.process import (
    IdentifiedPeak,
    IdentifiedProcess,
    Number,
    format_number,
    mean,
    merge_peaks,
    read_line,
    read_process,
    read_resonance,
    scale_number,
    with_reliable_std,
)
from wfsobs.identification.settings import MATCHED, base_scenario, model_settings
from wfsobs.identification.whiteness import Whiteness
from wfsobs.notebook import PlotAccessor, html_table, import_extra
from wfsobs.prior import Line, Lines
from wfsobs.scenario import Scenario
from wfsobs.signal.ar2 import Ar2, turbulence_corner
from wfsobs.simulation.layers import relative_cone_error, relative_rms
from wfsobs.spectral.model import Spectrum

if TYPE_CHECKING:
    import pandas

SLOWEST = 10.0
"""Minimum periods of turbulence in a record for a standard deviation of its corner: a slower one is not resolved."""
LARGEST = 100.0
"""Maximum strength of turbulence [um] in a scenario's settings."""


Row = tuple[str, Number | None, Number | None, Number | None]
"""Name, frequency [Hz], damping, rms [um]."""


@dataclass(frozen=True)
class IdentifiedMode:
    """The model of one mode.

    Attributes
    ----------
    name : str
        Name of the mode.
    noise : Number
        Rms of z's white noise [um].
    turbulence, background : IdentifiedProcess or None
        Coloured noise.
    peaks : tuple of IdentifiedProcess
        Peaks by frequency.
    broad : tuple of IdentifiedProcess
        Resonances of the continuum.
    spectrum : Spectrum
        Of all but the undamped lines.
    prior : Lines
        What an observer receives of the mode.
    whiteness : Whiteness
        Tests of the residual.
    difference : SensorDifference or None
        What the NGS tells beside z, of a record with enough NGS frames.
    outlying : int
        Samples of z far from what those around them predict, taken for missing.
    """

    name: str
    noise: Number
    turbulence: IdentifiedProcess | None
    background: IdentifiedProcess | None
    peaks: tuple[IdentifiedProcess, ...]
    broad: tuple[IdentifiedProcess, ...]
    spectrum: Spectrum
    prior: Lines
    whiteness: Whiteness
    difference: SensorDifference | None = None
    outlying: int = 0

    @property
    def lgs_error(self) -> Ar2 | None:
        """Slow error of the LGS as an observer receives it, if it is known."""
        return None if self.difference is None else self.difference.process

    @property
    def target(self) -> Lines:
        """`prior` without what the LGS alone see, as far as it is known."""
        return replace(self.prior, turbulence=without_error(self.prior.turbulence, self.lgs_error))


@dataclass(frozen=True)
class Identification:
    """The model of a record.

    Attributes
    ----------
    modes : tuple of IdentifiedMode
        One per column.
    dt : float
        Time step [s].
    n_steps : int
        Samples used.
    level : float
        Level of the search.
    """

    modes: tuple[IdentifiedMode, ...]
    dt: float
    n_steps: int
    level: float
    plot: ClassVar[PlotAccessor] = PlotAccessor()

    def __repr__(self) -> str:
        peaks = ", ".join(f"{mode.name} {len(mode.peaks)} peaks" for mode in self.modes)
        return f"Identification({peaks}, length {self.duration:g} s, rate {1.0 / self.dt:g} Hz)"

    def _repr_html_(self) -> str:
        cells = [
            (mode.name, what, *("" if n is None else format_number(n) for n in (f, damping, rms and scale_number(rms, 1e3))))
            for mode in self.modes
            for what, f, damping, rms in mode_rows(mode)
        ]
        return html_table(("Mode", "What", "frequency, Hz", "damping", "rms, nm"), cells)

    def to_dataframe(self) -> pandas.DataFrame:
        """Return a pandas table of noise, turbulence and peaks, a row each, with standard deviations; NaN where there is none.

        Raises ImportError without pandas.
        """
        columns = ("frequency_hz", "damping", "rms_um")
        rows = []
        for mode in self.modes:
            for what, *numbers in mode_rows(mode):
                row: dict[str, Any] = {"mode": mode.name, "what": what}
                for column, n in zip(columns, numbers, strict=True):
                    row[column], row[f"{column}_std"] = (nan, nan) if n is None else n
                rows.append(row)
        return import_extra("pandas", "arrays").DataFrame(rows)

    @property
    def duration(self) -> float:
        """Length of the part of the record that was used [s]."""
        return self.n_steps * self.dt

    @property
    def white(self) -> bool:
        """Whether the residual of every mode passes every test."""
        return all(mode.whiteness.white for mode in self.modes)

    @property
    def peaks(self) -> list[IdentifiedPeak]:
        """The peaks of all modes together; those that agree are one."""
        return merge_peaks([mode.peaks for mode in self.modes])

    @property
    def all_peaks(self) -> list[tuple[str, IdentifiedProcess]]:
        """(name of the mode, peak) of every mode and peak, in the order of `scenario`."""
        found = [(p.frequency.value, p.damping.value, p.rms.value, i, p) for i, mode in enumerate(self.modes) for p in mode.peaks]
        return [(self.modes[i].name, p) for *_, i, p in sorted(found, key=lambda each: each[:4])]

    def scenario(self, base: Scenario | None = None) -> Scenario:
        """Return a scenario whose z has the identified spectra, every mode with its own noise, turbulence and peaks.

        The models of the Kalman filters follow. A background counts as turbulence.

        Parameters
        ----------
        base : Scenario, optional
            All other settings, except its events, which name peaks by their number, and bands above half the rate. Wind, damping
            and strength of turbulence become the means over the modes.

        Returns
        -------
        Scenario
            The scenario.
        """
        out = base_scenario(len(self.modes), self.dt, base)
        changes: dict[str, Any] = {"sensors.lgs_low_frequency_rms": 0.0}
        changes |= {path: number.value for path, number in self.shared_settings(out).items()}
        return out.replace(changes | model_settings([mode.target for mode in self.modes], out) | MATCHED)

    def shared_settings(self, scenario: Scenario) -> dict[str, Number]:
        """Return dotted path -> number of the settings that all modes share, within the limits of the settings."""
        modes = [*zip(self.modes, scenario.modes, strict=False)]
        noises = [scale_number(m.noise, sqrt(scenario.sensors.lgs_count)) for m in self.modes]
        out = {"sensors.lgs_noise": _within(mean(noises), 0.0, 10.0)}
        seen = [(i, m.turbulence, mode.radial_order) for i, (m, mode) in enumerate(modes) if m.turbulence]
        if seen:
            corner = [2 * pi / turbulence_corner(1.0, scenario.telescope.diameter, order) for _, _, order in seen]
            winds = [scale_number(t.frequency, per) for (_, t, _), per in zip(seen, corner, strict=True)]
            out["turbulence.wind_speed"] = _within(mean(winds), 0.1, 100.0)
            out["turbulence.damping"] = _within(mean([t.damping for _, t, _ in seen]), 0.01, 1.0)
            strengths = [scale_number(t.rms, 1.0 / relative_rms(scenario, i)) for i, t, _ in seen]
            if thirds := [t.third_corner for _, t, _ in seen if t.third_corner]:
                out["turbulence.third_corner"] = _within(mean(thirds), 1.0, 1000.0)
            out["turbulence.rms"] = _within(mean(strengths), 0.0, LARGEST)
        differences = [m.difference for m in self.modes if m.difference is not None]
        if differences:
            slow = [error_of_a_star(d, scenario.sensors.lgs_count) for d in differences]
            slow = [scale_number(e, 1.0 / relative_cone_error(scenario, i)) for i, e in enumerate(slow)]
            out["sensors.lgs_low_frequency_rms"] = _within(mean(slow), 0.0, 10.0)
            out["sensors.ngs_noise"] = _within(mean([d.noise for d in differences]), 0.0, 10.0)
        return out


def mode_rows(mode: IdentifiedMode) -> list[Row]:
    """Return all processes of a mode, peaks by frequency."""
    out: list[Row] = [("white noise", None, None, mode.noise)]
    if (t := mode.turbulence) is not None:
        out.append(("turbulence", t.frequency, t.damping, t.rms))
        if (third := t.third_corner) is not None:
            out.append(("its third corner", Number(*(x * t.frequency.value for x in third)), None, None))
    else:
        out.append(("no turbulence", None, None, None))
    if (b := mode.background) is not None:
        out.append(("background, up to", b.frequency, None, b.rms))
    if (d := mode.difference) is not None:
        out.append(("white noise of an NGS frame", None, None, d.noise))
        if (e := d.error) is not None:
            out.append(("slow error of the LGS", e.frequency, e.damping, e.rms))
    widths = ["broad" if p.damping.value > BROAD else "slow" for p in mode.broad]
    out += [(f"{width}, of the continuum", p.frequency, p.damping, p.rms) for width, p in zip(widths, mode.broad, strict=True)]
    return out + [("line" if p.pure else "resonance", p.frequency, p.damping, p.rms) for p in mode.peaks]


def read_mode(name: str, mode: OneMode, lowest: float, whiteness: Whiteness) -> IdentifiedMode:
    """Return the numbers of a mode and their standard deviations, where they hold.

    A resonance of the continuum is not a peak; an observer receives it as turbulence. lowest : minimum frequency of peaks [Hz]
    """
    std = mode.errors()
    noise = scale_number(Number(1.0, float(std[0])), mode.spectrum.noise)
    found = [read_process(p, std[start:]) for start, p in zip(mode.spectrum.starts, mode.spectrum.processes, strict=False)]
    turbulence, background = (None if p is None else found.pop(0) for p in (mode.spectrum.turbulence, mode.spectrum.background))
    if turbulence is not None and turbulence.frequency.value < SLOWEST * mode.f[0]:
        turbulence = replace(turbulence, frequency=Number(turbulence.frequency.value, nan))
    smooth = [is_continuum(mode.spectrum, p, lowest) for p in mode.spectrum.resonances]
    broad = [p for p, is_smooth in zip(found, smooth, strict=True) if is_smooth]
    seen = [
        read_resonance(mode, p, one)
        for p, one, is_smooth in zip(mode.spectrum.resonances, found, smooth, strict=True)
        if not is_smooth
    ]
    seen += [read_line(mode, line) for line in mode.lines]
    peaks = sorted((p for p in seen if p.frequency.value >= lowest), key=lambda p: p.frequency.value)
    s = mode.spectrum
    shapes = (p for p, is_smooth in zip(s.resonances, smooth, strict=True) if is_smooth)
    prior = Lines(
        s.noise,
        s.dt,
        tuple(p for p in (s.turbulence, s.background, *shapes) if p is not None),
        tuple(Line(p.frequency.value, p.damping.value, (p.ensemble_rms or p.rms).value) for p in peaks),
    )
    return IdentifiedMode(name, with_reliable_std(noise), turbulence, background, tuple(peaks), tuple(broad), s, prior, whiteness)


def _within(n: Number, low: float, high: float) -> Number:
    return Number(min(max(n.value, low), high), n.std)
