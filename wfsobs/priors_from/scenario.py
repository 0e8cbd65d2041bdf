"""What observers and controllers are told of a scenario: matched to it, or wrong on purpose where its settings say so."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from math import sqrt
from types import MappingProxyType
from typing import TypeVar

import numpy as np

from wfsobs.observers.base import Observer
from wfsobs.observers.kalman.single import steady_filter
from wfsobs.prior import (
    Asterism,
    Bands,
    Beams,
    Flow,
    FlowOfBoth,
    LgsError,
    LgsModel,
    LgsStars,
    Line,
    Lines,
    Model,
    NgsModel,
    Noise,
    NoiselessModel,
    OfflineBands,
    OnlineBands,
    Part,
    Prior,
    Spectra,
    Training,
)
from wfsobs.priors_from.flow import asterism_of, flow_of, flow_of_both
from wfsobs.priors_from.training import training_of
from wfsobs.priors_from.turbulence import beams_of, lgs_error_of, lines_turbulence, measurement_noise, one_process, stars_of
from wfsobs.priors_from.vibration import vibration_continuum
from wfsobs.record import Measurements, Record, Sampling
from wfsobs.scenario import Scenario
from wfsobs.settings.group import Group
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.signal.statespace import MIN_MODEL_DAMPING, DisturbanceModel
from wfsobs.simulation.disturbance import vibration_lines, vibration_variance
from wfsobs.simulation.true_spectra import TrueSpectra, has_known_spectra, true_spectra

T = TypeVar("T", Model, Bands)

PriorParts = dict[Part, Prior]
"""Parts of a prior that several observers of one record and scenario are told; they cannot be changed."""


def arguments(
    observer: Observer, record: Record, scenario: Scenario, known_parts: PriorParts | None = None
) -> tuple[Measurements, Prior, Group | None]:
    """All that an observer receives of a record and a scenario: measurements, prior and settings of its own.

    known_parts : as in `prior_and_settings`. Raises ValueError where the scenario has no such prior.
    """
    return observer.measurements(record), *prior_and_settings(observer, record, scenario, known_parts)


def prior_and_settings(
    observer: Observer, record: Record, scenario: Scenario, known_parts: PriorParts | None = None
) -> tuple[Prior, Group | None]:
    """Return the prior and the settings of its own that an observer receives beside the measurements of a record.

    known_parts : what others have been told of the same record and scenario: not made again, and added to

    Raises ValueError where the scenario has no such prior.
    """
    settings = observer_settings(observer, scenario)
    parts = observer.parts(settings)
    if known_parts is None:
        return prior_of(scenario, record, parts), settings
    for part in parts:
        if part in SHARED and part not in known_parts:
            known_parts[part] = prior_of(scenario, record, (part,))
    own = prior_of(scenario, record, [part for part in parts if part not in SHARED])
    return replace(own, **{SHARED[part]: getattr(known_parts[part], SHARED[part]) for part in parts if part in SHARED}), settings


SHARED: Mapping[Part, str] = MappingProxyType(
    {
        **dict.fromkeys((Model, LgsModel, NgsModel, NoiselessModel), "model"),
        **dict.fromkeys((Bands, OfflineBands, OnlineBands), "bands"),
        Noise: "noise",
        LgsError: "lgs_error",
        Lines: "lines",
        Beams: "beams",
        LgsStars: "stars",
    }
)
"""Parts that hold no arrays -> where they stand in a prior."""


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
    model, bands = _most_of(Model, asked), _most_of(Bands, asked)
    return Prior(
        model=tuple(model_of(scenario, mode, dt, model) for mode in modes) if model else (),
        noise=tuple(Noise(*measurement_noise(scenario, mode)) for mode in modes) if Noise in asked else (),
        lgs_error=tuple(lgs_error_of(scenario, mode, dt) for mode in modes) if LgsError in asked else (),
        lines=tuple(lines_of(scenario, mode, dt) for mode in modes) if Lines in asked else (),
        stars=tuple(stars_of(scenario, mode, dt) for mode in modes) if LgsStars in asked else (),
        beams=tuple(beams_of(scenario, mode, dt) for mode in modes) if Beams in asked else (),
        flow=flow_of(scenario, len(modes), dt) if Flow in asked else None,
        asterism=_asterism(asked, scenario, len(modes), dt),
        bands=bands_of(scenario, bands) if bands else None,
        spectra=tuple(spectra or [spectra_of(scenario, mode) for mode in modes]) if Spectra in asked else (),
        training=training_of(record, modes) if Training in asked and record else None,
    )


def _asterism(parts: Collection[Part], scenario: Scenario, n_modes: int, dt: float) -> Asterism | None:
    if Asterism in parts:
        return asterism_of(scenario, n_modes, dt)
    return flow_of_both(scenario, n_modes, dt) if FlowOfBoth in parts else None


def _most_of(kind: type[T], parts: Collection[Part]) -> type[T] | None:
    """Return what is asked of a kind of part: the whole, where two ask for different shares of it."""
    found = [part for part in parts if issubclass(part, kind)]
    return found[0] if len(found) == 1 else kind if found else None


def bands_of(scenario: Scenario, kind: type[Bands] = Bands) -> Bands:
    """Return the bands of the vibration; kind : as much of them."""
    b = scenario.butterworth
    return kind(tuple(b.frequencies), b.bandwidth_offline, b.bandwidth_online, b.order)


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


def model_of(scenario: Scenario, mode: int, dt: float | None = None, kind: type[Model] = Model) -> Model:
    """Return the model of one mode with one peak; dt [s]: by default that of the scenario; kind : as much of it."""
    return kind(*modelled_processes(scenario, mode, dt or scenario.dt), *measurement_noise(scenario, mode))


def modelled_processes(scenario: Scenario, mode: int, dt: float) -> tuple[Ar2, Ar2]:
    """Return the turbulence and the one vibration peak of the model, sampled every `dt` [s] (paper, Tables 1 and 2)."""
    k, tip_tilt = scenario.kalman, scenario.modes[mode].radial_order == 1
    manual = k.process_noise == "manual"
    vibration_rms = k.vibration_rms if manual and tip_tilt else float(np.sqrt(vibration_variance(scenario, mode)))
    frequency, damping = modelled_peak(scenario, mode)
    vibration = Ar2(2.0 * np.pi * frequency, max(damping, MIN_MODEL_DAMPING), vibration_rms, dt)
    return one_process(scenario, mode, dt), vibration


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


# ---------------------------------------------------------------------- every line


def lines_of(scenario: Scenario, mode: int, dt: float | None = None, turbulence: tuple[Ar2 | Ar3, ...] | None = None) -> Lines:
    """Noise, turbulence, lines and continuum of one mode; a table of a spectrum is a continuum as a whole.

    turbulence : that of the same scenario, where already fitted
    """
    dt = dt or scenario.dt
    return Lines(
        measurement_noise(scenario, mode)[0],
        dt,
        lines_turbulence(scenario, mode, dt) if turbulence is None else turbulence,
        tuple(Line(*line) for line in vibration_lines(scenario, mode)),
        tuple(process.at(dt) for process in vibration_continuum(scenario, mode)),
    )


def multi_model(scenario: Scenario, mode: int, dt: float) -> DisturbanceModel:
    """Return the state-space model of the whole vibration."""
    return lines_of(scenario, mode, dt).disturbance(scenario.multipeak.line_width)


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
