"""Adaptive Kalman filter: its model is identified anew from the last seconds of z, again and again.

It needs no prior and follows changes: noise, turbulence and peaks of every window are identified
(`wfsobs.spectral.quick`), and the steady-state filter of that model runs until the next. A new filter starts at rest at the
beginning of its window, so that its state has converged when its estimates begin.

Missing measurements are missing: the filter in charge has the gains that it has near gaps, and a window is identified from the
samples that it has (`quick_spectrum_of_samples`), those behind its last long gap. Where they are too few the filter goes on.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from wfsobs.observers.base import TARGETS, Look, Observer, Tunable
from wfsobs.observers.estimates import Estimates
from wfsobs.observers.kalman.adaptive_step import AdaptiveEstimator
from wfsobs.observers.kalman.spread import by_name, learnt_sd
from wfsobs.observers.kalman.window_model import NOT_YET, WindowModel, identify_window, lengths, mode_of
from wfsobs.observers.kalman.with_gaps import run_frames
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, RecordError, Sampling
from wfsobs.settings import Group, Real, Section, Whole
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.spectral.model import Spectrum
from wfsobs.typing import Array


class Adaptive(Group):
    """The Kalman filter whose model is re-identified all the time."""

    window = Real(
        4.0,
        bounds=(0.1, 100.0),
        softbounds=(0.5, 10.0),
        step=0.5,
        label="Window",
        doc="Length of the identification window [s]. Peaks closer than two over it are one; a peak that moves is "
        "followed after this time.",
    )
    longest = Real(
        30.0,
        bounds=(0.1, 1000.0),
        softbounds=(4.0, 60.0),
        step=1.0,
        label="Longest window",
        doc="Length to which the window of the multi-rate filter grows while the record is still [s].",
    )
    interval = Real(
        0.5,
        bounds=(0.01, 100.0),
        softbounds=(0.1, 5.0),
        step=0.1,
        label="Interval",
        doc="Time from one identification to the next [s].",
    )
    peak_count = Whole(
        20,
        bounds=(0, 60),
        label="Maximum peaks",
        doc="Maximum number of vibration peaks in the model of one mode; twice as many where the window has grown to twice.",
    )
    lowest = Real(
        5.0,
        bounds=(0.1, 1000.0),
        softbounds=(1.0, 20.0),
        step=0.5,
        label="Minimum frequency",
        doc="Minimum frequency of a peak [Hz]; at least 15 over the window.",
    )
    depth = Whole(
        400,
        bounds=(1, 2000),
        label="Depth of the GPR",
        doc="Samples in a window of the adaptive GPR; at most an eighth of the identification window.",
    )


def kf_adaptive(measurements: Measurements, _prior: Prior, settings: Adaptive, watch: Watch) -> Estimates:
    """Run the filter on the LGS measurement, at every fast step; NaN until the first window is full.

    Raises RecordError for a record shorter than a window, or a window of too few samples.
    """
    window, _ = lengths(settings, measurements.dt)
    needed = window + measurements.delay
    if measurements.n_steps < needed:
        raise RecordError(f"the record has {measurements.n_steps} steps; adaptive.window = {settings.window:g} s needs {needed}")
    if np.isnan(measurements.z).any():
        return run_frames(AdaptiveEstimator(settings, measurements.sampling), measurements, watch)
    z = measurements.z[measurements.delay :]  # what the mirror did before the record is not known
    columns, spreads = [], []
    for mode in range(measurements.n_modes):  # one after the other: steps as short as these leave a second thread no room

        def tell(fraction: float, mode: int = mode) -> None:
            watch.step((mode + fraction) / measurements.n_modes)

        for found, x in zip((columns, spreads), adapt(z[:, mode], measurements.dt, settings, tell), strict=True):
            found.append(np.pad(x, ((measurements.delay, 0), (0, 0)), constant_values=np.nan))
    return Estimates(*(by_name(np.stack(found, axis=-1)) for found in (columns, spreads)))


def adapt(z: Array, dt: float, settings: Adaptive, tell: Callable[[float], None]) -> tuple[Array, Array]:
    """Turbulence and vibration of one mode's z (n,), (n, 2), and standard deviations of these and of both together, (n, 3) [um].

    A window whose model or filter cannot be found leaves the filter before it in charge. tell : told the fraction done
    """
    n, window, interval = len(z), *lengths(settings, dt)
    out, sd = (np.full((n, len(TARGETS) + more), np.nan) for more in (0, 1))
    found = NOT_YET
    for start in range(0, n - window + 1, interval):
        tell(start / n)
        now, stop = start + window - 1, min(start + window - 1 + interval, n)
        found = identify_window(z[start : now + 1], dt, settings, found)
        if found.spectrum is not None:
            mean = z[start : now + 1].mean()  # what does not move in a window is turbulence, whatever its model says
            estimate = found.filter.run((z[start:stop] - mean)[:, None, None])
            out[now:stop] = estimate[window - 1 :, :, 0] + [mean, 0.0]
            if found.mode is not None:
                sd[now:stop] = learnt_sd(found.mode.model.output_rows(TARGETS), found.mode.posterior, found.hidden_rms)
    return out, sd


def filter_of(spectrum: Spectrum) -> PeriodicFilter:
    """Return the steady-state filter of a spectrum: z -> turbulence, vibration. Raises ValueError where there is none."""
    return WindowModel(spectrum, spectrum, mode_of(spectrum)).filter


def step_kf_adaptive(_prior: Prior, settings: Adaptive, sampling: Sampling, _horizon: float) -> AdaptiveEstimator:
    """Return `kf_adaptive`, one frame at a time."""
    return AdaptiveEstimator(settings, sampling)


def seconds(settings: Adaptive, n_steps: int, n_modes: int, dt: float) -> float:
    """3.5 ms + 0.9 us per sample for every window, one mode after the other [s]."""
    windows = max((n_steps - round(settings.window / dt)) // max(round(settings.interval / dt), 1), 0)
    return n_modes * windows * (3.5e-3 + 0.9e-6 * settings.window / dt)


ADAPTIVE = Section("adaptive", "Adaptive Kalman filter", Adaptive)


def identification_settings(_prior: Prior, settings: Adaptive) -> tuple[float, ...]:
    """Return what identifications of windows depend on."""
    return settings.window, settings.interval, settings.peak_count, settings.lowest


KF_ADAPTIVE = Observer(
    "kf-adaptive",
    "Adaptive KF",
    TARGETS,
    kf_adaptive,
    help="Kalman filter that identifies noise, turbulence and peaks in the last 4 s, twice a second; not in the paper",
    settings=ADAPTIVE,
    takes_missing=True,
    tunable=Tunable(("adaptive.window",), ("adaptive.interval",)),  # a shorter interval costs time, which no error shows
    weight=50.0,
    seconds=seconds,
    look=Look("Adaptive KF", "#522C0A", "#F4C173", (20, 2), width=1.8),
    step=step_kf_adaptive,
    counts=identification_settings,
)
