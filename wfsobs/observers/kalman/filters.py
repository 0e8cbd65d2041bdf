"""Steady-state Kalman filters, of one sensor and of both (paper, section 2.2).

Of LGS or NGS measurements alone, `kf-lgs` and `kf-ngs`:

    x_pred[k+1] = A x_hat[k],    x_hat[k] = x_pred[k] + L (z[k] - C x_pred[k])

with the filter gain L = P C' (C P C' + R)^-1; the paper's eq. 9 is the predictor form with K = A L, which uses
y up to k - 1. Here phi_hat[k] uses y[k] too, like the GPR. The mirror's part is known and taken off before.

`kf-multi` is the same filter with one AR(2) per line of the vibration, which the paper expects to help (its conclusion), and, as
an option, turbulence of third order.

Multi-rate: LGS at every step, NGS at every n-th. The paper's, `multirate` (section 2.2.1):

    x_pred[k+1] = A x_hat[k]
    x_hat[k] = x_pred[k] + L_j (z_j[k] - C_j x_pred[k])        (eq. 11)

with two steady-state gains: L_LGS from C_LGS and r_LGS, and L_LGS^NGS from both rows with diag(r_LGS, r_NGS), as if
both came at every step. The paper prints the predictor gain K; the correction of a state that is already
predicted takes the filter gain L. An NGS frame counts as a measurement of phi_dist[k-1], like the LGS.

The optimal one, `multirate-optimal`: periodic gains, and the NGS frame modelled as the mean that it is. To the state of the
disturbance model come the mean of what the running NGS frame has seen so far,

    frame[k+1] = (frame[k], or 0 if a frame has just been read) + phi_dist[k] / n,

so that z_ngs[k] = frame[k] + noise at k = n, 2n, ..., and (an option) the slow AR(2) error of the LGS mean. The gains solve
the periodic Riccati equation of the n steps. Optimal for its model only.

With every peak, `multirate-multi`: one AR(2) per line of the vibration, and turbulence in the beams of target and LGS as sums of
independent processes: in both, in the target's alone, in that of the LGS alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
import param

from wfsobs.observers.base import TARGETS, TURBULENCE, Look, Observer, Tunable
from wfsobs.observers.kalman.step import FrameErrors, FrameEstimator, ModeFilter, kalman_filters, lgs_mean
from wfsobs.observers.stepping import Gain, GainCycle, steady_gains
from wfsobs.prior import Beams, LgsError, LgsModel, LgsStars, Lines, Model, NgsModel, Noise, NoiselessModel, Part, Prior
from wfsobs.record import Sampling
from wfsobs.settings import Group, Real, Section, Whole
from wfsobs.settings.group import UsedWhen
from wfsobs.settings.values import Choice
from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.signal.gains import ONE, SensorMean, SteadyState, Step, periodic_steady_state, posteriors_of_gains, steady_state
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.signal.statespace import DisturbanceModel, blocks_along_diagonal, disturbance_model
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.settings.priors import Kalman


NGS = ("y_ngs", "ratio")
"""Fields that a record with NGS frames has."""

linear_filter: partial[Observer] = partial(Observer, linear=True, takes_missing=True)
"""A linear filter that takes missing measurements as missing."""
filter_of_both: partial[Observer] = partial(linear_filter, needs=NGS, sensors=("lgs", "ngs"))
"""One of both sensors."""

MODEL = ("kalman.frequency", "kalman.damping", "kalman.turbulence_rms", "kalman.vibration_rms")
"""Settings of the model with one peak."""

TUNABLE_PEAKS = Tunable(("multipeak.line_width", "kalman.lgs_noise"), ("multipeak.turbulence_order", "kalman.turbulence_rms"))
"""Of filters with every line in their model."""

MIN_NOISE = 1e-6
"""Floor of a modelled measurement noise [um]: a filter for perfect measurements has no Riccati solution."""


def steady_filter(model: DisturbanceModel, noise: float, outputs: Array | None = None) -> tuple[PeriodicFilter, SteadyState]:
    """Return the steady-state filter of z (1 input), and its covariances; noise [um].

    outputs : rows of the state x_hat[k] to return, (p, n); every target by default
    """
    gains, steady = steady_gains(model, noise)
    return gains.filter(model.output_rows(TARGETS) if outputs is None else outputs), steady


def one_peak_filter(_settings: None, prior: Prior, mode: int, _ratio: int | None) -> ModeFilter:
    """Return the Kalman filter of a mode on the LGS measurement, at every fast step, with one peak."""
    one = prior.model[mode]
    return steady_mode(one.disturbance(), one.lgs_noise, lgs_mean(prior, mode))


def steady_mode(
    model: DisturbanceModel, noise: float, mean: SensorMean = ONE, full: DisturbanceModel | None = None
) -> ModeFilter:
    """Return the steady-state filter of a mode.

    model : of the disturbance;  noise : of a measurement [um];  mean : the LGS whose mean it measures
    full  : the model with more states behind those of the disturbance, by default none
    """
    full = full or model
    gains, steady = steady_gains(full, noise)
    step = full.A, np.atleast_2d(full.C), full.Q, np.array([[noise**2]])
    return ModeFilter(model, gains, (steady.posterior,), (step,), mean)


def kf_ngs(prior: Prior, settings: Kalman, sampling: Sampling, _horizon: float) -> FrameEstimator:
    """Return the Kalman filters of all modes on NGS frames, with the coefficients for T_NGS.

    A frame at k = n i measures slow step i - 1 (fast steps k - n ... k - 1); the estimate is that of slow
    step i, the fast steps k ... k + n - 1. It is held over them, or propagated by the fast model.
    """
    assert sampling.ratio is not None
    n, how = sampling.ratio, settings.ngs_between_frames
    modes = [steady_mode(one.at(n * sampling.dt).disturbance(), one.ngs_noise) for one in prior.model]
    errors = [
        FrameErrors(model.disturbance(), mode.gains.steps[0], n, model.ngs_noise)
        for mode, model in zip(modes, prior.model, strict=True)
    ]
    return FrameEstimator(modes, errors, partial(_spread, prior.model, modes, n, how), holds=how == "hold")


def _spread(models: Sequence[Model], modes: Sequence[ModeFilter], n: int, how: str, mode: int, target: str, since: int) -> Array:
    """Return the row of the slow filter's state that gives a target, some fast steps since the frame."""
    model, at = models[mode], TARGETS.index(target)
    weights = between_frames((model.turbulence, model.vibration)[at], n, how, max(since + 1, n))[since]
    return weights @ modes[mode].model.pairs[2 * at : 2 * at + 2]


