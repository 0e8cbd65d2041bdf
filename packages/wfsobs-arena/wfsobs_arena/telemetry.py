"""Scenarios from telemetry: the next measurement of a record that the user gives.

There is no truth. What is told is identified in the first half of the record. The second half is scored, in parts that stand for
seeds.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from wfsobs.identification.identification import identify
from wfsobs.observers.base import Observer
from wfsobs.pipeline import as_stated
from wfsobs.prior import Prior
from wfsobs.priors_from.scenario import prior_and_settings
from wfsobs.priors_from.telemetry import told_by
from wfsobs.record import Record, RecordError, hold_last
from wfsobs.scenario import Scenario
from wfsobs.telemetry.records import load
from wfsobs.typing import Array
from wfsobs_arena.cases import mean_square
from wfsobs_arena.reference import TAPS, taps_error

PARTS = 8
"""Parts of the second half that are scored each by itself."""


@dataclass(frozen=True)
class TelemetryCase:
    """A record of telemetry in the track "next"; see `wfsobs_arena.cases.Case`."""

    path: Path

    track = "next"
    seeds: Sequence[int] = (0,)

    @property
    def name(self) -> str:
        """Name of the file, without its ending."""
        return self.path.stem

    @property
    def help(self) -> str:
        """One line."""
        record = self.whole
        return f"{record.n_steps * record.dt:.3g} s at {1.0 / record.dt:.4g} Hz, {record.n_modes} modes"

    @property
    def reference(self) -> str:
        """What errors are divided by."""
        return f"{TAPS} taps"

    @property
    def digest(self) -> str:
        """SHA-256 of the file."""
        return self._sha256

    @cached_property
    def _sha256(self) -> str:
        return hashlib.sha256(self.path.read_bytes()).hexdigest()

    def record_id(self, seed: int) -> str:
        """Return the SHA-256 of the file."""
        return self.digest

    @cached_property
    def whole(self) -> Record:
        """The measurements of the LGS and the commands. Raises RecordError."""
        found = replace(load(self.path), y_ngs=None, ratio=None, turbulence=None, vibration=None, training=None, open_loop_y=None)
        if found.n_steps < 2 * PARTS * TAPS:
            raise RecordError(f"{self.path}: has {found.n_steps} steps, {2 * PARTS * TAPS} are needed")
        return found

    def record(self, seed: int) -> Record:
        """Return the record."""
        return self.whole

    @property
    def scenario(self) -> Scenario:
        """Models of what is identified in the first half."""
        return self._identified_models

    @cached_property
    def _identified_models(self) -> Scenario:
        record, half = self.whole, self.whole.n_steps // 2
        first = Record(record.y_lgs[:half], record.u[:half], record.dt, delay=record.delay)
        return told_by(identify(first), as_stated(record, Scenario()))

    def prior_and_settings(self, observer: Observer, record: Record) -> tuple[Prior, Any]:
        """Return what of that an observer asks for, and its settings. Raises ValueError."""
        return prior_and_settings(observer, record, self.scenario)

    def stretches(self, record: Record) -> list[slice]:
        """Return the parts of the second half, without the last step, which nothing follows."""
        edges = np.linspace(record.n_steps // 2, record.n_steps - 1, PARTS + 1).round().astype(int)
        return [slice(a, b) for a, b in pairwise(edges.tolist())]

    def truth(self, record: Record) -> Array:
        """Return the next measurement, z[k + 1], (n_steps, n_modes) [um], NaN where it is missing."""
        return np.vstack([record.z[1:], np.full((1, record.n_modes), np.nan)])

    def reference_squares(self, record: Record, seed: int) -> list[float]:
        """Return the mean squares [um^2] of the predictor of TAPS taps, trained on the first half."""
        half, z = record.n_steps // 2, hold_last(record.z)
        error = taps_error(z[: half - 1], z[1:half], record.z, self.truth(record))
        return [mean_square(error[part]) for part in self.stretches(record)]
