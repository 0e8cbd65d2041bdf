"""The result of a run: estimates and scores, and the observers that failed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from wfsobs.evaluation.rows import score_rows
from wfsobs.evaluation.scores import Score
from wfsobs.notebook import PlotAccessor, html_table, import_extra
from wfsobs.observers.estimates import Estimate
from wfsobs.prior import TRUE, PriorSource
from wfsobs.record import Record
from wfsobs.scenario import Scenario

if TYPE_CHECKING:
    import pandas
    import xarray


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
    plot: ClassVar[PlotAccessor] = PlotAccessor()

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
        return import_extra("pandas", "arrays").DataFrame(
            score_rows(self.scores, self.scenario.run.seed, source=self.prior_source)
        )

    def to_xarray(self) -> xarray.Dataset:
        """Return the record and the estimates as labelled arrays.

        Returns
        -------
        xarray.Dataset
            That of the record; `turbulence_estimate` and `vibration_estimate` over `observer`, `time` [s] and `mode` (its name),
            NaN where there is none, and `..._sd`, the standard deviation that an observer states.

        Raises
        ------
        ImportError
            xarray is not installed.
        """
        out = self.record.to_xarray()
        out = out.assign_coords(mode=[m.name for m in self.scenario.modes][: self.record.n_modes])
        names = list(dict.fromkeys(e.observer for e in self.estimates))
        nothing = np.full_like(self.record.y_lgs, np.nan)
        for target in dict.fromkeys(e.target for e in self.estimates):
            own = {e.observer: e for e in self.estimates if e.target == target}
            for name, what in ((f"{target}_estimate", "values"), (f"{target}_sd", "sd")):
                found = {key: x for key, e in own.items() if (x := getattr(e, what)) is not None}
                if found:
                    stacked = np.stack([found.get(key, nothing) for key in names])
                    out[name] = (("observer", "time", "mode"), stacked, {"units": "um"})
        return out.assign_coords(observer=names)

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
