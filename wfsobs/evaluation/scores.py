"""Scores of estimates: error and lag after the warm-up, and stated standard deviations against errors.

Errors that are compared are on common samples.

The error against time shows the effect of an event, and how long each observer takes to recover.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import blake2b
from math import pi, sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri, stdtrit

from wfsobs.observers.base import TARGETS
from wfsobs.record import NEXT_Z, TOTAL, Estimate, Record, fuse_frames
from wfsobs.sensors.zernike import MODE_NAMES
from wfsobs.settings.values import check_kind
from wfsobs.signal.spectrum import rms
from wfsobs.typing import Array

BACK = 1.1
"""An observer has recovered where its error is at most this many times that before the event."""


def running_rms(record: Record, estimate: Estimate, window: float) -> Array:
    """Compute the rms of the error over the last `window` at every step.

    Parameters
    ----------
    record : Record
        Record with truth.
    estimate : Estimate
        Estimate of one target.
    window : float
        Length of the window [s].

    Returns
    -------
    Array
        (n_steps, n_modes) [um]. Steps without estimate or truth do not count; NaN where none counts, and before the first window
        is complete.

    Raises
    ------
    ValueError
        The record has no truth for the target.
    """
    truth = record.truth(estimate.target)
    if truth is None:
        raise ValueError(f"the record has no true {estimate.target}")
    return trailing_rms(estimate.values - truth, max(round(window / record.dt), 1))


def trailing_rms(x: Array, n: int) -> Array:
    """Return the rms of x[k-n+1] ... x[k] at every k, (n_steps, n_columns); NaN do not count, and where k < n - 1 it is NaN."""
    known = ~np.isnan(x)
    count = trailing_sum(known.astype(float), n)
    mean = np.divide(trailing_sum(np.where(known, x, 0.0) ** 2, n), count, out=np.full(x.shape, np.nan), where=count > 0)
    mean[: n - 1] = np.nan
    return np.sqrt(mean)


def trailing_sum(x: Array, n: int) -> Array:
    """Return x[k-n+1] + ... + x[k] at every k, zeros before the start; same shape as x (n_steps, n_columns).

    It is put together of sums over 1, 2, 4, ... steps: nothing is subtracted, so that a large error leaves no trace in the sums
    after it.
    """
    total, late, width = np.zeros_like(x), 0, 1
    while n and late < len(x):
        if n & 1:
            total[late:] += x[: len(x) - late]
            late += width
        x = x + np.concatenate([np.zeros_like(x[:width]), x[:-width]])
        n, width = n >> 1, 2 * width
    return total


@dataclass
class PooledRms:
    """Running rms of several records of one length together: root of the mean of squares, without NaN."""

    total: Array | float = 0.0
    count: Array | int = 0

    def add(self, running: Array) -> None:
        """Add a record's running rms, (n_steps, n_modes)."""
        known = ~np.isnan(running)
        self.total = self.total + np.where(known, running, 0.0) ** 2
        self.count = self.count + known

    @property
    def rms(self) -> Array:
        """Pooled rms, (n_steps, n_modes), NaN where no record has any."""
        total, count = np.asarray(self.total), np.asarray(self.count)
        return np.sqrt(np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0))


@dataclass(frozen=True)
class Recovery:
    """Effect of an event on an observer in one mode.

    Attributes
    ----------
    start : float
        Start of the event [s].
    before : float
        Rms of the error before it [um].
    worst : float
        Maximum running rms from it to the next [um].
    last : float
        Running rms at the end of that time [um].
    back : float or None
        Recovery time: until the running rms is within 10 % of that before, and stays so until the next event [s]; None if never.
    """

    start: float
    before: float
    worst: float
    last: float
    back: float | None


def recovery(running: Array, dt: float, starts: Sequence[float], window: float, warm_up: float) -> list[Recovery | None]:
    """Measure the effect of each event on a running rms.

    The error before an event is the rms over the second half of the time since the event before, or the warm-up.

    Parameters
    ----------
    running : Array
        Running rms, (n_steps,) [um].
    dt : float
        Time step [s].
    starts : sequence of float
        Starts of the events [s]; simultaneous events count as one.
    window : float
        Window of the running rms [s].
    warm_up : float
        Start of the record that does not count [s].

    Returns
    -------
    list of Recovery or None
        One per event; None where there is nothing before or after it.
    """
    times = sorted(set(starts))
    out: list[Recovery | None] = []
    for before, start, after in zip([warm_up, *times], times, [*times[1:], running.size * dt], strict=False):
        first, at, end = (min(round(t / dt), running.size) for t in (0.5 * (before + start) + window, start, after))
        quiet, then = running[min(first, max(at - 1, 0)) : at], running[at:end]
        quiet, known = quiet[~np.isnan(quiet)], ~np.isnan(then)
        if not quiet.size or not known.any():
            out.append(None)
            continue
        settled = float(np.sqrt(np.mean(quiet**2)))
        late = np.flatnonzero(known & (then > BACK * settled))
        back = 0.0 if not late.size else float((late[-1] + 1) * dt) if late[-1] + 1 < then.size else None
        out.append(Recovery(start, settled, float(then[known].max()), float(then[known][-1]), back))
    return out


