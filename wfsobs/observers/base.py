"""What an observer is: a name, what it estimates, what it needs, and a function.

phi_hat[k], its estimate of the target at step k, may use y[0..k] and u[0..k-1], nothing later and
never the truth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from wfsobs.progress import Watch
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.typing import Array

TURBULENCE, VIBRATION = "turbulence", "vibration"
TARGETS = (TURBULENCE, VIBRATION)

NOTHING, SPECTRA, MODEL, LINES, BANDS, TRAINING = "nothing", "true spectra", "model", "true lines", "bands", "training data"
"""What an observer or a controller may have to be given beside measurements: the spectra of turbulence, vibration and noise;
a model with numbers, of one vibration peak; every line of the vibration; where the vibration is; a record to learn from."""


@dataclass(frozen=True)
class Observer:
    """An entry of the registry.

    id, label : for tables and files, and for people
    targets   : what it estimates, of "turbulence" and "vibration"
    run       : (record, scenario, watch) -> {target: (n_steps, n_modes) [um]}, NaN where there is no estimate yet
    needs     : record fields without which it cannot run
    given     : what it has to be told beside measurements, of the words above
    causal    : false only for a reference that looks ahead
    weight    : its computing time relative to a Kalman filter's, for progress and to run the quick ones first
    """

    id: str
    label: str
    targets: tuple[str, ...]
    run: Callable[[Record, Scenario, Watch], dict[str, Array]]
    needs: tuple[str, ...] = ()
    given: tuple[str, ...] = ()
    causal: bool = True
    weight: float = 1.0

    def missing(self, record: Record) -> tuple[str, ...]:
        """The needed fields that a record does not have."""
        return tuple(name for name in self.needs if getattr(record, name) is None)

    @property
    def told(self) -> str:
        """What it has to be told beside measurements, for people."""
        return ", ".join(self.given) or NOTHING


@dataclass(frozen=True)
class Estimate:
    """What one observer says of one target: values (n_steps, n_modes) [um], NaN where it says nothing,
    and its computing time per step and mode [s]."""

    observer: str
    target: str
    values: Array
    seconds_per_step: float
