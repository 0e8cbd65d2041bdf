"""Turbulence and noise of observers' models, from a scenario: its own processes, or one that is fitted to its true spectra."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from wfsobs.observers.kalman.single import MIN_NOISE
from wfsobs.prior import Beams, LgsError, LgsStars
from wfsobs.scenario import Scenario
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3, Ar3Fits
from wfsobs.signal.shared_process import SharedProcess, fit_shared_process
from wfsobs.simulation.guide_stars import lgs_error_process, lgs_error_variance, lgs_noise_rms, lgs_weights
from wfsobs.simulation.layers import relative_rms
from wfsobs.simulation.sensor_noise import noise_rms
from wfsobs.simulation.true_spectra import lgs_turbulence_spectrum, n_frequencies
from wfsobs.simulation.turbulence import processes, turbulence_process, turbulence_rms
from wfsobs.simulation.turbulence_spectra import TurbulenceSpectra, turbulence_spectra
from wfsobs.typing import Array


def lgs_error_of(scenario: Scenario, mode: int, dt: float | None = None) -> LgsError:
    """Return the slow error of the combined LGS in one mode."""
    return LgsError(lgs_error_process(scenario, mode, dt or scenario.dt))


def stars_of(scenario: Scenario, mode: int, dt: float | None = None) -> LgsStars:
    """Return what the LGS together are in one mode where some are out; dt [s]: by default that of the scenario.

    What the variance of the error grows by where one is out is a slow error of its own.
    """
    count, process = scenario.sensors.lgs_count, lgs_error_process(scenario, mode, dt or scenario.dt)
    noises = np.array([max(lgs_noise_rms(scenario, mode, stars), MIN_NOISE) for stars in range(1, count + 1)])
    growth = -np.diff([lgs_error_variance(scenario, mode, stars) for stars in range(1, count + 1)])
    slow = tuple(replace(process, rms=float(np.sqrt(max(variance, 0.0)))) for variance in growth)
    return LgsStars(tuple((noises / noises[-1]).tolist()), slow)


def one_process(scenario: Scenario, mode: int, dt: float) -> Ar2:
    """Return the turbulence of the model with one peak."""
    turbulence = turbulence_process(scenario, mode, dt)
    if scenario.kalman.process_noise == "manual":
        return replace(turbulence, rms=scenario.kalman.turbulence_rms * relative_rms(scenario, mode))
    return turbulence


def measurement_noise(scenario: Scenario, mode: int) -> tuple[float, float]:
    """Return the rms of the modelled noise [um] of the combined LGS and of an NGS frame in one mode."""
    k = scenario.kalman
    if k.measurement_noise == "manual":
        return k.lgs_noise, k.ngs_noise
    return max(lgs_noise_rms(scenario, mode), MIN_NOISE), max(float(noise_rms(scenario, "ngs")[mode]), MIN_NOISE)


def lines_turbulence(
    scenario: Scenario, mode: int, dt: float, spectrum: Array | None = None, fits: Ar3Fits | None = None
) -> tuple[Ar2 | Ar3, ...]:
    """Return a scenario's own processes, in the strength of the model; else one process, as `modelled_turbulence`."""
    found = processes(scenario, mode, dt) if scenario.turbulence.source == "processes" else []
    if not found:
        return (modelled_turbulence(scenario, mode, dt, spectrum, fits),)
    if scenario.kalman.process_noise == "matched":
        return tuple(found)
    factor = one_process(scenario, mode, dt).rms / turbulence_rms(scenario, mode)
    return tuple(replace(p, rms=factor * p.rms) for p in found)


def modelled_turbulence(
    scenario: Scenario, mode: int, dt: float, spectrum: Array | None = None, fits: Ar3Fits | None = None
) -> Ar2 | Ar3:
    """Return the turbulence of the model: that of one peak, or of third order and nearest to the true spectrum of the LGS.

    spectrum : that of the turbulence in the LGS (`lgs_turbulence_spectrum`), where already computed
    fits : those of similar scenarios, to start from
    """
    process = one_process(scenario, mode, dt)
    if not _is_third_order(scenario, process):
        return process
    return _fit_seen(scenario, mode, dt) if spectrum is None else _fit_third_order(scenario, mode, dt, spectrum, fits)


@lru_cache(maxsize=32)
def _fit_seen(scenario: Scenario, mode: int, dt: float) -> Ar3:
    """Return the fit to the spectrum that the LGS measure; kept, since every observer with several lines needs the same one."""
    return _fit_third_order(scenario, mode, dt, lgs_turbulence_spectrum(scenario, mode))


def _fit_third_order(scenario: Scenario, mode: int, dt: float, spectrum: Array, fits: Ar3Fits | None = None) -> Ar3:
    noise, _ = measurement_noise(scenario, mode)
    return (fits or Ar3Fits()).fit("LGS", spectrum, noise**2, _third_order(one_process(scenario, mode, dt)))


def beams_of(
    scenario: Scenario,
    mode: int,
    dt: float | None = None,
    spectra: TurbulenceSpectra | None = None,
    fits: Ar3Fits | None = None,
) -> Beams:
    """Return turbulence as the target has it and as the LGS see it in one mode; dt [s]: by default that of the scenario.

    Of third order it is fitted to the true spectra of both and to their cross spectrum, else it is the AR(2) and the slow error.

    spectra : the true ones, where already computed
    fits : those of similar scenarios, to start from
    """
    dt = dt or scenario.dt
    line_gain = float(lgs_weights(scenario)[mode, :, mode].sum())
    process = one_process(scenario, mode, dt)
    if scenario.turbulence.source == "processes" or not _is_third_order(scenario, process):
        return Beams(lines_turbulence(scenario, mode, dt), lgs=(lgs_error_of(scenario, mode, dt).process,), line_gain=line_gain)
    found = _shared_turbulence(scenario, mode, dt) if spectra is None else _fit_shared(scenario, mode, dt, spectra, fits)
    factor = process.rms / turbulence_process(scenario, mode, dt).rms  # where the strength is set by hand
    common, target, lgs = (tuple(replace(p, rms=factor * p.rms) for p in part) for part in found[1:])
    return Beams(common, target, lgs, found.gain, line_gain)


@lru_cache(maxsize=32)
def _shared_turbulence(scenario: Scenario, mode: int, dt: float) -> SharedProcess:
    """Return the fit to the spectra, which takes a while."""
    return _fit_shared(scenario, mode, dt, turbulence_spectra(scenario, mode, n_frequencies(scenario, mode)))


def _fit_shared(
    scenario: Scenario, mode: int, dt: float, spectra: TurbulenceSpectra, fits: Ar3Fits | None = None
) -> SharedProcess:
    noise, _ = measurement_noise(scenario, mode)
    start = _third_order(turbulence_process(scenario, mode, dt))
    return fit_shared_process(spectra.own, spectra.measurement, np.real(spectra.cross), noise**2, start, fits)


def _is_third_order(scenario: Scenario, process: Ar2) -> bool:
    return scenario.multipeak.turbulence_order == 3 and process.rms > 0


def _third_order(process: Ar2) -> Ar3:
    """Return a first guess for fits."""
    return Ar3(process.omega, process.damping, 5.0 * process.omega, process.rms, process.dt)