BANDS = (0.68, 0.95)
"""Shares of the errors that the bands of a Gaussian error hold."""


def half_width(share: float) -> float:
    """Return the half width of the band that holds this share of a Gaussian error [sd].

    >>> round(half_width(0.95), 4)
    1.96
    """
    return float(ndtri(0.5 + 0.5 * share))


class Calibration(NamedTuple):
    """Stated standard deviations against errors.

    sd        : rms of the standard deviations [um]
    within_68, within_95 : share of the errors within the bands of 68 and 95 %
    crps      : continuous ranked probability score, mean [um]: lower is better, and lowest where what is stated is true
    """

    sd: float
    within_68: float
    within_95: float
    crps: float


def crps(error: Array, sd: Array) -> Array:
    """Return the continuous ranked probability score of Gaussian predictions, closed form.

    Parameters
    ----------
    error, sd : Array
        Errors of the means, and standard deviations, of equal shape [any unit].

    Returns
    -------
    Array
        Scores [same unit]; |error| where the standard deviation is zero.

    Notes
    -----
    Gneiting and Raftery, JASA 102, 359 (2007), eq. 21.
    """
    w = np.abs(error) / np.where(sd > 0.0, sd, 1.0)
    gaussian = sd * (w * (2.0 * ndtr(w) - 1.0) + sqrt(2.0 / pi) * np.exp(-0.5 * w**2) - 1.0 / sqrt(pi))
    return np.where(sd > 0.0, gaussian, np.abs(error))


def calibration(error: Array, sd: Array) -> Calibration | None:
    """Compare errors with stated standard deviations, (n,) [um]; None where nothing is stated."""
    stated = np.isfinite(sd) & np.isfinite(error)
    if not stated.any():
        return None
    error, sd = error[stated], sd[stated]
    low, high = (float(np.mean(np.abs(error) <= half_width(share) * sd)) for share in BANDS)
    return Calibration(float(np.sqrt(np.mean(sd**2))), low, high, float(np.mean(crps(error, sd))))


SCORED = (*TARGETS, TOTAL)
"""What errors are of where there is a truth: what observers estimate, and the sum of both, which a mirror would follow."""

PREDICTION, RESIDUAL = NEXT_Z, "residual y"
"""Targets where there is no truth: the next measurement, and the residual of the loop."""

LOOP, BOUND, BOUND_BOTH, BOUND_STARS = "loop", "bound", "bound-both", "bound-stars"
BOUND_MODES, BOUND_BOTH_MODES, BOUND_ASTERISM = "bound-modes", "bound-both-modes", "bound-asterism"
"""Rows that are not observers: the loop that made the record, and the Wiener bounds of the LGS alone, of LGS and NGS, of both
with every star apart, and of all modes together: of the LGS alone, of LGS and NGS, and of every star apart and the NGS."""

COMMON_BOUNDS = (BOUND, BOUND_BOTH)
"""The bounds of every scenario that has any."""

BOUNDS = (*COMMON_BOUNDS, BOUND_STARS, BOUND_MODES, BOUND_BOTH_MODES, BOUND_ASTERISM)
"""The bounds, in the order of tables."""

OF_STAR = "with the mean over each NGS frame from the NGS where the record has one"
"""Which measurement observers predict where there is no truth."""

SHARE = 0.5
"""Minimum share of the samples after the warm-up that observers in a table have in common; those that leave fewer stand apart."""

BATCHES = 20
"""Pieces of a record whose means tell how far that of the whole scatters."""

SLOW, SLOW_FACTOR = 10.0, 1.5
"""Degrees of freedom below which the pieces of one record are so correlated that their scatter is known badly, and how much wider
it is then taken: set so that of two to eight equal errors 5 % are called different for correlation times up to a ninth of the
record (simulated first-order autoregressions)."""

MAX_LAG = 0.025
"""Maximum lag [s]."""


