"""The controllers, by id, and the vibration as the GPR predict it for them: what it will be while the next command acts.

In a loop that the prediction itself drives, u[k] does not exist yet at step k, so windows are of z whatever the settings of the
observer say; high-passed or standardised they are as those say. With a delay of two frames the target of the window ending at
step j is phi_vib[j+1]; the Butterworth bank on z says so at step j + 2, one step after the prediction was used.
"""

from __future__ import annotations

from functools import partial
from typing import Any, TypeVar

from wfsobs import registry
from wfsobs.control.base import Controller
from wfsobs.control.laws import best_gain, h2_fir, integrator_law, lqg, lqg_adaptive
from wfsobs.control.mirror import Law, Plant
from wfsobs.observers.base import VIBRATION, Look, Tunable
from wfsobs.observers.gpr.offline import OfflineEstimator, OfflineGpr, trained_estimator
from wfsobs.observers.gpr.online import OnlineEstimator, OnlineGpr
from wfsobs.observers.kalman.adaptive import KF_ADAPTIVE, MULTIRATE_ADAPTIVE, kf_adaptive, multirate_adaptive
from wfsobs.observers.kalman.filters import (
    MODEL,
    TUNABLE,
    every_peak_filter,
    matched_noise,
    multirate_mode,
    one_peak_filter,
    optimal_mode,
    optimal_mode_of_peaks,
)
from wfsobs.observers.kalman.window_model import window_lengths
from wfsobs.prior import (
    Bands,
    Beams,
    LgsError,
    LgsModel,
    LgsStars,
    Lines,
    Noise,
    NoiselessModel,
    OnlineBands,
    Part,
    Prior,
    Spectra,
    Training,
)
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Sampling
from wfsobs.registry import Registry
from wfsobs.settings.values import Plain
from wfsobs.typing import Array

G = TypeVar("G", OfflineGpr, OnlineGpr)


def gpr_offline_ahead(measurements: Measurements, prior: Prior, plant: Plant, settings: Any, watch: Watch) -> Array:
    """Predict the vibration while u[k] acts, (n_steps, n_modes) [um], NaN before the first full window.

    The GPR is trained once on the training record, with targets as many steps later.
    """
    estimator = step_gpr_offline_ahead(prior, plant, settings, measurements.sampling)
    return estimator.run(measurements, watch, with_sd=False)[VIBRATION]


def step_gpr_offline_ahead(prior: Prior, plant: Plant, settings: Any, sampling: Sampling) -> OfflineEstimator:
    """Return `gpr_offline_ahead`, one frame at a time."""
    return trained_estimator(prior, of_z(settings.gpr_offline), sampling, plant.mirror.taps[1:], None)


def step_gpr_online_ahead(prior: Prior, plant: Plant, settings: Any, sampling: Sampling) -> OnlineEstimator:
    """Return `gpr_online_ahead`, one frame at a time."""
    return OnlineEstimator(prior, of_z(settings.gpr_online), sampling, plant.mirror.taps[1:])


def of_z(settings: G) -> G:
    """Return the settings of a GPR with windows of z."""
    out = settings.copy()
    out.inputs = "z"
    return out


def gpr_online_ahead(measurements: Measurements, prior: Prior, plant: Plant, settings: Any, watch: Watch) -> Array:
    """Predict the vibration while u[k] acts, (n_steps, n_modes) [um], NaN before the training set is full.

    The GPR is trained anew at every step (paper, Algorithm 3), at step k on the last windows whose target is known by then: those
    up to k - mirror.taps.size + 1.
    """
    estimator = step_gpr_online_ahead(prior, plant, settings, measurements.sampling)
    return estimator.run(measurements, watch)[VIBRATION]


