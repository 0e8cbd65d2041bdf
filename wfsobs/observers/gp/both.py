"""Gaussian process regression in time on both sensors: the kernels of `gp.lgs` in the optimal multi-rate filter.

The slow error of the LGS and the NGS frame as the mean that it is are states, as in `kalman.multirate_optimal`; a coloured
background is an error of the LGS, and no part of what a frame is the mean of.
"""

from __future__ import annotations

from wfsobs.observers.base import TARGETS, Look, Observer, Tunable
from wfsobs.observers.estimates import Estimates
from wfsobs.observers.gp.lgs import GP, GaussianProcess, kernels_of, measured_late, sampled_model
from wfsobs.observers.kalman.mode_filter import ModeFilter
from wfsobs.observers.kalman.multirate import MultiRate, run_modes
from wfsobs.observers.kalman.multirate_optimal import Cycle, optimal_model
from wfsobs.observers.kalman.single import NGS
from wfsobs.observers.kalman.step import KalmanEstimator
from wfsobs.prior import LgsError, Lines, Model, Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Sampling


def cycle_of(prior: Prior, settings: GaussianProcess, mode: int, ratio: int) -> Cycle:
    """Return the cycle of one mode."""
    lines = prior.lines[mode]
    model = sampled_model(kernels_of(lines, settings), lines.dt)
    return optimal_model(MultiRate(), prior, mode, ratio, measured_late(model))._replace(model=model)


def gp_both(measurements: Measurements, prior: Prior, settings: GaussianProcess, watch: Watch) -> Estimates:
    """Run the regression over a record."""
    return run_modes(measurements, _filters(prior, settings, measurements.sampling), watch)


def _filters(prior: Prior, settings: GaussianProcess, sampling: Sampling) -> list[ModeFilter]:
    assert sampling.ratio is not None
    return [cycle_of(prior, settings, mode, sampling.ratio).filter() for mode in range(sampling.n_modes)]


def step_gp_both(prior: Prior, settings: GaussianProcess, sampling: Sampling, _horizon: float) -> KalmanEstimator:
    """Return the filters of all modes, one frame at a time."""
    return KalmanEstimator(_filters(prior, settings, sampling))


GP_BOTH = Observer(
    "gp-both",
    "GP in time on both",
    TARGETS,
    gp_both,
    help="that of `gp-lgs` on both sensors; not in the paper",
    prior=(Model, LgsError, Lines),
    settings=GP,
    needs=NGS,
    linear=True,
    takes_missing=True,
    sensors=("lgs", "ngs"),
    tunable=Tunable(("gp.background_rms", "gp.background_scale"), ("kalman.lgs_noise", "kalman.ngs_noise")),
    look=Look("GP, both", "#7A3B00", "#E8B07A", (6, 2, 2, 2, 2, 2), in_figures=False),
    step=step_gp_both,
)
