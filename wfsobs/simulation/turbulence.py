"""Turbulence of one run, simulated from a scenario, on the axis and in the beams of the stars.

A new source is one more function in `SOURCES`, under the name of the scenario's `turbulence.source` setting.

A record made by an inverse DFT of its own length is a sum of lines at multiples of 1 / T: it is periodic, so T seconds of it
determine the rest. A record is therefore cut from a period many times as long. The width of lines determines how well
they can be predicted; a record of T resolves none narrower than about 1 / T. Damped peaks and tables therefore get
at least the width `line_width`, in the record as in the bound. Lines are sines of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, hypot, pi

import numpy as np
from scipy.fft import next_fast_len

from wfsobs.atmosphere import View, frozen_flow
from wfsobs.progress import Watch
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.atmosphere import PsdTable
from wfsobs.signal.autoregressive import Ar2, Ar3, turbulence_corner
from wfsobs.signal.spectrum import gaussian_signal, table_power
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


@dataclass(frozen=True)
class TurbulenceSignals:
    """Turbulence of one run, each array (n_steps, n_modes) [um].

    Attributes
    ----------
    on_axis : Array
        The truth.
    ngs : Array or None
        In the beam of the NGS; None where it is the truth.
    lgs : tuple of Array or None
        In the beam of each LGS; None where it is the truth.
    """

    on_axis: Array
    ngs: Array | None = None
    lgs: tuple[Array, ...] | None = None


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
        return [(turbulence_process if t.source == "ar2" else third_order_process)(scenario, mode, dt)]
    for p in t.processes if t.source == "processes" else ():
        omega, rms = 2.0 * pi * p.frequency, p.rms[mode] if mode < len(p.rms) else 0.0
        if rms > 0:
            third = p.third_corner * omega
            out.append(Ar3(omega, p.damping, third, rms, dt) if third else Ar2(omega, p.damping, rms, dt))
    return out


def third_order_process(scenario: Scenario, mode: int, dt: float) -> Ar3:
    """Return the turbulence of one mode with its third corner, for source ar3."""
    p = turbulence_process(scenario, mode, dt)
    return Ar3(p.omega, p.damping, scenario.turbulence.third_corner * p.omega, p.rms, dt)


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
    return lambda scenario, n, rng, watch: TurbulenceSignals(columns(source, scenario, n, rng, watch))


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
    return TurbulenceSignals(on_axis, ngs, tuple(lgs))


SOURCES: dict[str, Source] = {
    **dict.fromkeys(("ar2", "ar3", "processes", "none"), _mode_by_mode(_sum_of_processes)),
    "frozen-flow": _frozen_flow,
    "psd": _mode_by_mode(_psd),
}
