"""Records that several tests share: simulated once per session, by whichever process comes first."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from wfsobs import PRESETS, simulate
from wfsobs.priors_from.scenario import model_of, usual_observers
from wfsobs.record import Record, Training
from wfsobs.scenario import Scenario
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.testing import QUICK

ON_PAPER = usual_observers(PRESETS["paper"]())
"""Observers that the paper's preset has something for, whose modes are independent and whose LGS are on the axis."""

MATCHED = Scenario().replace(
    {
        "vibration.source": "ar2",
        "vibration.peaks": [{"frequency": 47.5, "damping": 0.03, "rms": [0.05, 0.03]}],
        "kalman.frequency": 47.5,
        "kalman.damping": 0.03,
        "kalman.process_noise": "matched",
        "sensors.lgs_low_frequency_rms": 0.05,
        "sensors.lgs_rate": 250.0,
        "loop.closed": False,
    }
)
"""Its truth is the model of `multirate-optimal` and, with its one line, of `multirate-multi`."""


def kalman_model(scenario: Scenario, mode: int, dt: float) -> DisturbanceModel:
    """Return the state-space model of the turbulence and the one vibration peak that a scenario tells."""
    return model_of(scenario, mode, dt).disturbance()


def recorded(scenario: Scenario) -> Record:
    """Return the record of a scenario, kept in a file of the session (conftest.py)."""
    path = Path(os.environ["WFSOBS_TEST_RECORDS"]) / f"{sha256(repr(scenario.to_dict()).encode()).hexdigest()}.npz"
    with path.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            record = simulate(scenario)
            np.savez(path, **arrays(record), **{f"training.{name}": x for name, x in arrays(record.training).items()})
        with np.load(path) as file:
            found = dict(file)
    training = Training(**{name.removeprefix("training."): found.pop(name) for name in sorted(found) if "." in name})
    return Record(**{name: x if x.ndim else x[()].item() for name, x in found.items()}, training=training)


def arrays(data: Record | Training) -> dict[str, Any]:
    """Return what there is of a record, by name."""
    return {name: value for name, value in vars(data).items() if value is not None and name != "training"}


@cache
def short(preset: str) -> tuple[Record, Scenario]:
    """Return a record of 0.8 s of a preset, and its scenario; events come at the same share of it."""
    s = PRESETS[preset]()
    events = [e.to_dict() | {k: getattr(e, k) * 0.8 / s.run.duration for k in ("start", "duration")} for e in s.events]
    scenario = s.replace({**QUICK, "run.duration": 0.8, "events": events})
    return recorded(scenario), scenario


def third_of_pairs(names: Iterable[str], presets: Iterable[str]) -> list[tuple[str, str]]:
    """Return every third pair of a name and a preset: each name with several presets, and each preset with several names."""
    return [(name, preset) for i, name in enumerate(names) for j, preset in enumerate(presets) if (i + j) % 3 == 0]