def between_frames(process: Ar2, n: int, how: str, steps: int | None = None) -> Array:
    """Weights (steps, 2) of the slow estimates i and i - 1, both given frame i, in those of the fast steps from n i on.

    hold: (1, 0). propagate: the conditional mean of phi[n i + j] given the two slow means under the fast
    model, Cov(phi, s) Cov(s)^-1. steps : the n of slow step i unless given.
    """
    steps = n if steps is None else steps
    if how == "hold" or process.rms == 0:
        return np.column_stack([np.ones(steps), np.zeros(steps)])
    r = process.autocovariance(n + steps)
    lag = np.abs(np.subtract.outer(np.arange(n + steps), np.arange(2 * n)))
    covariance = r[lag]  # of fast steps n (i - 1) ... n i + steps - 1 with n (i - 1) ... n (i + 1) - 1
    means = np.kron(np.eye(2), np.full((1, n), 1.0 / n))[::-1]  # rows: slow step i, slow step i - 1
    cross, between = covariance[n:] @ means.T, means @ covariance[: 2 * n] @ means.T
    return np.linalg.lstsq(between, cross.T, rcond=1e-14)[0].T


def way_between(_prior: Prior, settings: Kalman) -> str:
    """Return what of the settings the filter of the NGS has beside its prior."""
    return settings.ngs_between_frames


KF_LGS = linear_filter(
    "kf-lgs",
    "LGS KF",
    TARGETS,
    help="steady-state Kalman filter on the LGS, one vibration peak in its model",
    prior=(LgsModel, LgsStars),
    # The gain depends on the ratios of turbulence, vibration and noise. Turbulence tuned for vibration would be no turbulence.
    tunable=Tunable((*MODEL[:2], "kalman.vibration_rms"), ("kalman.turbulence_rms", "kalman.lgs_noise")),
    look=Look("LGS KF", "#FF6600", "#FF8533"),
    step=partial(kalman_filters, one_peak_filter),
)

