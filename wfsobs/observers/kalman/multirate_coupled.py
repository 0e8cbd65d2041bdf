"""The coupled filter of both sensors: every mode of frozen flow from the LGS together and the NGS frames, in all modes.

It is the filter of `kalman.asterism` with the mean of the LGS, or what `sensors.lgs_combination` makes of them, in the place of a
single star: for LGS that see the same, and where a record or a loop has them together alone. Where modes tell nothing of one
another there is nothing to couple, and the observer refuses.

A measurement of which a mode is missing is none: the weights are those of the NGS alone until the next. So is an NGS frame.
"""

from __future__ import annotations

from wfsobs.observers.base import TARGETS, Look, Observer, Tunable
from wfsobs.observers.estimates import Estimates
from wfsobs.observers.kalman.asterism_model import AsterismModel
from wfsobs.observers.kalman.joint_run import run_joint
from wfsobs.observers.kalman.joint_step import JointEstimator
from wfsobs.observers.kalman.multi import PEAKS, MultiPeak, vibration_used
from wfsobs.observers.kalman.single import NGS
from wfsobs.prior import FlowOfBoth, Lines, Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Sampling
from wfsobs.typing import Array

INDEPENDENT = "the modes tell nothing of one another: `multirate-multi` estimates each by itself"
"""Why there is no coupled filter."""


class CoupledFramesEstimator(JointEstimator):
    """The filter one frame at a time."""

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        self.advance_each(z[None], ngs)


def coupled_model(prior: Prior, settings: MultiPeak, ratio: int | None) -> AsterismModel:
    """Return the weights. Raises ValueError where the prior has no flow."""
    if prior.asterism is None:
        raise ValueError(INDEPENDENT)
    return AsterismModel(prior, settings, ratio)


def multirate_coupled(measurements: Measurements, prior: Prior, settings: MultiPeak, watch: Watch) -> Estimates:
    """Run the filter over a record."""
    estimator = CoupledFramesEstimator(coupled_model(prior, settings, measurements.ratio))
    return run_joint(estimator, measurements.z[:, None], measurements, watch)


def step_multirate_coupled(prior: Prior, settings: MultiPeak, sampling: Sampling, _horizon: float) -> CoupledFramesEstimator:
    """Return the filter one frame at a time."""
    return CoupledFramesEstimator(coupled_model(prior, settings, sampling.ratio))


MULTIRATE_COUPLED = Observer(
    "multirate-coupled",
    "Coupled multi-rate KF",
    TARGETS,
    multirate_coupled,
    help="Kalman filter on both sensors in all modes together, for frozen flow; not in the paper",
    prior=(Lines, FlowOfBoth),
    settings=PEAKS,
    needs=NGS,
    linear=True,
    couples_modes=True,
    takes_missing=True,
    sensors=("lgs", "ngs"),
    weight=3.0,
    tunable=Tunable(("multipeak.line_width", "kalman.lgs_noise"), ("multipeak.turbulence_order", "kalman.turbulence_rms")),
    look=Look("Coupled, both", "#5343AF", "#9E6FA9", (10, 2, 4, 2)),
    step=step_multirate_coupled,
    counts=vibration_used,
)
