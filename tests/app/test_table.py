"""The RMS table of the first page."""

from __future__ import annotations

from typing import Any

from wfsobs.app.display import Display
from wfsobs.app.jobs import DONE
from wfsobs.app.sources import LoadedRecord
from wfsobs.app.store import Store
from wfsobs.app.views.table import Table
from wfsobs.simulation.loop import simulate


def test_lines_are_true_for_the_simulation_of_the_settings_and_given_for_a_loaded_record(make_store: Any, loop: Any) -> None:
    store: Store = make_store()
    table = Table(store.run, Display())
    store.start()
    loop.until(lambda: store.run.state == DONE)
    assert "model, true peaks" in table.pane.object and "given peaks" not in table.pane.object
    store.run_on(LoadedRecord(simulate(store.scenario), "mine", "key"), store.scenario)
    loop.until(lambda: store.run.state == DONE and store.run.result.is_recorded)
    assert "model, given peaks" in table.pane.object and "true peaks" not in table.pane.object
