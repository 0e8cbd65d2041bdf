"""Whether the data exclude the sign or the delay of the commands of a closed loop.

The spectrum of a disturbance in white noise falls, lines aside; that of z under a wrong sign or delay has the humps of the loop.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.fft import rfft
from scipy.ndimage import binary_dilation, median_filter
from scipy.optimize import isotonic_regression

from wfsobs.record import Record, hold_last
from wfsobs.sensors.modes import TIP_TILT
from wfsobs.telemetry.command_response import LONGEST, MOST_STEPS, command_response
from wfsobs.typing import Array

REVERSED = 0.7
"""Minimum correlation of what is new in a command and in the measurement of its row, of a sign that is reversed."""

BANDS, LINE = 60, 10.0
"""Bands of a spectrum that falls; how often the median about it a bin is that is left out, as one of a line."""

CLEAR, CLEAR_DELAY, FALLS = 30.0, 0.01, 0.5
"""Log-likelihood by which a sign is excluded; per sample, a delay (at least twice the first); that a falling band may lack."""


def contradiction(record: Record, sign: int = 1) -> str:
    """Return in a line why the data exclude that y = disturbance + u, `record.delay` steps later; empty where they do not.

    sign : of the commands as it was stated, for the line alone; that of the record is +1
    """
    response = command_response(record)
    if response is None:
        return ""
    y, u = (hold_last(x[LONGEST:MOST_STEPS, : len(TIP_TILT)]) for x in (record.y_lgs, record.u))
    moving = np.ptp(u, axis=0) > 0
    y, u = (x[:, moving] / max(np.abs(y).max(), np.abs(u).max()) for x in (y, u))
    ways = [(0, 1), *((s, d) for s in (1, -1) for d in {*range(1, LONGEST + 1), record.delay})]
    fits = sum(_falling(*mode, ways) for mode in zip(y.T, u.T, strict=True))
    likelihood, lacks = (dict(zip(ways, x, strict=True)) for x in np.transpose(fits))
    best, reverse = (max((w for w in ways if w[0] == s), key=lambda w: likelihood[w]) for s in (1, -1))
    falls = "the spectrum of z falls as that of a disturbance does, lines aside"
    if response.reply > REVERSED and likelihood[reverse] - max(likelihood[best], likelihood[0, 1]) > CLEAR:
        row = f"commands move with the measurement of their row (correlation {response.reply:+.2f})"
        return f"command sign {sign:+d} is excluded by the data: {row}, and with {-sign:+d} {falls}"
    clear = max(2.0 * CLEAR, CLEAR_DELAY * len(y))
    if likelihood[best] - max(likelihood[1, record.delay], likelihood[0, 1]) > clear and lacks[best] < FALLS * BANDS * y.shape[1]:
        return f"command delay {record.delay} is excluded by the data: with {best[1]}, not with {record.delay}, {falls}"
    return ""


def _falling(y: Array, u: Array, ways: Sequence[tuple[int, int]]) -> Array:
    """Return for every sign and delay the log-likelihood of the falling spectrum that is likeliest, and what it lacks, (ways, 2).

    Lines are left out: bins far above those about them, of y or u, whatever the sign and the delay are.
    """
    n = len(y)
    f = np.arange(2, n // 2) / n
    Y, U = (rfft((x - x.mean()) * np.hanning(n + 2)[1:-1])[2 : n // 2] for x in (y, u))
    keep = np.ones(len(f), dtype=bool)
    for power in (np.abs(Y) ** 2, np.abs(U) ** 2):
        keep &= ~binary_dilation(power > LINE * median_filter(power, min(201, len(f) // 20 | 1)), iterations=3)
    edges = np.unique(np.concatenate([[0], np.geomspace(20, len(f), BANDS).astype(int)]))[:-1]
    count = np.add.reduceat(keep.astype(float), edges)
    out, known = [], count > 0
    for sign, delay in ways:
        power = keep * np.abs(Y - sign * np.exp(-2j * np.pi * f * delay) * U) ** 2
        level = np.add.reduceat(power, edges)[known] / count[known]
        level = np.maximum(level, max(1e-20 * level.max(), 1e-300))
        S = isotonic_regression(level, weights=count[known], increasing=False).x
        out.append([-0.5 * count[known] @ np.log(S), 0.5 * count[known] @ np.log(S / level)])  # half the bins: of a taper
    return np.array(out)
