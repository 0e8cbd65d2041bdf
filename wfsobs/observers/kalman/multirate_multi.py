"""The optimal multi-rate filter that knows every peak: what `kalman.multi` models, from both sensors.

Turbulence of second or third order, one AR(2) per line of the vibration, the slow error of the LGS and the NGS frame as the mean
that it is, with the periodic gains of `kalman.multirate_optimal`.
"""

from __future__ import annotations

from wfsobs.observers.base import TARGETS, Estimates, Look, Observer, Tunable
from wfsobs.observers.kalman.multi import PEAKS, MultiPeak
from wfsobs.observers.kalman.multirate import MultiRate, run_modes
from wfsobs.observers.kalman.multirate_optimal import Cycle, optimal_model, step_filters
from wfsobs.observers.kalman.single import NGS
from wfsobs.observers.kalman.step import KalmanEstimator
from wfsobs.prior import LgsError, Lines, Model, Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Sampling


def every_peak_model(rates: MultiRate, peaks: MultiPeak, prior: Prior, mode: int, ratio: int) -> Cycle:
    """Return the cycle of one mode with every peak of the vibration in its model."""
    return optimal_model(rates, prior, mode, ratio, prior.lines[mode].disturbance(peaks.line_width))


def multirate_multi(measurements: Measurements, prior: Prior, settings: MultiPeak, watch: Watch) -> Estimates:
    """Run the filter over a record."""
    assert measurements.ratio is not None
    ratio, rates = measurements.ratio, MultiRate()
    return run_modes(measurements, watch, lambda mode: every_peak_model(rates, settings, prior, mode, ratio).filter())


def step_multirate_multi(prior: Prior, settings: MultiPeak, sampling: Sampling, _horizon: float) -> KalmanEstimator:
    """Return the filters of all modes, one frame at a time."""
    assert sampling.ratio is not None
    ratio, rates = sampling.ratio, MultiRate()
    return step_filters([every_peak_model(rates, settings, prior, mode, ratio) for mode in range(sampling.n_modes)])


MULTIRATE_MULTI = Observer(
    "multirate-multi",
    "Multi-rate multi-peak KF",
    TARGETS,
    multirate_multi,
    help="both sensors, every line of the scenario in the model; not in the paper",
    prior=(Model, LgsError, Lines),
    settings=PEAKS,
    needs=NGS,
    linear=True,
    sensors=("lgs", "ngs"),
    tunable=Tunable(
        ("multipeak.line_width", "kalman.lgs_noise", "kalman.ngs_noise"),
        ("multipeak.turbulence_order", "kalman.turbulence_rms"),
    ),
    look=Look("Multi-rate, all peaks", "#8C1D00", "#FFB59A", (16, 3, 3, 3)),
    step=step_multirate_multi,
)
