"""Sign and delay of the commands of a closed loop, from the record itself.

A loop whose commands follow from its measurements alone cannot be told from another disturbance under another loop, unless
something is known of the disturbance. Here it is that the disturbance is smooth: over a few steps its response to what is new in
a measurement is a polynomial, while that of the commands jumps. See U. Forssell and L. Ljung, Automatica 35, 1999, on what a
closed loop hides.

With w[k], the error of the prediction of y[k] from the past of y and u, h[i] = cov(y[k+i], w[k]) / var(w) and g[i] the same of
u, a sign s and a delay d are right where h[i] - s g[i-d] is smooth for i = 1, 2, ... The sign comes from g[0] as well: a loop
that reduces an error moves against it, s g[0] < 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt

import numpy as np

from wfsobs.identification.plant_likelihood import LONGEST, ORDER, SPAN, prediction_errors, smooth_basis
from wfsobs.record import Record, hold_last
from wfsobs.sensors.zernike import TIP_TILT
from wfsobs.typing import Array

MOST_STEPS = 100_000
"""Steps of a record that are looked at, its first."""

BLOCKS = 10
"""Parts of a record whose scatter says how sure a difference is."""

DECIDED = 3.0
"""Standard errors by which the best delay has to be better than any other."""


LIMITED = 40.0
"""Log-likelihood by which commands that are cut at a level have to predict a measurement better than the whole ones."""

ROWS = 10_000
"""Rows of a record from which that is computed."""

LEVELS = np.array([0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.94, 0.97, 0.985, 0.995])
"""Quantiles of the commands that are tried as such a level."""


@dataclass(frozen=True)
class CommandResponse:
    """What a record says of sign and delay of its commands.

    Attributes
    ----------
    sign : int or None
        +1, y = disturbance + u, or -1; None where the commands do not follow the measurements.
    delay : int or None
        Steps from a command to the first measurement that sees it; None where the record does not decide.
    reply : float
        Correlation of what is new in a command with what is new in the measurement of the same row.
    correlations : mapping of int to float
        Delay -> correlation of the measurements' response with that of the commands so much earlier, times the sign.
    shares : mapping of int to float
        Delay -> part of the measurements' response, less a polynomial, that commands of that delay, sign and unit gain explain.
    peak, second : int
        Delays of the best and of the second best agreement.
    margin : float
        How much better the best one is than any other, or none [standard errors].
    scale : float
        Units of the measurement by which a unit of command changes it, at the peak; 1 where both have one unit. A delay of 1
        tells little of it: the disturbance jumps there as well.
    """

    sign: int | None
    delay: int | None
    reply: float
    correlations: Mapping[int, float]
    shares: Mapping[int, float]
    peak: int
    second: int
    margin: float
    scale: float

    def lines(self) -> list[str]:
        """Return the evidence, a line for the sign and a line for the delay."""
        if self.sign is None:
            return [f"sign and delay undecided: commands do not follow the measurements (correlation {self.reply:+.2f} in a row)"]
        way = "against" if self.sign > 0 else "with"
        sign = f"sign {self.sign:+d}: commands move {way} the measurement of their row, correlation {self.reply:+.2f}"
        if self.margin < 0:  # no commands at all explain more
            units = ", as if the two had different units" if abs(self.scale) < 0.1 else ""
            return [sign, f"delay undecided: at no delay do the commands explain the measurements' jumps{units}"]
        said = f"delay {self.delay}" if self.delay is not None else "delay undecided"
        peak = (
            f"{said}: commands {_steps(self.peak)} earlier explain {self._share(self.peak)} of the measurements' jumps, those "
            f"{_steps(self.second)} earlier {self._share(self.second)}; {self.margin:.1f} standard errors apart"
        )
        return [sign, peak + ("" if self.delay is not None else f", {DECIDED:g} are needed")]

    def _share(self, delay: int) -> str:
        share = f"{100.0 * max(self.shares[delay], 0.0):.0f} %"
        return f"{share} (correlation {self.correlations[delay]:+.2f})"


def command_response(record: Record) -> CommandResponse | None:
    """Compare the sign and delay under which the disturbance of a closed loop is smooth.

    The record's own delay plays no part; its sign is that of u as it stands. Of the modes, the first two.
    None for a record of fewer than 40 steps per block, or with measurements or commands that never move.
    """
    y, u = _first_modes(record)
    moving = (np.ptp(y, axis=0) > 0) & (np.ptp(u, axis=0) > 0)
    if len(y) - ORDER - SPAN < 40 * BLOCKS or not moving.any():
        return None
    y, u = (x[:, moving] - x[:, moving].mean(axis=0) for x in (y, u))
    h, g, reply = (np.array(part) for part in zip(*map(_responses, y.T, u.T), strict=True))
    h, shifted = _rough(h[:, :, 1:]), {d: _rough(_shift(g, d)) for d in range(1, LONGEST + 1)}
    sign = -int(np.sign(reply.mean()))
    moves = abs(reply.mean()) > DECIDED * max(reply.std(), 0.03)
    misfits = {d: _misfits(h, sign * x) for d, x in shifted.items()}
    ranked = sorted(misfits, key=lambda d: float(misfits[d].sum()))
    peak, second = ranked[:2]
    margin = min(_in_errors(misfits[d] - misfits[peak]) for d in ranked[1:])
    margin = min(margin, _in_errors(_misfits(h, np.zeros_like(h)) - misfits[peak]))
    correlations = {d: sign * _correlation(h, x) for d, x in shifted.items()}
    best, power = shifted[peak].mean(axis=1), float((h.mean(axis=1) ** 2).sum())
    scale = sign * float((h.mean(axis=1) * best).sum() / (best**2).sum())
    decided = moves and margin >= DECIDED
    return CommandResponse(
        sign if moves else None,
        peak if decided else None,
        float(reply.mean()),
        correlations,
        {d: -float(misfits[d].mean()) / max(power, 1e-300) for d in misfits},
        peak,
        second,
        margin,
        scale,
    )


def saturation_lines(record: Record, rail: float | None = None) -> list[str]:
    """Return a line for each mode whose mirror does not follow commands beyond a level, or whose commands stay at their largest.

    The latter only where no rail is stated, at which they were cut.

    A loop is linear but for that: measurements are predicted from their past and that of the commands, whole and cut at a level.
    """
    y, u = _first_modes(record)
    if len(y) <= 40 * ORDER:
        return []
    lines = []
    for mode, measured, commands in zip(TIP_TILT, y.T, u.T, strict=False):
        high = _highest_followed(measured, commands)
        low = -_highest_followed(-measured, -np.minimum(commands, high))
        if np.isfinite(low):  # from above once more, with what is known from below
            high = _highest_followed(measured, np.maximum(commands, low))
        if beyond := np.count_nonzero((commands < low) | (commands > high)):
            levels = " and ".join(f"{1e3 * level:+.3g} nm" for level in (low, high) if np.isfinite(level))
            known = f"commands beyond about {levels}, {100.0 * beyond / len(y):.2g} % of all, do nothing"
            lines.append(f"{mode.name}: {known}: the mirror is at its limit there, and z is wrong without --rail")
        elif rail is None and (count := max(_count_at_end(commands), _count_at_end(-commands))):
            lines.append(f"{mode.name}: commands stay at their largest value in {count} frames, as at the limit of a mirror")
    return lines


def _first_modes(record: Record) -> tuple[Array, Array]:
    """Return tip and tilt of measurements and commands, gaps held, of MOST_STEPS at most."""
    y, u = (hold_last(x[:MOST_STEPS, : len(TIP_TILT)]) for x in (record.y_lgs, record.u))
    return y, u


def _highest_followed(y: Array, u: Array) -> float:
    """Return the level above which commands do nothing; infinity where they are not known to."""
    whole, quantiles = _log_likelihood(y, u), LEVELS
    for _ in range(3):  # each time nearer to the best
        levels = np.quantile(u, quantiles)
        likelihoods = [_log_likelihood(y, np.minimum(u, level)) for level in levels]
        best = int(np.argmax(likelihoods))
        if likelihoods[best] - whole < LIMITED:
            return np.inf
        quantiles = np.linspace(quantiles[max(best - 1, 0)], quantiles[min(best + 1, len(quantiles) - 1)], 5)
    return float(levels[best])


def _log_likelihood(y: Array, u: Array) -> float:
    """Return the log-likelihood of the prediction of y from the past of y and u, but for a constant, from ROWS rows at most."""
    rows = np.arange(ORDER, len(y), -(-len(y) // ROWS))
    past = [x[rows - i] for x in (y, u) for i in range(1, ORDER + 1)]
    table = np.column_stack([np.ones(rows.size), *past, y[rows]])
    triangle = np.asarray(np.linalg.qr(table, mode="r"))
    return -rows.size * float(np.log(max(abs(triangle[-1, -1]), 1e-300)))


def _count_at_end(u: Array) -> int:
    """Return in how many frames commands are at their largest value, if they come back to it more than to others; otherwise 0."""
    values, counts = np.unique(u, return_counts=True)
    at_end = u == values[-1]
    times = np.count_nonzero(at_end[1:] & ~at_end[:-1])
    return int(counts[-1]) if times >= 3 and counts[-1] >= 10 * counts[-2] else 0


def _responses(y: Array, u: Array) -> tuple[Array, Array, float]:
    """Return the responses of y and u to what is new in y, (blocks, 1 + SPAN) each, and the correlation of what is new in u."""
    w, v = prediction_errors(y, u)
    reply = float(np.corrcoef(w, v)[0, 1]) if np.ptp(v) > 0 else 0.0
    length = (len(w) - SPAN) // BLOCKS
    starts = range(0, BLOCKS * length, length)
    power = w[: BLOCKS * length] @ w[: BLOCKS * length] / BLOCKS

    def response(x: Array) -> Array:
        late = x[ORDER:]
        return np.array([[late[a + i : a + i + length] @ w[a : a + length] for i in range(SPAN + 1)] for a in starts]) / power

    return response(y), response(u), reply


def _shift(g: Array, delay: int) -> Array:
    """Return g[i - delay] for i = 1 ... SPAN, zero before the command."""
    i = np.arange(1, SPAN + 1)
    return np.where(i >= delay, g[..., np.maximum(i - delay, 0)], 0.0)


def _rough(x: Array) -> Array:
    """Return what a polynomial leaves of the last axis."""
    basis = smooth_basis()
    return x - x @ basis @ basis.T


def _misfits(h: Array, g: Array) -> Array:
    """Return per block the squared distance of h from the mean response g, less what does not depend on g."""
    mean = g.mean(axis=1, keepdims=True)
    return (mean**2 - 2.0 * h * mean).sum(axis=(0, 2))


def _in_errors(differences: Array) -> float:
    """Return the mean over blocks in standard errors."""
    return float(differences.mean()) / max(float(differences.std(ddof=1)) / sqrt(differences.size), 1e-300)


def _correlation(h: Array, g: Array) -> float:
    one, other = h.mean(axis=1), g.mean(axis=1)
    return float((one * other).sum() / max(np.sqrt((one**2).sum() * (other**2).sum()), 1e-300))


def _steps(count: int) -> str:
    return f"{count} step{'s' * (count > 1)}"
