"""The deformable mirror of one mode: its delay, a fraction of a frame included, and its limits; and the plant that it is part of.

With a delay of n + f frames, 0 <= f < 1, a command held for a frame acts during the last 1 - f of step k + n - 1 and the
first f of step k + n (zero-order hold), so that

    phi_corr[k] = (1 - f) u[k-n+1] + f u[k-n],    y[k] = phi_dist[k-1] + phi_corr[k-1] + w[k].

The paper's n = 2, f = 0 gives its phi_corr[k] = u[k-1].
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from scipy.signal import lfilter

from wfsobs.signal.wiener import Complex
from wfsobs.typing import Array


@dataclass(frozen=True)
class Mirror:
    """delay: frames, at least 1; stroke: largest |u| [um]; slew: largest |u[k] - u[k-1]| [um]."""

    delay: float = 2.0
    stroke: float = inf
    slew: float = inf

    @property
    def taps(self) -> Array:
        """Weights of u[k], u[k-1], ... in y[k]; the first is 0, their sum 1."""
        n = int(self.delay)
        f = self.delay - n
        out = np.zeros(n + 2 if f > 0 else n + 1)
        out[n] = 1.0 - f
        if f > 0:
            out[n + 1] = f
        return out

    @property
    def has_limits(self) -> bool:
        """Whether there is a limit at all."""
        return min(self.stroke, self.slew) < inf

    def correction(self, u: Array) -> Array:
        """phi_corr (n_steps, ...) [um] of commands u of that shape."""
        return lfilter(self.taps[1:], [1.0], u, axis=0)

    def response(self, omega: Array) -> Complex:
        """P, from a command to the measurement, at omega [rad per step]; same shape."""
        return np.exp(-1j * np.multiply.outer(omega, np.arange(self.taps.size))) @ self.taps

    def clip_command(self, command: float, last: float) -> float:
        """Return the command nearest to `command` within the limits after `last` [um]."""
        near = min(max(command, last - self.slew), last + self.slew)
        return min(max(near, -self.stroke), self.stroke)

    def within(self, u: Array) -> bool:
        """Whether commands u (n_steps,) [um], from rest, keep the limits."""
        return bool(np.abs(u).max() <= self.stroke and np.abs(np.diff(u, prepend=0.0)).max() <= self.slew)

    def at_limit(self, u: Array) -> Array:
        """Whether taken commands u (n_steps, ...) [um], from rest, are at a limit; same shape."""
        near = 1.0 - 1e-12
        return (np.abs(u) >= near * self.stroke) | (np.abs(np.diff(u, axis=0, prepend=0.0)) >= near * self.slew)

    def follow(self, u: Array) -> Array:
        """Return the commands (n_steps,) [um] that the mirror takes for the wanted ones, from rest."""
        if self.within(u):
            return u
        out, last = [], 0.0
        for wanted in u.tolist():
            last = self.clip_command(wanted, last)
            out.append(last)
        return np.array(out)


@dataclass(frozen=True)
class Plant:
    """What a controller is made for: the mirror of a mode, the fast step `dt` [s], and fast steps per NGS frame."""

    mirror: Mirror
    dt: float
    ratio: int
