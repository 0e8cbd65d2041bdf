"""Measurements that somebody has filled in, found by the noise that they lack.

Where a frame was lost, telemetry often has the last value once more, a line between neighbours or a prediction. An observer that
takes these for measurements trusts them, and starts wrong after the gap. A frame is taken for missing where

- the measurement, or the pseudo-open-loop of it, is the same in all modes for the third time, or as much later as it is by chance
  where the numbers of the measurement have steps, or
- the last WINDOW frames follow a polynomial as no measured ones do: the squares left over are below SHARE of their median so far.
  DEGREE is such that a line of 50 Hz at 1 kHz, which a prediction goes on with, leaves 1e-5 of its power.

No later frame decides, but for the steps of the numbers, which are those of the whole record, and nothing is found before
USUAL / 10 frames with noise. Windows overlap, so that one in 10^9 of white noise of usual strength would be below SHARE, and that
of one real frame at the end is not where the gap was long. What lasts longer than LONGEST is no gap but what the sensor measures.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from wfsobs.record import Record
from wfsobs.typing import Array

WINDOW = 28
"""Frames that are fitted by a polynomial."""

DEGREE = 8
"""Of the polynomial."""

SHARE = 0.05
"""Of the usual square of what the polynomial leaves over."""

USUAL = 2000
"""Frames that the usual square is the median of, taken anew at every tenth of them, the first of which has to be there first."""

LONGEST = 10.0
"""Gap that is taken for one, at most [s]."""

ROUNDING = 1e-12
"""Of a number, that is no noise."""

RARE = 0.1
"""Runs as long that a record has by chance, at most, where frames are taken for missing."""

AT_ONCE = 100_000
"""Windows that are fitted at once, for the memory."""


def without_bridged(record: Record) -> Record:
    """Return a record that tells no missing frames with those missing that were filled in; its origin says how many."""
    seen = slice(record.delay, None)  # z before has no commands
    bridged = np.zeros(record.n_steps, dtype=bool)
    bridged[seen] = find_bridged(record.y_lgs[seen], record.z[seen], record.dt)
    if not bridged.any():
        return record
    said = f"{bridged.sum()} LGS frames without noise of their own taken for missing"
    y_lgs = np.where(bridged[:, None], np.nan, record.y_lgs)
    return replace(record, y_lgs=y_lgs, origin=", ".join(filter(None, (record.origin, said))))


def find_bridged(y: Array, z: Array, dt: float) -> Array:
    """Return which frames were filled in.

    Parameters
    ----------
    y : Array
        Measurements, (n, n_modes), without NaN.
    z : Array
        Pseudo-open-loop measurements of the same frames, (n, n_modes).
    dt : float
        Time step [s].

    Returns
    -------
    Array
        True where a frame was filled in, (n,).
    """
    with np.errstate(over="ignore", invalid="ignore"):  # of values beyond all measure, which are found elsewhere
        rounding = ROUNDING * (np.abs(y) + np.abs(z))
        run, chance = np.maximum(_repeats(y, 0.0 * rounding), _repeats(z, rounding)), _chance_of_repeat(y)
        again = (run >= 2) & (len(y) * chance**run <= RARE)
        share = SHARE * float(len(y) * chance**WINDOW <= RARE)  # else whole windows of one value are measured
        return _lacking(again, _squares_left_over(z), rounding, LONGEST / dt, share)


def _lacking(again: Array, left_over: Array, rounding: Array, longest: float, share: float) -> Array:
    """Return which frames repeat, or lack the noise that those before them have, (n,); none before there is some noise.

    share : of the usual squares left over, below which they do
    """
    rows, every = np.arange(len(again)), USUAL // 10
    apart = rows - np.maximum.accumulate(np.where(again, rows, -1))  # a window with frames that repeat says nothing of the others
    usual, seen, lasting, k = np.zeros(left_over.shape[1]), 0, 0, WINDOW
    last = np.zeros((USUAL, left_over.shape[1]))  # of those that are measured, in any order
    out = np.zeros(len(left_over), dtype=bool)
    while k < len(out):  # up to where the usual square is taken anew, or a gap is too long for one
        part = slice(k, k + every - seen % every)
        squares, count = left_over[part], np.arange(1, len(out[part]) + 1)
        has_noise = (seen >= every) & (np.isfinite(usual) & (usual > rounding[part] ** 2)).all(axis=1)
        lacks = has_noise & (again[part] | (apart[part] >= WINDOW) & (squares < share * usual).all(axis=1))
        run = count - np.maximum.accumulate(np.where(lacks, -lasting, count))
        is_over = bool((run > longest).any())
        n = int(np.argmax(run > longest)) + 1 if is_over else len(count)
        lasting, seen = int(run[n - 1]), 0 if is_over else seen
        out[k : k + n] = lacks[:n] & (run[:n] <= longest)
        measured = squares[n - 1 : n] if is_over else squares[~lacks]
        last[(seen + np.arange(len(measured))) % USUAL] = measured
        seen, k = seen + len(measured), k + n
        if seen % every == 0:
            usual = np.median(last[:seen], axis=0)
    return out


def _repeats(x: Array, rounding: Array) -> Array:
    """Return for how many frames x (n, n_modes) has been in all modes what it was before, but for rounding, (n,)."""
    rows, same = np.arange(len(x)), (np.abs(np.diff(x, axis=0, prepend=np.nan)) <= rounding).all(axis=1)
    return rows - np.maximum.accumulate(np.where(same, 0, rows))


def _chance_of_repeat(y: Array) -> float:
    """Return the probability, at most, that the next frame of y (n, n_modes) is the same in all modes.

    In every mode it is taken for the share of the changes that are as small as any, those by one step of its numbers: nearly none
    where they are fine, and all where a step is more than the noise.
    """
    change = np.abs(np.diff(y, axis=0))
    change[change == 0.0] = np.inf
    least, changes = (change <= 1.5 * change.min(axis=0, initial=np.inf)).sum(axis=0), np.isfinite(change).sum(axis=0)
    return float(np.prod(np.minimum(least / np.maximum(changes, 1), 1.0)))


def _squares_left_over(z: Array) -> Array:
    """Return what a polynomial leaves of the squares of the last WINDOW frames, (n, n_modes); zeros before there are so many."""
    powers = np.polynomial.chebyshev.chebvander(np.linspace(-1.0, 1.0, WINDOW), DEGREE)
    rest = np.linalg.qr(powers, mode="complete")[0][:, DEGREE + 1 :]
    out = np.zeros_like(z)
    for first in range(0, max(len(z) - WINDOW + 1, 0), AT_ONCE):
        windows = sliding_window_view(z[first : first + AT_ONCE + WINDOW - 1], WINDOW, axis=0)
        out[first + WINDOW - 1 : first + WINDOW - 1 + len(windows)] = np.sum((windows @ rest) ** 2, axis=-1)
    return out
