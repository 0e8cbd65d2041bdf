"""A linear control law: a causal filter from measurements to commands.

Delay and mirror are known, so the mirror's part can be taken off the measurement, and the pseudo-open-loop
z[k] = phi_dist[k-1] + w[k] holds none of the commands. Every law is therefore a filter u = -F z, even in closed loop,
with no feedback to simulate. In terms of the measurement y = z + P u that a loop has, with P the mirror's delay,

    controller C = F / (1 - P F),    loop gain L = P C,    rejection 1 / (1 + L) = 1 - P F.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.linalg import schur

from wfsobs.observers.kalman.mode_filter import ModeFilter
from wfsobs.observers.stepping import GainCycle
from wfsobs.signal.periodic import FilterStep, PeriodicFilter
from wfsobs.signal.wiener import Complex
from wfsobs.typing import Array


@dataclass(frozen=True)
class Law:
    """A linear law of one mode.

    cycle : the filter from z (LGS, or LGS and NGS) to u
    run   : z (n_steps, n_inputs) [um] -> u (n_steps,) [um]
    gain, leak : of an integrator
    first : step 0, where it is not one of the cycle
    gains, row : the same filter as an observer: u[k] = row x_hat[k]; None where it is not known as one
    filter : the Kalman filter that this observer is, to which a missing measurement is none; None where it is no such filter
    """

    cycle: PeriodicFilter
    run: Callable[[Array], Array]
    gain: float | None = None
    leak: float = 1.0
    first: FilterStep | None = None
    gains: GainCycle | None = None
    row: Array | None = None
    filter: ModeFilter | None = None

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
        return -transfer(F, G[:, 0], H[0], float(J[0, 0]), np.exp(1j * omega))


def steady_law(cycle: PeriodicFilter, gain: float | None = None, leak: float = 1.0) -> Law:
    """Return the law of a filter of the LGS alone."""
    return Law(cycle, partial(_run_steady, cycle), gain, leak)


def _run_steady(cycle: PeriodicFilter, z: Array) -> Array:
    return cycle.run(z[:, :1, None])[:, 0, 0]


def transfer(F: Array, G: Array, H: Array, J: float, z: Complex) -> Complex:
    """Return H (z I - F)^-1 G + J at all z (n,) at once.

    By the triangular form of F, since nearly equal poles have no well-defined eigenvectors.
    """
    if not len(F):
        return np.full(z.shape, complex(J))
    T, Q = schur(F.astype(complex), output="complex")
    b = Q.conj().T @ G
    x = np.empty((len(F), z.size), dtype=complex)
    for i in reversed(range(len(F))):
        x[i] = (b[i] + T[i, i + 1 :] @ x[i + 1 :]) / (z - T[i, i])
    return (H @ Q) @ x + J
