"""Result of an identification, every number with its standard deviation, and the scenario of it.

Two sensors differ by the noise of the NGS, and by what the LGS alone see. With x the mean of phi over a frame, the NGS gives x
+ v, and the mean of z over the same steps x + e + w / sqrt(n). Their difference holds the slow error e of the LGS and both
noises, but no vibration. Its spectrum is fitted as that of a mode without peaks. e is taken for independent of phi.

The residual of each mode is tested for whiteness twice, each test of level WHITE_LEVEL.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import hypot, nan, pi, sqrt
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import chdtrc, kolmogorov

from wfsobs.identification.one_mode import BROAD, SETTLED, OneMode, is_continuum
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
from wfsobs.notebook import PlotAccessor, html_table, import_extra
from wfsobs.observers.kalman.filters import steady_filter
from wfsobs.prior import Line, Lines
from wfsobs.record import Record, RecordError, hold_last, pseudo_open_loop
from wfsobs.scenario import Scenario
from wfsobs.sensors.zernike import order_of
from wfsobs.signal.autoregressive import Ar2, Ar3, turbulence_corner
from wfsobs.signal.statespace import disturbance_model
from wfsobs.simulation.layers import relative_cone_error, relative_rms
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.whittle import fast_length, find_outlying, inflation
from wfsobs.typing import Array

if TYPE_CHECKING:
    import pandas


HIGHEST, LARGEST_RMS, LEAST_DAMPING = 50_000.0, 1e4, 1e-6
"""Limits of a scenario's settings: frequency of a peak [Hz], rms [um], minimum damping of a process."""
MATCHED: dict[str, Any] = {
    "sensors.noise_from": "nm",
    "sensors.lgs_combination": "mean",
    "sensors.tip_tilt_indetermination": False,
    "kalman.process_noise": "matched",
    "kalman.measurement_noise": "matched",
    "kalman.peak": "matched",
}
"""Settings by which filters take the models as they are told."""
WIDTHS = ("bandwidth_offline", "bandwidth_online")


def seen_z(record: Record) -> Array:
    """Return the pseudo-open-loop measurements whose commands are in the record. Raises RecordError where some are infinite."""
    if np.isinf(record.y_lgs).any() or np.isinf(record.u).any():
        raise RecordError("the record has infinite samples; NaN stands for a missing one")
    return record.z[record.delay :]


def base_scenario(n_modes: int, dt: float, base: Scenario | None) -> Scenario:
    """Return a scenario for telemetry of so many modes at steps of dt [s], without events, which name peaks by their number."""
    changes = {"telescope.radial_order": order_of(n_modes), "sensors.lgs_rate": 1.0 / dt}
    out = _with((base or Scenario()).before_events, changes)
    return _with(out, band_settings(out, 0.5 / dt))


def _with(scenario: Scenario, changes: Mapping[str, Any]) -> Scenario:
    """Return a scenario with settings changed; itself where it has these values, since a copy takes its time."""
    return scenario if all(scenario.lookup(path) == value for path, value in changes.items()) else scenario.replace(changes)


def model_settings(priors: Sequence[Lines], scenario: Scenario) -> dict[str, Any]:
    """Return dotted path -> value of the settings that give the filters these models, one per mode.

    For sensors as in the scenario. No two modes share a process or a peak: they stay as different as their numbers are.
    """
    modes = len(priors)
    smooth = [_process(p, _alone(p.rms, i, modes)) for i, prior in enumerate(priors) for p in prior.turbulence]
    lines = sorted((line, i) for i, prior in enumerate(priors) for line in prior.lines)
    peaks = [{"frequency": line.frequency, "damping": line.damping, "rms": _alone(line.rms, i, modes)} for line, i in lines]
    changes: dict[str, Any] = {
        "turbulence.source": "processes" if smooth else "none",
        "turbulence.processes": smooth,
        "vibration.source": "peaks" if peaks else "none",
        "vibration.peaks": peaks,
        "sensors.lgs_noise_per_mode": [min(p.noise * sqrt(scenario.sensors.lgs_count), LARGEST_RMS) for p in priors],
    }
    if lines:
        strongest, highest = max((line for line, _ in lines), key=lambda line: line.rms), lines[-1][0].frequency
        changes |= {
            "vibration.cutoff": min(max(scenario.vibration.cutoff, 1.2 * highest), HIGHEST),
            "kalman.frequency": strongest.frequency,
            "kalman.damping": strongest.damping,
        }
    return changes


