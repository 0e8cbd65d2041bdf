"""Turbulence and vibration of one run, simulated from a scenario: on the axis, and turbulence in the beams of the stars.

A new source of turbulence is one more function in `SOURCES`, under the name of the scenario's `turbulence.source` setting; one of
vibration is one more in `VIBRATION`, under the name of `vibration.source`.

A record made by an inverse DFT of its own length is a sum of lines at multiples of 1 / T: it is periodic, so T seconds of it
determine the rest. A record is therefore cut from a period many times as long. The width of lines determines how well
they can be predicted; a record of T resolves none narrower than about 1 / T. Damped peaks and tables therefore get
at least the width `line_width`, in the record as in the bound. Lines are sines of their own.

Events of a scenario change the disturbance and the measurements. A peak is shifted through its analytic signal x_a, which has its
positive frequencies alone,

    x'(t) = strength(t) Re(x_a(t) exp(2 pi i integral shift dt)),

so that its spectrum is shifted without change, and the signal before the event is unchanged. A change of the wind is a change of
the clock of the turbulence (Taylor's frozen flow): phi'(t) = phi(s(t)), s = integral factor dt, for all stars.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, hypot, pi

import numpy as np
import scipy
from scipy.fft import next_fast_len

from wfsobs.atmosphere import View, frozen_flow
from wfsobs.progress import QUIET, Watch
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.atmosphere import Peak, PsdTable
from wfsobs.scenario.groups.events import FRAMES, LASER, PEAK, WIND, Event, during, phase_turns, strength, turbulence_time
from wfsobs.scenario.measured_spectra import measured_spectrum
from wfsobs.signal.autoregressive import Ar2, Ar3, turbulence_corner
from wfsobs.signal.spectrum import bin_edges, bin_frequencies, gaussian_signal, random_phase_signal, resonance_power, table_power
from wfsobs.signal.statespace import sample_ar3
from wfsobs.simulation import layers as atmosphere
from wfsobs.simulation.sensor_noise import sensor
from wfsobs.typing import Array

LONGEST = 30.0
"""Longest record whose resolution counts [s]."""

SHARPER = 16
"""Resolution of a record over the minimum line width."""

BINS = 2
"""Bins of the period in the width of a line."""


def line_width(scenario: Scenario) -> float:
    """Return the minimum line width (FWHM) [Hz]: a sixteenth of the resolution of the record."""
    return 1.0 / (SHARPER * min(max(scenario.run.duration, 1.0), LONGEST))


def period_steps(scenario: Scenario, n: int) -> int:
    """Return the steps of the period that a record of `n` steps is cut from, even: at least twice the record."""
    return 2 * next_fast_len(max(ceil(0.5 * BINS / (line_width(scenario) * scenario.dt)), n), real=True)


def damping_for_width(width: float, frequency: float, damping: float) -> float:
    """Return the damping of a resonance, raised where it is narrower than `width` (FWHM); both in [Hz]."""
    return min(max(damping, width / (2.0 * frequency)), 1.0)


def widen_lines(spectrum: Array, width: float) -> Array:
    """Return a spectrum (n // 2 + 1,) of even n with all lines `width` wider [cycles per sample].

    Correlations decay by exp(-pi width |lag|).
    """
    n = 2 * (spectrum.size - 1)
    lag = np.minimum(np.arange(n), n - np.arange(n))
    return np.maximum(np.fft.rfft(np.fft.irfft(spectrum, n) * np.exp(-pi * width * lag)).real, 0.0)


TurbulenceSignals = tuple[Array, Array | None, tuple[Array, ...] | None]
"""Turbulence on the axis, in the beam of the NGS and in that of each LGS, (n_steps, n_modes) [um]; None where it is the first."""

Source = Callable[[Scenario, int, np.random.Generator, Watch], TurbulenceSignals]
"""(scenario, number of steps, generator, watch) -> turbulence."""
ModeSource = Callable[[Scenario, int, int, np.random.Generator], Array]
"""(scenario, mode index, number of steps, generator) -> one signal [um], shape (n_steps,)."""


def turbulence_process(scenario: Scenario, mode: int, dt: float) -> Ar2:
    """Return the AR(2) turbulence of one mode (paper, eq. 1), sampled every `dt` [s], rms in [um].

    Where the source is another, the AR(2) process of its variance and effective wind, or of its strongest process.
    """
    rms = turbulence_rms(scenario, mode)
    if found := processes(scenario, mode, dt) if scenario.turbulence.source == "processes" else []:
        strongest = max(found, key=lambda p: p.rms)
        return Ar2(strongest.omega, strongest.damping, rms, dt)
    corner = turbulence_corner(
        atmosphere.effective_wind(scenario), scenario.telescope.diameter, scenario.modes[mode].radial_order
    )
    return Ar2(corner, scenario.turbulence.damping, rms, dt)


def processes(scenario: Scenario, mode: int, dt: float) -> list[Ar2 | Ar3]:
    """Return the coloured noises whose sum is the turbulence of one mode, for the sources that are such sums; else none."""
    t, out = scenario.turbulence, list[Ar2 | Ar3]()
    if t.source in ("ar2", "ar3"):
        found = turbulence_process(scenario, mode, dt)
        third = t.third_corner * found.omega
        return [found if t.source == "ar2" else Ar3(found.omega, found.damping, third, found.rms, dt)]
    for p in t.processes if t.source == "processes" else ():
        omega, rms = 2.0 * pi * p.frequency, peak_rms(p.rms, mode)
        if rms > 0:
            third = p.third_corner * omega
            out.append(Ar3(omega, p.damping, third, rms, dt) if third else Ar2(omega, p.damping, rms, dt))
    return out


def turbulence_rms(scenario: Scenario, mode: int) -> float:
    """Return the standard deviation [um] of the scenario's turbulence in one mode."""
    t = scenario.turbulence
    if t.source == "none":
        return 0.0
    if t.source == "processes":
        return hypot(*(p.rms for p in processes(scenario, mode, scenario.dt)))
    if t.source == "psd":
        return float(np.sqrt(table_variance(scenario, mode, period_steps(scenario, scenario.n_steps)).sum()))
    if t.source == "frozen-flow":
        return float(np.sqrt(atmosphere.frozen_flow_variance(scenario, mode)))
    return t.rms * atmosphere.relative_rms(scenario, mode)


def mode_power(table: PsdTable, scenario: Scenario, mode: int, n: int) -> Array:
    """Return the variance [um^2] of a table in each DFT bin of `n` steps, for one mode; zero for modes without a column."""
    density = getattr(table, scenario.modes[mode].name, None)
    return np.zeros(n // 2 + 1) if density is None else table_power(table.frequency, density, n, scenario.dt)


def table_variance(scenario: Scenario, mode: int, n: int) -> Array:
    """Return the variance [um^2] of the turbulence of source psd in each DFT bin of `n` steps, even."""
    power = mode_power(scenario.turbulence.psd, scenario, mode, n)
    power[0] = 0.0
    return widen_lines(power, line_width(scenario) * scenario.dt)


def columns(source: ModeSource, scenario: Scenario, n_steps: int, rng: np.random.Generator, watch: Watch) -> Array:
    """Draw one signal per mode, each with a random stream of its own, (n_steps, n_modes)."""
    out = []
    for mode, stream in enumerate(rng.spawn(len(scenario.modes))):
        watch.check()
        out.append(source(scenario, mode, n_steps, stream))
    return np.column_stack(out)


def _mode_by_mode(source: ModeSource) -> Source:
    """Return a source that is the same for all stars."""
    return lambda scenario, n, rng, watch: (columns(source, scenario, n, rng, watch), None, None)


def _sum_of_processes(scenario: Scenario, mode: int, n: int, rng: np.random.Generator) -> Array:
    """Draw the processes; those of a list have a random stream each."""
    found = processes(scenario, mode, scenario.dt)
    streams = rng.spawn(len(found)) if scenario.turbulence.source == "processes" else [rng]
    parts = [sample_ar3(p, n, own) if isinstance(p, Ar3) else p.sample(n, own) for p, own in zip(found, streams, strict=False)]
    return np.sum(parts, axis=0) if parts else np.zeros(n)


def _psd(scenario: Scenario, mode: int, n: int, rng: np.random.Generator) -> Array:
    """Draw a Gaussian process with the spectrum of the table, up to half the rate."""
    period = period_steps(scenario, n)
    return gaussian_signal(table_variance(scenario, mode, period), period, rng)[:n]


def _frozen_flow(scenario: Scenario, n: int, rng: np.random.Generator, watch: Watch) -> TurbulenceSignals:
    """Simulate von Karman layers: their modes on the axis, and the signals of the sensors on the NGS and on every LGS."""
    layers = atmosphere.layers(scenario)
    ideal, on_ngs, on_lgs = atmosphere.ideal_sensor(scenario), sensor(scenario, "ngs"), sensor(scenario, "lgs")
    looking = [(ideal, atmosphere.on_axis()), (on_ngs, atmosphere.natural_star(scenario))]
    looking += [(on_lgs, star) for star in atmosphere.laser_stars(scenario)]
    views = [View(what, tuple(atmosphere.footprint(star, layer) for layer in layers)) for what, star in looking]
    on_axis, ngs, *lgs = frozen_flow(
        layers, scenario.turbulence.outer_scale, scenario.telescope.diameter, views, n, scenario.dt, rng, watch
    )
    return on_axis, ngs, tuple(lgs)


SOURCES: dict[str, Source] = {
    **dict.fromkeys(("ar2", "ar3", "processes", "none"), _mode_by_mode(_sum_of_processes)),
    "frozen-flow": _frozen_flow,
    "psd": _mode_by_mode(_psd),
}


GUARD = 64
"""Periods by which an AR(2) peak is extended on both sides for its analytic signal; at most the length of the record."""


def peak_events(scenario: Scenario, number: int) -> list[Event]:
    """Return the events of one vibration peak."""
    return [event for event in scenario.events if event.kind == PEAK and event.peak == number]


def shift_peak(signal: Array, events: Sequence[Event], dt: float, before: int = 0) -> Array:
    """Apply events to the signal of a vibration peak.

    Parameters
    ----------
    signal : Array
        Signal without events, (n,), periodic, as an inverse DFT is.
    events : sequence of Event
        Events of the peak.
    dt : float
        Time step [s].
    before : int
        Steps of the signal before the start of the record.

    Returns
    -------
    Array
        Signal with events, (n,).
    """
    t = (np.arange(signal.size) - before) * dt
    return strength(events, t) * (scipy.signal.hilbert(signal) * np.exp(2j * np.pi * phase_turns(events, t))).real


def shift_process(process: Ar2, x: Array, events: Sequence[Event]) -> Array:
    """Apply events to a sample x (n,) of an AR(2) process, which is not periodic.

    On both sides it is extended by the expectation of the process, which decays.
    """
    guard = min(round(GUARD * 2.0 * np.pi / (process.omega * process.dt)), x.size)
    fade = 0.5 + 0.5 * np.cos(np.pi * np.arange(1, guard + 1) / (guard + 1))
    ahead, behind = (fade * process.extrapolate(ends, guard) for ends in (np.resize(x[-2:], 2), np.resize(x[1::-1], 2)))
    return shift_peak(np.concatenate([behind[::-1], x, ahead]), events, process.dt, guard)[guard:-guard]


def turbulence_clock(scenario: Scenario, n_steps: int) -> Array | None:
    """Return the time [steps] of the turbulence at each step, (n_steps,); None where the wind is constant."""
    events = [event for event in scenario.events if event.kind == WIND]
    return turbulence_time(events, np.arange(n_steps) * scenario.dt) / scenario.dt if events else None


def turbulence_steps(at: Array | None, n_steps: int) -> int:
    """Return the number of steps of turbulence that a record needs, by its clock.

    At least those of the record, so that a falling wind does not change the turbulence before it.
    """
    return n_steps if at is None else max(n_steps, int(np.ceil(at[-1])) + 1, 2)


def interpolate_steps(x: Array, at: Array | None) -> Array:
    """Interpolate x (n, ...) at the times `at` [steps] by a cubic spline; return x itself where `at` is None."""
    return x if at is None else scipy.interpolate.CubicSpline(np.arange(len(x)), x)(at)


def laser_count(scenario: Scenario, n_steps: int) -> Array:
    """Return the number of LGS at each step, (n_steps,), integers."""
    out, t = np.full(n_steps, scenario.sensors.lgs_count), np.arange(n_steps) * scenario.dt
    for event in scenario.events:
        if event.kind == LASER:
            out[during(event, t)] -= event.lasers
    return np.maximum(out, 0)


def missing_frames(scenario: Scenario, n_steps: int, rng: np.random.Generator) -> dict[str, Array]:
    """Return for each sensor which of its measurements are missing, bool (n_steps,).

    Every event has a random stream of its own.
    """
    t = np.arange(n_steps) * scenario.dt
    out = {"lgs": np.zeros(n_steps, dtype=bool), "ngs": np.zeros(n_steps, dtype=bool)}
    for event, stream in zip(scenario.events, rng.spawn(len(scenario.events)), strict=True):
        if event.kind == FRAMES:
            out[event.sensor] |= during(event, t) & (stream.random(n_steps) < event.share)
    return out


RANDOM_PHASE = "random-phase"
"""The synthesis of the paper: the inverse DFT has the record's own length."""


@dataclass(frozen=True)
class Disturbance:
    """Turbulence and vibration of one run.

    Attributes
    ----------
    turbulence, vibration : Array
        The truth, (n_steps, n_modes) [um].
    ngs_turbulence : Array or None
        Turbulence in the beam of the NGS; None where it is the truth.
    lgs_turbulence : tuple of Array or None
        Turbulence in the beam of each LGS; None where it is the truth.
    """

    turbulence: Array
    vibration: Array
    ngs_turbulence: Array | None = None
    lgs_turbulence: tuple[Array, ...] | None = None

    @property
    def total(self) -> Array:
        """Disturbance phi_dist = phi_turb + phi_vib [um] (paper, eq. 4b)."""
        return self.turbulence + self.vibration


def make_disturbance(scenario: Scenario, n_steps: int, rng: np.random.Generator, watch: Watch = QUIET) -> Disturbance:
    """Simulate both disturbances of a scenario.

    Every source and mode has a random stream of its own, so changing one setting leaves the random numbers of the others.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    n_steps : int
        Number of steps.
    rng : numpy.random.Generator
        Source of all random numbers.
    watch : Watch
        Asked at every block of work whether to stop.

    Returns
    -------
    Disturbance
        Turbulence and vibration.

    Raises
    ------
    Cancelled
        `watch` asks to stop.
    """
    turbulence_rng, vibration_rng = rng.spawn(2)
    at = turbulence_clock(scenario, n_steps)
    on_axis, ngs, lgs = SOURCES[scenario.turbulence.source](scenario, turbulence_steps(at, n_steps), turbulence_rng, watch)
    vibration = columns(VIBRATION[scenario.vibration.source], scenario, n_steps, vibration_rng, watch)
    return Disturbance(
        interpolate_steps(on_axis, at),
        vibration,
        None if ngs is None else interpolate_steps(ngs, at),
        None if lgs is None else tuple(interpolate_steps(x, at) for x in lgs),
    )


def peak_rms(peak_rms_list: list[float], mode: int) -> float:
    """Return the rms [um] of a peak in one mode: 0 beyond the end of its list."""
    return peak_rms_list[mode] if mode < len(peak_rms_list) else 0.0


def vibration_variance(scenario: Scenario, mode: int) -> float:
    """Return the variance [um^2] of the scenario's vibration in one mode."""
    v = scenario.vibration
    if v.source == "none":
        return 0.0
    if v.source == "ar2":
        return float(sum(peak_rms(peak.rms, mode) ** 2 for peak in v.peaks))
    _, n, width = _synthesis(scenario, scenario.n_steps)
    return float(_bin_power(scenario, mode, n, width).sum() + sum(variance for _, variance in pure_lines(scenario, mode)))


def vibration_power(scenario: Scenario, mode: int, n: int) -> Array:
    """Return the variance [um^2] of the vibration, without its lines, in each DFT bin of `n` steps, even, (n // 2 + 1,)."""
    return _bin_power(scenario, mode, n, line_width(scenario))


def pure_lines(scenario: Scenario, mode: int) -> list[tuple[float, float]]:
    """Return (frequency [Hz], variance [um^2]) of the undamped lines of a mode's vibration."""
    pure = [peak for peak in scenario.vibration.peaks if _is_pure_line(scenario, peak)]
    return [(peak.frequency, peak_rms(peak.rms, mode) ** 2) for peak in pure if peak_rms(peak.rms, mode) > 0]


def vibration_lines(scenario: Scenario, mode: int) -> list[tuple[float, float, float]]:
    """Return (frequency [Hz], damping, rms [um]) of every peak of a mode's vibration; none where it is a table."""
    v = scenario.vibration
    if v.source == "measured":
        found = [(line.frequency, 0.0, peak_rms(list(line.rms), mode)) for line in measured_spectrum(v.spectrum).lines()]
    elif v.source in ("peaks", "ar2"):
        found = [(peak.frequency, peak.damping, peak_rms(peak.rms, mode)) for peak in v.peaks]
    else:
        found = []
    return [line for line in found if line[2] > 0 and (line[0] <= v.cutoff or v.source == "ar2")]


def _ar2_vibration(scenario: Scenario, mode: int, n: int, rng: np.random.Generator) -> Array:
    """Draw each peak as an AR(2) process (paper, eq. 2)."""
    out = np.zeros(n)
    for i, (peak, stream) in enumerate(zip(scenario.vibration.peaks, rng.spawn(len(scenario.vibration.peaks)), strict=True)):
        damping = damping_for_width(line_width(scenario), peak.frequency, peak.damping)
        process = Ar2(2.0 * np.pi * peak.frequency, damping, peak_rms(peak.rms, mode), scenario.dt)
        x, changes = process.sample(n, stream), peak_events(scenario, i)
        out += shift_process(process, x, changes) if changes else x
    return out


def _synthesis(scenario: Scenario, n: int) -> tuple[Callable[[Array, int, np.random.Generator], Array], int, float]:
    """Return (function from DFT bins to a signal, DFT length for a record of `n` steps, minimum line width [Hz])."""
    if scenario.vibration.synthesis == RANDOM_PHASE:
        return random_phase_signal, n, 0.0
    return gaussian_signal, period_steps(scenario, n), line_width(scenario)


def _dft_vibration(scenario: Scenario, mode: int, n: int, rng: np.random.Generator) -> Array:
    """Draw the vibration by an inverse DFT of the spectrum below the cut-off.

    Lines are added at their own frequencies. Peaks with events have random numbers of their own, so that they can be shifted.
    """
    bins, *peak_streams = rng.spawn(1 + len(scenario.vibration.peaks))
    moving = {event.peak for event in scenario.events if event.kind == PEAK}
    signal, period, width = _synthesis(scenario, n)
    out = signal(_bin_power(scenario, mode, period, width, without=moving), period, bins)[:n]
    t = np.arange(n) * scenario.dt
    for i, (peak, stream) in enumerate(zip(scenario.vibration.peaks, peak_streams, strict=True)):
        changes = peak_events(scenario, i)
        if _is_pure_line(scenario, peak):
            amplitude = np.sqrt(2.0) * peak_rms(peak.rms, mode) * strength(changes, t)
            out += amplitude * np.cos(2.0 * np.pi * (peak.frequency * t + phase_turns(changes, t) + stream.random()))
        elif i in moving:
            power = _below_cutoff(scenario.vibration.cutoff, _resonance(scenario, peak, mode, period, width), period, scenario.dt)
            out += shift_peak(signal(power, period, stream), changes, scenario.dt)[:n]
    return out


def _is_pure_line(scenario: Scenario, peak: Peak) -> bool:
    v = scenario.vibration
    return v.source == "peaks" and peak.damping == 0 and peak.frequency <= v.cutoff


def _bin_power(scenario: Scenario, mode: int, n: int, width: float, without: Collection[int] = ()) -> Array:
    """Return the variance [um^2] in each DFT bin up to the cut-off, nothing narrower than `width` [Hz].

    That of the damped peaks except those `without`, of the PSD table or of the measured spectrum.
    """
    v, dt = scenario.vibration, scenario.dt
    power = np.zeros(n // 2 + 1)
    if v.source == "peaks":
        for i, peak in enumerate(v.peaks):
            if peak.damping > 0 and i not in without:
                power = power + _resonance(scenario, peak, mode, n, width)
        return _below_cutoff(v.cutoff, power, n, dt)
    if v.source == "measured":
        return _measured_power(v.spectrum, v.part, mode, v.cutoff, n, dt, width)
    if v.source == "psd":
        power = _widen(_below_cutoff(v.cutoff, mode_power(v.psd, scenario, mode, n), n, dt), v.cutoff, n, dt, width)
    return power


@lru_cache(maxsize=32)
def _measured_power(name: str, part: str, mode: int, cutoff: float, n: int, dt: float, width: float) -> Array:
    """Return the variance [um^2] of a measured spectrum in each DFT bin; read-only."""
    spectrum, power = measured_spectrum(name), np.zeros(n // 2 + 1)
    if mode < spectrum.density.shape[1]:
        power = table_power(spectrum.frequency, spectrum.part(part)[:, mode], n, dt)
    power = _widen(_below_cutoff(cutoff, power, n, dt), cutoff, n, dt, width)
    power.flags.writeable = False
    return power


def _widen(power: Array, cutoff: float, n: int, dt: float, width: float) -> Array:
    """Return the power with nothing narrower than `width` [Hz], none of it above the cut-off."""
    if width > 0 and power.any():
        power = widen_lines(power, width * dt)
        power[bin_frequencies(n, dt) > cutoff] = 0.0
    return power


def _resonance(scenario: Scenario, peak: Peak, mode: int, n: int, width: float) -> Array:
    """Return the variance [um^2] of one damped peak in each DFT bin up to the cut-off."""
    damping = damping_for_width(width, peak.frequency, peak.damping)
    power = np.zeros(n // 2 + 1)
    if (strength := peak_rms(peak.rms, mode)) > 0:
        share = _resonance_share(peak.frequency, damping, scenario.vibration.cutoff, n, scenario.dt)
        power[: share.size] = strength**2 * share
    return power


@lru_cache(maxsize=64)
def _resonance_share(frequency: float, damping: float, cutoff: float, n: int, dt: float) -> Array:
    """Return the share of a resonance's variance in each DFT bin up to the cut-off; read-only."""
    edges = bin_edges(n, dt)
    share = resonance_power(frequency, damping, edges[: int(np.searchsorted(edges, cutoff)) + 2])
    share.flags.writeable = False
    return share


def _below_cutoff(cutoff: float, power: Array, n: int, dt: float) -> Array:
    f = bin_frequencies(n, dt)
    return np.where((f > 0) & (f <= cutoff) & (f < 0.5 / dt), power, 0.0)


VIBRATION: dict[str, ModeSource] = {
    "peaks": _dft_vibration,
    "psd": _dft_vibration,
    "measured": _dft_vibration,
    "ar2": _ar2_vibration,
    "none": lambda _scenario, _mode, n, _rng: np.zeros(n),
}
