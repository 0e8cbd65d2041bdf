"""The filter of an asterism: every mode from each LGS by itself in all modes, and from the NGS frames.

LGS beside the axis see different turbulence, and each tells something that their mean does not. Of what is told of the layers
follow the spectra between the target, all modes in every beam and the NGS (prior `Asterism`). The LGS are taken as their mean and
orthonormal differences, whose noise is independent; vibration is in the mean and in the NGS alone. The states of the independent
filters of `kalman.multi` on the mean, running means of every measurement, and running means of the NGS frames are put together by
the weights of least variance (`signal.joint_states`, `signal.frame_shares`); they repeat with the NGS frames.
What is done while stars or frames are missing is in `kalman.joint_step`.
"""

from __future__ import annotations

from wfsobs.observers.base import TARGETS, Look, Observer, Tunable
from wfsobs.observers.estimates import Estimates
from wfsobs.observers.kalman.asterism_model import AsterismModel
from wfsobs.observers.kalman.joint_run import run_joint
from wfsobs.observers.kalman.joint_step import JointEstimator
from wfsobs.observers.kalman.multi import PEAKS, MultiPeak, vibration_used
from wfsobs.prior import Asterism, Lines, Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Sampling
from wfsobs.typing import Array


class AsterismEstimator(JointEstimator):
    """The filter one frame at a time."""

    _each: Array | None = None

    @property
    def each_shape(self) -> tuple[int, int]:
        """Return (n_lgs, n_modes)."""
        return self.x.shape[0], self.x.shape[1]

    def see_each(self, each: Array) -> None:
        """Take the measurement of every LGS in the next frame, (n_lgs, n_modes) [um]."""
        self._each = each

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        assert self._each is not None
        self.advance_each(self._each, ngs)


def kf_asterism(measurements: Measurements, prior: Prior, settings: MultiPeak, watch: Watch) -> Estimates:
    """Run the filter over a record."""
    estimator = AsterismEstimator(AsterismModel(prior, settings, measurements.ratio))
    return run_joint(estimator, measurements.z_stars, measurements, watch)


def step_kf_asterism(prior: Prior, settings: MultiPeak, sampling: Sampling, _horizon: float) -> AsterismEstimator:
    """Return the filter one frame at a time."""
    return AsterismEstimator(AsterismModel(prior, settings, sampling.ratio))


KF_ASTERISM = Observer(
    "kf-asterism",
    "Asterism KF",
    TARGETS,
    kf_asterism,
    help="Kalman filter on each LGS by itself in all modes and the NGS, for frozen flow; not in the paper",
    prior=(Lines, Asterism),
    settings=PEAKS,
    needs=("y_stars", "y_ngs", "ratio"),
    linear=True,
    couples_modes=True,
    sensors=("lgs", "ngs"),
    weight=5.0,
    tunable=Tunable(("multipeak.line_width", "kalman.lgs_noise"), ("multipeak.turbulence_order", "kalman.turbulence_rms")),
    look=Look("Asterism", "#923222", "#F5B022", (8, 2, 2, 2)),
    step=step_kf_asterism,
    counts=vibration_used,
)
