"""The closed loop of the results shown: quick controllers first, each as it is done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from wfsobs.app.jobs import Tell
from wfsobs.app.work import RunResults
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.envelope import PlantEnvelope, plant_envelope
from wfsobs.closed_loop.run import ClosedLoop, Row, each_outcome, rows
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.margins import Curves, curves
from wfsobs.dependence import Memo
from wfsobs.prior import TRUE, PriorSource
from wfsobs.priors_from.controllers import own_settings
from wfsobs.progress import Watch
from wfsobs.scenario import Scenario
from wfsobs.signal.spectrum import psd
from wfsobs.typing import Array

PATIENCE = 60.0
"""A controller that would take longer is left out here [s]; `wfsobs loop` runs it."""


@dataclass(frozen=True)
class LoopResults:
    """What a closed loop has given so far.

    rows    : those of `wfsobs loop --json`
    spectra : controller -> (frequency (n,) [Hz], density of the residual (n, n_modes) [um^2/Hz])
    curves  : controller -> per mode, of stable time-invariant laws
    source  : where the prior of the controllers comes from
    """

    result: ClosedLoop
    rows: tuple[Row, ...] = ()
    spectra: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)
    curves: Mapping[str, tuple[Curves, ...]] = field(default_factory=dict)
    complete: bool = False
    source: PriorSource = TRUE

    def residual(self, controller: str) -> Array | None:
        """(n_steps, n_modes) [um], or None."""
        return next((o.residual for o in self.result.outcomes if o.controller == controller), None)


def compute(of: RunResults, watch: Watch, tell: Tell, memo: Memo | None = None) -> LoopResults | None:
    """Run every controller on the record shown; tell what is done once the quick ones are, and after each of the others.

    memo : a controller whose outcome is known in it by what it depends on does not run
    """
    record, shown = of.result.record, None
    plan = design(of.scenario, [name for name in CONTROLLERS if seconds(name, of.scenario) <= PATIENCE])
    linear = {
        name: tuple(curves(plan.loop(name, mode), d.law.poles, record.dt) for mode, d in enumerate(laws) if d.law)
        for name, laws in plan.laws.items()
        if all(d.margins for d in laws)
    }
    outcomes: list[Any] = []
    spectra: dict[str, tuple[Array, Array]] = {}
    start = round(of.scenario.run.warm_up / record.dt)
    names = list(plan.laws)
    quick = [name for name in names if CONTROLLERS[name].is_quick]
    for outcome in each_outcome(record, plan, watch, memo=memo):
        outcomes.append(outcome)
        if outcome.residual is not None:
            spectra[outcome.controller] = psd(outcome.residual[start:], record.dt)
        if outcome.controller not in quick[:-1]:
            result = ClosedLoop(plan, record, tuple(outcomes))
            source, simulation = of.result.prior_source, of.simulation
            table = tuple(rows(result, simulation.run.seed if simulation else None, source=source))
            shown = LoopResults(result, table, dict(spectra), linear, outcome.controller == names[-1], source)
            if not shown.complete:
                tell(result=shown)
    return shown


def uncertain(scenario: Scenario, watch: Watch, tell: Tell) -> PlantEnvelope:
    """Compute what the linear controllers leave over an uncertain plant; tell what there is after each."""
    return plant_envelope(scenario, on_spread=lambda found: tell(result=found), watch=watch)


def uncertain_seconds(scenario: Scenario) -> float:
    """Estimate how long that takes [s]: 10 to 16 for two modes, on two processors."""
    return 8.0 * len(scenario.modes)


def cost(scenario: Scenario) -> float:
    """About how long all that are not left out take at most [s]."""
    return sum(s for s in (seconds(name, scenario) for name in CONTROLLERS) if s <= PATIENCE)


def seconds(controller: str, scenario: Scenario) -> float:
    """Estimate how long a controller takes at most [s]."""
    it = CONTROLLERS[controller]
    return it.seconds(own_settings(it, scenario), scenario.n_steps, len(scenario.modes)) if it.seconds else 0.0
