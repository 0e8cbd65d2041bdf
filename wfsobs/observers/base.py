"""What an observer is: a name, what it estimates, what it needs, and a function.

phi_hat[k], its estimate of the target at step k, may use y[0..k] and u[0..k-1], nothing later. It receives measurements, what
it asked to be told and settings of its own: the truth is out of reach.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from wfsobs.observers.missing import LINE_WIDTH, bridged
from wfsobs.prior import PARTS, Part, Prior
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Measurements, Record
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.settings.group import Group

TURBULENCE, VIBRATION = "turbulence", "vibration"
TARGETS = (TURBULENCE, VIBRATION)

NOTHING, SPECTRA, MODEL, LINES, BANDS, TRAINING = "nothing", "true spectra", "model", "true lines", "bands", "training data"
"""What an observer or a controller may have to be given beside measurements: the spectra of turbulence, vibration and noise;
a model with numbers, of one vibration peak; every line of the vibration; where the vibration is; a record to learn from."""


def _nothing(_settings: Group | None) -> tuple[Part, ...]:
    return ()


@dataclass(frozen=True)
class Observer:
    """An entry of the registry.

    id, label : for tables and files, and for people
    targets   : what it estimates, of "turbulence" and "vibration"
    run       : (measurements without gaps, prior, settings, watch) -> {target: (n_steps, n_modes) [um]}, NaN where there is
        no estimate yet
    prior     : what it has to be told beside measurements, see `wfsobs.prior`
    settings  : the group of a scenario's settings that is its own, or None
    needs     : record fields without which it cannot run
    asks      : settings -> what it has to be told besides for these
    causal    : false only for a reference that looks ahead
    weight    : its computing time relative to a Kalman filter's, for progress and to run the quick ones first
    """

    id: str
    label: str
    targets: tuple[str, ...]
    run: Callable[[Measurements, Prior, Any, Watch], dict[str, Array]]
    prior: tuple[Part, ...] = ()
    settings: str | None = None
    needs: tuple[str, ...] = ()
    asks: Callable[[Any], tuple[Part, ...]] = _nothing
    causal: bool = True
    weight: float = 1.0

    def missing(self, record: Record) -> tuple[str, ...]:
        """The needed fields that a record does not have."""
        return tuple(name for name in self.needs if getattr(record, name) is None)

    def estimate(
        self, measurements: Measurements, prior: Prior, settings: Group | None = None, watch: Watch = QUIET
    ) -> dict[str, Array]:
        """{target: (n_steps, n_modes) [um]}, missing samples bridged by what it is told. Raises ValueError, Cancelled."""
        whole = bridged(measurements, prior, getattr(settings, "line_width", LINE_WIDTH))
        return self.run(whole, prior, settings, watch)

    @property
    def given(self) -> tuple[str, ...]:
        """What it has to be told beside measurements, of the words above."""
        return tuple(dict.fromkeys(word for part in self.prior for word in PARTS[part]))

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
