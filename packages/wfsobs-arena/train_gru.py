"""Train the recurrent network of the arena, challengers/gru.npz: `python packages/wfsobs-arena/train_gru.py [EPOCHS]`.

Records of scenarios with random noise and wind, of seeds that the arena does not have. Adam on the squared error of the next
difference over its rms, gradients by backpropagation through WINDOW steps, the state carried on from window to window.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np
from scipy.special import expit
from threadpoolctl import threadpool_limits
from wfsobs_arena.challengers.gru import FILE, Weights, scaled_differences

from wfsobs.files import write_whole
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.typing import Array

TAPS, UNITS, WINDOW, RECORDS, SECONDS = 12, 16, 100, 40, 4.0
RATE, EPOCHS = 3e-3, 80


def training_records(rng: np.random.Generator) -> Array:
    """Return the measurements z of all records and modes, (n, n_records * n_modes)."""
    columns = []
    for i in range(RECORDS):
        changes = {
            "run.seed": i + 1,
            "run.duration": SECONDS,
            "vibration.synthesis": "gaussian",
            "sensors.lgs_noise": float(np.exp(rng.uniform(np.log(0.005), np.log(0.1)))),
            "turbulence.wind_speed": float(rng.uniform(8.0, 35.0)),
            "events": [],
        }
        name = ("paper", "strong-turbulence", "ut4", "ut4-floor", "peak-jump")[i % 5]
        columns.append(simulate(PRESETS[name]().replace(changes)).z)
    return np.hstack(columns)


def initial_weights(x: Array, target: Array, rng: np.random.Generator) -> Weights:
    """Return random weights of the unit, none of its output, and the linear part by least squares."""
    flat = x.reshape(-1, TAPS)
    v = np.linalg.solve(flat.T @ flat + 1e-3 * len(flat) * np.eye(TAPS), flat.T @ target.ravel())
    return {
        "W": rng.standard_normal((TAPS, 3 * UNITS)) / np.sqrt(TAPS),
        "U": rng.standard_normal((UNITS, 3 * UNITS)) / np.sqrt(UNITS),
        "b": np.concatenate([np.zeros(UNITS), np.linspace(-5.0, 0.0, UNITS), np.zeros(UNITS)]),  # slow and fast units
        "v": v,
        "w": np.zeros(UNITS),
    }


def loss_gradient(p: Weights, x: Array, target: Array, h: Array) -> tuple[float, dict[str, Array], Array]:
    """Return half the mean square error over a window, its gradient, and the state after it.

    x : (n, batch, taps);  target : (n, batch);  h : (batch, units)
    """
    n, batch, units = len(x), x.shape[1], h.shape[1]
    past, gates, news = np.empty((n, batch, units)), np.empty((n, batch, 2 * units)), np.empty((n, batch, units))
    driven = x @ p["W"] + p["b"]
    states = np.empty((n, batch, units))
    for k in range(n):
        past[k] = h
        gates[k] = expit(driven[k, :, : 2 * units] + h @ p["U"][:, : 2 * units])
        r, g = gates[k, :, :units], gates[k, :, units:]
        news[k] = np.tanh(driven[k, :, 2 * units :] + (r * h) @ p["U"][:, 2 * units :])
        states[k] = h = (1.0 - g) * h + g * news[k]
    error = x @ p["v"] + states @ p["w"] - target
    scaled = error / error.size
    from_output = scaled[:, :, None] * p["w"]
    d_driven, d_h = np.empty((n, batch, 3 * units)), np.zeros((batch, units))
    for k in range(n - 1, -1, -1):
        d = d_h + from_output[k]
        r, g = gates[k, :, :units], gates[k, :, units:]
        d_c = d * g * (1.0 - news[k] ** 2)
        d_rh = d_c @ p["U"][:, 2 * units :].T
        d_r = d_rh * past[k] * r * (1.0 - r)
        d_g = d * (news[k] - past[k]) * g * (1.0 - g)
        d_driven[k] = np.hstack([d_r, d_g, d_c])
        d_h = d * (1.0 - g) + d_rh * r + d_driven[k, :, : 2 * units] @ p["U"][:, : 2 * units].T
    flat_past, flat = past.reshape(-1, units), d_driven.reshape(-1, 3 * units)
    gated = (gates[:, :, :units] * past).reshape(-1, units)
    gradient = {
        "W": x.reshape(n * batch, -1).T @ flat,
        "U": np.hstack([flat_past.T @ flat[:, : 2 * units], gated.T @ flat[:, 2 * units :]]),
        "b": flat.sum(axis=0),
        "v": np.einsum("kb,kbt->t", scaled, x),
        "w": np.einsum("kb,kbu->u", scaled, states),
    }
    return 0.5 * float(np.mean(error**2)), gradient, h


def windows(n: int) -> Iterator[slice]:
    """Yield the windows of a record of n steps."""
    for start in range(0, n - WINDOW + 1, WINDOW):
        yield slice(start, start + WINDOW)


def train(x: Array, target: Array, p: Weights, epochs: int) -> Weights:
    """Return the weights after some epochs of Adam, the rate falling to zero."""
    p = {name: value.copy() for name, value in p.items()}
    mean, square = ({name: np.zeros_like(value) for name, value in p.items()} for _ in range(2))
    step, n_windows = 0, len(list(windows(len(x))))
    for epoch in range(epochs):
        h, losses = np.zeros((x.shape[1], UNITS)), []
        for window in windows(len(x)):
            loss, gradient, h = loss_gradient(p, x[window], target[window], h)
            norm = np.sqrt(sum(float(np.sum(g**2)) for g in gradient.values()))
            step += 1
            rate = RATE * (1.0 - step / (epochs * n_windows + 1))
            for name, g in gradient.items():
                g = g * min(1.0, 1.0 / norm)
                mean[name] += 0.1 * (g - mean[name])
                square[name] += 1e-3 * (g**2 - square[name])
                p[name] -= rate * (mean[name] / (1 - 0.9**step)) / (np.sqrt(square[name] / (1 - 0.999**step)) + 1e-8)
            losses.append(loss)
        print(f"epoch {epoch + 1}: rms {np.sqrt(2 * np.mean(losses)):.5f}", flush=True)
    return p


def main() -> None:
    """Train and write the file."""
    threadpool_limits(1, user_api="blas")
    rng = np.random.default_rng(20)
    z = training_records(rng)
    x, scale = scaled_differences(z, TAPS)
    x, target = x[WINDOW:-1], ((z[1:] - z[:-1]) / scale[:-1])[WINDOW:]  # after the rms has settled
    p = initial_weights(x, target, rng)
    print(f"linear: rms {np.sqrt(np.mean((x @ p['v'] - target) ** 2)):.5f}", flush=True)
    p = train(x, target, p, int(sys.argv[1]) if len(sys.argv) > 1 else EPOCHS)
    write_whole(FILE, lambda file: np.savez_compressed(file, **{n: v.astype(np.float32) for n, v in p.items()}))


if __name__ == "__main__":
    main()
