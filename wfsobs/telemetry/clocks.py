"""The steps of rows by their time stamps or a counter of frames, and the rows of NGS frames."""

from __future__ import annotations

import numpy as np

from wfsobs.record import RecordError, check_frames
from wfsobs.typing import Array
from wfsobs.units import SECONDS

JITTER = 0.3
"""Maximum distance of a stamp from its step, in steps."""

AGREE = 1e-3
"""Maximum relative difference of the step of the stamps and a declared one."""

BLOCK = 64
"""Rows whose median tells a lost frame from the jitter of stamps."""

ROUNDED = 1.3
"""Maximum spread of rounded stamps about a line, in quanta."""

TURNS = 8
"""Uneven differences that tell rounding, which spaces them evenly, from losses."""

BLOCKS = 100
"""Maximum stretches of TURNS uneven differences that are looked at."""

COUNTERS = (8, 16, 32, 64)
"""Bits of a frame counter."""

DAY = SECONDS["d"]
"""Length of a day [s]."""


def past_midnight(time: Array) -> Array:
    """Return the times of a day [s] with those after midnight going on; others as they are."""
    midnight = np.diff(time, prepend=time[:1]) < -0.5 * DAY
    return time + DAY * np.cumsum(midnight) if midnight.any() and 0 <= time.min() and time.max() < DAY else time


def steps_of(time: Array, dt: float | None = None, frames: Array | None = None) -> tuple[Array, float, str]:
    """Return the step of every row, and the time step, of time stamps.

    A difference of several steps is a gap, unless rounding alone explains it. Stamps that scatter are accepted where the frames
    are counted, or where the rate is declared and no frame, or none that could not be told, is missing.

    Parameters
    ----------
    time : Array
        Time stamps, (n,) [s].
    dt : float, optional
        Declared time step [s].
    frames : Array, optional
        Step of every row where a frame counter tells it, (n,); the stamps then give the time step alone.

    Returns
    -------
    steps : Array
        Integers from 0, (n,).
    dt : float
        Time step [s].
    said : str
        That stamps are rounded or scatter, in a few words.

    Raises
    ------
    RecordError
        Time goes backwards, the rate is not constant or not the declared one, most frames are missing, or rounded stamps do not
        tell which are.
    """
    bad = np.flatnonzero(~np.isfinite(time))
    if bad.size:
        raise RecordError(f"time is {time[bad[0]]} in row {bad[0]}")
    if time.size < 2:
        raise RecordError("time needs two rows at least")
    if frames is not None:
        return frames, *_step_of_frames(time, dt, frames)
    if dt is None and (rounded := _rounded_step(time)):
        return np.arange(time.size), *rounded
    try:
        return *_regular_steps(time, dt), ""
    except RecordError:
        steps = None if dt is None else _scattered_steps(time, dt)
        if dt is None or steps is None:
            raise
    _check_lost(steps)
    return steps, dt, f"stamps {np.std(time / dt - steps):.2g} steps rms off the stated rate"


