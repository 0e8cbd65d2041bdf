"""The bound of both sensors against least squares on a long record. `long_regression.py [minutes]`.

The first part of a record of `paper` in open loop teaches the best weights of the last LGS measurements and NGS frames
in one step of the NGS frame, the rest scores them: rms [nm], over the bound in that step.
"""

from __future__ import annotations

import argparse

import numpy as np

from wfsobs import PRESETS, simulate
from wfsobs.evaluation.bound import least_errors_of_both
from wfsobs.simulation.true_spectra import true_spectra

TAPS, FRAMES, PHASE = 1200, 100, 2
LEARNT = 5 / 6
"""Share of the record that teaches."""


def main() -> None:
    """Print a row per target."""
    parser = argparse.ArgumentParser()
    parser.add_argument("minutes", type=float, nargs="?", default=20.0)
    duration = 60.0 * parser.parse_args().minutes
    scenario = PRESETS["paper"]().replace({"run.duration": duration, "loop.closed": False, "vibration.synthesis": "gaussian"})
    record, n = simulate(scenario), scenario.sensors.exposure_ratio
    assert record.y_ngs is not None and record.turbulence is not None and record.vibration is not None
    frames = record.y_ngs
    at = np.arange((max(TAPS, FRAMES * n) // n + 1) * n, record.n_steps - n, n) + PHASE
    taught, width = round(LEARNT * len(at)), TAPS + FRAMES
    truth = np.column_stack([record.turbulence[:, 0], record.vibration[:, 0]])

    def inputs(k: np.ndarray) -> np.ndarray:
        z, ngs = record.z[k[:, None] - np.arange(TAPS), 0], frames[(k - PHASE)[:, None] - n * np.arange(FRAMES), 0]
        return np.hstack([z, ngs])

    gram, cross = np.zeros((width, width)), np.zeros((width, 2))
    for k in np.array_split(at[:taught], 200):
        x = inputs(k)
        gram += x.T @ x
        cross += x.T @ truth[k]
    weights = np.linalg.solve(gram, cross)
    errors = np.concatenate([inputs(k) @ weights - truth[k] for k in np.array_split(at[taught:], 200)])
    least = least_errors_of_both(true_spectra(scenario, 0))
    for name, rms in zip(("turbulence", "vibration"), np.sqrt(np.mean(errors**2, axis=0)), strict=True):
        bound = least[name].phases[PHASE]
        print(f"| {name} | {1e3 * rms:.2f} | {1e3 * bound:.2f} | {rms / bound:.4f} | {width} weights from {taught} equations |")


if __name__ == "__main__":
    main()
