"""Control laws: the integrator and its best gain, LQG, and H2 robust to a plant that is not the assumed one.

The integrator u[k] = leak u[k-1] - g y[k] is the yardstick of all others. Its optimal gain is found from closed-loop telemetry,
without a model of spectra or noise. The pseudo-open-loop z of a record is what an integrator of another gain would have been
given: it would have left the measurement y = E(g) z. With white noise and at least one step of delay, E(g) = 1 + terms of the
past, so that the noise of y is uncorrelated with the residual that it measures and mean y^2 is the mean square of the residual
plus the variance of the noise, whatever g is: the gain that is best for y is best for the residual. This is the integral over the
measured spectrum times |E(g)|^2 by which observatories optimise modal gains (Gendron and Lena 1994, A&A 291, 337). It is
taken over correlations of the steps z[k] - leak z[k-1], which the rest of E(g) filters to y. Each correlation is a mean over the
pairs that are known, so that missing samples do not bias it.

LQG commands against the disturbance what a Kalman filter predicts of it. The mirror follows a command at once and without cost,
so the best command is minus the prediction of what the disturbance will be while it acts (certainty equivalence): u[k] =
-(turb_hat[k+1] + vib_hat[k+1]) for the paper's delay of two frames, and for n + f frames the mean over the time that the command
is held,

    u[k] = -((1 - f) phi_hat[k+n-1] + f phi_hat[k+n]).

The adaptive ones predict by a filter that is identified anew while the loop runs, from the pseudo-open-loop so far; until its
first window is full an integrator closes the loop.

H2 control is a finite impulse response from z to the command. A law u = -Q z is in itself the parametrisation of all stabilising
controllers by a stable Q (Youla). With Q of finite length the mean square of the residual is quadratic in its taps, and what
limits it is convex:

    |1 - P Q| <= PEAK                      no disturbance is amplified by more
    |P Q| W <= ROBUST / caution,           W = max |P' / P - 1| over errors of delay, gain and rotation

The second, below 1, keeps the loop stable for every such plant P' (small gain; a rotation by theta turns the two modes of a pair
of azimuthal order m by exp(+-i m theta), and m = 1 is borne). It rolls the command off where the delay is felt most. After
P. Dinis et al. 2024 (arXiv:2410.05123), who design by the frequency response of a plant that was measured. The limits act by
multipliers at each frequency, which grow in proportion to what is exceeded (iterative reweighting, as C. Lawson's).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi
from typing import Any

import numpy as np
import scipy
from scipy.linalg import toeplitz
from scipy.optimize import minimize_scalar

from wfsobs.control.margins import residual_density
from wfsobs.control.mirror import Law, Mirror, Plant
from wfsobs.control.step import Integrators, PredictionLaws
from wfsobs.observers.base import TARGETS
from wfsobs.observers.kalman.step import MakeFilter
from wfsobs.observers.step import MakeEstimator
from wfsobs.observers.stepping import Gain, GainCycle
from wfsobs.prior import Noise, Prior, Spectra
from wfsobs.record import RecordError, Sampling
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.typing import Array

FINE, COARSE = 2048, 64
"""Bins kept as they are, and how many of the others count as one: the integrator's response is smooth there."""

GRID = 40
"""Gains tried before the best of them is refined."""


def integrator_law(mirror: Mirror, gain: float, leak: float) -> Law:
    """Return the integrator on y = z + P u as a filter of z: its state is the last commands."""
    taps = mirror.taps
    row = -gain * taps[1:]
    row[0] += leak
    n = row.size
    A = np.vstack([row, np.eye(n)[:-1]])
    into = np.array([-gain])
    cycle = PeriodicFilter([(A, np.eye(n)[:, :1] * into, row[None, :], into[:, None])])
    return Law(cycle, gain, leak, gains=_as_observer(taps, gain, leak), row=np.eye(n + 1)[0])


def _as_observer(taps: Array, gain: float, leak: float) -> GainCycle:
    """Return the integrator as an observer: its state is what the leak leaves of the last command, then the last commands."""
    n = len(taps)
    A = np.eye(n, k=-1)
    A[0, 0] = leak
    return GainCycle([Gain(A, -np.append(0.0, taps[1:])[None], -gain * np.eye(n)[:, :1])])