def _rounded_step(time: Array) -> tuple[float, str] | None:
    """Return the time step of stamps that are rounded to a third of it or more, and that they are; None of any others.

    Stamps in whole quanta are rounded where they follow a line over the whole record. Raises RecordError where they follow it
    over most stretches alone. Where fewer than TURNS of their differences are uneven, frames are missing there.
    """
    difference, error = np.diff(time), 4.0 * np.spacing(np.abs(time).max())
    for unit in (1.0, DAY) if difference.min() > 0 else ():
        quantum = unit * 10.0 ** np.floor(np.log10(1.01 * difference.min() / unit))
        ticks = np.rint(difference / quantum)
        if quantum < JITTER * difference.mean() or np.abs(difference - ticks * quantum).max() > error:
            continue
        uneven = np.flatnonzero(ticks != np.median(ticks))
        count = np.concatenate([[0.0], np.cumsum(ticks)])
        slope, spread = _line(count)
        if spread <= ROUNDED and uneven.size >= TURNS:
            rate = 1.0 / (slope * quantum)
            written = (float(f"{rate:.{digits}g}") for digits in range(1, 17))
            rate = next((x for x in written if abs(x / rate - 1.0) * count[-1] <= 1.0), rate)
            return 1.0 / rate, f"stamps rounded to {quantum:.3g} s"
        parts = np.split(count, uneven[TURNS::TURNS])[:-1]
        spreads = [_line(part)[1] for part in parts[:: len(parts) // BLOCKS + 1]]
        if spreads and np.median(spreads) <= ROUNDED:
            raise RecordError(
                f"time is in whole {quantum:.3g} s, so that rounded stamps and missing frames are not told apart; "
                "state the rate (--rate, rate=)"
            )
    return None


def _line(x: Array) -> tuple[float, float]:
    """Return the slope of the least-squares line of x by its row, and the range of what it leaves."""
    row = np.arange(x.size) - 0.5 * (x.size - 1)
    slope = row @ x / max(row @ row, 1.0)
    return float(slope), float(np.ptp(x - slope * row))


def _regular_steps(time: Array, dt: float | None) -> tuple[Array, float]:
    """Return the steps and the time step of stamps that are at most JITTER from their steps."""
    hint = "stamps that scatter need a stated rate" if dt is None else "it is not known which frames are missing"
    difference = np.diff(time)
    back = np.flatnonzero(difference <= 0)
    if back.size:
        row = back[0] + 1
        raise RecordError(
            f"time {'stands still' if difference[row - 1] == 0 else 'goes backwards'} at row {row}, "
            f"from {time[row - 1]:.9g} to {time[row]:.9g} s; {hint}"
        )
    jump = np.rint(difference / np.median(difference))
    steps = np.concatenate([[0.0], np.cumsum(np.maximum(jump, 1.0))])
    step = _round_step((time[-1] - time[0]) / steps[-1], time)
    off = np.abs(time - time[0] - steps * step) / step
    uneven = np.abs(difference / step - np.diff(steps))
    if max(off.max(), uneven.max()) > JITTER:
        row = int(np.argmax(uneven)) + 1
        raise RecordError(
            f"the rate is not constant: {difference[row - 1]:.6g} s before row {row}, {step:.6g} s on average; {hint}"
        )
    _check_lost(steps)
    if dt is not None and abs(step / dt - 1.0) > AGREE:
        raise RecordError(f"time has a step of {step:.6g} s, but {dt:.6g} s are stated")
    return steps.astype(int), step if dt is None else dt


def counted_steps(frame: Array) -> Array:
    """Return the step of every row of a frame counter (n,), from 0; one that starts anew at a power of two goes on.

    >>> counted_steps(np.array([65534.0, 65535.0, 0.0, 3.0]))
    array([0, 1, 2, 5])
    """
    if not (np.isfinite(frame) & (frame == np.round(frame))).all():
        raise RecordError("frame takes whole numbers")
    difference = np.diff(frame)
    turn = next(2.0**bits for bits in COUNTERS if np.ptp(frame) < 2.0**bits)  # also of one with a sign
    around = difference + turn * (difference < 0)
    each = np.median(around)
    wrong = np.flatnonzero((around <= 0) | (around % max(each, 1) != 0) | ((difference < 0) & (around > frame.size * each)))
    if wrong.size:
        row = wrong[0] + 1
        raise RecordError(f"frame does not count at row {row}: from {frame[row - 1]:.0f} to {frame[row]:.0f}")
    steps = np.concatenate([[0.0], np.cumsum(around / each)])
    _check_lost(steps)
    return steps.astype(int)


def _check_lost(steps: Array) -> None:
    lost = steps[-1] + 1 - steps.size
    if lost > steps.size:
        raise RecordError(f"{lost:.0f} frames are missing, more than the {steps.size} measured: cut the record at its gaps")


def _step_of_frames(time: Array, dt: float | None, steps: Array) -> tuple[float, str]:
    """Return the time step of rows whose steps are known, and how far the stamps are off. Raises where a pause lies between."""
    step = _round_step((time[-1] - time[0]) / steps[-1], time)
    if dt is not None and abs(step / dt - 1.0) > AGREE:
        raise RecordError(f"time has a step of {step:.6g} s per frame, but {dt:.6g} s are stated")
    off = (time - time[0]) / step - steps
    if np.ptp(_medians(off)) > 1.0:
        raise RecordError("time and frame do not agree: the frames counted do not come at one rate")
    rms = np.std(off)
    return step if dt is None else dt, f"stamps {rms:.2g} steps rms off the frames counted" if rms > JITTER / 3 else ""


def _scattered_steps(time: Array, dt: float) -> Array | None:
    """Return the steps of stamps that scatter about a known rate; None where they do not tell which frames are missing."""
    exact = (time - time[0]) / dt
    exact -= np.median(exact - np.rint(exact))
    near = np.rint(exact)
    jump = np.diff(near)
    if np.median(jump) == 1 and jump.min() == 1 and np.abs(exact - near).max() < 0.5 - JITTER / 3:
        return (near - near[0]).astype(int)
    middle = _medians(exact - np.arange(time.size))
    if middle.size < 3 or np.abs(middle[2:] - middle[:-2]).max() > 0.5:
        return None
    return np.arange(time.size)


def _medians(x: Array) -> Array:
    """Return the medians of successive blocks; of all where there are few."""
    n = max(x.size // BLOCK, 1)
    return np.array([np.median(part) for part in np.array_split(x, n)])


def _round_step(step: float, time: Array) -> float:
    """Return the shortest number within the rounding errors of the stamps that a step was computed from."""
    error = 4.0 * np.spacing(np.abs(time).max()) / time.size
    return next((x for x in (float(f"{step:.{digits}g}") for digits in range(1, 17)) if abs(x - step) <= error), step)


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


def rows_of_frames(y_ngs: Array) -> Array:
    """Return the rows with a frame, (n,); where most rows have numbers, those in which they change. The first row has none.

    y_ngs : (n_steps, n_modes) [um], NaN or the last frame between two
    """
    rows = np.flatnonzero(np.isfinite(y_ngs).any(axis=1))
    if rows.size > 0.5 * (y_ngs.shape[0] + 1):
        rows = rows[np.concatenate([[True], (y_ngs[rows[1:]] != y_ngs[rows[:-1]]).any(axis=1)])]
    return rows[rows > 0]


def frame_distance(steps: Array) -> int | None:
    """Return the greatest common divisor of the distances of frames [steps]; None where it is 1, or of fewer than three frames.

    steps : of the frames, (n,)
    """
    distance = int(np.gcd.reduce(np.diff(steps))) if steps.size > 2 else 1
    return distance if distance > 1 else None


def place_frames(frames: Array, n: int, ratio: int) -> Array:
    """Return frames with a row per fast step, from one row per step or per frame."""
    if frames.shape[0] == n:
        return frames
    out = np.full((n, frames.shape[1]), np.nan)
    due = out[ratio::ratio]
    if not 0 <= frames.shape[0] - len(due) <= 1:
        raise RecordError(f"y_ngs has {frames.shape[0]} rows; it takes {n}, or one per frame, {len(due)}")
    due[:] = frames[: len(due)]
    return out


def drop_partial_frames(y_ngs: Array, ratio: int) -> Array:
    """Check that frames are at k = n, 2n, ...; drop a frame at k = 0, which saw nothing, and frames without all modes."""
    check_frames(y_ngs, ratio)
    is_kept = np.asarray(~np.isnan(y_ngs).any(axis=1))
    is_kept[0] = False
    return np.where(is_kept[:, None], y_ngs, np.nan)