KF_NGS = linear_filter(
    "kf-ngs",
    "NGS KF",
    (TURBULENCE,),
    help="steady-state Kalman filter on the NGS, its frames held or spread between them",
    prior=(NgsModel,),
    settings="kalman",
    needs=NGS,
    sensors=("ngs",),
    tunable=Tunable(("kalman.turbulence_rms", "kalman.vibration_rms"), (*MODEL[:2], "kalman.ngs_noise")),
    look=Look("NGS KF", "#003DE6", "#7AA2FF", (8, 2)),
    step=kf_ngs,
    counts=way_between,
)


class MultiPeak(Group):
    """The Kalman filters with every peak of the scenario in their models."""

    turbulence_order: Whole = Whole(
        2,
        bounds=(2, 3),
        label="Order of the turbulence model",
        doc="2: the AR(2) of the paper; 3: one more pole, fitted to the scenario's true spectrum.",
    )
    line_width: Real = Real(
        0.025,
        bounds=(1e-4, 10.0),
        softbounds=(0.005, 1.0),
        label="Minimum line width",
        doc="Minimum line width (FWHM) in the model [Hz]; the filter averages over its inverse.",
    )


def every_peak_filter(settings: MultiPeak, prior: Prior, mode: int, _ratio: int | None = None) -> ModeFilter:
    """Return the Kalman filter of a mode on the LGS measurement, at every fast step, with every peak."""
    one = prior.lines[mode]
    return steady_mode(one.disturbance(settings.line_width), one.noise, lgs_mean(prior, mode))


def vibration_used(prior: Prior, settings: MultiPeak) -> list[list[Ar2]]:
    """Return the vibration of every mode as it is modelled: a minimum below the width of every line is none."""
    return [one.vibration(settings.line_width) for one in prior.lines]


PEAKS = Section("multipeak", "Multi-peak Kalman filter", MultiPeak)

KF_MULTI = linear_filter(
    "kf-multi",
    "Multi-peak KF",
    TARGETS,
    help="Kalman filter on the LGS with every vibration peak in its model; not in the paper",
    prior=(Lines, LgsStars),
    settings=PEAKS,
    tunable=TUNABLE_PEAKS,
    look=Look("Multi-peak", "#AE7D40", "#BA6A26", (14, 3)),
    step=partial(kalman_filters, every_peak_filter),
    counts=vibration_used,
)


class MultiRate(Group):
    """Noise weights of the multi-rate Kalman filter."""

    used_when: ClassVar[UsedWhen] = MappingProxyType(
        {"lgs_noise": ("measurement_noise", ("manual",)), "ngs_noise": ("measurement_noise", ("manual",))}
    )

    measurement_noise: Choice = Choice(
        ["matched", "manual"],
        label="Measurement noise R",
        doc="matched: as in the Kalman filters; manual: the two numbers below, r_NGS < r_LGS (paper, section 2.2.1).",
    )
    lgs_noise: Real = Real(
        0.05,
        bounds=(1e-6, 100.0),
        softbounds=(0.001, 0.2),
        label="Weight of LGS",
        doc="Square root of r_LGS [um], for measurement noise manual.",
    )
    ngs_noise: Real = Real(
        0.01,
        bounds=(1e-6, 100.0),
        softbounds=(0.001, 0.2),
        label="Weight of NGS",
        doc="Square root of r_NGS [um], for measurement noise manual.",
    )
    model_lgs_error: param.Boolean[bool] = param.Boolean(
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
) -> PeriodicFilter:
    """Return the filter of `multirate_gains`, whose step 0 has no NGS frame; its cycle begins at k = 1, the frame last.

    outputs : rows of the state x_hat[k] to return, (p, n); every target by default. Raises UnstableCycle.
    """
    gains = multirate_gains(model, ratio, lgs_noise, ngs_noise)
    return gains.recursion(model.output_rows(TARGETS) if outputs is None else outputs)


