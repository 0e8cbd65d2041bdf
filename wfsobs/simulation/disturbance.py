"""`Disturbance`: turbulence and vibration of one run, made from a scenario.

A new source of vibration is one more function in `VIBRATION`, under the name the scenario's `source`
setting knows it by; turbulence has a module of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from wfsobs.progress import QUIET, Watch
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.events import PEAK
from wfsobs.scenario.groups.vibration import Peak
from wfsobs.scenario.measured_spectra import measured_spectrum
from wfsobs.scenario.timeline import strength, turns
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.spectrum import bin_edges, bin_frequencies, gaussian_signal, random_phase_signal, resonance_power, table_power
from wfsobs.simulation import events
from wfsobs.simulation.synthesis import damping_at_least, line_width, period_steps, widened
from wfsobs.simulation.turbulence import SOURCES, ModeSource, columns, mode_power
from wfsobs.typing import Array

RANDOM_PHASE = "random-phase"
"""The synthesis of the paper: the inverse DFT has the record's own length."""


@dataclass(frozen=True)
class Disturbance:
    """Turbulence and vibration [um], each of shape (n_steps, n_modes).

    ngs_turbulence, lgs_turbulence : what the NGS and each of the LGS see of the turbulence, None where all see it as it is
    """

    turbulence: Array
    vibration: Array
    ngs_turbulence: Array | None = None
    lgs_turbulence: tuple[Array, ...] | None = None

    @property
    def total(self) -> Array:
        """phi_dist = phi_turb + phi_vib [um] (paper, eq. 4b)."""
        return self.turbulence + self.vibration


def make_disturbance(scenario: Scenario, n_steps: int, rng: np.random.Generator, watch: Watch = QUIET) -> Disturbance:
    """Both disturbances over `n_steps`. Every source and mode has a random stream of its own, so
    changing one setting leaves the others' numbers as they were."""
    turbulence_rng, vibration_rng = rng.spawn(2)
    at = events.clock(scenario, n_steps)
    air = SOURCES[scenario.turbulence.source](scenario, events.steps_of_air(at, n_steps), turbulence_rng, watch)
    vibration = columns(VIBRATION[scenario.vibration.source], scenario, n_steps, vibration_rng, watch)
    return Disturbance(
        events.read(air.on_axis, at),
        vibration,
        None if air.ngs is None else events.read(air.ngs, at),
        None if air.lgs is None else tuple(events.read(x, at) for x in air.lgs),
    )


def peak_rms(peak_rms_list: list[float], mode: int) -> float:
    """The rms [um] of a peak in one mode: 0 beyond the end of its list."""
    return peak_rms_list[mode] if mode < len(peak_rms_list) else 0.0


def vibration_variance(scenario: Scenario, mode: int) -> float:
    """Variance [um^2] that the scenario's vibration has in one mode."""
    v = scenario.vibration
    if v.source == "none":
        return 0.0
    if v.source == "ar2":
        return float(sum(peak_rms(peak.rms, mode) ** 2 for peak in v.peaks))
    _, n, width = _synthesis(scenario, scenario.n_steps)
    return float(_bin_power(scenario, mode, n, width).sum() + sum(variance for _, variance in pure_lines(scenario, mode)))


def vibration_power(scenario: Scenario, mode: int, n: int) -> Array:
    """Variance [um^2] of the vibration in each DFT bin of `n` steps, an even number, (n // 2 + 1,), but for its pure lines."""
    return _bin_power(scenario, mode, n, line_width(scenario))


def pure_lines(scenario: Scenario, mode: int) -> list[tuple[float, float]]:
    """(frequency [Hz], variance [um^2]) of the lines of no width that the vibration of a mode has."""
    pure = [peak for peak in scenario.vibration.peaks if _is_pure_line(scenario, peak)]
    return [(peak.frequency, peak_rms(peak.rms, mode) ** 2) for peak in pure if peak_rms(peak.rms, mode) > 0]


def vibration_lines(scenario: Scenario, mode: int) -> list[tuple[float, float, float]]:
    """(frequency [Hz], damping, rms [um]) of every line that the vibration of a mode has; none where it is a table."""
    v = scenario.vibration
    if v.source == "measured":
        found = [(line.frequency, 0.0, peak_rms(list(line.rms), mode)) for line in measured_spectrum(v.spectrum).lines()]
    elif v.source in ("peaks", "ar2"):
        found = [(peak.frequency, peak.damping, peak_rms(peak.rms, mode)) for peak in v.peaks]
    else:
        found = []
    return [line for line in found if line[2] > 0 and (line[0] <= v.cutoff or v.source == "ar2")]


def _no_vibration(_scenario: Scenario, _mode: int, n: int, _rng: np.random.Generator) -> Array:
    return np.zeros(n)


