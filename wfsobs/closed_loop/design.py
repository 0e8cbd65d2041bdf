"""The laws of all controllers of a scenario, and what theory says of them before any random number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from wfsobs.control.base import Controller, Settings
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.law import Law
from wfsobs.control.margins import Margins, frequencies, margins
from wfsobs.control.mirror import Mirror, Plant
from wfsobs.control.residual import residual_variance
from wfsobs.evaluation.bound import INFORMATION, least_residual
from wfsobs.observers.kalman.multirate import UnstableCycle
from wfsobs.prior import Prior, Spectra
from wfsobs.priors_from.controllers import own_settings, plant_of, prior_for
from wfsobs.priors_from.scenario import told_spectra
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError
from wfsobs.simulation.true_spectra import has_known_spectra, true_spectra


@dataclass(frozen=True)
class LawDesign:
    """A law in one mode and what theory says of it.

    law           : None for control by nothing, and where there is none
    stable        : None where there is no law
    predicted_rms : rms [um] of the residual by the true spectra; None where the law has no frequency response or is not stable
    margins       : the same
    note          : why there is no law
    """

    law: Law | None
    stable: bool | None
    predicted_rms: float | None = None
    margins: Margins | None = None
    note: str = ""


@dataclass(frozen=True)
class Design:
    """All controllers of a scenario, before any random number.

    laws   : controller -> one per mode
    bounds : BOUND, BOUND_BOTH -> per mode, rms [um] of the least residual of any causal controller of the mean of the LGS, or of
        the NGS, too; none where the spectrum of the turbulence is not known
    priors : controller -> what it is told, spectra aside, of which only laws are made
    start  : from which the residuals count [s]: after the warm-up, and after what is trained on
    """

    scenario: Scenario
    plant: Plant
    laws: dict[str, tuple[LawDesign, ...]]
    bounds: dict[str, tuple[float, ...]]
    priors: dict[str, Prior] = field(default_factory=dict, repr=False)
    start: float = 0.0

    @property
    def mirror(self) -> Mirror:
        """The mirror of the plant."""
        return self.plant.mirror


def design(scenario: Scenario, controllers: Sequence[str] | None = None, start: float = 0.0) -> Design:
    """Make the laws of the controllers (all unless named) and judge them by theory. Raises SettingError.

    start : from which a residual counts [s], or from the end of the warm-up
    Laws are those of the scenario before its events. What they will leave is then not known by theory, nor a bound.
    """
    scenario.validate()
    before, plant = scenario.before_events, plant_of(scenario)
    true = [true_spectra(before, mode) for mode in range(len(scenario.modes))] if has_known_spectra(before) else []
    spectra = [told_spectra(one) for one in true]
    made = {c.id: _design_one(c, before, plant, spectra) for c in select_controllers(controllers)}
    laws, priors = {name: laws for name, (laws, _) in made.items()}, {name: prior for name, (_, prior) in made.items()}
    if scenario.events:
        laws = {name: tuple(replace(one, predicted_rms=None) for one in designed) for name, designed in laws.items()}
        return Design(scenario, plant, laws, {}, priors, max(scenario.run.warm_up, start))
    given = ("lgs", "both") if true else ()
    bounds = {INFORMATION[of]: tuple(least_residual(one, plant.mirror.delay, of) for one in true) for of in given}
    return Design(scenario, plant, laws, bounds, priors, max(scenario.run.warm_up, start))


def design_mode(controller: str, scenario: Scenario, mode: int, spectra: Spectra | None) -> LawDesign:
    """Make and judge the law of a controller that is told nothing, in one mode; spectra : where known, for the residual."""
    found = CONTROLLERS[controller]
    return _of_mode(found, Prior(), mode, plant_of(scenario), own_settings(found, scenario), spectra)


def select_controllers(controllers: Sequence[str] | None) -> list[Controller]:
    """Return the controllers of these ids, in the order of the registry; all for None. Raises SettingError."""
    unknown = set(controllers or ()) - set(CONTROLLERS)
    if unknown:
        raise SettingError(f"controller {sorted(unknown)[0]!r}: no such controller; there are {', '.join(CONTROLLERS)}")
    return [c for c in CONTROLLERS.values() if controllers is None or c.id in controllers]


def _design_one(
    controller: Controller, scenario: Scenario, plant: Plant, spectra: Sequence[Spectra]
) -> tuple[tuple[LawDesign, ...], Prior]:
    """(one per mode, the prior that they were made with less its spectra)."""
    settings, modes = own_settings(controller, scenario), range(len(scenario.modes))
    try:
        prior = prior_for(controller, scenario, spectra)
    except ValueError as error:
        return tuple(LawDesign(None, None, note=str(error)) for _ in modes), Prior()
    designed = (_of_mode(controller, prior, mode, plant, settings, spectra[mode] if spectra else None) for mode in modes)
    return tuple(designed), replace(prior, spectra=())


def _of_mode(
    controller: Controller, prior: Prior, mode: int, plant: Plant, settings: Settings, spectra: Spectra | None
) -> LawDesign:
    if controller.law is None:
        return LawDesign(None, True)
    try:
        law = controller.law(prior, mode, plant, settings)
    except UnstableCycle as error:
        return LawDesign(None, False, note=str(error))
    except ValueError as error:
        return LawDesign(None, None, note=str(error))
    stable, mirror = law.stable, plant.mirror
    if not stable or controller.predict is not None or not law.time_invariant:
        return LawDesign(law, stable)
    predicted = None if spectra is None else float(np.sqrt(residual_variance(law, spectra, mirror)))
    known = margins(lambda omega: mirror.response(omega) * law.response(omega), frequencies(law.poles), plant.dt)
    return LawDesign(law, stable, predicted, known)
