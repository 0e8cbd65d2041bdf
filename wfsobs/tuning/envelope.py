"""Tuning of a controller on an uncertain plant: least residual at the worst of its plants, or below which 95 % of them are."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Literal

import numpy as np

from wfsobs.closed_loop.envelope import Plants, Spread, Uncertainty, known_spectra, spread_of, uncertain_plants
from wfsobs.scenario import Scenario
from wfsobs.simulation.true_spectra import TrueSpectra
from wfsobs.tuning.trials import Errors, Evaluation, Stage, Trials

SEARCHED, HELD_OUT = 64, 256
"""Points of the envelope that the search sees, beside all corners, and others that the result is scored on."""


@dataclass(frozen=True)
class EnvelopeGoal:
    """What a controller is tuned for on an uncertain plant.

    Attributes
    ----------
    uncertainty : Uncertainty
        Largest errors of the plant.
    by : {"worst", "p95"}
        Residual that is made small: at the worst of points and corners, or the 95 % quantile of the points.
    loss : float
        How much more the controller may leave at the nominal plant than with the settings before.
    """

    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    by: Literal["worst", "p95"] = "worst"
    loss: float = 0.1


@dataclass
class EnvelopeTrials(Trials):
    """What a controller leaves of some plants with trial settings."""

    controller: str
    goal: EnvelopeGoal
    most_nominal: float = field(default=inf, init=False)
    spectra: list[TrueSpectra] = field(init=False)
    search_plants: Plants = field(init=False)
    other_plants: Plants = field(init=False)

    def __post_init__(self) -> None:
        self.spectra = known_spectra(self.scenario)
        _, _, plants = uncertain_plants(self.scenario, self.goal.uncertainty, SEARCHED + HELD_OUT)
        self.search_plants = replace(plants, points=plants.points[:SEARCHED])
        self.other_plants = replace(plants, points=plants.points[SEARCHED:], corners=())

    def errors_of(self, scenario: Scenario) -> Errors:
        """Return the residuals that count, of the plants of the search."""
        spread = self._spread(scenario, self.search_plants)
        nominal = float(np.sqrt(np.mean(spread.nominal**2)))
        if not self.history:
            self.most_nominal = (1.0 + self.goal.loss) * nominal
        if nominal > self.most_nominal or not isfinite(nominal):
            raise ValueError(f"{1e3 * nominal:.2f} nm at the nominal plant, above {1e3 * self.most_nominal:.2f}")
        errors = self._errors(spread)
        if not isfinite(errors.rms):
            raise ValueError("not stable at every plant")
        return errors

    def stage(self, evaluation: Evaluation) -> Stage:
        """Return the controller on plants that the search has not seen."""
        scenario = self.scenario.replace(evaluation.changes)
        seen, held_out = (self._spread(scenario, plants) for plants in (self.search_plants, self.other_plants))
        errors = self._errors(held_out)
        return Stage(scenario, evaluation.errors, errors if isfinite(errors.rms) else None, spreads=(seen, held_out))

    def _spread(self, scenario: Scenario, plants: Plants) -> Spread:
        scenario.validate()
        watch = self.inner()
        watch.check()
        spread = spread_of(self.controller, scenario, plants, self.spectra, watch)
        watch.step(1.0)
        return spread

    def _errors(self, spread: Spread) -> Errors:
        left = spread.worst if self.goal.by == "worst" else spread.p95
        return Errors({mode.name: float(x) for mode, x in zip(self.scenario.modes, left, strict=True)})
