"""Scores of estimates: error and lag after the warm-up; compared errors are on common samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from hashlib import blake2b
from typing import Any

import numpy as np

from wfsobs.evaluation.calibration import Calibration, calibration
from wfsobs.evaluation.lag import lag
from wfsobs.evaluation.samples import batch_means, common_samples, rms_interval, samples_after, stretch_of
from wfsobs.evaluation.totals import of_both, totals
from wfsobs.observers.base import TARGETS
from wfsobs.observers.estimates import NEXT_Z, TOTAL, Estimate
from wfsobs.record import Record
from wfsobs.sensors.modes import HIGHEST_ORDER, modes_up_to
from wfsobs.signal.welch import rms
from wfsobs.typing import Array

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
    pieces: tuple[tuple[float, float], ...] = ()


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
    """
    names = [m.name for m in modes_up_to(HIGHEST_ORDER)][: record.n_modes] if mode_names is None else list(mode_names)
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
    out, every = [], [*estimates, *totals(estimates)]
    for target in SCORED:
        truth, of = record.truth(target), [e for e in every if e.target == target]
        if truth is None:
            continue
        for mode, name in enumerate(mode_names):
            true = truth[:, mode]
            counts = samples_after(record, warm_up) & ~np.isnan(true)
            scored = common_samples([counts & ~np.isnan(e.values[:, mode]) for e in of])
            words = {id(samples): blake2b(samples.tobytes(), digest_size=16).hexdigest() for samples, _ in scored}
            for e, (samples, apart) in zip(of, scored, strict=True):
                if samples.any():
                    make = partial(_score_mode, e, true, mode, name, record.dt, samples, apart)
                    out.append(derive(e, f"score {target} {mode} {name} {words[id(samples)]} {apart}", make))
    return out


def _score_mode(e: Estimate, true: Array, mode: int, name: str, dt: float, samples: Array, apart: bool) -> Score:
    """Score one mode of an estimate on some samples of the truth (n_steps,) [um]."""
    t, value = true[samples], e.values[samples, mode]
    return Score(
        e.observer,
        e.target,
        name,
        rms(value - t),
        rms(t),
        _ratio(value - t, t),
        lag(t, value, dt),
        e.seconds_per_step,
        *stretch_of(samples, dt),
        apart,
        calibration=None if e.sd is None else calibration(value - t, e.sd[samples, mode]),
        **_scatter(value - t, t),
    )


def _scatter(error: Array, truth: Array) -> dict[str, Any]:
    """Return the fields `pieces` and `interval` of a score."""
    pieces = batch_means(np.column_stack([error, truth]) ** 2)
    return {"pieces": tuple(map(tuple, pieces.tolist())), "interval": rms_interval(rms(error), pieces[:, :1])}


def unsupervised_scores(record: Record, estimates: Sequence[Estimate], warm_up: float, mode_names: list[str]) -> list[Score]:
    """Score estimates without truth, on common samples as well; truth_rms is the rms of z throughout.

    - PREDICTION: rms of z[k+1] - phi_hat[k], one step ahead, since z[k+1] = phi_dist[k] + noise and phi_hat[k] knows y up to
      k. The noise of the measurement is included. Only an observer that estimates both turbulence and vibration predicts
      z; the others have no such score. Missing samples do not count.
    - RESIDUAL: rms of y_lgs, the residual of the recorded loop.
    """
    out: list[Score] = []
    both = of_both(estimates)
    counts = samples_after(record, warm_up + record.dt)
    for mode, name in enumerate(mode_names):
        z, left = record.z[:, mode], record.y_lgs[:, mode]
        measured = counts & ~np.isnan(z)
        if not rms(z[measured]) > 0:
            continue
        errors = [z - _later(sum(e.values[:, mode] for e in parts)) for parts in both.values()]  # type: ignore[arg-type]
        scored = common_samples([measured & ~np.isnan(error) for error in errors])
        for (observer, parts), error, (samples, apart) in zip(both.items(), errors, scored, strict=True):
            if samples.any():
                sd = parts[0].sd_of_sum.get(PREDICTION)
                out.append(
                    Score(
                        observer,
                        PREDICTION,
                        name,
                        rms(error[samples]),
                        rms(z[samples]),
                        _ratio(error[samples], z[samples]),
                        None,
                        max(e.seconds_per_step for e in parts),
                        *stretch_of(samples, record.dt),
                        apart,
                        calibration=None if sd is None else calibration(error[samples], _later(sd[:, mode])[samples]),
                        **_scatter(error[samples], z[samples]),
                    )
                )
        samples = next((s for s, apart in scored if not apart and s.any()), measured) & ~np.isnan(left)
        if samples.any():
            out.append(
                Score(
                    LOOP,
                    RESIDUAL,
                    name,
                    rms(left[samples]),
                    rms(z[samples]),
                    _ratio(left[samples], z[samples]),
                    None,
                    0.0,
                    *stretch_of(samples, record.dt),
                    **_scatter(left[samples], z[samples]),
                )
            )
    return out


def _later(x: Array) -> Array:
    """Return x one step later, NaN first."""
    return np.concatenate([[np.nan], x[:-1]])


def _ratio(error: Array, signal: Array) -> float | None:
    """Return the rms of an error over that of the signal, None where that is zero."""
    scale = rms(signal)
    return rms(error) / scale if scale > 0 else None
