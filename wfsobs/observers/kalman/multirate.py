"""The paper's multi-rate Kalman filter: LGS at every step, NGS at every n-th (section 2.2.1).

    x_pred[k+1] = A x_hat[k]
    x_hat[k] = x_pred[k] + L_j (z_j[k] - C_j x_pred[k])        (eq. 11)

with two steady-state gains: L_LGS from C_LGS and r_LGS, and L_LGS^NGS from both rows with diag(r_LGS, r_NGS), as if
both came at every step. The paper prints the predictor gain K; the correction of a state that is already
predicted takes the filter gain L. An NGS frame counts as a measurement of phi_dist[k-1], like the LGS.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import param

from wfsobs.observers.base import TARGETS, TURBULENCE, Look, Observer, Tunable
from wfsobs.observers.estimates import Estimates
from wfsobs.observers.kalman.mode_filter import ModeFilter, lgs_mean
from wfsobs.observers.kalman.single import MODEL, NGS
from wfsobs.observers.kalman.spread import by_target
from wfsobs.observers.kalman.step import KalmanEstimator
from wfsobs.observers.kalman.with_gaps import run_frames
from wfsobs.prior import LgsStars, Model, Noise, NoiselessModel, Part, Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements, Sampling
from wfsobs.settings import Group, Real, Section
from wfsobs.signal.filter_covariance import posteriors_of_gains
from wfsobs.signal.periodic import FilterStep, PeriodicFilter
from wfsobs.signal.riccati import steady_state
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.signal.stepping import Gain, GainCycle
from wfsobs.typing import Array


class MultiRate(Group):
    """Noise weights of the multi-rate Kalman filter."""

    used_when = MappingProxyType(
        {"lgs_noise": ("measurement_noise", ("manual",)), "ngs_noise": ("measurement_noise", ("manual",))}
    )

    measurement_noise = param.Selector(
        default="matched",
        objects=["matched", "manual"],
        label="Measurement noise R",
        doc="matched: as in the Kalman filters; manual: the two numbers below, r_NGS < r_LGS (paper, section 2.2.1).",
    )
    lgs_noise = Real(
        0.05,
        bounds=(1e-6, 100.0),
        softbounds=(0.001, 0.2),
        label="Weight of LGS",
        doc="Square root of r_LGS [um], for measurement noise manual.",
    )
    ngs_noise = Real(
        0.01,
        bounds=(1e-6, 100.0),
        softbounds=(0.001, 0.2),
        label="Weight of NGS",
        doc="Square root of r_NGS [um], for measurement noise manual.",
    )
    model_lgs_error = param.Boolean(
        True,
        label="LGS error in the optimal filter",
        doc="Include the slow LGS error in the model of the optimal multi-rate filter, as a state of its own; without "
        "it the filter relies far too much on the LGS.",
    )


RATES = Section("multirate", "Multi-rate filter", MultiRate)

TUNABLE = Tunable(("multirate.lgs_noise", "multirate.ngs_noise"), MODEL)


class UnstableCycle(ValueError):
    """Two gains, each stable, that make an unstable cycle."""


def multirate_noise(settings: MultiRate, noise: Model | Noise) -> tuple[float, float]:
    """Square roots of r_LGS and r_NGS [um] in one mode: those of the settings, or as told."""
    own = settings.measurement_noise == "manual"
    return (settings.lgs_noise, settings.ngs_noise) if own else (noise.lgs_noise, noise.ngs_noise)


def matched_noise(settings: MultiRate) -> tuple[Part, ...]:
    """Return the noise, where it is not that of the settings."""
    return () if settings.measurement_noise == "manual" else (Noise,)


@dataclass(frozen=True)
class MultiRateFilter:
    """first: (F, G, H, J) of step 0, which has no NGS frame; cycle: the steps from k = 1 on, the frame last."""

    first: FilterStep
    cycle: PeriodicFilter

    def run(self, z: Array) -> Array:
        """Filter z (n_steps, 2) = (z_lgs, z_ngs), any number where there is no frame; (n_steps, n_targets)."""
        _, G, _, J = self.first
        start = z[0] * [1.0, 0.0]
        rest = self.cycle.run(z[1:, :, None], (G @ start)[:, None])[:, :, 0]
        return np.vstack([J @ start, rest])


def filter_of_gains(gains: GainCycle, outputs: Array) -> MultiRateFilter:
    """Return the filter with these outputs (p, n) of the state."""
    assert gains.first is not None
    return MultiRateFilter(gains.first.filter_step(outputs), gains.filter(outputs))


def multirate_gains(model: DisturbanceModel, ratio: int, lgs_noise: float, ngs_noise: float) -> GainCycle:
    """Return the gains for an NGS frame every `ratio` steps; lgs_noise, ngs_noise: square roots of r [um].

    Raises UnstableCycle.
    """
    C_lgs, C_both = np.atleast_2d(model.C), np.vstack([model.C, model.C])
    L_lgs = steady_state(model.A, C_lgs, model.Q, np.array(lgs_noise**2)).L
    L_both = steady_state(model.A, C_both, model.Q, np.diag([lgs_noise**2, ngs_noise**2])).L
    alone = Gain(model.A, C_both, np.hstack([L_lgs, np.zeros_like(L_lgs)]))
    gains = GainCycle([*([alone] * (ratio - 1)), Gain(model.A, C_both, L_both)], alone)
    radius = np.abs(np.linalg.eigvals(gains.filter(np.zeros((0, len(model.A)))).cycle_matrix())).max()
    if radius >= 1.0:
        raise UnstableCycle(
            f"multi-rate filter: the cycle of {ratio} steps is unstable (spectral radius {radius:.3g}) with LGS noise "
            f"{lgs_noise * 1e3:.4g} nm and NGS noise {ngs_noise * 1e3:.4g} nm; bring the two closer together"
        )
    return gains


def multirate_filter(
    model: DisturbanceModel, ratio: int, lgs_noise: float, ngs_noise: float, outputs: Array | None = None
) -> MultiRateFilter:
    """Return the filter of `multirate_gains`.

    outputs : rows of the state x_hat[k] to return, (p, n); every target by default. Raises UnstableCycle.
    """
    gains = multirate_gains(model, ratio, lgs_noise, ngs_noise)
    return filter_of_gains(gains, model.output_rows(TARGETS) if outputs is None else outputs)


def multirate_posteriors(model: DisturbanceModel, gains: GainCycle, lgs_noise: float, ngs_noise: float) -> list[Array]:
    """Return the covariances after the measurement at steps 1 ... n, by the model that the gains are of."""
    R = np.diag([lgs_noise**2, ngs_noise**2])
    return posteriors_of_gains([(A, C, model.Q, R) for A, C, _ in gains.steps], [step.L for step in gains.steps])


def run_modes(measurements: Measurements, modes: Sequence[ModeFilter], watch: Watch) -> Estimates:
    """Run the filters of all modes on both sensors."""
    n, z_ngs = measurements.ratio, measurements.z_ngs
    assert n is not None
    if measurements.lgs_stars is not None or np.isnan(measurements.z).any() or np.isnan(z_ngs[n::n]).any():
        return run_frames(KalmanEstimator(modes), measurements, watch)
    z = np.stack([measurements.z, np.nan_to_num(z_ngs)], axis=1)
    columns, sd = [], []
    for mode, one in enumerate(modes):
        watch.step(mode / measurements.n_modes)
        rows = one.rows(TARGETS)
        columns.append(filter_of_gains(one.gains, rows).run(z[:, :, mode]))
        sd.append(one.steady_sd())
    return by_target(columns, sd, first=1)


def multirate(measurements: Measurements, prior: Prior, settings: MultiRate, watch: Watch) -> Estimates:
    """Run the multi-rate filter over a record, for turbulence."""
    assert measurements.ratio is not None
    both = run_modes(measurements, _filters(prior, settings, measurements.ratio), watch)
    return Estimates({TURBULENCE: both[TURBULENCE]}, {TURBULENCE: both.sd[TURBULENCE]})


def _filters(prior: Prior, settings: MultiRate, ratio: int) -> list[ModeFilter]:
    """Return the filters of all modes."""
    noises = noise_used(prior, settings)
    found = [multirate_mode(one.disturbance(), ratio, *noise) for one, noise in zip(prior.model, noises, strict=True)]
    return [one._replace(mean=lgs_mean(prior, mode)) for mode, one in enumerate(found)]


def multirate_mode(model: DisturbanceModel, ratio: int, lgs_noise: float, ngs_noise: float) -> ModeFilter:
    """Return the filter of a mode; near gaps it has more gains than two: those of the covariance as it is there.

    Raises UnstableCycle.
    """
    gains = multirate_gains(model, ratio, lgs_noise, ngs_noise)
    R, last = np.diag([lgs_noise**2, ngs_noise**2]), gains.steps[-1]
    cycle = tuple((A, C if step is last else C * [[1.0], [0.0]], model.Q, R) for step in gains.steps for A, C, _ in [step])
    return ModeFilter(model, gains, tuple(multirate_posteriors(model, gains, lgs_noise, ngs_noise)), cycle)


def noise_used(prior: Prior, settings: MultiRate) -> list[tuple[float, float]]:
    """Return the noise of both sensors in every mode."""
    return [multirate_noise(settings, prior.noise_of(mode)) for mode in range(len(prior.model))]


def step_multirate(prior: Prior, settings: MultiRate, sampling: Sampling, _horizon: float) -> KalmanEstimator:
    """Return the filters of all modes, one frame at a time."""
    assert sampling.ratio is not None
    return KalmanEstimator(_filters(prior, settings, sampling.ratio))


MULTIRATE = Observer(
    "multirate",
    "Multi-rate KF",
    (TURBULENCE,),
    multirate,
    help="Kalman filter on the LGS at every step and the NGS at every n-th, two gains",
    prior=(NoiselessModel, LgsStars),
    asks=matched_noise,
    settings=RATES,
    needs=NGS,
    linear=True,
    takes_missing=True,
    sensors=("lgs", "ngs"),
    tunable=TUNABLE,
    look=Look("Multi-rate KF", "#E31FFF", "#7E75C8", (10, 2, 2, 2)),
    step=step_multirate,
    counts=noise_used,
)
