"""Interacting multiple models: Kalman filters of several hypotheses, mixed by how well each predicts.

Before every step the filters start from a mixture of the states of all, weighed by the probability that the disturbance passes
from one hypothesis to another; afterwards each hypothesis has the probability that its innovation gives it, the estimate is the
mean over them (Blom and Bar-Shalom 1988, IEEE Trans. Autom. Control 33, 780). The hypotheses are the model that it is told,
turbulence that is twice as fast, and a vibration peak that is lower or higher by SHIFT. With one it is the Kalman filter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import pi
from typing import Any, NamedTuple

import numpy as np

from wfsobs.observers.base import TARGETS, Observer
from wfsobs.prior import Model, Prior
from wfsobs.progress import Watch
from wfsobs.record import NEXT_Z, TOTAL, Estimates, Measurements
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.typing import Array
from wfsobs_arena.challengers.base import Challenger

STAY = 2.0
"""Mean time in a hypothesis [s]."""

SHIFT = 0.06
"""Of the frequency of the vibration peak, over it."""

FASTER = 2.0
"""Speed of the turbulence of a gust, over that of the model."""

BLOCK = 1000
"""Steps between two looks at whether to stop."""


class Mixture(NamedTuple):
    """What the filters of a mode give after every step.

    values        : means of the rows, (n, n_rows)
    variances     : of the rows, (n, n_rows), the spread between hypotheses included
    probabilities : of the hypotheses, (n, n_models)
    """

    values: Array
    variances: Array
    probabilities: Array


def hypotheses(model: Model) -> list[DisturbanceModel]:
    """Return the models of a mode: as told, a gust, the peak lower and higher. Their states are pairs (phi[k], phi[k-1])."""
    slow, peak = model.turbulence, model.vibration
    variants = [
        model,
        replace(model, turbulence=replace(slow, omega=FASTER * slow.omega)),
        replace(model, vibration=replace(peak, omega=(1.0 - SHIFT) * peak.omega)),
        replace(model, vibration=replace(peak, omega=min((1.0 + SHIFT) * peak.omega, 0.9 * pi / peak.dt))),
    ]
    return [one.disturbance() for one in variants]


def to_pairs(model: DisturbanceModel) -> DisturbanceModel:
    """Return a model in the coordinates (phi_1[k], phi_1[k-1], phi_2[k], ...), which all hypotheses share."""
    T, back = model.pairs, np.linalg.inv(model.pairs)
    outputs = {target: row @ back for target, row in model.outputs.items()}
    return DisturbanceModel(T @ model.A @ back, model.C @ back, T @ model.Q @ T.T, outputs, np.eye(len(T)))


def stationary_covariance(model: DisturbanceModel) -> Array:
    """Return the covariance of the state, (n, n)."""
    from scipy.linalg import solve_discrete_lyapunov

    return solve_discrete_lyapunov(model.A, model.Q)


def run_mixture(
    z: Array, models: Sequence[DisturbanceModel], noise: float, stay: float, rows: Array, watch: Watch | None = None
) -> Mixture:
    """Run interacting multiple models on the measurements of a mode.

    Parameters
    ----------
    z : Array
        Measurements, (n,).
    models : sequence of DisturbanceModel
        Hypotheses, with states of the same meaning.
    noise : float
        Rms of the measurement noise.
    stay : float
        Probability that the hypothesis is the same at the next step.
    rows : Array
        Rows of the state to return, (n_rows, n_states).
    watch : Watch, optional
        Asked whether to stop.

    Returns
    -------
    Mixture
        After every step.
    """
    m, n = len(models), len(z)
    A, C, Q = (np.array([getattr(one, name) for one in models]) for name in ("A", "C", "Q"))
    passage = np.full((m, m), (1.0 - stay) / max(m - 1, 1))
    np.fill_diagonal(passage, stay if m > 1 else 1.0)
    x, P = np.zeros(C.shape), np.array([stationary_covariance(one) for one in models])
    mu = np.full(m, 1.0 / m)
    out = Mixture(np.empty((n, len(rows))), np.empty((n, len(rows))), np.empty((n, m)))
    for k in range(n):
        if watch is not None and k % BLOCK == 0:
            watch.check()
        prior = mu @ passage
        weights = (passage * mu[:, None] / prior).T  # of the state of each hypothesis, for each one
        mixed = weights @ x
        apart = x[None] - mixed[:, None]
        P = np.einsum("ij,jab->iab", weights, P) + np.einsum("ij,ija,ijb->iab", weights, apart, apart)
        x, P = np.einsum("iab,ib->ia", A, mixed), A @ P @ A.transpose(0, 2, 1) + Q
        PC = np.einsum("iab,ib->ia", P, C)
        variance = np.einsum("ia,ia->i", C, PC) + noise**2
        innovation = z[k] - np.einsum("ia,ia->i", C, x)
        x = x + PC * (innovation / variance)[:, None]
        P = P - PC[:, :, None] * PC[:, None, :] / variance[:, None, None]
        log = np.log(prior) - 0.5 * (np.log(variance) + innovation**2 / variance)
        mu = np.exp(log - log.max())
        mu /= mu.sum()
        each = x @ rows.T
        out.values[k] = mean = mu @ each
        out.variances[k] = mu @ (np.einsum("ra,iab,rb->ir", rows, P, rows) + (each - mean) ** 2)
        out.probabilities[k] = mu
    return out


def run_imm(measurements: Measurements, prior: Prior, _settings: Any, watch: Watch) -> Estimates:
    """Run the filters of every mode on z."""
    z, stay, found = measurements.z, float(np.exp(-measurements.dt / STAY)), []
    for mode, model in enumerate(prior.model):
        watch.step(mode / measurements.n_modes)
        models = [to_pairs(one) for one in hypotheses(model)]
        targets = models[0].output_rows(TARGETS)
        rows = np.vstack([targets, targets.sum(axis=0)])
        found.append(run_mixture(z[:, mode], models, max(model.lgs_noise, 1e-6), stay, rows, watch))
    values = np.stack([one.values for one in found], axis=2)
    sd = np.sqrt(np.stack([one.variances for one in found], axis=2))
    noise = np.array([model.lgs_noise for model in prior.model])
    spread = {name: sd[:, i] for i, name in enumerate((*TARGETS, TOTAL))} | {NEXT_Z: np.hypot(sd[:, 2], noise)}
    return Estimates({target: values[:, i] for i, target in enumerate(TARGETS)}, spread)


IMM = Challenger(
    Observer(
        "imm",
        "Interacting models",
        TARGETS,
        run_imm,
        help="Kalman filters for the model, a gust, and a peak that is lower or higher, mixed by their innovations",
        prior=(Model,),
    ),
    ("vibration", "turbulence", "disturbance", "next", "events"),
    "Blom and Bar-Shalom 1988, IEEE Trans. Autom. Control 33, 780",
)
