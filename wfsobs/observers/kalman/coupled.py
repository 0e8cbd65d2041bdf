"""The coupled filter: every mode of frozen flow is estimated from the measurements of all modes.

The wind carries what one mode measures into another, and the LGS see through their narrower beams as one mode what is several.
The states of the independent filters of `kf-multi`, one per mode, and running means of every measurement over 0, 3, 9, ...
243 steps are put together by the weights of least variance under the matrix of spectra in the prior (`signal.joint_states`).
Longer means gain a little in an endless record, and lose more in its first seconds. Since the estimates of the independent
filters are among what is weighed, it is no worse than they are where it is told the truth. It is the filter of `kalman.joint` on
one star: `kf-coupled` without an NGS, `multirate-coupled` with one.

Where modes tell nothing of one another, the prior has no such matrix: there is nothing to couple, and the observer refuses.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wfsobs.observers.base import TARGETS, Look, Observer
from wfsobs.observers.kalman.joint import MEANS, AsterismModel, JointEstimator
from wfsobs.observers.kalman.single import NGS, PEAKS, TUNABLE_PEAKS, MultiPeak, vibration_used
from wfsobs.prior import Flow, FlowOfBoth, LgsStars, Lines, Prior
from wfsobs.record import Sampling
from wfsobs.signal.joint_states import StateFilter

INDEPENDENT = "the modes tell nothing of one another: `kf-multi` estimates each by itself"
INDEPENDENT_ON_BOTH = INDEPENDENT.replace("kf-multi", "multirate-multi")
"""Why there is no coupled filter."""


def flow_model(prior: Prior, settings: MultiPeak, means: StateFilter = MEANS) -> AsterismModel:
    """Return the weights of the LGS in all modes; means : of each measurement. Raises ValueError where the prior has no flow."""
    if prior.flow is None:
        raise ValueError(INDEPENDENT)
    star = replace(prior.flow, noise=np.array([one.noise for one in prior.lines]))
    return AsterismModel(replace(prior, asterism=star), settings, 1, means)


def kf_coupled(prior: Prior, settings: MultiPeak, _sampling: Sampling, _horizon: float) -> JointEstimator:
    """Return the filter on the LGS in all modes. Raises ValueError where the prior has no flow."""
    return JointEstimator(flow_model(prior, settings))


def coupled_model(prior: Prior, settings: MultiPeak, ratio: int | None) -> AsterismModel:
    """Return the weights. Raises ValueError where the prior has no flow."""
    if prior.asterism is None:
        raise ValueError(INDEPENDENT_ON_BOTH)
    return AsterismModel(prior, settings, ratio)


def multirate_coupled(prior: Prior, settings: MultiPeak, sampling: Sampling, _horizon: float) -> JointEstimator:
    """Return the filter on all LGS together. Raises ValueError where the prior has no flow."""
    return JointEstimator(coupled_model(prior, settings, sampling.ratio))


KF_COUPLED = Observer(
    "kf-coupled",
    "Coupled KF",
    TARGETS,
    help="Kalman filter on the LGS of all modes together, for frozen flow; not in the paper",
    prior=(Lines, Flow, LgsStars),
    settings=PEAKS,
    linear=True,
    couples_modes=True,
    weight=2.0,
    tunable=TUNABLE_PEAKS,
    look=Look("Coupled", "#D35312", "#D48F4D", (10, 2, 2, 2)),
    step=kf_coupled,
    counts=vibration_used,
)

MULTIRATE_COUPLED = Observer(
    "multirate-coupled",
    "Coupled multi-rate KF",
    TARGETS,
    help="Kalman filter on both sensors in all modes together, for frozen flow; not in the paper",
    prior=(Lines, FlowOfBoth, LgsStars),
    settings=PEAKS,
    needs=NGS,
    linear=True,
    couples_modes=True,
    takes_missing=True,
    sensors=("lgs", "ngs"),
    weight=3.0,
    tunable=TUNABLE_PEAKS,
    look=Look("Coupled, both", "#3806FF", "#2C49F5", (10, 2, 4, 2)),
    step=multirate_coupled,
    counts=vibration_used,
)