def multirate_mode(settings: MultiRate, prior: Prior, mode: int, ratio: int) -> ModeFilter:
    """Return the paper's filter of a mode; near gaps it has more gains than two: those of the covariance as it is there.

    Raises UnstableCycle.
    """
    model, (lgs_noise, ngs_noise) = prior.model[mode].disturbance(), multirate_noise(settings, prior.noise_of(mode))
    gains = multirate_gains(model, ratio, lgs_noise, ngs_noise)
    R, last = np.diag([lgs_noise**2, ngs_noise**2]), gains.steps[-1]
    cycle = tuple((A, C if step is last else C * [[1.0], [0.0]], model.Q, R) for step in gains.steps for A, C, _ in [step])
    posteriors = posteriors_of_gains([(A, C, model.Q, R) for A, C, _ in gains.steps], [step.L for step in gains.steps])
    return ModeFilter(model, gains, tuple(posteriors), cycle, lgs_mean(prior, mode))


def noise_used(prior: Prior, settings: MultiRate) -> list[tuple[float, float]]:
    """Return the noise of both sensors in every mode."""
    return [multirate_noise(settings, prior.noise_of(mode)) for mode in range(len(prior.model))]


MULTIRATE = filter_of_both(
    "multirate",
    "Multi-rate KF",
    (TURBULENCE,),
    help="Kalman filter on the LGS at every step and the NGS at every n-th, two gains",
    prior=(NoiselessModel, LgsStars),
    asks=matched_noise,
    settings=RATES,
    tunable=TUNABLE,
    look=Look("Multi-rate KF", "#E31FFF", "#7E75C8", (10, 2, 2, 2)),
    step=partial(kalman_filters, multirate_mode),
    counts=noise_used,
)


def optimal_cycle(
    model: DisturbanceModel, ratio: int, lgs_noise: float, ngs_noise: float, lgs_error: Sequence[Ar2 | Ar3] = ()
) -> list[Step]:
    """Return (A, C, Q, R) of the steps k = 1 ... n, the NGS frame at the last; noises as standard deviations [um].

    State (disturbance model, slow LGS errors if any, frame). C has two rows at every step, LGS and NGS; where there is no
    frame the second is zero. Steps without a frame are one and the same.
    """
    A0, C0, Q0 = model.A, model.C, model.Q
    now = sum(model.outputs.values()) / ratio
    if lgs_error:
        error = disturbance_model(lgs_error, ())
        A0, Q0 = blocks_along_diagonal([A0, error.A]), blocks_along_diagonal([Q0, error.Q])
        C0, now = np.append(C0, error.C), np.append(now, np.zeros(len(error.A)))
    n = len(A0)
    R = np.diag([lgs_noise**2, ngs_noise**2])
    Q = np.zeros((n + 1, n + 1))
    Q[:n, :n] = Q0

    def step(frame: bool) -> Step:
        A, C = np.zeros((n + 1, n + 1)), np.zeros((2, n + 1))
        A[:n, :n], A[n, :n], A[n, n] = A0, now, float(not frame)
        C[0, :n], C[1, n] = C0, float(frame)
        return A, C, Q, R

    return [*([step(False)] * (ratio - 1)), step(True)]


def optimal_gains(cycle: list[Step]) -> tuple[GainCycle, list[SteadyState]]:
    """Return the gains of a cycle, and its covariances at steps 1 ... n.

    Step 0, before the first frame, measures the LGS alone and starts the frame anew.
    """
    states = periodic_steady_state(cycle)
    A, C, _, R = cycle[-1]
    alone = C * [[1.0], [0.0]]
    L = np.linalg.solve(alone @ states[-1].P @ alone.T + R, alone @ states[-1].P).T
    steps = [Gain(A, C, s.L) for (A, C, _, _), s in zip(cycle, states, strict=True)]
    return GainCycle(steps, Gain(A, alone, L)), states


def optimal_filter(cycle: list[Step], outputs: Array) -> tuple[PeriodicFilter, list[SteadyState]]:
    """Return the filter of `optimal_gains` and the covariances; outputs (p, n_states) rows of the state."""
    gains, states = optimal_gains(cycle)
    return gains.recursion(outputs), states


