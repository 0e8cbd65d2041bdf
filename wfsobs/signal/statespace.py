"""The paper's state-space model (eq. 6 and 7), for one Zernike mode.

State x[k] = (phi_turb[k], phi_turb[k-1], phi_vib[k], phi_vib[k-1], u[k-1], u[k-2]), so that
y[k] = C x[k] + w[k] = phi_dist[k-1] + u[k-2] + w[k]. With the B_u = (0, 1) that the paper prints, y[k]
would see u[k-1]; B_u = (1, 0) is what its sensor and mirror equations (3 to 5) say.

The commands in the state are known exactly: the Riccati solution is zero there, and the filter
on y[k] and u[k] is the filter of the disturbance alone on z[k] = y[k] - u[k-2]. Observers use that
smaller model, `DisturbanceModel`, in coordinates that keep its digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import toeplitz

from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.typing import Array

MIN_MODEL_DAMPING = 1e-4
"""Minimum damping of a modelled process: a line of damping 0 would put an estimator pole on the unit circle."""

BLOCK = 256
"""Steps of a third-order process that are drawn at once."""


@dataclass(frozen=True)
class DisturbanceModel:
    """Sum of autoregressive processes measured one step late, z[k] = C x[k] + w[k].

    Attributes
    ----------
    A, C, Q : Array
        Transition (n, n), measurement (n,) and process-noise covariance (n, n); the state has as many elements per
        process as it has poles (`process_model`).
    outputs : dict of str to Array
        Target -> row (n,) that gives its phi[k] [um].
    pairs : Array
        (two per process, n): gives the paper's state (phi_1[k], phi_1[k-1], phi_2[k], ...) [um].
    """

    A: Array
    C: Array
    Q: Array
    outputs: dict[str, Array]
    pairs: Array

    def output_rows(self, targets: Sequence[str]) -> Array:
        """Return the rows of several targets, (len(targets), n)."""
        return np.array([self.outputs[target] for target in targets])


class ProcessModel(NamedTuple):
    """One process of p poles as a state-space model: A, Q (p, p); rows (p,) that give phi[k] and phi[k-1]."""

    A: Array
    Q: Array
    now: Array
    before: Array


def process_model(p: Ar2) -> ProcessModel:
    """Return an AR(2) process in uncorrelated coordinates of unit variance.

    The paper's pair (phi[k], phi[k-1]) is almost linearly dependent for a slow process, which costs the Riccati equation
    its digits. With rho the correlation of the two, s = sqrt(1 - rho^2) and

        phi[k] = rms xi_0,    phi[k-1] = rms (rho xi_0 + s xi_1)

    the same process is xi[k+1] = [[rho, a2 s], [s, -rho a2]] xi[k] + (1, -rho / s) v[k], v for phi of rms one. For s, nothing is
    subtracted from one: s (1 - a2) = |1 - exp(-2 xi w T + 2 i angle)| has the two squares below.
    """
    (damped, angle), rho = p.turn, p.correlation
    s = np.hypot(np.expm1(-2.0 * damped), 2.0 * np.exp(-damped) * np.sin(angle)) / (1.0 - p.a2)
    drive = np.array([1.0, -rho / s])
    return ProcessModel(
        A=np.array([[rho, p.a2 * s], [s, -rho * p.a2]]),
        Q=p.unit_drive_variance * np.outer(drive, drive),
        now=p.rms * np.array([1.0, 0.0]),
        before=p.rms * np.array([rho, s]),
    )


def third_order_model(p: Ar3) -> ProcessModel:
    """Return a third-order process in uncorrelated coordinates of unit variance, like `process_model`.

    xi_0 is phi[k], xi_1 the part of phi[k-1] that is independent of it, xi_2 the part of phi[k-2] that is independent of
    both, each over its own rms. With the partial autocorrelations k_i and s_i = sqrt(1 - k_i^2), (A | drive) has orthonormal
    rows (the normalised lattice of Gray and Markel, IEEE Trans. ASSP 23, 268, 1975), so the state keeps its variance
    whatever the rounding of the k_i.
    """
    (k1, k2, k3), (s1, s2, s3) = p.lattice
    drive = np.array([s1 * s2 * s3, -k1 * s2 * s3, -k2 * s3])
    return ProcessModel(
        A=np.array([[k1, k2 * s1, k3 * s1 * s2], [s1, -k1 * k2, -k1 * k3 * s2], [0.0, s2, -k2 * k3]]),
        Q=np.outer(drive, drive),
        now=p.rms * np.array([1.0, 0.0, 0.0]),
        before=p.rms * np.array([k1, s1, 0.0]),
    )


def sample_ar3(p: Ar3, n: int, rng: np.random.Generator) -> Array:
    """Draw `n` steps of a third-order process, stationary from the first, (n,).

    By its state, block by block: in a difference equation a slow process loses the sum of its coefficients, of order (w T)^3.
    """
    model = third_order_model(p)
    A, drive, x = model.A, model.Q[:, 0] / np.sqrt(model.Q[0, 0]), rng.standard_normal(3)
    v = np.zeros((-(-n // BLOCK), BLOCK))
    v.flat[:n] = rng.standard_normal(n)
    powers = [np.eye(3)]
    for _ in range(BLOCK):
        powers.append(A @ powers[-1])
    free, forced = np.array(powers)[:, 0], np.array(powers) @ drive
    out = v @ toeplitz(np.zeros(BLOCK), np.append(0.0, forced[: BLOCK - 1, 0]))
    for block, kicks in zip(out, v @ forced[BLOCK - 1 :: -1], strict=True):
        block += free[:BLOCK] @ x
        x = powers[-1] @ x + kicks
    return p.rms * out.ravel()[:n]


def disturbance_model(turbulence: Sequence[Ar2 | Ar3], vibration: Sequence[Ar2 | Ar3]) -> DisturbanceModel:
    """Return the model of the sum of processes, each with its own drive (paper, eq. 1, 2 and 7).

    Parameters
    ----------
    turbulence, vibration : sequence of Ar2 or Ar3
        Processes of either part.

    Returns
    -------
    DisturbanceModel
        The state-space model.
    """
    models = [third_order_model(p) if isinstance(p, Ar3) else process_model(p) for p in (*turbulence, *vibration)]
    now = np.concatenate([m.now for m in models])
    first = np.arange(now.size) < sum(m.now.size for m in models[: len(turbulence)])
    return DisturbanceModel(
        A=blocks_along_diagonal([m.A for m in models]),
        C=np.concatenate([m.before for m in models]),
        Q=blocks_along_diagonal([m.Q for m in models]),
        outputs={"turbulence": np.where(first, now, 0.0), "vibration": np.where(first, 0.0, now)},
        pairs=blocks_along_diagonal([np.array([m.now, m.before]) for m in models]),
    )


def blocks_along_diagonal(blocks: Sequence[Array]) -> Array:
    """Return matrices (n_i, m_i) along a diagonal, (sum n_i, sum m_i); scipy's function takes ten times as long."""
    rows, columns = np.cumsum([block.shape for block in blocks], axis=0).T
    out = np.zeros((rows[-1], columns[-1]))
    for row, column, block in zip(rows, columns, blocks, strict=True):
        n, m = block.shape
        out[row - n : row, column - m : column] = block
    return out


def paper_matrices(turbulence: Ar2, vibration: Ar2) -> tuple[Array, Array, Array]:
    """Return A (6, 6), B (6,) and C (6,) of the paper's eq. 7, with the B_u that its equations 3 to 5 imply."""
    A = blocks_along_diagonal([turbulence.transition, vibration.transition, np.array([[0.0, 0.0], [1.0, 0.0]])])
    B = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    C = np.array([0.0, 1.0, 0.0, 1.0, 0.0, 1.0])
    return A, B, C
