"""Results of the arena: a table per track, as plain values and as one HTML page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from math import pi, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from wfsobs import __version__
from wfsobs.campaign.store import PHYSICS_VERSION
from wfsobs.files import write_whole
from wfsobs.observers.base import Observer
from wfsobs.prior import IDENTIFIED, TRUE
from wfsobs.priors_from.controllers import own_settings
from wfsobs.scenario import Scenario
from wfsobs_arena.cases import Case
from wfsobs_arena.challengers import CHALLENGERS
from wfsobs_arena.definition import Arena
from wfsobs_arena.entries import FOLDER, ArenaEntry, load_object
from wfsobs_arena.run import EntryOutcome
from wfsobs_arena.scores import geometric_mean, rank_entries
from wfsobs_arena.tracks import NEXT, TRACKS, Track
from wfsobs_arena.trials import Trial

Table = dict[str, Any]

GAUSSIAN = 1.0 / sqrt(pi)
"""Continuous ranked probability score of a Gaussian error over its standard deviation, where that is stated."""


def tables(arena: Arena, outcomes: Sequence[EntryOutcome]) -> Table:
    """Return all results as plain values, the keys of results.json.

    Parameters
    ----------
    arena : Arena
        Scenarios and rules.
    outcomes : sequence of EntryOutcome
        Of the entries.

    Returns
    -------
    dict
        "version", "digest", "physics", "wfsobs", "tracks" (each with "scenarios" and "rows", the best first), "refused".
    """
    tracks = [_table(track, [c for c in arena.cases if c.track == track.id], outcomes) for track in TRACKS.values()]
    return {
        "version": arena.version,
        "digest": arena.digest,
        "physics": PHYSICS_VERSION,
        "wfsobs": __version__,
        "tracks": [table for table in tracks if table["rows"]],
        "refused": [{"entry": o.entry.id, "label": o.entry.label, "reason": o.refusal} for o in outcomes if o.refusal],
    }


def _table(track: Track, cases: Sequence[Case], outcomes: Sequence[EntryOutcome]) -> Table:
    """Return scenarios and rows of a track."""
    of = {
        o.entry.id: [o.trials[c.track, c.name] for c in cases]
        for o in outcomes
        if any((c.track, c.name) in o.trials for c in cases)
    }
    entries = {o.entry.id: o.entry for o in outcomes}
    reference = _samples(next(iter(of.values())), "reference") if of else []
    squares = {name: _samples(trials, "squares") for name, trials in of.items()}
    standings = rank_entries(squares, reference) if of else []
    return {
        **{key: value for key, value in asdict(track).items() if key != "target"},
        "scenarios": [_scenario(case) for case in cases],
        "rows": [
            {**asdict(one), "label": entries[one.entry].label, "told": needs_of(entries[one.entry], track)}
            | _beside(of[one.entry])
            for one in standings
        ],
    }


def _scenario(case: Case) -> Table:
    records = {str(seed): case.record_id(seed) for seed in case.seeds}
    return {"name": case.name, "help": case.help, "reference": case.reference, "records": records}


def _samples(trials: Sequence[Sequence[Trial]], what: str) -> list[np.ndarray]:
    """Return the mean squares of all samples, one array per scenario."""
    return [np.concatenate([getattr(trial, what) for trial in of_case]) for of_case in trials]


def _beside(trials: Sequence[Sequence[Trial]]) -> Table:
    """Return what stands beside the score: time per step [us], calibration, failures.

    crps : of the stated standard deviations, over that of a Gaussian error with the rms of the reference; geometric mean
    """
    flat = [trial for of_case in trials for trial in of_case]
    stated = [trial.calibration for trial in flat if trial.calibration]
    times = [trial.microseconds for trial in flat if trial.microseconds is not None]
    reasons = [trial.failure for trial in flat if trial.failure]
    scores = [
        t.calibration["crps"] / (GAUSSIAN * sqrt(np.mean(t.reference) / t.calibration["modes"])) for t in flat if t.calibration
    ]
    return {
        "microseconds": float(np.median(times)) if times else None,
        "within_68": float(np.mean([one["within_68"] for one in stated])) if stated else None,
        "within_95": float(np.mean([one["within_95"] for one in stated])) if stated else None,
        "crps": geometric_mean(scores) if scores else None,
        "failures": len(reasons),
        "runs": len(flat),
        "reason": reasons[0] if reasons else "",
    }


def needs_of(entry: ArenaEntry, track: Track) -> str:
    """Return what an entry is told beside measurements in a track, for people."""
    if entry.kind == FOLDER:
        return "not known"
    algorithm = load_object(entry)
    if not isinstance(algorithm, Observer):
        return algorithm.needs_text(own_settings(algorithm, Scenario()))
    return algorithm.needs_text(source=IDENTIFIED if track.target == NEXT else TRUE)


def source_of(entry_id: str) -> str:
    """Return the publication of a challenger, empty for others."""
    return CHALLENGERS[entry_id].source if entry_id in CHALLENGERS else ""


def _add_known(values: Table, path: Path) -> Table:
    """Return the results with the tables of other tracks in a file of the same arena and code; as they are without one."""
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return values
    if not isinstance(known, dict) or any(known.get(name) != values[name] for name in ("version", "digest", "physics", "wfsobs")):
        return values
    ranked = {row["entry"] for table in values["tracks"] for row in table["rows"]}
    try:
        by_track = {table["id"]: table for table in (*known["tracks"], *values["tracks"])}
        refused = {one["entry"]: one for one in (*known["refused"], *values["refused"]) if one["entry"] not in ranked}
    except (KeyError, TypeError):
        return values
    return values | {"tracks": [by_track[name] for name in TRACKS if name in by_track], "refused": list(refused.values())}


def write_results(values: Table, folder: Path) -> None:
    """Write results.json and index.html, with the tables of other tracks that are there. Raises OSError."""
    values = _add_known(values, folder / "results.json")
    text = json.dumps(values, indent=1) + "\n"
    write_whole(folder / "results.json", lambda file: file.write(text.encode()))
    environment = Environment(
        loader=PackageLoader("wfsobs_arena"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    page = environment.get_template("arena.html").render(results=values, source_of=source_of)
    write_whole(folder / "index.html", lambda file: file.write(page.encode()))
