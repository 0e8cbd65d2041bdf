"""Fixed-interval smoothing: what a whole window of measurements says of every step of it, the past and the future of the step.

With x_pred and e the predictions and innovations of the steady-state Kalman filter, F = A (I - L C) and S the variance of e,

    lambda[k] = C' e[k] / S + F' lambda[k+1],    x_s[k] = x_pred[k] + P lambda[k]

is the smoothed state (Bryson and Frazier 1963), P - P Lambda P its covariance, Lambda that of lambda. The window begins with the
state zero of covariance P.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wfsobs.signal.filter_covariance import lyapunov
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.signal.riccati import steady_state
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.typing import Array


class Smoother(NamedTuple):
    """The smoother of one target.

    forward  : z -> prediction of z and of the target, from the measurements before
    backward : innovations in reverse -> what the measurements now and later add to the target
    variance : of its error far from the ends [um^2]
    """

    forward: PeriodicFilter
    backward: PeriodicFilter
    variance: float

    def run(self, z: Array) -> Array:
        """Return the target at every step of z (n,), given all of z, (n,)."""
        expected, target = self.forward.run(z[:, None, None])[:, :, 0].T
        return target + self.backward.run((z - expected)[::-1, None, None])[::-1, 0, 0]


def smoother(model: DisturbanceModel, target: str, noise: float) -> Smoother:
    """Return the smoother of a target, noise : rms of the white noise of z [um]. Raises RiccatiError."""
    s, A, C, row = steady_state(model.A, model.C, model.Q, np.array(noise**2)), model.A, model.C[None], model.outputs[target]
    F, S = A - s.K @ C, float((C @ s.P @ C.T)[0, 0]) + noise**2
    into, h = C.T / S, row @ s.P
    variance = row @ s.P @ row - h @ lyapunov(F.T, into @ C) @ h
    return Smoother(
        PeriodicFilter([(F, s.K, np.vstack([C, row]), np.zeros((2, 1)))]),
        PeriodicFilter([(F.T, into, (h @ F.T)[None], h[None] @ into)]),
        max(float(variance), 0.0),
    )
