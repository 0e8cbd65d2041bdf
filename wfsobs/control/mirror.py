"""The deformable mirror of one mode, the plant that it is part of, and linear control laws.

The mirror has a delay, a fraction of a frame included, and limits. With a delay of n + f frames, 0 <= f < 1, a command held for a
frame acts during the last 1 - f of step k + n - 1 and the first f of step k + n (zero-order hold), so that

    phi_corr[k] = (1 - f) u[k-n+1] + f u[k-n],    y[k] = phi_dist[k-1] + phi_corr[k-1] + w[k].

The paper's n = 2, f = 0 gives its phi_corr[k] = u[k-1].

A law is a causal filter from measurements to commands. Delay and mirror are known, so the mirror's part can be taken off the
measurement, and the pseudo-open-loop z[k] = phi_dist[k-1] + w[k] holds none of the commands. Every law is therefore a filter u =
-F z, even in closed loop, with no feedback to simulate. In terms of the measurement y = z + P u that a loop has, with P the
mirror's delay,

    controller C = F / (1 - P F),    loop gain L = P C,    rejection 1 / (1 + L) = 1 - P F.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
import scipy

from wfsobs.observers.kalman.step import ModeFilter
from wfsobs.observers.stepping import GainCycle
from wfsobs.signal.joint_states import StateFilter
from wfsobs.signal.periodic import PeriodicFilter
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
        f = self.delay % 1.0
        return np.array([0.0] * int(self.delay) + ([1.0 - f, f] if f else [1.0]))

    @property
    def has_limits(self) -> bool:
        """Whether there is a limit at all."""
        return min(self.stroke, self.slew) < inf

    def correction(self, u: Array) -> Array:
        """phi_corr (n_steps, ...) [um] of commands u of that shape."""
        return scipy.signal.lfilter(self.taps[1:], [1.0], u, axis=0)

    def response(self, omega: Array) -> Complex:
        """P, from a command to the measurement, at omega [rad per step]; same shape."""
        return np.exp(-1j * np.multiply.outer(omega, np.arange(self.taps.size))) @ self.taps

    def clip_commands(self, u: Array, last: Array) -> Array:
        """Return the commands of all modes nearest to u (n_modes,) within the limits after `last` [um]."""
        return np.clip(np.clip(u, last - self.slew, last + self.slew), -self.stroke, self.stroke) if self.has_limits else u

    def clip_command(self, command: float, last: float) -> float:
        """Return `clip_commands` of one mode."""
        return min(max(min(max(command, last - self.slew), last + self.slew), -self.stroke), self.stroke)

    def follow(self, u: Array) -> Array:
        """Return the commands (n_steps,) [um] that the mirror takes for the wanted ones of one mode, from rest."""
        out, last = [], 0.0
        for wanted in u.tolist():
            last = self.clip_command(wanted, last)
            out.append(last)
        return np.array(out)

    def within(self, u: Array) -> bool:
        """Whether commands u (n_steps, ...) [um], from rest, keep the limits."""
        return bool(np.abs(u).max() <= self.stroke and np.abs(np.diff(u, axis=0, prepend=0.0)).max() <= self.slew)

    def at_limit(self, u: Array) -> Array:
        """Whether taken commands u (n_steps, ...) [um], from rest, are at a limit; same shape."""
        near = 1.0 - 1e-12
        return (np.abs(u) >= near * self.stroke) | (np.abs(np.diff(u, axis=0, prepend=0.0)) >= near * self.slew)


@dataclass(frozen=True)
class Plant:
    """What a controller is made for: the mirror of a mode, the fast step `dt` [s], and fast steps per NGS frame."""

    mirror: Mirror
    dt: float
    ratio: int


@dataclass(frozen=True)
class Law:
    """A linear law of one mode.

    cycle : the filter from z (LGS, or LGS and NGS) to u, with a step 0 that is not one of the cycle where there is one
    gain, leak : of an integrator
    gains, row : the same filter as an observer: u[k] = row x_hat[k]; None where it is not known as one
    filter : the Kalman filter that this observer is, to which a missing measurement is none; None where it is no such filter
    """

    cycle: PeriodicFilter
    gain: float | None = None
    leak: float = 1.0
    gains: GainCycle | None = None
    row: Array | None = None
    filter: ModeFilter | None = None

    def run(self, z: Array) -> Array:
        """Return the commands (n_steps,) [um] of measurements z (n_steps, n_inputs) [um]."""
        return self.cycle.run(z[:, : self.cycle.steps[0][1].shape[1]])[:, 0]

    @property
    def poles(self) -> Complex:
        """Poles of the closed loop, of one cycle where it is periodic; the mirror's own delay aside."""
        return np.linalg.eigvals(self.cycle.cycle_matrix()).astype(complex)

    @property
    def stable(self) -> bool:
        """Whether all poles lie within the unit circle."""
        return bool(np.abs(self.poles).max(initial=0.0) < 1.0)

    @property
    def time_invariant(self) -> bool:
        """Whether it is a filter of the LGS that does the same at every step, and so has a frequency response."""
        return len(self.cycle.steps) == 1 and self.cycle.steps[0][1].shape[1] == 1

    def response(self, omega: Array) -> Complex:
        """F = -u / z at omega (n,) [rad per step], (n,); of time-invariant laws."""
        F, G, H, J = self.cycle.steps[0]
        return -(H[0] @ StateFilter(F, G[:, 0]).response(omega) * np.exp(-1j * omega) + J[0, 0])