@dataclass(frozen=True)
class Score:
    """One row of the RMS table: one observer, target and mode.

    Attributes
    ----------
    observer, target, mode : str
        What was scored; target "total" is the sum of turbulence and vibration.
    rms : float
        RMS error [um].
    truth_rms : float
        RMS of the truth [um].
    normalised_rms : float or None
        rms / truth_rms; None where the truth is zero.
    lag : float or None
        Lag, positive if the estimate is late; None where it is constant [s].
    seconds_per_step : float
        Computing time per step and mode [s].
    start, stop : float or None
        Interval of the scored samples; None for a mean over all records [s].
    apart : bool
        Whether the samples differ from those of the other rows, so that the row cannot be compared with them.
    interval : tuple of float or None
        Range that has the rms over all records at 95 % confidence, by the scatter within this one [um]. Of the bound of the
        LGS: range of the rms of an optimal observer in 95 % of records.
    phases : tuple of float or None
        Of the bounds of both sensors: the bound in steps with an NGS frame, one step later, ... [um]; `rms` is over all.
    calibration : Calibration or None
        How the standard deviation that the observer states fits its errors; None where it states none.
    pieces : tuple of (float, float)
        Mean squares of error and truth in pieces of the scored samples [um^2]; empty for a bound.
    """

    observer: str
    target: str
    mode: str
    rms: float
    truth_rms: float
    normalised_rms: float | None
    lag: float | None
    seconds_per_step: float
    start: float | None = None
    stop: float | None = None
    apart: bool = False
    interval: tuple[float, float] | None = None
    phases: tuple[float, ...] | None = None
    calibration: Calibration | None = None
    pieces: tuple[tuple[float, float], ...] = field(default=(), repr=False)


Derive = Callable[[Estimate, str, Callable[[], Score]], Score]
"""Recalls, or makes, what follows from an estimate and its record alone, by name."""


def make_anew(_estimate: Estimate, _name: str, make: Callable[[], Score]) -> Score:
    """Recall nothing."""
    return make()


def score(
    record: Record,
    estimates: Sequence[Estimate],
    *,
    warm_up: float = 0.0,
    mode_names: Sequence[str] | None = None,
    derive: Derive | None = None,
) -> list[Score]:
    """Score estimates: the error where the record has a truth, else that of predicting the next measurement.

    Parameters
    ----------
    record : Record
        Measurements, and the truth where there is one.
    estimates : sequence of Estimate
        Estimates of the observers.
    warm_up : float
        Start of the record that does not count [s].
    mode_names : sequence of str, optional
        Names of the columns; by default those of Noll's order.
    derive : callable, optional
        Recalls a score against the truth where it is known.

    Returns
    -------
    list of Score
        One per estimate and mode, and one of the sum of both estimates of an observer.

    Raises
    ------
    ValueError
        There are not as many names as modes.
    """
    check_kind("score", record, Record)
    names = list(MODE_NAMES[: record.n_modes] if mode_names is None else mode_names)
    if len(names) != record.n_modes:
        raise ValueError(f"mode_names takes {record.n_modes} names, one per mode of the record, not {len(names)}")
    known = record.turbulence is not None or record.vibration is not None
    if known:
        return supervised_scores(record, estimates, warm_up, names, derive or make_anew)
    return unsupervised_scores(record, estimates, warm_up, names)


def supervised_scores(
    record: Record, estimates: Sequence[Estimate], warm_up: float, mode_names: list[str], derive: Derive = make_anew
) -> list[Score]:
    """Score estimates against the truth, those of a target and mode on common samples.

    None for a target without truth or where no sample is left.
    """
    out, every, after = [], [*estimates, *totals(estimates)], np.arange(record.n_steps) >= round(warm_up / record.dt)
    for target in SCORED:
        truth, of = record.truth(target), [e for e in every if e.target == target]
        if truth is None:
            continue
        for mode, name in enumerate(mode_names):
            true = truth[:, mode]
            counts = after & ~np.isnan(true)
            scored = common_samples([counts & ~np.isnan(e.values[:, mode]) for e in of])
            words = {id(samples): blake2b(samples.tobytes(), digest_size=16).hexdigest() for samples, _ in scored}
            for e, (samples, apart) in zip(of, scored, strict=True):
                if samples.any():
                    value, sd, key = e.values[:, mode], None if e.sd is None else e.sd[:, mode], (e.observer, target, name)
                    of_truth = value - true, true, record.dt, samples, apart, e.seconds_per_step
                    make = partial(_score_error, key, *of_truth, sd, value)
                    out.append(derive(e, f"score {target} {mode} {name} {words[id(samples)]} {apart}", make))
    return out


