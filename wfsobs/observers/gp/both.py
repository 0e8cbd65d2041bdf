"""Gaussian process regression in time on both sensors: the kernels of `gp.lgs` in the optimal multi-rate filter.

The slow error of the LGS and the NGS frame as the mean that it is are states, as in `kalman.multirate_optimal`; a coloured
background is an error of the LGS, and no part of what a frame is the mean of.
"""

from __future__ import annotations

from wfsobs.observers.base import TARGETS, Look, Observer, Tunable
from wfsobs.observers.gp.lgs import GP, GaussianProcess, kernels_of, measured_late, sampled_model
from wfsobs.observers.kalman.multirate import MultiRate
from wfsobs.observers.kalman.multirate_optimal import Cycle, OptimalFilters, optimal_model
from wfsobs.observers.kalman.single import NGS
from wfsobs.prior import LgsError, LgsStars, Lines, Noise, Prior


def cycle_of(settings: GaussianProcess, prior: Prior, mode: int, ratio: int) -> Cycle:
    """Return the cycle of one mode."""
    lines = prior.lines[mode]
    model = sampled_model(kernels_of(lines, settings), lines.dt)
    return optimal_model(MultiRate(), prior, mode, ratio, measured_late(model))._replace(model=model)


_FILTERS = OptimalFilters(cycle_of)

GP_BOTH = Observer(
    "gp-both",
    "GP on both sensors",
    TARGETS,
    _FILTERS.run,
    help="Gaussian process in time on both sensors; not in the paper",
    prior=(Noise, LgsError, LgsStars, Lines),
    settings=GP,
    needs=NGS,
    linear=True,
    weight=2.0,
    takes_missing=True,
    sensors=("lgs", "ngs"),
    tunable=Tunable(("gp.background_rms", "gp.background_scale"), ("kalman.lgs_noise", "kalman.ngs_noise")),
    look=Look("GP, both", "#55A17F", "#03E49C", (6, 2, 2, 2, 2, 2)),
    step=_FILTERS.step,
)
