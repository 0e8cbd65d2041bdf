"""What the observers run on where it is not the simulation of the settings: a file, or a simulation that is kept."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from wfsobs.app.cache import key_of
from wfsobs.app.limits import Limits
from wfsobs.dependence import Memo, digest, simulate_once
from wfsobs.pipeline import as_stated
from wfsobs.progress import Watch
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.sensors.zernike import HIGHEST_ORDER, order_of
from wfsobs.telemetry.intake import DeclaredFormat


@dataclass(frozen=True, eq=False)
class LoadedRecord:
    """A record that was loaded.

    key  : names its content
    what : one line on it;  declaration : what was said of it;  sha256 : of the file, in hexadecimal digits
    """

    record: Record
    name: str
    key: str
    what: str = ""
    declaration: DeclaredFormat = field(default_factory=DeclaredFormat)
    sha256: str = ""

    simulation = None

    def make(self, _watch: Watch, _memo: Memo | None = None) -> Record:
        """Return the record."""
        return self.record

    def check(self, limits: Limits) -> None:
        """Raise SettingError where a server does not allow it."""
        limits.check_steps(self.record.n_steps)

    @property
    def title(self) -> str:
        """What takes the place of the simulation."""
        return f"Record {self.name}: {self.what}"


@dataclass(frozen=True, eq=False)
class SimulatedRecord:
    """The simulation of other settings than those that the observers are told."""

    simulation: Scenario

    @property
    def key(self) -> str:
        """The same settings, the same key."""
        return key_of(self.simulation)

    def make(self, watch: Watch, memo: Memo | None = None) -> Record:
        """Simulate the record. Raises SettingError, Cancelled."""
        return simulate_once(self.simulation, memo, watch)

    def check(self, limits: Limits) -> None:
        """Raise SettingError where the simulation is impossible, or more than a server allows."""
        self.simulation.validate()
        limits.check(self.simulation)

    @property
    def title(self) -> str:
        """What takes the place of the simulation of the settings."""
        vibration = self.simulation.vibration
        count = 0 if "peaks" in vibration.idle() else len(vibration.peaks)
        peaks = f" with {count} peak{'s' * (count > 1)}" if count else ""
        return f"The simulation{peaks} is kept; the settings are the prior knowledge of the filters."


Source = LoadedRecord | SimulatedRecord

Step = tuple[Scenario, str, Source | None]
"""Settings, the preset that they are compared with, and what they run on where that is not their simulation."""


def record_key(record: Record) -> str:
    """Name a record by its content, whatever file it came from."""
    return digest(replace(record, gate=None))


def give_same_record(one: Source | None, other: Source | None) -> bool:
    """Whether two give the same record; None is the simulation of the settings."""
    return one is other or (one is not None and other is not None and one.key == other.key)


def fit_to_record(record: Record, scenario: Scenario) -> Scenario:
    """Set the rate, ratio, length and modes of a scenario to those of a record. Raises SettingError."""
    duration = record.n_steps * record.dt
    changes = {
        "telescope.radial_order": order_of(record.n_modes) or HIGHEST_ORDER,
        "run.duration": duration,
        "run.warm_up": min(scenario.run.warm_up, 0.2 * duration),
    }
    return as_stated(record, scenario).replace(changes)


@dataclass(frozen=True)
class NamedRecord:
    """A record that a link is of; sha256 : of its file, in hexadecimal digits."""

    name: str
    sha256: str
    declaration: DeclaredFormat

    def line(self, other: str = "", digest: str = "") -> str:
        """Ask for the file. other, digest : name and SHA-256 of a file that is another one."""
        line = (
            f"This link is of the record {self.name} (SHA-256 {self.sha256[:12]}…): drop that file here, or load it, to see it; "
            "until then the simulation of these settings is shown."
        )
        return line + (f" {other} is another file: its SHA-256 is {digest[:12]}…" if other else "")
