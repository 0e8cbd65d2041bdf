"""What observers and controllers are told of a scenario: matched to it, or wrong on purpose where its settings say so."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from math import sqrt

import numpy as np

from wfsobs.observers.base import Observer
from wfsobs.observers.kalman.single import MIN_NOISE, steady_filter
from wfsobs.prior import Bands, Beams, LgsError, Line, Lines, Model, Part, Prior, Spectra, Training
from wfsobs.record import Measurements, Record, Sampling
from wfsobs.scenario import Scenario
from wfsobs.settings.group import Group
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3, fit_ar3
from wfsobs.signal.shared_process import SharedProcess, fit_shared_process
from wfsobs.signal.statespace import MIN_MODEL_DAMPING, DisturbanceModel
from wfsobs.simulation.disturbance import vibration_lines, vibration_variance
from wfsobs.simulation.guide_stars import lgs_error_process, lgs_noise_rms, lgs_weights
from wfsobs.simulation.layers import relative_rms
from wfsobs.simulation.sensor_noise import noise_rms
from wfsobs.simulation.true_spectra import TrueSpectra, has_known_spectra, lgs_turbulence_spectrum, n_frequencies, true_spectra
from wfsobs.simulation.turbulence import processes, turbulence_process, turbulence_rms
from wfsobs.simulation.turbulence_spectra import turbulence_spectra
from wfsobs.typing import Array


def arguments(observer: Observer, record: Record, scenario: Scenario) -> tuple[Measurements, Prior, Group | None]:
    """All that an observer receives of a record and a scenario: measurements, prior and settings of its own.

    Raises ValueError where the scenario has no such prior.
    """
    return record.measurements(open_loop="open_loop_y" in observer.needs), *prior_and_settings(observer, record, scenario)


def prior_and_settings(observer: Observer, record: Record, scenario: Scenario) -> tuple[Prior, Group | None]:
    """Return the prior and the settings of its own that an observer receives beside the measurements of a record.

    Raises ValueError where the scenario has no such prior.
    """
    settings = observer_settings(observer, scenario)
    return prior_of(scenario, record, (*observer.prior, *observer.asks(settings))), settings


def observer_settings(observer: Observer, scenario: Scenario) -> Group | None:
    """Return a copy of an observer's own settings, or None."""
    return None if observer.group is None else getattr(scenario, observer.group).copy()


def prior_of(
    scenario: Scenario,
    record: Record | None,
    parts: Iterable[Part],
    spectra: Sequence[Spectra] = (),
    modes: Sequence[int] | None = None,
) -> Prior:
    """Return these parts of a scenario's prior for the modes of a record, or without a record for its own.

    spectra : one per mode, where already computed; modes : only these. Raises ValueError where the scenario does not have a part.
    """
    asked = set(parts)
    if modes is None:
        modes = range(record.n_modes if record else len(scenario.modes))
    dt = record.dt if record else scenario.dt
    return Prior(
        model=tuple(model_of(scenario, mode, dt) for mode in modes) if Model in asked else (),
        lgs_error=tuple(lgs_error_of(scenario, mode, dt) for mode in modes) if LgsError in asked else (),
        lines=tuple(lines_of(scenario, mode, dt) for mode in modes) if Lines in asked else (),
        beams=tuple(beams_of(scenario, mode, dt) for mode in modes) if Beams in asked else (),
        bands=bands_of(scenario) if Bands in asked else None,
        spectra=tuple(spectra or [spectra_of(scenario, mode) for mode in modes]) if Spectra in asked else (),
        training=record.training.copy() if Training in asked and record and record.training else None,
    )


def bands_of(scenario: Scenario) -> Bands:
    """Return the bands of the vibration."""
    b = scenario.butterworth
    return Bands(tuple(b.frequencies), b.bandwidth_offline, b.bandwidth_online, b.order)


def spectra_of(scenario: Scenario, mode: int) -> Spectra:
    """Return the true spectra of one mode. Raises ValueError where they are not known."""
    if not has_known_spectra(scenario):
        raise ValueError(
            f"the spectrum of turbulence from {scenario.turbulence.source} is not known: set control.integrator "
            "to manual, and control.gain"
        )
    return told_spectra(true_spectra(scenario, mode))