def highest_stable_gain(mirror: Mirror, leak: float) -> float:
    """Return the gain at which the loop becomes unstable, by bisection on the poles, which grow with it."""
    low, high = 0.0, 5.0  # the limit is highest, 4, for a pure integrator and a delay of 1.25
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if integrator_law(mirror, middle, leak).stable else (low, middle)
    return low


def best_gain(spectra: Spectra, mirror: Mirror, leak: float) -> float:
    """Return the stable gain of minimum residual variance for the spectra of a mode."""
    omega, weight, target, cross, measured = _bin_spectra(spectra)
    P, one = mirror.response(omega), 1.0 - leak * np.exp(-1j * omega)

    def variance(gain: float) -> float:
        T = gain * P / (one + gain * P)
        return float(weight @ residual_density(T, target, cross, measured))

    # Vibration above the crossover can make a second minimum: the best of a grid tells which of them to go down to.
    gains = highest_stable_gain(mirror, leak) * np.linspace(0.0, 1.0, GRID + 2)
    best = 1 + int(np.argmin([variance(gain) for gain in gains[1:-1]]))
    around = (gains[best - 1], gains[best + 1])
    return float(minimize_scalar(variance, bounds=around, method="bounded", options={"xatol": 1e-5}).x)


def _bin_spectra(spectra: Spectra) -> tuple[Array, Array, Array, Array, Array]:
    """(omega, weight in the mean over the circle, and the three spectra of `residual_density`) on fewer points."""
    n = spectra.measurement.size
    weight = np.full(n, 1.0 / (n - 1))
    weight[[0, -1]] *= 0.5
    starts = np.concatenate([np.arange(min(FINE, n)), np.arange(FINE, n, COARSE)])
    total = np.add.reduceat(weight, starts)

    def mean(x: Array) -> Array:
        return np.add.reduceat(weight * x, starts) / total

    omega = np.pi * np.arange(n) / (n - 1)
    return mean(omega), total, mean(spectra.disturbance), mean(spectra.cross), mean(spectra.measurement)


def limited_integrator(mirror: Mirror, gain: float, leak: float, z: Array, forward: Array) -> tuple[Array, Array]:
    """Commands (n_steps,) of an integrator on z (n_steps,) plus `forward` (n_steps,), that a mirror with limits took; and wanted.

    Anti-windup: the integrator goes on from what the mirror took, less `forward`.
    """
    taps = mirror.taps[1:].tolist()
    own = [0.0] * len(taps)  # the integrator's part of the last commands, newest first
    taken, wanted, last = [], [], 0.0
    for measured, ahead in zip(z.tolist(), forward.tolist(), strict=True):
        y = measured + sum(tap * u for tap, u in zip(taps, own, strict=True))
        wanted.append(leak * own[0] - gain * y + ahead)
        last = mirror.clip_command(wanted[-1], last)
        taken.append(last)
        own = [last - ahead, *own[:-1]]
    return np.array(taken), np.array(wanted)


TRIED = 80
"""Gains up to the limit of stability; a parabola through the best three refines them."""

BLOCKS = 16
"""Of the record, for the jackknife."""

LAGS = 1000
"""Of the correlations: an integrator of the smallest gain tried remembers less."""

SHORTEST, LEAST = 1000, 0.8
"""Minimum of measured samples, and of their share: where more are missing, few pairs of steps are known."""


@dataclass(frozen=True)
class TelemetryGain:
    """The gain of least residual of one mode.

    Attributes
    ----------
    gain, deviation : float
        Optimal gain and its standard deviation, by a jackknife over blocks of the record.
    measured_rms : float
        Rms [um] of the measurement with that gain: residual and noise.
    limit : float
        Gain at which the loop becomes unstable.
    """

    gain: float
    deviation: float
    measured_rms: float
    limit: float


