"""The scenarios of the arena: records with an identity, what entries are told of them, and what they are judged by."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from wfsobs.campaign.store import PHYSICS_VERSION
from wfsobs.closed_loop.design import design
from wfsobs.evaluation.bound import bound
from wfsobs.observers.base import Observer
from wfsobs.prior import Prior
from wfsobs.priors_from.scenario import prior_and_settings
from wfsobs.record import TOTAL, Record
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import simulate, training_settings
from wfsobs.simulation.true_spectra import has_known_spectra
from wfsobs.typing import Array
from wfsobs_arena.reference import TAPS, taps_error
from wfsobs_arena.tracks import DISTURBANCE, RESIDUAL, TRACKS, Track

BOUND = "bound"
"""What an error is divided by where the spectra are known; else the error of a predictor of TAPS taps."""

TRAINING_SEEDS = 1_000_000
"""Distance from the seed of a record to that of the record which its reference is trained on."""


class Case(Protocol):
    """Interface of a scenario: the samples that are scored are those of the seeds, or parts of a record."""

    @property
    def track(self) -> str:
        """Id of the track."""
        ...

    @property
    def name(self) -> str:
        """Name within the track."""
        ...

    @property
    def help(self) -> str:
        """One line."""
        ...

    @property
    def seeds(self) -> Sequence[int]:
        """Seeds of the records; of telemetry, the number of the one record."""
        ...

    @property
    def scenario(self) -> Scenario:
        """Settings of entries."""
        ...

    @property
    def digest(self) -> str:
        """SHA-256 of all records and of what entries are told."""
        ...

    @property
    def reference(self) -> str:
        """What errors are divided by."""
        ...

    def record_id(self, seed: int) -> str:
        """Return the SHA-256 of a record."""
        ...

    def record(self, seed: int) -> Record:
        """Return a record."""
        ...

    def prior_and_settings(self, observer: Observer, record: Record) -> tuple[Prior, Any]:
        """Return the prior that an observer asks for, and its settings. Raises ValueError."""
        ...

    def stretches(self, record: Record) -> list[slice]:
        """Return the steps that are scored, one slice per sample."""
        ...

    def truth(self, record: Record) -> Array:
        """Return what is asked, (n_steps, n_modes) [um], NaN where it is not known."""
        ...

    def reference_squares(self, record: Record, seed: int) -> list[float]:
        """Return the mean square of the reference [um^2], all modes together, one per sample."""
        ...


@dataclass(frozen=True)
class SimulatedCase:
    """A scenario of simulated records, one per seed; see `Case`."""

    track: str
    name: str
    help: str
    seeds: Sequence[int]
    scenario: Scenario = field(repr=False)

    @property
    def of(self) -> Track:
        """The track."""
        return TRACKS[self.track]

    def with_seed(self, seed: int) -> Scenario:
        """Return the scenario of a seed."""
        return self.scenario.replace({"run.seed": seed})

    def record_id(self, seed: int) -> str:
        """Return the SHA-256 of settings, seed and physics version."""
        known = [PHYSICS_VERSION, training_settings(self.with_seed(seed)), self.scenario.run.warm_up, self.track]
        return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()

    @property
    def digest(self) -> str:
        """SHA-256 of all records, whatever the number of seeds, and of what entries are told."""
        known = [self.record_id(0), self.name, self.scenario.difference(Scenario())]
        return hashlib.sha256(json.dumps(known, sort_keys=True).encode()).hexdigest()

    @property
    def reference(self) -> str:
        """What errors are divided by."""
        return BOUND if has_known_spectra(self.scenario) else f"{TAPS} taps"

    def record(self, seed: int) -> Record:
        """Simulate a record; without the NGS where the track has none."""
        record = simulate(self.with_seed(seed))
        return record if "ngs" in self.of.sensors else replace(record, y_ngs=None, ratio=None)

    def prior_and_settings(self, observer: Observer, record: Record) -> tuple[Prior, Any]:
        """Return the prior that an observer asks for, of the scenario before its events, and its settings. Raises ValueError."""
        return prior_and_settings(observer, record, self.scenario.before_events)

    def stretches(self, record: Record) -> list[slice]:
        """Return the steps after the warm-up."""
        return [slice(round(self.scenario.run.warm_up / record.dt), record.n_steps)]

    def truth(self, record: Record) -> Array:
        """Return what is asked, (n_steps, n_modes) [um]; of a controller, the disturbance."""
        assert record.turbulence is not None and record.vibration is not None
        if self.of.target in (DISTURBANCE, RESIDUAL):
            return record.turbulence + record.vibration
        true = record.truth(self.of.target)
        assert true is not None
        return true

    @cached_property
    def _bound(self) -> float:
        """Mean square [um^2] of the bound on what entries receive, all modes together."""
        if self.of.target == RESIDUAL:
            of_modes = design(self.scenario, []).bounds["bound-both"]
        else:
            least = bound(self.scenario, information="both" if "ngs" in self.of.sensors else "lgs")
            name = TOTAL if self.of.target == DISTURBANCE else self.of.target
            of_modes = tuple(one[name].rms for one in least)
        return float(np.sum(np.square(of_modes)))

    def reference_squares(self, record: Record, seed: int) -> list[float]:
        """Return the mean square [um^2] of the bound, or where that is not known of the predictor of TAPS taps."""
        if self.reference == BOUND:
            return [self._bound]
        training = simulate(self.with_seed(seed + TRAINING_SEEDS).before_events)
        error = taps_error(training.z, self.truth(training), record.z, self.truth(record))
        return [mean_square(error[part]) for part in self.stretches(record)]


def mean_square(error: Array) -> float:
    """Return the mean square of an error (n, n_modes), all modes together; samples without a truth do not count."""
    return float(np.sum(np.nanmean(error**2, axis=0)))
