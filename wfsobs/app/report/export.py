"""A report from nothing: run a scenario, or every combination of variations of it, and write the page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

from wfsobs.app.report.data import Report, state_of
from wfsobs.app.report.page import page
from wfsobs.files import check_writable, write_whole
from wfsobs.pipeline import run
from wfsobs.progress import QUIET, Watch
from wfsobs.result import Result
from wfsobs.scenario import Scenario
from wfsobs.scenario.grid import Variation, scenarios


def export(
    path: str | Path,
    scenario: Scenario,
    *,
    vary: Sequence[Variation] = (),
    preset: str = "paper",
    watch: Watch = QUIET,
    on_result: Callable[[Result], None] = lambda result: None,
) -> None:
    """Run a scenario and write a report: one HTML file with figures and numbers that opens without a network.

    Parameters
    ----------
    path : str or Path
        File to write.
    scenario : Scenario
        Settings of the run.
    vary : sequence of Variation, optional
        Settings and their values (`wfsobs.scenario.grid.parse_variation`); every combination is run.
    preset : str
        Preset that the report compares the settings with.
    watch : Watch, optional
        Receives the progress, and is asked at every block of work whether to stop.
    on_result : callable, optional
        Receives every result.

    Raises
    ------
    SettingError
        Two settings exclude each other.
    OSError
        The file cannot be written.
    Cancelled
        `watch` asks to stop.
    """
    chosen = scenarios(scenario, vary)
    check_writable(path)
    kept = []
    for i, one in enumerate(chosen):
        result = run(one, watch=Watch(lambda f, i=i: watch.progress((i + f) / len(chosen)), watch.is_cancelled))
        on_result(result)
        kept.append(state_of(result, len(chosen)))
    content = page(Report(preset, scenario, tuple(vary), tuple(kept)), datetime.now().astimezone()).encode()
    write_whole(path, lambda file: file.write(content))
