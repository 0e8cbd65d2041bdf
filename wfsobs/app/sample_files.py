"""Files to begin with: a template to fill in, and a sample record that is simulated."""

from __future__ import annotations

from collections.abc import Callable

from wfsobs.app.jobs import DONE, FAILED, BackgroundTask, Job
from wfsobs.app.picker import Picker
from wfsobs.app.store import Store
from wfsobs.telemetry.examples import TEMPLATE, sample_csv

TEMPLATE_NAME, SAMPLE_NAME = "wfsobs-template.csv", "wfsobs-sample.csv"


class Examples:
    """Sends them to the browser; say : shows a line."""

    def __init__(self, store: Store, picker: Picker, say: Callable[[str], None]):
        self._picker, self._say = picker, say
        self._task = BackgroundTask(store.session)
        self._task.param.watch(self._save, ["state", "place"])

    def send_template(self) -> None:
        """Send the template."""
        self._picker.save(TEMPLATE_NAME, "text/csv", TEMPLATE.encode())

    def send_sample(self) -> None:
        """Simulate the sample beside the page, and send it."""
        self._task.start(Job("save", lambda watch, _tell: sample_csv(watch)))

    def _save(self, *_: object) -> None:
        task = self._task
        self._say("" if task.state == DONE else task.message if task.state == FAILED else task.line("Simulating a sample"))
        if task.state == DONE:
            self._picker.save(SAMPLE_NAME, "text/csv", task.result)