def band_settings(scenario: Scenario, nyquist: float) -> dict[str, Any]:
    """Return dotted path -> value of the settings of bands, without those above half the rate [Hz].

    Where none remains there is one in the middle.
    """
    b = scenario.butterworth
    widest = 0.5 * max(b.bandwidth_offline, b.bandwidth_online)
    inside = [f for f in b.frequencies if widest < f < nyquist - widest]
    changes: dict[str, Any] = {} if inside == b.frequencies else {"butterworth.frequencies": inside or [0.5 * nyquist]}
    if not inside:
        changes |= {f"butterworth.{name}": min(getattr(b, name), 0.5 * nyquist) for name in WIDTHS}
    if scenario.kalman.frequency >= nyquist:
        changes["kalman.frequency"] = 0.5 * nyquist
    return changes


def _process(p: Ar2 | Ar3, rms: list[float]) -> dict[str, Any]:
    return {
        "frequency": p.frequency,
        "damping": max(p.damping, LEAST_DAMPING),
        "rms": rms,
        "third_corner": p.corner / p.omega if isinstance(p, Ar3) else 0.0,
    }


def _alone(rms: float, mode: int, modes: int) -> list[float]:
    """Return the strength per mode of a process of one mode."""
    return [min(rms, LARGEST_RMS) if i == mode else 0.0 for i in range(modes)]


WHITE_LEVEL = 0.01
LAGS = 100
"""Lags of the autocorrelation, beside one for every parameter of the model."""
MIN_NOISE = 1e-6
"""Minimum noise of the filter, over the rms of z."""


@dataclass(frozen=True)
class Whiteness:
    """Tests of the residual of one mode; p-values are probabilities that white noise would look less white.

    Attributes
    ----------
    periodogram : float
        p-value of the largest distance between the cumulative I / S and a straight line (Bartlett, with Kolmogorov's law).
    innovations : float
        p-value of the autocorrelation of the Kalman filter's innovations (Ljung and Box, Biometrika 65, 297, 1978).
    left : int
        Candidates that the search still finds and no peak explains.
    remarks : tuple of str
        Differences, one clause each, where it is not white.
    """

    periodogram: float
    innovations: float
    left: int
    remarks: tuple[str, ...] = ()

    @property
    def white(self) -> bool:
        """Whether both tests pass at WHITE_LEVEL and no candidate is left."""
        return min(self.periodogram, self.innovations) >= WHITE_LEVEL and not self.left


def cumulated_test(ratio: Array, n: int) -> float:
    """Return the p-value of I / S, (bins,), of a record of n samples."""
    count = len(ratio)
    distance = np.cumsum(ratio) / ratio.sum() - np.arange(1, count + 1) / count
    return float(kolmogorov(np.max(np.abs(distance)) * np.sqrt(count / inflation(n))))


