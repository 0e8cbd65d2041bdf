"""The paper's state-space model (eq. 6 and 7), for one Zernike mode.

State x[k] = (phi_turb[k], phi_turb[k-1], phi_vib[k], phi_vib[k-1], u[k-1], u[k-2]), so that
y[k] = C x[k] + w[k] = phi_dist[k-1] + u[k-2] + w[k]. With the B_u = (0, 1) that the paper prints, y[k]
would see u[k-1]; B_u = (1, 0) is what its sensor and mirror equations (3 to 5) say.

The mirror's part of the state is known exactly: the Riccati solution is zero there, and the filter
on y[k] and u[k] is the filter of the disturbance alone on z[k] = y[k] - u[k-2]. Observers use that
smaller model, `DisturbanceModel`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from wfsobs.ar2 import Ar2
from wfsobs.arrays import Array

MIN_MODEL_DAMPING = 1e-4
"""Damping floor of a modelled process: a line of damping 0 would put an estimator pole on the unit circle."""


@dataclass(frozen=True)
class DisturbanceModel:
    """Sum of AR(2) processes measured one step late, z[k] = C x[k] + w[k].

    A (n, n), C (n,) with x = (phi_1[k], phi_1[k-1], phi_2[k], ...); Q (n, n) in [um^2].
    outputs : target -> row (n,) that gives its phi[k].
    """

    A: Array
    C: Array
    Q: Array
    outputs: dict[str, Array]

    def output_rows(self, targets: Sequence[str]) -> Array:
        """The rows of several targets, (len(targets), n)."""
        return np.array([self.outputs[target] for target in targets])


def disturbance_model(turbulence: list[Ar2], vibration: list[Ar2]) -> DisturbanceModel:
    """The model of all the given processes, each with its own drive (paper, eq. 1, 2 and 7)."""
    processes = [*turbulence, *vibration]
    n = 2 * len(processes)
    C, Q = np.zeros(n), np.zeros((n, n))
    C[1::2] = 1.0
    Q[range(0, n, 2), range(0, n, 2)] = [p.drive_variance for p in processes]
    rows = {"turbulence": np.zeros(n), "vibration": np.zeros(n)}
    rows["turbulence"][0 : 2 * len(turbulence) : 2] = 1.0
    rows["vibration"][2 * len(turbulence) :: 2] = 1.0
    return DisturbanceModel(block_diag(*(p.transition for p in processes)), C, Q, rows)


def paper_matrices(turbulence: Ar2, vibration: Ar2) -> tuple[Array, Array, Array]:
    """A (6, 6), B (6,), C (6,) of the paper's eq. 7, with the B_u that its equations 3 to 5 imply."""
    A = block_diag(turbulence.transition, vibration.transition, [[0.0, 0.0], [1.0, 0.0]])
    B = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    C = np.array([0.0, 1.0, 0.0, 1.0, 0.0, 1.0])
    return A, B, C
