"""What observers are told of a scenario and a record.

The part of the vibration that is no line is a few processes; the turbulence is the scenario's own process, or one that is
fitted to its true spectra.

Without a choice of observers, those run that the scenario has an input for. An observer of the correlation of modes, or of
guide stars, equals a simpler one where there is none: it is left out then, and refuses to run if chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import Observer
from wfsobs.observers.kalman.filters import MIN_NOISE
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
from wfsobs.priors_from.telemetry import training_of
from wfsobs.record import Measurements, Record, Sampling
from wfsobs.scenario import Scenario
from wfsobs.scenario.measured_spectra import ALL, LINES
from wfsobs.settings.group import Group
from wfsobs.signal.autoregressive import Ar2, Ar3, Ar3Fits, SharedProcess, fit_shared_process
from wfsobs.signal.statespace import MIN_MODEL_DAMPING
from wfsobs.simulation.disturbance import (
    processes,
    turbulence_process,
    turbulence_rms,
    vibration_lines,
    vibration_power,
    vibration_variance,
)
from wfsobs.simulation.flow_spectra import TurbulenceSpectra, star_basis
from wfsobs.simulation.layers import relative_rms
from wfsobs.simulation.mode_spectra import are_coupled, beam_spectra, combined_spectra, frequency_rule, mode_spectra
from wfsobs.simulation.sensing import lgs_error_process, lgs_error_variance, lgs_noise_rms, lgs_weights, stars_differ
from wfsobs.simulation.sensor_noise import noise_rms
from wfsobs.simulation.true_spectra import (
    TrueSpectra,
    has_known_spectra,
    lgs_turbulence_spectrum,
    n_frequencies,
    true_spectra,
    turbulence_spectra,
)
from wfsobs.spectral.model import fit_processes
from wfsobs.typing import Array

Of = TypeVar("Of", bound=Asterism)


def turbulence_together(kind: type[Of], scenario: Scenario, n_modes: int, dt: float) -> Of | None:
    """Return the turbulence of the first modes together, at steps of dt [s].

    None where all LGS see the same, or for `Flow` and `FlowOfBoth` where modes tell nothing of one another. Where the strength of
    the model is set by hand the turbulence has that.
    """
    is_known = has_stars_apart(scenario) if kind is Asterism else are_coupled(scenario) and n_modes > 1
    return _of_beams(kind, scenario, dt).first(n_modes) if is_known else None


def has_stars_apart(scenario: Scenario) -> bool:
    """Return whether every LGS tells something that their mean does not."""
    return any(stars_differ(scenario, mode) for mode in range(len(scenario.modes)))


@lru_cache(maxsize=8)
def _of_beams(kind: type[Asterism], scenario: Scenario, dt: float) -> Any:
    """Return that of all modes in the beams of the LGS, and but for `Flow` in the NGS, which takes a while."""
    frequency, weight = frequency_rule(scenario)
    spectra = {Asterism: beam_spectra, FlowOfBoth: combined_spectra, Flow: mode_spectra}[kind]
    found, strength, m = spectra(scenario, frequency), _strength(scenario, dt), len(scenario.modes)
    by_pair, beams = weight * np.outer(strength, strength)[:, :, None], len(found.measurement) // m
    noise, ngs_noise = np.array([measurement_noise(scenario, mode) for mode in range(m)]).T
    combination, line_gain, ratio = np.eye(m)[:, None], _line_gain(scenario), scenario.sensors.exposure_ratio
    if kind is Asterism:
        combination, line_gain = lgs_weights(scenario), np.ones(m)
        noise = noise / np.sqrt(np.sum(combination[range(m), :, range(m)] ** 2, axis=1))  # of one, from that of all together
    elif kind is Flow:
        ngs_noise, ratio = np.zeros(m), 1
    return kind(
        omega=2.0 * np.pi * frequency * dt,
        own=found.own * weight * strength[:, None] ** 2,
        measurement=found.measurement.reshape(beams, m, beams, m, -1) * by_pair[:, None],
        cross=found.cross.reshape(m, beams, m, -1) * by_pair[:, None],
        basis=star_basis(combination.shape[1]),
        noise=noise,
        ngs_noise=ngs_noise,
        combination=combination,
        line_gain=line_gain,
        ratio=ratio,
    )


def _line_gain(scenario: Scenario) -> Array:
    """Return the gain of the combined LGS for the vibration of each mode, (n_modes,)."""
    modes = range(len(scenario.modes))
    return lgs_weights(scenario)[modes, :, modes].sum(axis=1)


def _strength(scenario: Scenario, dt: float) -> Array:
    """Return the strength of the model over that of the turbulence, (n_modes,)."""
    modes = range(len(scenario.modes))
    own = [turbulence_process(scenario, mode, dt).rms for mode in modes]
    return np.divide([one_process(scenario, mode, dt).rms for mode in modes], own)


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
    if not _is_third_order(scenario, mode, dt):
        return one_process(scenario, mode, dt)
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
    line_gain = float(_line_gain(scenario)[mode])
    if scenario.turbulence.source == "processes" or not _is_third_order(scenario, mode, dt):
        return Beams(lines_turbulence(scenario, mode, dt), lgs=(lgs_error_of(scenario, mode, dt).process,), line_gain=line_gain)
    found = _shared_turbulence(scenario, mode, dt) if spectra is None else _fit_shared(scenario, mode, dt, spectra, fits)
    factor = one_process(scenario, mode, dt).rms / turbulence_process(scenario, mode, dt).rms  # where the strength is set by hand
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


def _is_third_order(scenario: Scenario, mode: int, dt: float) -> bool:
    return scenario.multipeak.turbulence_order == 3 and turbulence_process(scenario, mode, dt).rms > 0


def _third_order(process: Ar2) -> Ar3:
    """Return a first guess for fits."""
    return Ar3(process.omega, process.damping, 5.0 * process.omega, process.rms, process.dt)


PROCESSES = 8
"""Processes of a continuum. With five, `multirate-multi` is up to 1.27 times the bound on `ut4-floor`, with eight 1.23."""


@lru_cache(maxsize=32)
def vibration_continuum(scenario: Scenario, mode: int) -> tuple[Ar2, ...]:
    """Return processes whose sum has the spectrum of what is no line in a mode's vibration; none where all of it is lines.

    Fitted beside turbulence and noise of the LGS, at the step of the scenario.
    """
    n = n_frequencies(scenario, mode)
    power = continuum_power(scenario, mode, n)
    if not power.any():
        return ()
    beside = measurement_noise(scenario, mode)[0] ** 2 + lgs_turbulence_spectrum(scenario, mode)
    return fit_processes(0.5 * n * power, beside, scenario.dt, PROCESSES)


def continuum_power(scenario: Scenario, mode: int, n: int) -> Array:
    """Return the variance [um^2] of what is no line in a mode's vibration, in each DFT bin of `n` steps, even, (n // 2 + 1,)."""
    v = scenario.vibration
    if v.source == "psd":
        return vibration_power(scenario, mode, n)
    if v.source != "measured" or v.part != ALL:
        return np.zeros(n // 2 + 1)
    lines = vibration_power(scenario.replace({"vibration.part": LINES}), mode, n)
    return np.maximum(vibration_power(scenario, mode, n) - lines, 0.0)


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
    beams = [kind for kind in (Asterism, FlowOfBoth) if kind in asked]

    def each(part: Part, make: Callable[..., Any], *arguments: Any) -> tuple[Any, ...]:
        return tuple(make(scenario, mode, *arguments) for mode in modes) if part in asked else ()

    return Prior(
        model=tuple(model_of(scenario, mode, dt, model) for mode in modes) if model else (),
        noise=tuple(Noise(*one) for one in each(Noise, measurement_noise)),
        lgs_error=each(LgsError, lgs_error_of, dt),
        lines=each(Lines, lines_of, dt),
        stars=each(LgsStars, stars_of, dt),
        beams=each(Beams, beams_of, dt),
        flow=turbulence_together(Flow, scenario, len(modes), dt) if Flow in asked else None,
        asterism=turbulence_together(beams[0], scenario, len(modes), dt) if beams else None,
        bands=bands_of(scenario, bands) if bands else None,
        spectra=tuple(spectra) if spectra and Spectra in asked else each(Spectra, spectra_of),
        training=training_of(record, modes) if Training in asked and record else None,
    )


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


def as_sampled(scenario: Scenario, sampling: Sampling) -> Scenario:
    """Return the scenario with the time step and exposure ratio of a loop."""
    changes: dict[str, float] = {}
    if abs(sampling.dt * scenario.sensors.lgs_rate - 1.0) > 1e-12:
        changes["sensors.lgs_rate"] = 1.0 / sampling.dt
    if sampling.ratio is not None and sampling.ratio != scenario.sensors.exposure_ratio:
        changes["sensors.exposure_ratio"] = sampling.ratio
    return scenario.replace(changes) if changes else scenario


def has_prior(observer: Observer, scenario: Scenario, n_modes: int | None = None) -> bool:
    """Return whether a scenario has what an observer is told; n_modes : of the record, by default those of the scenario."""
    n = len(scenario.modes) if n_modes is None else n_modes
    is_alone = Asterism in observer.prior and not has_stars_apart(scenario)
    is_joint = not {Flow, FlowOfBoth}.isdisjoint(observer.prior)
    return not is_alone and (not is_joint or (are_coupled(scenario) and n > 1))


def is_usual(observer: Observer, scenario: Scenario, record: Record | None = None) -> bool:
    """Return whether an observer runs on a record of a scenario, or on its own, though it is not named."""
    is_without_stars = record is not None and record.y_stars is None and "y_stars" in observer.needs
    return not is_without_stars and has_prior(observer, scenario, None if record is None else record.n_modes)


def usual_observers(scenario: Scenario, record: Record | None = None) -> list[str]:
    """Return the ids of the observers that run where none is named."""
    return [o.id for o in OBSERVERS.values() if is_usual(o, scenario, record)]


def common_observers(scenarios: Iterable[Scenario]) -> tuple[str, ...]:
    """Return the ids of the observers that every scenario has something for."""
    found = list(OBSERVERS)
    for scenario in scenarios:
        found = [name for name in found if has_prior(OBSERVERS[name], scenario)]
    return tuple(found)


def quick_observers(scenario: Scenario, groups: Container[str | None] = ()) -> list[str]:
    """Return the ids of `usual_observers` but for those that learn during the run.

    groups : of settings; those that learn and have one of them as their own stay
    """
    return [name for name in usual_observers(scenario) if not (o := OBSERVERS[name]).slow or o.group in groups]