def innovations(z: Array, spectrum: Spectrum) -> Array:
    """Return the innovations of the steady-state Kalman filter of the spectrum on z (n,), without the start.

    One second or a tenth of the record is left out; the rest is white where the spectrum is that of z.
    """
    settle = min(len(z) // 10, round(1.0 / spectrum.dt))
    if not spectrum.processes:
        return z[settle:]
    model = disturbance_model(list(spectrum.processes[:1]), list(spectrum.processes[1:]))
    kalman, _ = steady_filter(model, max(spectrum.noise, MIN_NOISE * float(np.std(z))), (model.C @ model.A)[None])
    predicted = kalman.run(z[:, None])[:, 0]  # C A x_hat[k], what z[k+1] should be
    return (z[1:] - predicted[:-1])[settle:]


def autocorrelation_test(e: Array, numbers: int) -> float:
    """Return the p-value of Ljung and Box's statistic of e (n,); numbers : parameters of the model that made it."""
    n, lags = len(e), LAGS + numbers
    e = e - e.mean()
    power = np.abs(rfft(e, next_fast_len(2 * n, real=True))) ** 2
    r = irfft(power)[: lags + 1]
    rho = r[1:] / r[0]
    statistic = n * (n + 2) * np.sum(rho**2 / (n - np.arange(1, lags + 1)))
    return float(chdtrc(LAGS, statistic))


FEWEST, SHARE = 200, 0.5
"""Minimum NGS frames, and minimum share of them that is measured."""
NO_NOISE = 1e-4
"""Of the rms of z: a difference that is never larger is of numbers that were rounded."""
LEAST = 0.1
"""Minimum share of the NGS in the noise of the difference."""
LEFT = 0.01
"""Minimum share of the variance of z's turbulence that is not the error of the LGS."""


@dataclass(frozen=True)
class SensorDifference:
    """What the sensors of one mode differ by.

    Attributes
    ----------
    noise : Number
        Rms of the noise of an NGS frame [um].
    error : IdentifiedProcess or None
        Slow error of the combined LGS.
    process : Ar2 or None
        The same, as an observer receives it.
    outlying : int
        Frames far from what those around them predict, taken for missing.
    """

    noise: Number
    error: IdentifiedProcess | None = None
    process: Ar2 | None = None
    outlying: int = 0


def sensor_differences(record: Record) -> Array | None:
    """Return the mean of z over each NGS frame minus the frame, (frames, n_modes) [um]; None without enough frames.

    NaN where a sample is missing.
    """
    if record.y_ngs is None or record.ratio is None:
        return None
    ratio, u = record.ratio, hold_last(record.u)
    z = pseudo_open_loop(record.y_lgs, u, record.delay)
    first = ratio * -(-(record.delay + ratio) // ratio)  # what the mirror did before the record is not known
    frames = replace(record, u=u).z_ngs[first::ratio]
    whole = fast_length(len(frames))
    if whole < FEWEST:
        return None
    start = first - ratio + 1
    out = z[start : start + whole * ratio].reshape(whole, ratio, -1).mean(axis=1) - frames[:whole]
    return out if (np.isfinite(out).mean(axis=0) >= SHARE).all() else None


def read_difference(difference: Array, dt: float, ratio: int, lgs_noise: Number) -> SensorDifference:
    """Identify one mode.

    Parameters
    ----------
    difference : Array
        Of the sensors, (frames,) [um]; NaN is a missing one.
    dt, ratio : float, int
        Time step of z [s], and steps of a frame.
    lgs_noise : Number
        Rms of the noise of z [um].

    Returns
    -------
    SensorDifference
        The numbers.
    """
    outlying = find_outlying(difference)
    mode = OneMode(np.where(outlying, np.nan, difference), dt * ratio)
    for _ in range(mode.missing.rounds(SETTLED)):
        mode.refit()
    std, spectrum = mode.errors(), mode.spectrum
    whole, of_lgs = spectrum.noise**2, lgs_noise.value**2 / ratio
    rms = sqrt(max(whole - of_lgs, LEAST * whole))
    noise = with_reliable_std(Number(rms, hypot(whole * float(std[0]), lgs_noise.value * lgs_noise.std / ratio) / rms))
    if not isinstance(slow := spectrum.turbulence, Ar2):
        return SensorDifference(noise, outlying=int(outlying.sum()))
    return SensorDifference(noise, read_process(slow, std[spectrum.starts[0] :]), slow.at(dt), int(outlying.sum()))


def without_error(turbulence: tuple[Ar2 | Ar3, ...], error: Ar2 | None) -> tuple[Ar2 | Ar3, ...]:
    """Return the processes of z's turbulence, the first without the variance of the LGS error."""
    if error is None or not turbulence:
        return turbulence
    first, *others = turbulence
    return replace(first, rms=sqrt(max(first.rms**2 - error.rms**2, LEFT * first.rms**2))), *others


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
        stars = sqrt(scenario.sensors.lgs_count)
        noises = [scale_number(m.noise, stars) for m in self.modes]
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
            slow = [scale_number(d.error.rms, stars) if d.error else Number(0.0, nan) for d in differences]  # of one star
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


def read_mode(name: str, mode: OneMode, whiteness: Whiteness) -> IdentifiedMode:
    """Return the numbers of a mode and their standard deviations, where they hold.

    A resonance of the continuum is not a peak; an observer receives it as turbulence.
    """
    std, s = mode.errors(), mode.spectrum
    noise = with_reliable_std(Number(s.noise, float(std[0]) * s.noise))
    found = [read_process(p, std[start:]) for start, p in zip(s.starts, s.processes, strict=False)]
    turbulence, background = (None if p is None else found.pop(0) for p in (s.turbulence, s.background))
    if turbulence is not None and turbulence.frequency.value < SLOWEST * mode.f[0]:
        turbulence = replace(turbulence, frequency=Number(turbulence.frequency.value, nan))
    shapes, broad, seen = [*s.continuum], [], [read_line(mode, line) for line in mode.lines]
    for p, one in zip(s.resonances, found, strict=True):
        if is_continuum(s, p, mode.lowest):
            shapes.append(p)
            broad.append(one)
        else:
            seen.append(read_resonance(mode, p, one))
    peaks = sorted((p for p in seen if p.frequency.value >= mode.lowest), key=lambda p: p.frequency.value)
    lines = tuple(Line(p.frequency.value, p.damping.value, (p.ensemble_rms or p.rms).value) for p in peaks)
    prior = Lines(s.noise, s.dt, tuple(shapes), lines)
    return IdentifiedMode(name, noise, turbulence, background, tuple(peaks), tuple(broad), s, prior, whiteness)


def _within(n: Number, low: float, high: float) -> Number:
    return Number(min(max(n.value, low), high), n.std)
