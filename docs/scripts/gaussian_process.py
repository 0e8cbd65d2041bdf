"""The table of docs/gaussian-processes.md: from windows to time, vibration of tip, preset `paper`, five seeds.

A Gaussian process in time that sees the last d measurements alone is a linear predictor of windows; with all it is a filter.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from scipy.linalg import solve

from wfsobs import PRESETS, observe, simulate
from wfsobs.observers.gp import GaussianProcess, kernels_of
from wfsobs.observers.gpr.ridge import predict
from wfsobs.prior import Lines
from wfsobs.priors_from.scenario import prior_of

SEEDS = range(1, 6)
DEPTHS = (10, 30, 100, 407, 1000)
LEARN = ("gpr-offline", "ridge", "ridge-30")
TOLD = ("kf-lgs", "kf-multi", "gp-lgs")


def weights(lines: Lines, depth: int) -> np.ndarray:
    """Weights of the last measurements, the newest first, in the posterior mean of the vibration now."""
    lags = lines.dt * np.arange(depth + 1)
    turbulence, vibration, _ = (kernel.state_space().covariance(lags) for kernel in kernels_of(lines, GaussianProcess()))
    both = (turbulence + vibration)[np.abs(np.subtract.outer(np.arange(depth), np.arange(depth)))]
    return solve(both + lines.noise**2 * np.eye(depth), vibration[1:], assume_a="pos")


if __name__ == "__main__":
    squares = defaultdict(list)
    for seed in SEEDS:
        scenario = PRESETS["paper"]().replace({"run.seed": seed})
        record = simulate(scenario)
        truth, start = record.vibration[:, 0], round(4.0 / record.dt)
        lines = prior_of(scenario, record, (Lines,)).lines[0]
        for depth in DEPTHS:
            estimate = predict(record.z[:, :1], weights(lines, depth)[:, None], 0.0)
            squares[f"process in time, last {depth}"].append(np.mean((estimate - truth)[start:] ** 2))
        for estimate in observe(record, scenario, observers=[*LEARN, *TOLD]).estimates:
            if estimate.target == "vibration":
                squares[estimate.observer].append(np.mean((estimate.values[start:, 0] - truth[start:]) ** 2))
    for name, values in squares.items():
        print(f"| {name} | {1e3 * np.sqrt(np.mean(values)):.2f} |", flush=True)
