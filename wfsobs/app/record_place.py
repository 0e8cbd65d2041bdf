"""A record takes the place of the simulation, and gives it back."""

from __future__ import annotations

from typing import Any

from wfsobs.app.sources import LoadedRecord, fit_to_record, record_key
from wfsobs.app.store import Store
from wfsobs.scenario.configfile import changed_settings
from wfsobs.settings.errors import SettingError
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.preview import Preview

AFTER_FIT = ("telescope.radial_order", "run.warm_up")
"""Settings that follow a record, and may be changed afterwards."""


class RecordPlace:
    """What the observers of a store run on."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self._own: dict[str, Any] = {}

    def take(self, preview: Preview, declaration: DeclaredFormat, sha256: str) -> None:
        """Run on a record; the settings of rate, ratio and length follow it, but to the ones of a link. Raises SettingError."""
        before, wanted = self.store.scenario, self.store.wanted_record
        scenario = fit_to_record(preview.record, before)
        if wanted is not None and wanted.sha256 == sha256:
            scenario = scenario.replace({path: before.lookup(path) for path in AFTER_FIT})
        own = self._own if isinstance(self.store.source, LoadedRecord) else changed_settings(before, scenario)
        key, line = record_key(preview.record), preview.lines()[0]
        self.store.run_on(LoadedRecord(preview.record, preview.name, key, line, declaration, sha256), scenario)
        self._own = own

    def give_back(self) -> None:
        """Go back to the simulation: of settings that were kept, or of these with its own rate, ratio and length."""
        self.store.wanted_record = None
        if (source := self.store.source) is None:
            return
        scenario = source.simulation or self.store.scenario
        try:
            self.store.run_on(None, scenario.replace(self._own if isinstance(source, LoadedRecord) else {}))
        except SettingError:  # they do not go with what was changed since
            self.store.run_on(None, scenario)
