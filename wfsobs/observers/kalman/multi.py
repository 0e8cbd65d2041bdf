"""The Kalman filter that knows every peak, which the paper expects to help (its conclusion).

The filter is that of `kalman.single`, its model one AR(2) per line of the vibration and, as an option, turbulence of third order.
"""

from __future__ import annotations

from wfsobs.observers.base import TARGETS, Look, Observer, Tunable
from wfsobs.observers.estimates import Estimates
from wfsobs.observers.kalman.mode_filter import ModeFilter, lgs_mean
from wfsobs.observers.kalman.single import run_steady, steady_mode
from wfsobs.observers.kalman.step import KalmanEstimator
from wfsobs.prior import LgsStars, Lines, Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Sampling
from wfsobs.settings import Group, Real, Section, Whole
from wfsobs.signal.ar2 import Ar2


class MultiPeak(Group):
    """The Kalman filters with every peak of the scenario in their models."""

    turbulence_order = Whole(
        2,
        bounds=(2, 3),
        label="Order of the turbulence model",
        doc="2: the AR(2) of the paper; 3: one more pole, fitted to the scenario's true spectrum.",
    )
    line_width = Real(
        0.025,
        bounds=(1e-4, 10.0),
        softbounds=(0.005, 1.0),
        label="Minimum line width",
        doc="Minimum line width (FWHM) in the model [Hz]; the filter averages over its inverse.",
    )


def kf_multi(measurements: Measurements, prior: Prior, settings: MultiPeak, watch: Watch) -> Estimates:
    """Run the filter on the LGS measurement, at every fast step."""
    return run_steady(measurements, independent_filters(prior, settings), watch)


def independent_filters(prior: Prior, settings: MultiPeak) -> list[ModeFilter]:
    """Return the steady-state filters of all modes, each of its own."""
    found = [steady_mode(one.disturbance(settings.line_width), one.noise) for one in prior.lines]
    return [one._replace(mean=lgs_mean(prior, mode)) for mode, one in enumerate(found)]


def vibration_used(prior: Prior, settings: MultiPeak) -> list[list[Ar2]]:
    """Return the vibration of every mode as it is modelled: a minimum below the width of every line is none."""
    return [one.vibration(settings.line_width) for one in prior.lines]


def step_kf_multi(prior: Prior, settings: MultiPeak, _sampling: Sampling, _horizon: float) -> KalmanEstimator:
    """Return the filters of all modes, one frame at a time."""
    return KalmanEstimator(independent_filters(prior, settings))


PEAKS = Section("multipeak", "Multi-peak Kalman filter", MultiPeak)

KF_MULTI = Observer(
    "kf-multi",
    "Multi-peak KF",
    TARGETS,
    kf_multi,
    help="Kalman filter on the LGS with every vibration peak in its model; not in the paper",
    prior=(Lines, LgsStars),
    settings=PEAKS,
    linear=True,
    takes_missing=True,
    tunable=Tunable(("multipeak.line_width", "kalman.lgs_noise"), ("multipeak.turbulence_order", "kalman.turbulence_rms")),
    look=Look("Multi-peak", "#AE7D40", "#BA6A26", (14, 3)),
    step=step_kf_multi,
    counts=vibration_used,
)
