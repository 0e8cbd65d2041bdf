"""Results of a sweep: scores of its runs, the observer that is best in each scenario, and the runs themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from wfsobs.campaign.sweep import Sweep
from wfsobs.evaluation.evidence import FEWEST, Evidence, Key, gather_evidence
from wfsobs.evaluation.scores import BOUNDS, Score
from wfsobs.evaluation.verdict import Verdict, contenders
from wfsobs.pipeline import observe
from wfsobs.progress import QUIET, Watch
from wfsobs.settings.errors import SettingError
from wfsobs.simulation.loop import simulate


def run_cell(sweep: Sweep, cell: int, number: int, watch: Watch = QUIET) -> tuple[Score, ...]:
    """Run a scenario with one of the seeds, and return the scores; with the first also the bounds, which no seed changes.

    Raises SettingError, Cancelled.
    """
    scenario = sweep.scenario(cell, number)
    record = simulate(scenario, watch=watch)
    return observe(record, scenario, observers=sweep.observers, watch=watch, is_simulated=number == 0).scores


@dataclass(frozen=True)
class Winner:
    """The best observer in a scenario, for a target and mode.

    Attributes
    ----------
    name : str
        Observer with the smallest mean error over the seeds.
    rms : float
        That mean [um].
    margin : float or None
        Mean error of the second over that of the best, less 1; None where there is no second.
    ties : tuple of str
        Observers whose errors do not differ significantly from those of the best.
    seeds : int
        Number of seeds.
    """

    name: str
    rms: float
    margin: float | None
    ties: tuple[str, ...]
    seeds: int

    @property
    def is_significant(self) -> bool:
        """Whether all others are significantly worse; never with fewer than FEWEST seeds."""
        return self.seeds >= FEWEST and not self.ties


@dataclass(frozen=True)
class SweepResults:
    """What is known of a sweep so far.

    Attributes
    ----------
    sweep : Sweep
        What is run.
    scores : mapping
        Cell -> scores of its seeds in order.
    evidence : mapping
        Cell -> errors over its seeds.
    failures : mapping
        Cell -> why it cannot be run.
    """

    sweep: Sweep
    scores: Mapping[int, tuple[tuple[Score, ...], ...]] = field(default_factory=dict)
    evidence: Mapping[int, Evidence] = field(default_factory=dict)
    failures: Mapping[int, str] = field(default_factory=dict)

    def add(self, cell: int, scores: Sequence[Score]) -> SweepResults:
        """Return the results with those of one more seed of a cell."""
        seeds = (*self.scores.get(cell, ()), tuple(scores))
        return replace(self, scores={**self.scores, cell: seeds}, evidence={**self.evidence, cell: gather_evidence(seeds)})

    def add_failure(self, cell: int, reason: str) -> SweepResults:
        """Return the results with the reason why a cell cannot be run."""
        return replace(self, failures={**self.failures, cell: reason})

    def seeds(self, cell: int) -> int:
        """Return the number of seeds of a cell that have been run."""
        return len(self.scores.get(cell, ()))

    @property
    def n_done(self) -> int:
        """Number of runs that are done or cannot be done."""
        return sum(self.sweep.seeds if cell in self.failures else self.seeds(cell) for cell in range(len(self.sweep.cells)))

    def next_run(self) -> tuple[int, int] | None:
        """Return (cell, number of the seed) of the next run: every cell has its first seed before any has its second."""
        left = [cell for cell in range(len(self.sweep.cells)) if cell not in self.failures]
        cell = min(left, key=self.seeds, default=None)
        return None if cell is None or self.seeds(cell) >= self.sweep.seeds else (cell, self.seeds(cell))

    def winner(self, cell: int, target: str, mode: str) -> Winner | None:
        """Return the best observer of a cell; None where nothing is known."""
        evidence = self.evidence.get(cell)
        ranked = evidence.ranking(target, mode) if evidence else []
        if evidence is None or not ranked:
            return None
        errors = [evidence.mean((name, target, mode)) or 0.0 for name in ranked[:2]]
        margin = max(errors[1] / errors[0] - 1.0, 0.0) if len(errors) > 1 and errors[0] > 0 else None
        return Winner(ranked[0], errors[0], margin, evidence.leaders(target, mode)[1:], evidence.n_seeds)

    def verdict(self, cell: int, target: str, mode: str) -> Verdict | None:
        """Return the verdict on a cell, without what does harm; None where nothing is known."""
        evidence, scores = self.evidence.get(cell), self.scores.get(cell)
        if evidence is None or not scores or not evidence.ranking(target, mode):
            return None
        places = contenders(self.sweep.scenario(cell), evidence, scores[0], target, mode)
        return Verdict(target, mode, places, 0, (), evidence.n_seeds)

    def error(self, cell: int, key: Key) -> tuple[float, float, float] | None:
        """Return the mean error of an observer over the seeds of a cell, and the interval of that mean [um].

        Without an interval, the ends are the mean; a bound has none. None where the error is not known.
        """
        if key[0] in BOUNDS:
            known = [s.rms for scores in self.scores.get(cell, ()) for s in scores if (s.observer, s.target, s.mode) == key]
            return (float(np.mean(known)),) * 3 if known else None  # type: ignore[return-value]
        evidence = self.evidence.get(cell)
        mean = evidence.mean(key) if evidence else None
        if evidence is None or mean is None:
            return None
        return (mean, *(evidence.interval(key) or (mean, mean)))

    def known_keys(self) -> list[Key]:
        """Return (observer, target, mode) of all that is known in some cell, in the order of the scores."""
        known = {(s.observer, s.target, s.mode): None for seeds in self.scores.values() for s in seeds[0]}
        return list(known)

    def rows(self) -> list[dict[str, Any]]:
        """Return one plain dictionary per cell, target, mode and observer, errors in [nm]."""
        out = []
        for cell, changes in enumerate(self.sweep.cells):
            for key in self.known_keys():
                error, best = self.error(cell, key), self.winner(cell, *key[1:])
                if error is None:
                    continue
                few = self.seeds(cell) < FEWEST or key[0] in BOUNDS
                first = best is not None and key[0] == best.name
                out.append(
                    {
                        **changes,
                        "target": key[1],
                        "mode": key[2],
                        "observer": key[0],
                        "seeds": self.seeds(cell),
                        "mean_rms_nm": 1e3 * error[0],
                        "low_nm": None if few else 1e3 * error[1],
                        "high_nm": None if few else 1e3 * error[2],
                        "rank": "best" if first else "tied" if best and key[0] in best.ties else "",
                        "margin": best.margin if best and first else None,
                    }
                )
        return out


def run_sweep(sweep: Sweep, watch: Watch = QUIET) -> SweepResults:
    """Run all cells of a sweep with all seeds.

    Parameters
    ----------
    sweep : Sweep
        What is to be run.
    watch : Watch, optional
        Receives the progress, and is asked at every block of work whether to stop.

    Returns
    -------
    SweepResults
        Errors of every cell.

    Raises
    ------
    Cancelled
        `watch` asks to stop.
    """
    results = SweepResults(sweep)
    while (following := results.next_run()) is not None:
        done = results.n_done
        inner = Watch(lambda f, done=done: watch.progress((done + f) / sweep.n_runs), watch.is_cancelled)
        try:
            results = results.add(following[0], run_cell(sweep, *following, inner))
        except SettingError as error:
            results = results.add_failure(following[0], str(error))
    return results