def _ar2_vibration(scenario: Scenario, mode: int, n: int, rng: np.random.Generator) -> Array:
    """Each peak as an AR(2) process (paper, eq. 2)."""
    out = np.zeros(n)
    for i, (peak, stream) in enumerate(zip(scenario.vibration.peaks, rng.spawn(len(scenario.vibration.peaks)), strict=True)):
        damping = damping_at_least(line_width(scenario), peak.frequency, peak.damping)
        process = Ar2(2.0 * np.pi * peak.frequency, damping, peak_rms(peak.rms, mode), scenario.dt)
        x, changes = process.sample(n, stream), events.of_peak(scenario, i)
        out += events.moved_process(process, x, changes) if changes else x
    return out


def _synthesis(scenario: Scenario, n: int) -> tuple[Callable[[Array, int, np.random.Generator], Array], int, float]:
    """(how the bins of a DFT become a signal, the steps of that DFT for a record of `n`, the least width of a line [Hz])."""
    if scenario.vibration.synthesis == RANDOM_PHASE:
        return random_phase_signal, n, 0.0
    return gaussian_signal, period_steps(scenario, n), line_width(scenario)


def _dft_vibration(scenario: Scenario, mode: int, n: int, rng: np.random.Generator) -> Array:
    """Inverse DFT of the spectrum below the cut-off, plus the pure lines at their own frequencies, and the peaks that have
    events, each with random numbers of its own so that it can be moved."""
    bins, *peak_streams = rng.spawn(1 + len(scenario.vibration.peaks))
    moving = {event.peak for event in scenario.events if event.kind == PEAK}
    signal, period, width = _synthesis(scenario, n)
    out = signal(_bin_power(scenario, mode, period, width, without=moving), period, bins)[:n]
    t = np.arange(n) * scenario.dt
    for i, (peak, stream) in enumerate(zip(scenario.vibration.peaks, peak_streams, strict=True)):
        changes = events.of_peak(scenario, i)
        if _is_pure_line(scenario, peak):
            amplitude = np.sqrt(2.0) * peak_rms(peak.rms, mode) * strength(changes, t)
            out += amplitude * np.cos(2.0 * np.pi * (peak.frequency * t + turns(changes, t) + stream.random()))
        elif i in moving:
            power = _below_cutoff(scenario, _resonance(scenario, peak, mode, period, width), period)
            out += events.moved(signal(power, period, stream), changes, scenario.dt)[:n]
    return out


def _is_pure_line(scenario: Scenario, peak: Peak) -> bool:
    v = scenario.vibration
    return v.source == "peaks" and peak.damping == 0 and peak.frequency <= v.cutoff


def _bin_power(scenario: Scenario, mode: int, n: int, width: float, without: Collection[int] = ()) -> Array:
    """Variance [um^2] in each DFT bin: that of the damped peaks, but for those `without`, of the PSD table or of the
    measured spectrum, up to the cut-off; nothing narrower than `width` [Hz]."""
    v, dt = scenario.vibration, scenario.dt
    power = np.zeros(n // 2 + 1)
    if v.source == "peaks":
        for i, peak in enumerate(v.peaks):
            if peak.damping > 0 and i not in without:
                power = power + _resonance(scenario, peak, mode, n, width)
        return _below_cutoff(scenario, power, n)
    if v.source == "psd":
        power = mode_power(v.psd, scenario, mode, n)
    elif v.source == "measured":
        spectrum = measured_spectrum(v.spectrum)
        if mode < spectrum.density.shape[1]:
            power = table_power(spectrum.frequency, spectrum.part(v.part)[:, mode], n, dt)
    power = _below_cutoff(scenario, power, n)
    if width > 0:
        power = widened(power, width * dt)
        power[bin_frequencies(n, dt) > v.cutoff] = 0.0
    return power


def _resonance(scenario: Scenario, peak: Peak, mode: int, n: int, width: float) -> Array:
    """Variance [um^2] of one damped peak in each DFT bin, those above the cut-off left out."""
    edges = bin_edges(n, scenario.dt)
    used = min(int(np.searchsorted(edges, scenario.vibration.cutoff)) + 2, edges.size)
    damping = damping_at_least(width, peak.frequency, peak.damping)
    power = np.zeros(edges.size - 1)
    power[: used - 1] = peak_rms(peak.rms, mode) ** 2 * resonance_power(peak.frequency, damping, edges[:used])
    return power


def _below_cutoff(scenario: Scenario, power: Array, n: int) -> Array:
    f = bin_frequencies(n, scenario.dt)
    return np.where((f > 0) & (f <= scenario.vibration.cutoff) & (f < 0.5 / scenario.dt), power, 0.0)


VIBRATION: dict[str, ModeSource] = {
    "peaks": _dft_vibration,
    "psd": _dft_vibration,
    "measured": _dft_vibration,
    "ar2": _ar2_vibration,
    "none": _no_vibration,
}
