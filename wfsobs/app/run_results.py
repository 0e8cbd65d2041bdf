"""What a run has given so far, as the views take it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wfsobs.app.sources import Source
from wfsobs.evaluation.record_bounds import Bound
from wfsobs.result import Result
from wfsobs.scenario import Scenario

Array = NDArray[np.float64]
Key = tuple[str, str]
"""(observer or TRUTH, target)."""

TRUTH = "truth"


@dataclass(frozen=True)
class SignalAndError:
    """Power spectral densities [um^2/Hz], one column per mode, of a signal and of its error; frequency in [Hz]."""

    frequency: Array
    signal: Array
    error: Array


@dataclass(frozen=True)
class RunResults:
    """What a run has given so far.

    partial : values so far, NaN where there are none yet, of observers still at work
    spectra : of the truth and of every finished estimate
    source : what they are of where that is not the simulation of the settings
    bounds : of the record
    ran    : observers that ran for it, None for all; nothing changed that the others depend on, so their estimates were known
    """

    result: Result
    partial: Mapping[Key, Array] = field(default_factory=dict)
    spectra: Mapping[Key, SignalAndError] = field(default_factory=dict)
    seconds: float = 0.0
    source: Source | None = None
    bounds: Sequence[Bound] = ()
    ran: tuple[str, ...] | None = None

    @property
    def is_recorded(self) -> bool:
        """Whether the record stays whatever the settings."""
        return self.source is not None

    @property
    def simulation(self) -> Scenario | None:
        """What the record was simulated from; None where it was loaded."""
        return self.scenario if self.source is None else self.source.simulation

    @property
    def scenario(self) -> Scenario:
        """The settings this was computed from."""
        return self.result.scenario

    def values(self, observer: str, target: str) -> Array | None:
        """(n_steps, n_modes) [um] of the truth, a finished or a growing estimate, or None."""
        if observer == TRUTH:
            return self.result.record.truth(target)
        estimate = self.result.estimate(observer, target)
        return estimate.values if estimate else self.partial.get((observer, target))

    def sd(self, observer: str, target: str) -> Array | None:
        """(n_steps, n_modes) [um], the standard deviation that a finished estimate states, or None."""
        estimate = self.result.estimate(observer, target)
        return estimate.sd if estimate else None
