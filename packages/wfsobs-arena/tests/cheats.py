"""Entries that break a rule, imported by the processes of the arena."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from wfsobs.observers.base import VIBRATION, Observer
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements


def misbehave(measured: Measurements, _prior: Prior, how: Any, _watch: Watch) -> dict[str, np.ndarray]:
    if how == "slow":
        time.sleep(600.0)
    if how == "large":
        return {VIBRATION: np.ones((measured.n_steps, 10**9)) @ np.ones((10**9, measured.n_modes))}
    if how == "error":
        raise RuntimeError("a line\nand another")
    out = np.zeros_like(measured.z)
    if how == "nan":
        out[-3:] = np.nan
    return {VIBRATION: out[:-1] if how == "short" else out}


MISBEHAVES = Observer("misbehaves", "Misbehaves", (VIBRATION,), misbehave)


def look_ahead(measured: Measurements, _prior: Prior, _settings: Any, _watch: Watch) -> dict[str, np.ndarray]:
    return {VIBRATION: np.roll(measured.z, -1, axis=0)}


LOOKS_AHEAD = Observer("looks-ahead", "Looks ahead", (VIBRATION,), look_ahead)


def read_truth(measured: Measurements, _prior: Prior, _settings: Any, _watch: Watch) -> dict[str, np.ndarray]:
    """Look for it in the memory of the process."""
    import gc

    from wfsobs.record import Record

    for x in gc.get_objects():
        if isinstance(x, Record) and x.vibration is not None and x.y_lgs.shape == measured.y_lgs.shape:
            return {VIBRATION: x.vibration}
    return {VIBRATION: np.zeros_like(measured.z)}


READS_TRUTH = Observer("reads-truth", "Reads the truth", (VIBRATION,), read_truth)


def sleep(measured: Measurements, _prior: Prior, _settings: Any, _watch: Watch) -> dict[str, np.ndarray]:
    print("asleep", flush=True)
    time.sleep(600.0)
    return {VIBRATION: np.zeros_like(measured.z)}


SLEEPS = Observer("sleeps", "Sleeps", (VIBRATION,), sleep)