def _score_error(
    key: tuple[str, str, str],
    error: Array,
    signal: Array,
    dt: float,
    samples: Array,
    apart: bool = False,
    seconds: float = 0.0,
    sd: Array | None = None,
    value: Array | None = None,
) -> Score:
    """Score an error (n_steps,) [um] on some samples; key : observer, target and mode; value : estimate that has a lag."""
    error, signal = error[samples], signal[samples]
    size, scale, pieces = rms(error), rms(signal), batch_means(np.column_stack([error, signal]) ** 2)
    return Score(
        *key,
        size,
        scale,
        size / scale if scale > 0 else None,
        None if value is None else lag(signal, value[samples], dt),
        seconds,
        float(np.argmax(samples) * dt),  # of the first sample
        float((samples.size - np.argmax(samples[::-1])) * dt),  # of the end of the last
        apart,
        interval=rms_interval(size, pieces[:, :1]),
        calibration=None if sd is None else calibration(error, sd[samples]),
        pieces=tuple(map(tuple, pieces.tolist())),
    )


def unsupervised_scores(record: Record, estimates: Sequence[Estimate], warm_up: float, mode_names: list[str]) -> list[Score]:
    """Score estimates without truth, on common samples as well; truth_rms is the rms of z throughout.

    - PREDICTION: rms of z[k+1] - phi_hat[k], one step ahead, since z[k+1] = phi_dist[k] + noise and phi_hat[k] knows y up to
      k. The noise of the measurement is included. Only an observer that estimates both turbulence and vibration predicts
      z; the others have no such score. Missing samples and outliers do not count. In a mode with at least half of its NGS
      frames, z has the mean over each frame from the NGS, as z of the LGS has their slow error in it, which the better
      observer leaves out; of that no observer states a deviation.
    - RESIDUAL: rms of y_lgs, the residual of the recorded loop.
    """
    out, both, of, n = list[Score](), totals(estimates), record.without_outliers, record.ratio
    after, whole = np.arange(record.n_steps) > round(warm_up / record.dt), of.z
    is_fused = np.zeros(record.n_modes, dtype=bool)
    if n is not None and of.y_ngs is not None and after[n::n].any():
        is_fused = np.mean(~np.isnan(of.z_ngs[n::n][after[n::n]]), axis=0) >= SHARE
        whole = np.where(is_fused, fuse_frames(whole, of.z_ngs, n), whole)
    for mode, name in enumerate(mode_names):
        z, left = whole[:, mode], of.y_lgs[:, mode]
        measured = after & ~np.isnan(z)
        if not rms(z[measured]) > 0:
            continue
        errors = [z - _later(e.values[:, mode]) for e in both]
        scored = common_samples([measured & ~np.isnan(error) for error in errors])
        for e, error, (samples, apart) in zip(both, errors, scored, strict=True):
            if samples.any():
                sd = None if is_fused[mode] else e.sd_of_sum.get(PREDICTION)
                stated = None if sd is None else _later(sd[:, mode])
                key = e.observer, PREDICTION, name
                out.append(_score_error(key, error, z, record.dt, samples, apart, e.seconds_per_step, stated))
        samples = next((s for s, apart in scored if not apart and s.any()), measured) & ~np.isnan(left)
        if samples.any():
            out.append(_score_error((LOOP, RESIDUAL, name), left, z, record.dt, samples))
    return out


def totals(estimates: Sequence[Estimate]) -> list[Estimate]:
    """Return the estimate of the sum of turbulence and vibration of every observer that estimates both."""
    whole: dict[str, list[Estimate]] = {}
    for estimate in estimates:
        whole.setdefault(estimate.observer, []).append(estimate)
    return [
        replace(
            parts[0],
            target=TOTAL,
            values=np.sum([e.values for e in parts], axis=0),
            seconds_per_step=max(e.seconds_per_step for e in parts),
            sd=parts[0].sd_of_sum.get(TOTAL),
        )
        for parts in whole.values()
        if {e.target for e in parts} == set(TARGETS)
    ]


def _later(x: Array) -> Array:
    """Return x one step later, NaN first."""
    return np.concatenate([[np.nan], x[:-1]])


def common_samples(samples: Sequence[Array]) -> list[tuple[Array, bool]]:
    """Select the samples on which estimates are scored.

    Starting with the estimate with most samples, every estimate takes part that leaves SHARE of the samples in common. These are
    scored on the common samples, every other one on its own, apart.

    Parameters
    ----------
    samples : sequence of Array
        Samples that each estimate has, bool (n,).

    Returns
    -------
    list of (Array, bool)
        Samples of each estimate, and whether it stands apart.
    """
    if not samples:
        return []
    order = sorted(range(len(samples)), key=lambda i: -samples[i].sum())
    shared, apart = samples[order[0]], set()
    for i in order[1:]:
        both = shared & samples[i]
        if both.sum() >= SHARE * samples[order[0]].sum():
            shared = both
        else:
            apart.add(i)
    return [(samples[i] if i in apart else shared, i in apart) for i in range(len(samples))]


