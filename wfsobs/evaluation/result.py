"""The result of a run: estimates and scores, and the observers that failed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from wfsobs.evaluation.rows import score_rows
from wfsobs.evaluation.scores import Score
from wfsobs.notebook import PlotAccessor, html_table
from wfsobs.observers.estimates import Estimate
from wfsobs.prior import TRUE, PriorSource
from wfsobs.record import Record
from wfsobs.scenario import Scenario

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True)
class Failure:
    """An observer without an estimate, and the reason in one line."""

    observer: str
    reason: str


@dataclass(frozen=True, repr=False)
class Result:
    """Result of a run: scenario, record, estimates and scores.

    Attributes
    ----------
    scenario : Scenario
        Settings of the run.
    record : Record
        Measurements, commands and truth.
    estimates : tuple of Estimate
        One per observer and target, in the order of the registry.
    scores : tuple of Score
        One per observer, target and mode; the bounds last.
    failures : tuple of Failure
        Observers without an estimate.
    prior_source : {"true", "identified", "given"}
        Where the prior of the observers comes from: the settings of the simulation, an identification, or settings alone.
    """

    scenario: Scenario
    record: Record
    estimates: tuple[Estimate, ...]
    scores: tuple[Score, ...]
    failures: tuple[Failure, ...] = ()
    prior_source: PriorSource = TRUE
    plot = PlotAccessor()

    def __repr__(self) -> str:
        left_out = f", {len(self.failures)} left out" if self.failures else ""
        observers = len({e.observer for e in self.estimates})
        return f"Result({observers} observers, {len(self.scores)} scores{left_out}, {self.record!r})"

    def _repr_html_(self) -> str:
        cells = [(s.target, s.mode, s.observer, f"{s.rms * 1e3:.2f}") for s in self.scores]
        return html_table(("Target", "Mode", "Observer", "error, nm"), cells)

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the scores as a pandas table, one row per score.

        Returns
        -------
        pandas.DataFrame
            The keys of `wfsobs run --json` as columns.

        Raises
        ------
        ImportError
            pandas is not installed.
        """
        import pandas

        return pandas.DataFrame(score_rows(self.scores, self.scenario.run.seed, source=self.prior_source))

    def estimate(self, observer: str, target: str) -> Estimate | None:
        """Return the estimate of one observer and target.

        Parameters
        ----------
        observer : str
            Id of the observer.
        target : str
            "turbulence" or "vibration".

        Returns
        -------
        Estimate or None
            None where there is no such estimate.
        """
        return next((e for e in self.estimates if (e.observer, e.target) == (observer, target)), None)
