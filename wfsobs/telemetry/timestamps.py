"""From time stamps to steps: jumps become missing frames, an unusable clock is refused."""

from __future__ import annotations

import numpy as np

from wfsobs.record import RecordError
from wfsobs.typing import Array

JITTER = 0.3
"""Maximum distance of a stamp from its step, in steps."""

AGREE = 1e-3
"""Maximum relative difference of the step of the stamps and a declared one."""

DIGITS = 10
"""Digits of a step computed from stamps, which have rounding errors."""


def steps_of(time: Array, dt: float | None = None) -> tuple[Array, float]:
    """Return the step of every row, and the time step, of time stamps.

    A difference of several steps is a gap.

    Parameters
    ----------
    time : Array
        Time stamps, (n,) [s].
    dt : float, optional
        Declared time step [s].

    Returns
    -------
    steps : Array
        Integers from 0, (n,).
    dt : float
        Time step [s].

    Raises
    ------
    RecordError
        Time goes backwards, the rate is not constant or not the declared one, or most frames are missing.
    """
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise RecordError(f"time is {time[bad[0]]} in row {bad[0]}")
    if time.size < 2:
        raise RecordError("time needs two rows at least")
    difference = np.diff(time)
    back = np.flatnonzero(difference <= 0)
    if back.size:
        row = back[0] + 1
        raise RecordError(
            f"time {'stands still' if difference[row - 1] == 0 else 'goes backwards'} at row {row}, "
            f"from {time[row - 1]:.9g} to {time[row]:.9g} s"
        )
    jump = np.rint(difference / np.median(difference))
    steps = np.concatenate([[0.0], np.cumsum(np.maximum(jump, 1.0))])
    step = _round_step((time[-1] - time[0]) / steps[-1])
    off = np.abs(time - time[0] - steps * step) / step
    uneven = np.abs(difference / step - np.diff(steps))
    if max(off.max(), uneven.max()) > JITTER:
        row = int(np.argmax(uneven)) + 1
        raise RecordError(f"the rate is not constant: {difference[row - 1]:.6g} s before row {row}, {step:.6g} s on average")
    if steps[-1] + 1 > 2 * time.size:
        raise RecordError(
            f"{steps[-1] + 1 - time.size:.0f} frames are missing, more than the {time.size} measured: cut the record at its gaps"
        )
    if dt is not None and abs(step / dt - 1.0) > AGREE:
        raise RecordError(f"time has a step of {step:.6g} s, but {dt:.6g} s are stated")
    return steps.astype(int), step if dt is None else dt


def place_rows(values: Array, steps: Array) -> Array:
    """Return an array with the rows at their steps, NaN where a step has none."""
    out = np.full((steps[-1] + 1, values.shape[1]), np.nan)
    out[steps] = values
    return out


def frames_at(time: Array, start: float, dt: float) -> Array:
    """Return the fast steps (n,) of frames stamped `time` [s], where step 0 is at `start`. Raises RecordError between steps."""
    exact = (time - start) / dt
    steps = np.rint(exact)
    wrong = np.flatnonzero(~(np.abs(exact - steps) <= JITTER))
    if wrong.size:
        raise RecordError(f"time_ngs is {time[wrong[0]]:.9g} s in row {wrong[0]}, which is no step of the fast clock")
    back = np.flatnonzero(np.diff(steps) <= 0)
    if back.size:
        raise RecordError(f"time_ngs goes backwards or stands still at row {back[0] + 1}")
    return steps.astype(int)


def _round_step(step: float) -> float:
    return float(f"{step:.{DIGITS}g}")