def integrator(prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    """Return the integrator with the gain of the settings, or with the optimal gain for the given spectra."""
    c = settings.control
    gain = c.gain if c.integrator == "manual" else best_gain(prior.spectra[mode], plant.mirror, c.leak) / c.caution
    return integrator_law(plant.mirror, gain, c.leak)


def _gain(settings: Any) -> tuple[Part, ...]:
    """Return the spectra for an optimised gain."""
    return (Spectra,) if settings.control.integrator == "optimised" else ()


def _gain_and_scale(settings: Any) -> tuple[Part, ...]:
    """Beside the gain, standardised inputs are divided by the deviations of a training record."""
    scale = (Training,) if settings.gpr_online.inputs_filter == "standardised" else ()
    return (*_gain(settings), *scale)


def _matched_noise(settings: Any) -> tuple[Part, ...]:
    """Return the noise of both sensors, where it is not that of the settings."""
    return matched_noise(settings.multirate)


def _offline_used(settings: Any) -> Plain:
    return of_z(settings.gpr_offline).effective_values()


def _online_used(settings: Any) -> Plain:
    return of_z(settings.gpr_online).effective_values()


def _adaptive_used(settings: Any) -> Any:
    assert MULTIRATE_ADAPTIVE.counts is not None
    return *MULTIRATE_ADAPTIVE.counts(Prior(), settings.adaptive), settings.control.fallback_gain, settings.control.leak


def _first_window(settings: Any, sampling: Sampling) -> int:
    lengths = window_lengths(settings.adaptive, sampling.dt, sampling.ratio, sampling.delay)
    return lengths.first + lengths.window


def _adaptive_seconds(settings: Any, n_steps: int, n_modes: int) -> float:
    """Estimate the time of a step, and that of the identifications at 1 kHz."""
    assert KF_ADAPTIVE.seconds is not None
    return n_steps * n_modes * 5e-5 + KF_ADAPTIVE.seconds(settings.adaptive, n_steps, n_modes, 1e-3)


def _online_seconds(settings: Any, n_steps: int, n_modes: int) -> float:
    """One sample at a time takes a step of 0.1 ms + 0.7 ns m^2."""
    return n_steps * n_modes * (1e-4 + 0.7e-9 * settings.gpr_online.training_size**2)


_CAUTION = ("control.caution",)
_BOTH_SENSORS = Tunable(_CAUTION, (*TUNABLE.usual, *MODEL))

CONTROLLERS = Registry(
    Controller,
    registry.CONTROLLERS,
    (
        Controller(
            "none", "No control", help="no command at all", weight=0.1, look=Look("No control", "#606060", "#C8C8C8", (6, 3))
        ),
        Controller(
            "integrator",
            "Integrator",
            integrator,
            help="u[k] = leak u[k-1] - g y[k]",
            settings=("control",),
            asks=_gain,
            tunable=Tunable(_CAUTION, ("control.gain", "control.leak")),
            look=Look("Integrator", "#003DE6", "#7AA2FF"),
        ),
        Controller(
            "lqg-kf-lgs",
            "LQG, LGS KF",
            partial(lqg, one_peak_filter, ""),
            help="minus what the LGS Kalman filter predicts",
            prior=(LgsModel, LgsStars),
            settings=("control",),
            tunable=Tunable(_CAUTION, (*MODEL, "kalman.lgs_noise")),
            look=Look("LQG LGS KF", "#FF6600", "#FF8533"),
        ),
        Controller(
            "lqg-kf-multi",
            "LQG, multi-peak KF",
            partial(lqg, every_peak_filter, "multipeak"),
            help="minus what the Kalman filter of every peak predicts",
            prior=(Lines, LgsStars),
            settings=("control", "multipeak"),
            tunable=Tunable(_CAUTION, ("multipeak.line_width", "kalman.lgs_noise", "kalman.turbulence_rms")),
            look=Look("LQG multi-peak", "#AE7D40", "#BA6A26", (14, 3)),
        ),
        Controller(
            "h2-fir",
            "H2, robust",
            h2_fir,
            help="64 taps of least residual that bear half a frame, 20 % and 10 degrees",
            prior=(Spectra,),
            settings=("control",),
            tunable=Tunable(_CAUTION),
            look=Look("H2, robust", "#A3004F", "#FF7AB0", (5, 2, 1, 2)),
        ),
        Controller(
            "lqg-multirate",
            "LQG, multi-rate KF",
            partial(lqg, multirate_mode, "multirate"),
            help="minus what the paper's multi-rate filter predicts",
            prior=(NoiselessModel, LgsStars),
            asks=_matched_noise,
            settings=("control", "multirate"),
            ngs=True,
            tunable=_BOTH_SENSORS,
            look=Look("LQG multi-rate", "#E31FFF", "#7E75C8", (10, 2, 2, 2)),
        ),
        Controller(
            "lqg-multirate-optimal",
            "LQG, optimal multi-rate KF",
            partial(lqg, optimal_mode, "multirate"),
            help="minus what the optimal multi-rate filter predicts",
            prior=(NoiselessModel, LgsError, LgsStars),
            asks=_matched_noise,
            settings=("control", "multirate"),
            ngs=True,
            tunable=_BOTH_SENSORS,
            look=Look("LQG opt. multi-rate", "#5718C1", "#B848F9", (3, 2)),
        ),
        Controller(
            "lqg-multirate-multi",
            "LQG, multi-rate multi-peak KF",
            partial(lqg, optimal_mode_of_peaks, "multipeak"),
            help="minus what the optimal multi-rate filter of every peak predicts",
            prior=(Noise, LgsStars, Lines, Beams),
            settings=("control", "multipeak"),
            ngs=True,
            tunable=Tunable(_CAUTION, ("multipeak.line_width", "kalman.lgs_noise", "kalman.ngs_noise", "kalman.turbulence_rms")),
            look=Look("LQG multi-rate multi-peak", "#AB64CF", "#F26FF3", (8, 3)),
        ),
        Controller(
            "lqg-kf-adaptive",
            "LQG, adaptive KF",
            step_law=partial(lqg_adaptive, kf_adaptive),
            help="minus what a filter predicts whose model is identified anew as the loop runs; at first an integrator",
            settings=("control", "adaptive"),
            weight=20.0,
            seconds=_adaptive_seconds,
            counts=_adaptive_used,
            learns=_first_window,
            look=Look("LQG adaptive", "#522C0A", "#F4C173", (20, 2)),
        ),
        Controller(
            "lqg-multirate-adaptive",
            "LQG, adaptive multi-rate KF",
            step_law=partial(lqg_adaptive, multirate_adaptive),
            help="the same with a filter of both sensors",
            settings=("control", "adaptive"),
            ngs=True,
            weight=20.0,
            seconds=_adaptive_seconds,
            counts=_adaptive_used,
            learns=_first_window,
            look=Look("LQG adaptive multi-rate", "#591677", "#F3C1F7", (20, 2, 3, 2)),
        ),
        Controller(
            "integrator+gpr-offline",
            "Integrator and offline GPR",
            integrator,
            predict=gpr_offline_ahead,
            step_predict=step_gpr_offline_ahead,
            help="integrator and minus the vibration that the offline GPR predicts",
            prior=(Training, Bands),
            settings=("control", "gpr_offline"),
            asks=_gain,
            weight=20.0,
            counts=_offline_used,
            look=Look("Int. + offline", "#183B2C", "#37C9B2", (12, 2, 2, 2, 2, 2)),
        ),
        Controller(
            "integrator+gpr-online",
            "Integrator and online GPR",
            integrator,
            predict=gpr_online_ahead,
            step_predict=step_gpr_online_ahead,
            help="the same with the online GPR, one sample at a time",
            prior=(OnlineBands,),
            settings=("control", "gpr_online"),
            asks=_gain_and_scale,
            weight=200.0,
            seconds=_online_seconds,
            counts=_online_used,
            look=Look("Int. + online", "#046D72", "#5B8A77", (10, 2, 4, 2)),
        ),
    ),
    reserved_ids=("truth", "loop", "bound", "bound-both", "bound-stars"),
)
"""Every controller, in the order of tables and legends."""
