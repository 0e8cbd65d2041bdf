"""A small recurrent network, to see whether a nonlinear predictor gains anything at tip and tilt.

A gated recurrent unit (Cho et al. 2014, arXiv:1406.1078) takes the last differences of z over their rms, x, and predicts the
next one,

    r = S(W_r x + U_r h + b_r),  g = S(W_g x + U_g h + b_g),  c = tanh(W_c x + U_c (r h) + b_c),  h <- (1 - g) h + g c,
    z[k+1] = z[k] + s (v x + w h),

S the logistic function, s the rms of the differences so far. Each mode is by itself. The weights are those of `gru.npz`, trained
by scripts/train_gru.py on simulated records of other seeds and settings than those of the arena; nothing is learnt in a run.
Hafeez et al. (2022, JATIS 8, 029003) find no gain of networks over a linear autoregression.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit

from wfsobs.observers.base import TARGETS, Observer
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Estimates, Measurements
from wfsobs.typing import Array
from wfsobs_arena.challengers.base import WHOLE, Challenger, whole_estimate
from wfsobs_arena.challengers.rls import histories

FILE = Path(__file__).with_name("gru.npz")
"""The weights: W (taps, 3 units), U (units, 3 units), b (3 units,) for r, g and c; v (taps,), w (units,)."""

MEMORY = 1000.0
"""Differences after which the past of their rms counts 1 / e."""

BLOCK = 1000
"""Steps between two looks at whether to stop."""

Weights = Mapping[str, Array]


@cache
def stored_weights() -> Weights:
    """Return the weights of the file."""
    with np.load(FILE, allow_pickle=False) as file:
        return {name: file[name].astype(float) for name in file.files}


def scaled_differences(z: Array, taps: int) -> tuple[Array, Array]:
    """Return the last differences over their rms, the newest first, (n, n_modes, taps), and the rms, (n, n_modes)."""
    differences = np.vstack([np.zeros((1, z.shape[1])), np.diff(z, axis=0)])
    keep, total, weight, scale = np.exp(-1.0 / MEMORY), np.zeros(z.shape[1]), 0.0, np.empty_like(z)
    for k, square in enumerate(differences**2):
        total, weight = keep * total + square, keep * weight + 1.0
        scale[k] = total / weight
    scale = np.sqrt(scale) + 1e-12
    return histories(differences, taps).reshape(len(z), taps, -1).transpose(0, 2, 1) / scale[:, :, None], scale


def step_gru(weights: Weights, x: Array, h: Array) -> Array:
    """Return the next state (n_modes, units) from inputs (n_modes, taps) and the state."""
    units = h.shape[1]
    gates = expit(x @ weights["W"][:, : 2 * units] + h @ weights["U"][:, : 2 * units] + weights["b"][: 2 * units])
    r, g = gates[:, :units], gates[:, units:]
    c = np.tanh(x @ weights["W"][:, 2 * units :] + (r * h) @ weights["U"][:, 2 * units :] + weights["b"][2 * units :])
    return (1.0 - g) * h + g * c


def predict_gru(weights: Weights, z: Array, watch: Watch | None = None) -> Array:
    """Return the predictions of z[k + 1] from z up to step k, (n, n_modes)."""
    x, scale = scaled_differences(z, len(weights["v"]))
    h, out = np.zeros((z.shape[1], len(weights["w"]))), np.empty_like(z)
    for k in range(len(z)):
        if watch is not None and k % BLOCK == 0:
            watch.step(k / len(z))
        h = step_gru(weights, x[k], h)
        out[k] = z[k] + scale[k] * (x[k] @ weights["v"] + h @ weights["w"])
    return out


def run_gru(measurements: Measurements, _prior: Prior, _settings: Any, watch: Watch) -> Estimates:
    """Run the network on z."""
    return whole_estimate(predict_gru(stored_weights(), measurements.z, watch))


GRU = Challenger(
    Observer("gru", "Recurrent network", TARGETS, run_gru, help="a gated recurrent unit, trained on simulated records"),
    WHOLE,
    "Hafeez et al. 2022, JATIS 8, 029003; Cho et al. 2014, arXiv:1406.1078",
)