def batch_means(values: Array) -> Array:
    """Return the means of BATCHES pieces of values (n, ...), of fewer where there are fewer values."""
    edges = np.unique(np.linspace(0, len(values), BATCHES + 1).astype(int))
    return (np.add.reduceat(values, edges[:-1], axis=0).T / np.diff(edges)).T


def scatter_of_mean(values: Array, independent: bool = False) -> tuple[Array, Array, Array]:
    """Return the means of columns of values (n, k), their standard deviations and degrees of freedom, each (k,).

    Values that are not independent are batch means: slow signals make neighbours alike, which counts as fewer of them, those of a
    first-order autoregression with their correlation (Law and Kelton, Simulation Modeling and Analysis, ch. 9). Few independent
    ones underestimate the scatter: it is widened, so that intervals hold the truth for slow errors, too. Fewer than three of
    them say nothing, and fewer than two of any: NaN.
    """
    n, mean = len(values), values.mean(axis=0)
    if n < (2 if independent else 3):
        return mean, np.full_like(mean, np.nan), np.ones_like(mean)
    deviation = values - mean
    power = (deviation**2).sum(axis=0)
    if independent:
        return mean, np.sqrt(power / (n - 1) / n), np.full_like(mean, n - 1.0)
    alike = np.divide((deviation[1:] * deviation[:-1]).sum(axis=0), power, out=np.zeros_like(power), where=power > 0)
    alike = np.maximum(alike + 1.0 / n, 0.0)  # the estimate of a correlation from n values is low by about 1 / n
    effective = np.maximum(n * (1.0 - alike) / (1.0 + alike), 2.0)
    freedom = effective - 1.0
    is_slow = freedom.size and np.median(freedom) < SLOW * min(n / BATCHES, 1.0)
    wider = (1.0 + 1.0 / freedom) ** 2 * (SLOW_FACTOR if is_slow else 1.0)
    return mean, wider * np.sqrt(power / (n - 1) / effective), freedom


def rms_interval(rms: float, squares: Array) -> tuple[float, float] | None:
    """Return the interval of an rms at 95 % confidence, by the scatter of its logarithm in batch means of squares (n, 1).

    None where there is none: of too few, or of an error that is zero.
    """
    mean, deviation, freedom = (float(x[0]) for x in scatter_of_mean(squares))
    reach = 0.5 * float(stdtrit(freedom, 0.975)) * deviation / mean if mean > 0 else np.nan
    low, high = (rms * np.exp([-reach, reach])).tolist()
    return (low, high) if np.isfinite(reach) else None


def lag(truth: Array, value: Array, dt: float) -> float | None:
    """Estimate the delay of `value` behind `truth` [s]: where their correlation coefficient is highest.

    The maximum is interpolated by a parabola through three points. Positive is late; None where either is constant.

    The middle of the truth is compared with equally long pieces of the estimate, each with its own mean and variance:
    a plain cross-correlation has fewer terms at larger lags, which biases the broad maximum of a slow signal towards
    zero. The phase of an oscillation tells its delay but for whole periods: of maxima that reach half of the highest, which
    may be highest by chance, it is the one nearest to zero.
    """
    reach = min(round(MAX_LAG / dt), (truth.size - 1) // 4)
    middle = truth[reach : truth.size - reach]
    if np.ptp(value) == 0 or np.ptp(middle) == 0:
        return None
    n, moving = middle.size, value - value.mean()
    sums, squares = (np.concatenate([[0.0], np.cumsum(x)]) for x in (moving, moving**2))
    power = squares[n:] - squares[:-n] - (sums[n:] - sums[:-n]) ** 2 / n
    if not power.max() > 0:  # so small that its square is nothing
        return None
    power = np.maximum(power, 1e-12 * power.max())
    alike = np.correlate(moving, middle - middle.mean(), "valid") / np.sqrt(power)
    inner = alike[1:-1]
    tops = 1 + np.flatnonzero((inner >= alike[:-2]) & (inner >= alike[2:]) & (inner >= 0.5 * alike.max()))
    if tops.size == 0:
        return float((np.argmax(alike) - reach) * dt)
    peak = tops[np.argmin(np.abs(tops - reach))]
    before, at, after = alike[peak - 1 : peak + 2]
    curvature = before - 2.0 * at + after
    shift = 0.5 * (before - after) / curvature if curvature < 0 else 0.0
    return float((peak - reach + shift) * dt)