class Cycle(NamedTuple):
    """What is estimated in one mode.

    steps : (A, C, Q, R) of the steps
    model : of the disturbance alone;  has_lgs_error : whether the slow error of the LGS is among the states
    """

    steps: list[Step]
    model: DisturbanceModel
    has_lgs_error: bool = False

    def filter(self, prior: Prior | None = None, mode: int = 0) -> ModeFilter:
        """Return the optimal filter on the LGS of a prior, by default one."""
        (gains, states), mean = optimal_gains(self.steps), lgs_mean(prior or Prior(), mode, self.has_lgs_error)
        return ModeFilter(self.model, gains, tuple(state.posterior for state in states), tuple(self.steps), mean)


def optimal_model(settings: MultiRate, prior: Prior, mode: int, ratio: int, model: DisturbanceModel | None = None) -> Cycle:
    """Return the cycle of one mode; model: of the disturbance, by default that of one peak."""
    model = model or prior.model[mode].disturbance()
    error = [prior.lgs_error[mode].process] if settings.model_lgs_error else []
    return estimated_cycle(model, ratio, *multirate_noise(settings, prior.noise_of(mode)), error)


def estimated_cycle(
    model: DisturbanceModel, ratio: int, lgs_noise: float, ngs_noise: float, lgs_error: Sequence[Ar2 | Ar3]
) -> Cycle:
    """Return `optimal_cycle` with what it is of."""
    return Cycle(optimal_cycle(model, ratio, lgs_noise, ngs_noise, lgs_error), model, bool(lgs_error))


def optimal_mode(settings: MultiRate, prior: Prior, mode: int, ratio: int) -> ModeFilter:
    """Return the optimal filter of a mode with one peak."""
    return optimal_model(settings, prior, mode, ratio).filter(prior, mode)


MULTIRATE_OPTIMAL = filter_of_both(
    "multirate-optimal",
    "Optimal multi-rate KF",
    TARGETS,
    help="Kalman filter on both sensors with periodic gains, NGS frames as means; not in the paper",
    prior=(NoiselessModel, LgsError, LgsStars),
    asks=matched_noise,
    settings=RATES,
    tunable=TUNABLE,
    look=Look("Opt. multi-rate", "#5718C1", "#B848F9", (3, 2)),
    step=partial(kalman_filters, optimal_mode),
)


def every_peak_model(peaks: MultiPeak, prior: Prior, mode: int, ratio: int) -> Cycle:
    """Return the cycle of one mode with every peak of the vibration in its model."""
    beams, noise = prior.beams[mode], prior.noise_of(mode)
    model = beam_model(beams, prior.lines[mode].vibration(peaks.line_width))
    return estimated_cycle(model, ratio, noise.lgs_noise, noise.ngs_noise, beams.lgs)


def optimal_mode_of_peaks(peaks: MultiPeak, prior: Prior, mode: int, ratio: int) -> ModeFilter:
    """Return the optimal filter of a mode with every peak."""
    return every_peak_model(peaks, prior, mode, ratio).filter(prior, mode)


def beam_model(beams: Beams, vibration: Sequence[Ar2]) -> DisturbanceModel:
    """Return the model of the target's disturbance, measured as the LGS see it but for what they see alone."""
    turbulence = (*beams.common, *beams.target)
    model = disturbance_model(turbulence, vibration)
    gains = [*[beams.gain] * len(beams.common), *[0.0] * len(beams.target), *[beams.line_gain] * len(vibration)]
    poles = [3 if isinstance(process, Ar3) else 2 for process in (*turbulence, *vibration)]
    return replace(model, C=model.C * np.repeat(gains, poles))


MULTIRATE_MULTI = filter_of_both(
    "multirate-multi",
    "Multi-rate multi-peak KF",
    TARGETS,
    help="Kalman filter on both sensors with every vibration peak in its model; not in the paper",
    prior=(Noise, LgsStars, Lines, Beams),
    settings=PEAKS,
    tunable=Tunable(
        ("multipeak.line_width", "kalman.lgs_noise", "kalman.ngs_noise"),
        ("multipeak.turbulence_order", "kalman.turbulence_rms"),
    ),
    look=Look("Multi-rate multi-peak", "#AB64CF", "#F26FF3", (16, 3, 3, 3)),
    step=partial(kalman_filters, optimal_mode_of_peaks),
    counts=vibration_used,
)