def told_spectra(spectra: TrueSpectra) -> Spectra:
    """Return the part of true spectra in a prior: those of the disturbance as a whole."""
    disturbance, cross = spectra.total
    return Spectra(disturbance, spectra.measurement, cross)


# ---------------------------------------------------------------------- one vibration peak


def model_of(scenario: Scenario, mode: int, dt: float | None = None) -> Model:
    """Return the model of one mode with one peak; dt [s]: by default that of the scenario."""
    return Model(*modelled_processes(scenario, mode, dt or scenario.dt), *measurement_noise(scenario, mode))


def lgs_error_of(scenario: Scenario, mode: int, dt: float | None = None) -> LgsError:
    """Return the slow error of the combined LGS in one mode."""
    return LgsError(lgs_error_process(scenario, mode, dt or scenario.dt))


def modelled_processes(scenario: Scenario, mode: int, dt: float) -> tuple[Ar2, Ar2]:
    """Return the turbulence and the one vibration peak of the model, sampled every `dt` [s] (paper, Tables 1 and 2)."""
    k, tip_tilt = scenario.kalman, scenario.modes[mode].radial_order == 1
    manual = k.process_noise == "manual"
    vibration_rms = k.vibration_rms if manual and tip_tilt else float(np.sqrt(vibration_variance(scenario, mode)))
    frequency, damping = modelled_peak(scenario, mode)
    vibration = Ar2(2.0 * np.pi * frequency, max(damping, MIN_MODEL_DAMPING), vibration_rms, dt)
    return _one_process(scenario, mode, dt), vibration


def _one_process(scenario: Scenario, mode: int, dt: float) -> Ar2:
    """Return the turbulence of the model with one peak."""
    turbulence = turbulence_process(scenario, mode, dt)
    if scenario.kalman.process_noise == "manual":
        return replace(turbulence, rms=scenario.kalman.turbulence_rms * relative_rms(scenario, mode))
    return turbulence


def modelled_peak(scenario: Scenario, mode: int) -> tuple[float, float]:
    """Natural frequency [Hz] and damping of the one peak of the model."""
    k, lines = scenario.kalman, vibration_lines(scenario, mode)
    if k.peak == "manual" or not lines:
        return k.frequency, k.damping
    frequency, damping, _ = max(lines, key=lambda line: line[2])
    return frequency, damping


def kalman_model(scenario: Scenario, mode: int, dt: float) -> DisturbanceModel:
    """Return the state-space model of the two processes."""
    return model_of(scenario, mode, dt).disturbance()


def measurement_noise(scenario: Scenario, mode: int) -> tuple[float, float]:
    """Return the rms of the modelled noise [um] of the combined LGS and of an NGS frame in one mode."""
    k = scenario.kalman
    if k.measurement_noise == "manual":
        return k.lgs_noise, k.ngs_noise
    return max(lgs_noise_rms(scenario, mode), MIN_NOISE), max(noise_rms(scenario, "ngs")[mode], MIN_NOISE)


# ---------------------------------------------------------------------- every line


def lines_of(scenario: Scenario, mode: int, dt: float | None = None, turbulence: tuple[Ar2 | Ar3, ...] | None = None) -> Lines:
    """Noise, turbulence and all the lines of one mode. Raises ValueError where the vibration names no lines.

    turbulence : that of the same scenario, where already fitted
    """
    if scenario.vibration.source == "psd":
        raise ValueError("vibration.source = psd is a table, not lines that a model could have")
    dt = dt or scenario.dt
    return Lines(
        measurement_noise(scenario, mode)[0],
        dt,
        lines_turbulence(scenario, mode, dt) if turbulence is None else turbulence,
        tuple(Line(*line) for line in vibration_lines(scenario, mode)),
    )


def multi_model(scenario: Scenario, mode: int, dt: float) -> DisturbanceModel:
    """Return the state-space model of all peaks. Raises ValueError where the vibration names no lines."""
    return lines_of(scenario, mode, dt).disturbance(scenario.multipeak.line_width)


