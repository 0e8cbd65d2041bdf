"""A report from nothing: run a scenario, or every combination of variations of it, and write the page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path

from wfsobs.app.report.data import Report, state_of
from wfsobs.app.report.page import page
from wfsobs.evaluation.evidence import gather_evidence
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
    observers: Sequence[str] | None = None,
    vary: Sequence[Variation] = (),
    preset: str = "paper",
    seeds: int = 1,
    watch: Watch = QUIET,
    on_result: Callable[[Result], None] | None = None,
) -> None:
    """Run a scenario and write a report: one HTML file with figures and numbers that opens without a network.

    Parameters
    ----------
    path : str or Path
        File to write.
    scenario : Scenario
        Settings of the run.
    observers : sequence of str, optional
        Ids of the observers; by default all that the scenario has something for.
    vary : sequence of Variation, optional
        Settings and their values (`wfsobs.scenario.grid.parse_variation`); every combination is run.
    preset : str
        Preset that the report compares the settings with.
    seeds : int
        Number of seeds of every state, `run.seed` and those after it; figures and budgets are of the first, errors have
        intervals over all.
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
        of = []
        for number in range(seeds):
            done, scenario_of_seed = i + number / seeds, one.replace({"run.seed": one.run.seed + number}) if number else one
            inner = Watch(lambda f, done=done: watch.progress((done + f / seeds) / len(chosen)), watch.is_cancelled)
            of.append(run(scenario_of_seed, observers=observers, watch=inner))
        if on_result is not None:
            on_result(of[0])
        evidence = gather_evidence([result.scores for result in of]) if seeds > 1 else None
        kept.append(state_of(of[0], len(chosen), evidence=evidence))
    content = page(Report(preset, scenario, tuple(vary), tuple(kept)), datetime.now().astimezone()).encode()
    write_whole(path, lambda file: file.write(content))