def gain_from_telemetry(z: Array, mirror: Mirror, leak: float = 1.0) -> TelemetryGain:
    """Find the integrator's gain of least residual for a pseudo-open-loop record of one mode.

    Parameters
    ----------
    z : Array
        Pseudo-open-loop measurement, (n_steps,) [um]; NaN is a missing sample.
    mirror : Mirror
        Its delay; limits are not regarded.
    leak : float
        Leak of the integrator.

    Raises
    ------
    RecordError
        Too few samples are measured, or they do not move.
    """
    measured = np.flatnonzero(~np.isnan(z))
    if measured.size < max(SHORTEST, LEAST * z.size):
        raise RecordError(f"{measured.size} of {z.size} samples are measured, a gain needs {SHORTEST}, and {100.0 * LEAST:.0f} %")
    if not np.ptp(z[measured]) > 0.0:
        raise RecordError("the measurements do not move: every gain is as good as another")
    steps = z[1:] - leak * z[:-1]
    steps = steps[steps.size % BLOCKS :]
    known = ~np.isnan(steps)
    total, count = _lag_sums(np.where(known, steps, 0.0), BLOCKS), _lag_sums(known.astype(float), BLOCKS)
    limit = highest_stable_gain(mirror, leak)
    gains = limit * np.arange(1, TRIED + 1) / (TRIED + 1)
    weights = np.stack([_weights(gain, mirror, leak) for gain in gains])

    def least(blocks: Array | slice) -> tuple[float, float]:
        return _least(gains, weights @ (total[blocks].sum(axis=0) / np.maximum(count[blocks].sum(axis=0), 1.0)))

    gain, variance = least(slice(None))
    others = np.array([least(kept)[0] for kept in ~np.eye(BLOCKS, dtype=bool)])
    deviation = float(np.sqrt((BLOCKS - 1) * others.var()))
    return TelemetryGain(gain, deviation, float(np.sqrt(variance)), limit)


def _lag_sums(x: Array, blocks: int) -> Array:
    """Return the sums of x[k] x[k + lag] over each of so many blocks of x (n,), (blocks, LAGS)."""
    size, ahead = x.size // blocks, np.pad(x, (0, LAGS - 1))
    sums = [scipy.signal.correlate(ahead[i : i + size + LAGS - 1], x[i : i + size], "valid") for i in range(0, x.size, size)]
    return np.array(sums)


def _weights(gain: float, mirror: Mirror, leak: float) -> Array:
    """Return the weights (LAGS,) of the correlations of the steps in the mean square that the integrator leaves."""
    loop = gain * mirror.taps
    loop[:2] += 1.0, -leak
    weights = _lag_sums(scipy.signal.lfilter([1.0], loop, np.eye(1, LAGS)[0]), 1)[0]
    weights[1:] *= 2.0
    return weights


def _least(gains: Array, variance: Array) -> tuple[float, float]:
    """Return where a curve is least, and its value there, by a parabola through the best three points."""
    best = min(max(int(np.argmin(variance)), 1), gains.size - 2)
    three = slice(best - 1, best + 2)
    a, b, c = np.polyfit(gains[three] - gains[best], variance[three], 2)
    step = float(np.clip(-0.5 * b / a, gains[0] - gains[1], gains[1] - gains[0])) if a > 0.0 else 0.0
    return float(gains[best] + step), float(c + step * (b + step * a))


def command_rows(A: Array, phi: Array, mirror: Mirror) -> Array:
    """Row (1, n) that makes the command of the estimated state x_hat[k].

    A (n, n): transition; phi (n,): row that gives phi_dist[k], which no other part of the state drives later on
    """
    row = -phi
    out = np.zeros_like(row)
    for tap in mirror.taps[1:]:
        out += tap * row
        row = row @ A
    return out[None, :]


def _with_caution(prior: Prior, settings: Any) -> Prior:
    """Return a prior with the noise that the settings have a filter take measurements to have."""
    factor = settings.control.caution
    if factor == 1.0:
        return prior
    return replace(
        prior,
        model=tuple(replace(m, lgs_noise=factor * m.lgs_noise, ngs_noise=factor * m.ngs_noise) for m in prior.model),
        lines=tuple(replace(lines, noise=factor * lines.noise) for lines in prior.lines),
        noise=tuple(Noise(factor * lgs, factor * ngs) for lgs, ngs in prior.noise),
    )