def lines_turbulence(scenario: Scenario, mode: int, dt: float, spectrum: Array | None = None) -> tuple[Ar2 | Ar3, ...]:
    """Return a scenario's own processes, in the strength of the model; else one process, as `modelled_turbulence`."""
    found = processes(scenario, mode, dt) if scenario.turbulence.source == "processes" else []
    if not found:
        return (modelled_turbulence(scenario, mode, dt, spectrum),)
    if scenario.kalman.process_noise == "matched":
        return tuple(found)
    factor = _one_process(scenario, mode, dt).rms / turbulence_rms(scenario, mode)
    return tuple(replace(p, rms=factor * p.rms) for p in found)


def modelled_turbulence(scenario: Scenario, mode: int, dt: float, spectrum: Array | None = None) -> Ar2 | Ar3:
    """Return the turbulence of the model: that of one peak, or of third order and nearest to the true spectrum of the LGS.

    spectrum : that of the turbulence in the LGS (`lgs_turbulence_spectrum`), where already computed
    """
    process = _one_process(scenario, mode, dt)
    if not _is_third_order(scenario, process):
        return process
    noise, _ = measurement_noise(scenario, mode)
    spectrum = lgs_turbulence_spectrum(scenario, mode) if spectrum is None else spectrum
    return fit_ar3(spectrum, noise**2, _third_order(process))


def beams_of(scenario: Scenario, mode: int, dt: float | None = None) -> Beams:
    """Return turbulence as the target has it and as the LGS see it in one mode; dt [s]: by default that of the scenario.

    Of third order it is fitted to the true spectra of both and to their cross spectrum, else it is the AR(2) and the slow error.
    """
    dt = dt or scenario.dt
    line_gain = float(lgs_weights(scenario)[mode, :, mode].sum())
    process = _one_process(scenario, mode, dt)
    if scenario.turbulence.source == "processes" or not _is_third_order(scenario, process):
        return Beams(lines_turbulence(scenario, mode, dt), lgs=(lgs_error_of(scenario, mode, dt).process,), line_gain=line_gain)
    found = _shared_turbulence(scenario, mode, dt)
    factor = process.rms / turbulence_process(scenario, mode, dt).rms  # where the strength is set by hand
    common, target, lgs = (tuple(replace(p, rms=factor * p.rms) for p in part) for part in found[1:])
    return Beams(common, target, lgs, found.gain, line_gain)


@lru_cache(maxsize=32)
def _shared_turbulence(scenario: Scenario, mode: int, dt: float) -> SharedProcess:
    """Return the fit to the spectra, which takes a while."""
    seen, (noise, _) = turbulence_spectra(scenario, mode, n_frequencies(scenario)), measurement_noise(scenario, mode)
    start = _third_order(turbulence_process(scenario, mode, dt))
    return fit_shared_process(seen.own, seen.measurement, np.real(seen.cross), noise**2, start)


def _is_third_order(scenario: Scenario, process: Ar2) -> bool:
    return scenario.multipeak.turbulence_order == 3 and process.rms > 0


def _third_order(process: Ar2) -> Ar3:
    """Return a first guess for fits."""
    return Ar3(process.omega, process.damping, 5.0 * process.omega, process.rms, process.dt)


def predicted_rms(scenario: Scenario, mode: int) -> float:
    """Return the predicted error of the multi-peak filter for the next phi_dist, rms [um]."""
    model = multi_model(scenario, mode, scenario.dt)
    row = np.sum(list(model.outputs.values()), axis=0)
    _, steady = steady_filter(model, measurement_noise(scenario, mode)[0])
    return sqrt(float(row @ steady.P @ row))


def as_sampled(scenario: Scenario, sampling: Sampling) -> Scenario:
    """Return the scenario with the time step and exposure ratio of a loop."""
    changes: dict[str, float] = {}
    if abs(sampling.dt * scenario.sensors.lgs_rate - 1.0) > 1e-12:
        changes["sensors.lgs_rate"] = 1.0 / sampling.dt
    if sampling.ratio is not None and sampling.ratio != scenario.sensors.exposure_ratio:
        changes["sensors.exposure_ratio"] = sampling.ratio
    return scenario.replace(changes) if changes else scenario
