"""Alarms of peaks: how many a quiet loop raises, and which lines are told that come and go.

    python docs/scripts/peak_alarms.py [PRESET [MINUTES]]

Simulates minutes of a preset, and has each identified and compared as `wfsobs live` does: as they are; and with a line without
damping in every other one, at a frequency of its own from 5 to 150 Hz, in every mode.
"""

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"

import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial

import numpy as np

import wfsobs
from wfsobs.live.finding import CLOSE, Finding, identify_frames, peak_changes
from wfsobs.record import Record

LINES = (0.0, 0.003, 0.005, 0.010, 0.030)
"""Rms of the line that comes and goes, in each mode [um]."""


def line_of(number: int, rms: float) -> tuple[float, float]:
    """Return frequency [Hz] and rms [um] of the line of a minute."""
    return float(np.random.default_rng(number // 2).uniform(5.0, 150.0)), rms * (number % 2)


def find(preset: str, job: tuple[int, float]) -> Finding:
    """Identify one minute."""
    scenario = wfsobs.PRESETS[preset]().replace({"run.duration": 60.0, "run.seed": 5000 + job[0]})
    record = wfsobs.simulate(scenario)
    frequency, rms = line_of(*job)
    phases = np.random.default_rng(job[0]).uniform(0.0, 2.0 * np.pi, record.z.shape[1])
    t = record.dt * np.arange(record.n_steps)
    z = record.z + rms * np.sqrt(2.0) * np.sin(2.0 * np.pi * frequency * t[:, None] + phases)
    return identify_frames(Record(y_lgs=z, u=np.zeros_like(z), dt=record.dt), scenario.to_dict())


def is_of(row: str, frequency: float) -> bool:
    """Return whether a row is of a peak at this frequency."""
    named = [float(word) for word in row.split() if word.replace(".", "").isdigit()]
    return any(abs(one - frequency) <= CLOSE * frequency for one in named)


def main(preset: str = "paper", minutes: str = "20") -> None:
    """Print the alarms of each rms of the line."""
    n = int(minutes)
    print(f"{preset}, {n} minutes")
    with ProcessPoolExecutor() as pool:
        for rms in LINES:
            findings = list(pool.map(partial(find, preset), [(k, rms) for k in range(n)]))
            rows = [(k, row) for k in range(1, n) for row in peak_changes(findings[max(k - 3, 0) : k + 1])]
            told = [(k, row) for k, row in rows if rms and any(is_of(row, line_of(j, rms)[0]) for j in (k - 1, k))]
            come = len({k for k, row in told if k % 2 and ("new" in row or "moved" in row)})
            gone = len({k for k, row in told if not k % 2 and ("gone" in row or "moved" in row)})
            others = [row for row in rows if row not in told]
            share = f"told as new {come} of {n // 2}, as gone {gone} of {(n - 1) // 2}, " if rms else ""
            print(f"line of {1e3 * rms:.0f} nm: {share}others {len(others)}", [row for _, row in others])


if __name__ == "__main__":
    main(*sys.argv[1:])