def lqg(make: MakeFilter, group: str, prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    """Return the law that commands against what a filter predicts; group : its settings, "" for none. Raises ValueError."""
    one = make(getattr(settings, group, None), _with_caution(prior, settings), mode, plant.ratio)
    row = command_rows(one.cycle[0][0], one.rows(TARGETS).sum(axis=0), plant.mirror)
    return Law(one.gains.recursion(row), gains=one.gains, row=row[0], filter=one)


def lqg_adaptive(make: MakeEstimator, prior: Prior, plant: Plant, settings: Any, sampling: Sampling) -> PredictionLaws:
    """Return the laws of an adaptive filter, at first of integrators. Raises RecordError for a window of too few samples."""
    first = integrator_law(plant.mirror, settings.control.fallback_gain, settings.control.leak)
    integrators = Integrators([first] * sampling.n_modes, plant.mirror)
    return PredictionLaws(make(prior, settings.adaptive, sampling, 0.0), integrators, plant.mirror)


TAPS = 64
"""Length of Q."""

PEAK = 2.0
"""Largest amplification of a disturbance."""

ROBUST = 0.8
"""Part of what small gain allows that a law of caution 1 takes."""

DELAY, GAIN, ROTATION = 0.5, 0.2, 10.0
"""Errors of the plant that are borne, either way: delay [frames], gain, rotation [deg]."""

FREQUENCIES = np.unique(np.concatenate([np.geomspace(1e-3, pi, 60), np.linspace(0.02, pi, 140)]))
"""Frequencies of the limits [rad per step]."""

ROUNDS = 300
"""Of the multipliers; after a third of them the taps change by less than 1e-6."""


def h2_fir(prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    """Return the law of one mode of least residual within the limits, by the spectra in the prior; `control.caution` counts."""
    q = taps_of(prior.spectra[mode], plant.mirror, settings.control.caution)
    gains = GainCycle([Gain(np.eye(q.size, k=-1), np.zeros((1, q.size)), np.eye(q.size)[:, :1])])  # the state is the last z
    return Law(gains.filter(-q[None]), gains=gains, row=-q)


def taps_of(spectra: Spectra, mirror: Mirror, caution: float) -> Array:
    """Return the taps of Q (TAPS,), of commands over measurements; spectra : on equidistant frequencies up to half the rate."""
    n = spectra.measurement.size
    P = mirror.response(pi * np.arange(n) / (n - 1))
    power = np.fft.irfft(np.abs(P) ** 2 * spectra.measurement)[:TAPS]
    target = np.fft.irfft(spectra.cross * np.conj(P))[:TAPS]
    response, lags = mirror.response(FREQUENCIES), np.arange(TAPS)
    E = response[:, None] * np.exp(-1j * FREQUENCIES[:, None] * lags)
    of_limits = np.abs(response) ** 2 * np.cos(lags[:, None] * FREQUENCIES)  # E* w E is Toeplitz, its first column of_limits w
    most = ROBUST / caution / uncertainty(mirror, FREQUENCIES)
    scale = power[0]
    power[0] += 1e-12 * scale
    peak, roll_off = np.full((2, FREQUENCIES.size), 1e-9 * scale)
    q = np.zeros(TAPS)
    for _ in range(ROUNDS):
        q = np.linalg.solve(toeplitz(power + of_limits @ (peak + roll_off)), target + E.real.T @ peak)
        T = E @ q
        peak = np.maximum(peak * (np.abs(1.0 - T) / PEAK) ** 1.5, 1e-14 * scale)
        roll_off = np.maximum(roll_off * (np.abs(T) / most) ** 1.5, 1e-14 * scale)
    return q


def uncertainty(mirror: Mirror, omega: Array) -> Array:
    """Return W at omega [rad per step], the same shape (n,)."""
    lags = np.linspace(max(-DELAY, 1.0 - mirror.delay), DELAY, 5)
    turned = [replace(mirror, delay=mirror.delay + lag).response(omega) / mirror.response(omega) for lag in lags]
    angles = np.exp(1j * np.radians([-ROTATION, 0.0, ROTATION]))
    factors = np.multiply.outer([1.0 - GAIN, 1.0, 1.0 + GAIN], angles).ravel()
    return np.abs(np.multiply.outer(factors, np.array(turned)) - 1.0).max(axis=(0, 1))
