"""The laws of all controllers of a scenario, and what theory says of them before any random number.

The residual of a linear controller follows from the true spectra; of both sensors, too. What the mirror does against the
disturbance of step k, -phi_corr[k], is an estimate of it from measurements as old as the delay is long, so that its residual is
the error of a fixed linear observer (`exact_errors`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from wfsobs.control.base import Controller, Settings
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.margins import Margins, Response, frequencies, margins, residual_variance
from wfsobs.control.mirror import Law, Mirror, Plant
from wfsobs.control.mismatch import SensorSpectra, loops, margins_of, one_loop, pairs, radius, weigh
from wfsobs.control.true_plant import TruePlant
from wfsobs.evaluation.bound import INFORMATION, PeriodicError, least_residual
from wfsobs.evaluation.exact_errors import variance_of
from wfsobs.observers.kalman.filters import UnstableCycle
from wfsobs.prior import Prior, Spectra
from wfsobs.priors_from.controllers import own_settings, plant_of, prior_for, supervision_of, true_plant_of
from wfsobs.priors_from.scenario import told_spectra
from wfsobs.record import TOTAL
from wfsobs.registry import name_list
from wfsobs.scenario import Scenario
from wfsobs.settings.values import error_line
from wfsobs.simulation.true_spectra import TrueSpectra, has_known_spectra, true_spectra
from wfsobs.typing import Array


@dataclass(frozen=True)
class LawDesign:
    """A law in one mode and what theory says of it.

    law           : None for control by nothing, and where there is none
    stable        : None where there is no law; that of the law with the plant that it is designed for where the plant as it is
        is not linear, with a prediction beside the law, or under supervision
    predicted_rms : rms [um] of the residual by the true spectra; None where the law has no frequency response, is not stable or
        is supervised
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
        the NGS, too; none where the spectrum of the turbulence is not known, or there is jitter
    priors : controller -> what it is told, spectra aside, of which only laws are made
    start  : from which the residuals count [s]: after the warm-up, and after what is trained on
    true   : the plant as it is; None where it is the one that the controllers are designed for
    """

    scenario: Scenario
    plant: Plant
    laws: dict[str, tuple[LawDesign, ...]]
    bounds: dict[str, tuple[float, ...]]
    priors: dict[str, Prior] = field(default_factory=dict, repr=False)
    start: float = 0.0
    true: TruePlant | None = None

    @property
    def mirror(self) -> Mirror:
        """The mirror of the plant."""
        return self.plant.mirror

    def loop(self, controller: str, mode: int) -> Response:
        """Return T = L / (1 + L) of a time-invariant law with the plant as it is, loops of other modes closed."""
        if self.true is None:
            return nominal_loop(_law(self.laws[controller][mode]), self.mirror)
        columns = next(of for of in pairs(self.true.matrix) if mode in of)
        laws = [_law(self.laws[controller][column]) for column in columns]
        return one_loop(laws, self.mirror, self.true, columns, columns.index(mode))


def nominal_loop(law: Law, mirror: Mirror) -> Response:
    """Return T = L / (1 + L) of a time-invariant law with the mirror that it is designed for."""
    return lambda omega: mirror.response(omega) * law.response(omega)


def _law(of: LawDesign) -> Law:
    assert of.law is not None
    return of.law


def design(scenario: Scenario, controllers: Sequence[str] | None = None, start: float = 0.0) -> Design:
    """Make the laws of the controllers (all unless named) and judge them by theory. Raises SettingError.

    start : from which a residual counts [s], or from the end of the warm-up
    Laws are those of the scenario before its events. What they will leave is then not known by theory, nor a bound; neither where
    errors of the plant begin later, or its delay has jitter: an early command can beat the bound of the mean delay.
    """
    scenario.validate()
    before, plant = scenario.before_events, plant_of(scenario)
    true = [true_spectra(before, mode) for mode in range(len(scenario.modes))] if has_known_spectra(before) else []
    spectra = [told_spectra(one) for one in true]
    made = {c.id: _design_one(c, before, plant, spectra) for c in select_controllers(controllers)}
    laws, priors = {name: laws for name, (laws, _) in made.items()}, {name: prior for name, (_, prior) in made.items()}
    delay, actual = plant.mirror.delay, true_plant_of(scenario)
    if actual is not None:
        laws = {name: _with_plant(name, of, plant, actual, true) for name, of in laws.items()}
        delay = actual.delay
    for name in [name for name in laws if supervision_of(CONTROLLERS[name], scenario)]:
        laws[name] = tuple(replace(one, predicted_rms=None, margins=None) for one in made[name][0])
    if scenario.events or (actual is not None and (actual.start or actual.jitter)):
        laws = {name: tuple(replace(one, predicted_rms=None) for one in designed) for name, designed in laws.items()}
        true = []
    given = ("lgs", "both") if true else ()
    bounds = {INFORMATION[of]: tuple(least_residual(one, delay, of) for one in true) for of in given}
    return Design(scenario, plant, laws, bounds, priors, max(scenario.run.warm_up, start), actual)


def design_mode(controller: str, scenario: Scenario, mode: int, spectra: Spectra | None) -> LawDesign:
    """Make and judge the law of a controller that is told nothing, in one mode; spectra : where known, for the residual."""
    found = CONTROLLERS[controller]
    return _of_mode(found, Prior(), mode, plant_of(scenario), own_settings(found, scenario), spectra)


def select_controllers(controllers: Sequence[str] | None) -> list[Controller]:
    """Return the controllers of these ids, in the order of the registry; all for None. Raises SettingError."""
    controllers = name_list(controllers)
    CONTROLLERS.check_ids(controllers or ())
    return [c for c in CONTROLLERS.values() if controllers is None or c.id in controllers]


def _design_one(
    controller: Controller, scenario: Scenario, plant: Plant, spectra: Sequence[Spectra]
) -> tuple[tuple[LawDesign, ...], Prior]:
    """(one per mode, the prior that they were made with less its spectra)."""
    settings, modes = own_settings(controller, scenario), range(len(scenario.modes))
    try:
        prior = prior_for(controller, scenario, spectra)
    except MemoryError:
        raise
    except (Exception, SystemExit) as error:
        return tuple(LawDesign(None, None, note=error_line(error)) for _ in modes), Prior()
    designed = (_of_mode(controller, prior, mode, plant, settings, spectra[mode] if spectra else None) for mode in modes)
    return tuple(designed), replace(prior, spectra=())


def _of_mode(
    controller: Controller, prior: Prior, mode: int, plant: Plant, settings: Settings, spectra: Spectra | None
) -> LawDesign:
    if controller.law is None:
        return LawDesign(None, True)
    try:
        law = controller.law_of(prior, mode, plant, settings)
        stable, mirror = law.stable, plant.mirror
        if not stable or controller.predict is not None or not law.time_invariant:
            return LawDesign(law, stable)
        predicted = None if spectra is None else float(np.sqrt(residual_variance(law, spectra, mirror)))
        known = margins(nominal_loop(law, mirror), frequencies(law.poles), plant.dt)
        return LawDesign(law, stable, predicted, known)
    except MemoryError:
        raise
    except (Exception, SystemExit) as error:  # by a controller of another package, perhaps: the others keep their laws
        return LawDesign(None, False if isinstance(error, UnstableCycle) else None, note=error_line(error))


def loop_spectra(spectra: TrueSpectra) -> SensorSpectra:
    """Return true spectra as the theory of loops takes them."""
    disturbance, cross = spectra.total
    ngs = spectra.ngs
    shared = ngs.measurement_cross, sum(ngs.cross.values(), np.zeros(1))
    return SensorSpectra(disturbance, spectra.measurement, cross, (ngs.signal, *shared), ngs.noise)


def _with_plant(
    controller: str, designs: Sequence[LawDesign], plant: Plant, true: TruePlant, spectra: Sequence[TrueSpectra]
) -> tuple[LawDesign, ...]:
    """Return the designs of all modes with stability, residual and margins of the plant as it is; where that is linear."""
    out = [replace(one, predicted_rms=None, margins=None) for one in designs]
    if not true.is_linear or CONTROLLERS[controller].predict is not None or not all(one.law and one.stable for one in designs):
        return tuple(out)
    for columns in pairs(true.matrix):
        laws, part = [_law(designs[column]) for column in columns], np.ix_(columns, columns)
        matrix = true.matrix[part]
        stable = radius(laws, plant.mirror, replace(true, matrix=matrix)) < 1.0
        variance: Sequence[float] | None = None
        if stable and spectra and true.time_invariant:
            of = loops(laws, plant.mirror)
            response = true.response(of.images)
            _, Q = of.solve(response, matrix)
            variance = of.residual(Q, response, matrix, [weigh(loop_spectra(spectra[column]), of) for column in columns]).tolist()
        has_margins = stable and true.time_invariant and all(law.time_invariant for law in laws)
        for i, column in enumerate(columns):
            known = margins_of(one_loop(laws, plant.mirror, true, columns, i), laws, plant.dt) if has_margins else None
            rms = None if variance is None else float(np.sqrt(variance[i]))
            out[column] = replace(out[column], stable=stable, predicted_rms=rms, margins=known)
    return tuple(out)


def exact_residuals(controller: str, scenario: Scenario) -> list[PeriodicError]:
    """Compute the residual of a controller that is told the scenario, its mirror without limits.

    Parameters
    ----------
    controller : str
        Id of a controller with a linear law and no prediction beside it.
    scenario : Scenario
        Of known spectra (`has_known_spectra`).

    Returns
    -------
    list of PeriodicError
        Per mode: residual a step with an NGS frame, one step later, ....

    Raises
    ------
    ValueError
        The spectra are not known, the plant has errors, or a law of the controller is none, not stable, or has a prediction
        beside it.
    """
    if not has_known_spectra(scenario):
        raise ValueError("the spectra of this scenario are not known for the whole record")
    plan = design(scenario, [controller])
    if plan.true is not None:
        raise ValueError("the exact residual is that of a plant without errors")
    out = []
    for mode, found in enumerate(plan.laws[controller]):
        if found.law is None or not found.stable or CONTROLLERS[controller].predict is not None:
            raise ValueError(f"{controller}: the exact residual is that of a stable linear law: {found.note or 'it has none'}")
        spectra = true_spectra(scenario, mode)
        ratio = spectra.ngs.ratio
        taps = np.stack(_responses(found.law, plan.mirror, ratio, spectra.n // (2 * ratio) * ratio))
        out.append(PeriodicError(variance_of(taps, TOTAL, spectra)))
    return out


def _responses(law: Law, mirror: Mirror, ratio: int, length: int) -> tuple[Array, Array]:
    """Return the response of -phi_corr to z and to a frame, by age, p steps after a frame, (ratio, length) each."""
    fast, slow = np.zeros((ratio, length)), np.zeros((ratio, length))
    start = 2 * ratio  # the first cycle may differ
    for sensor, response, first in [*((0, fast, p) for p in range(ratio)), (1, slow, 0)]:
        measurements = np.zeros((start + length + ratio, 2))
        measurements[start + first, sensor] = 1.0
        correction = -mirror.correction(law.run(measurements))[start + first :][:length]
        for phase in range(ratio):
            age = np.arange((phase - first) % ratio, length, ratio)
            response[phase, age] = correction[age]
    return fast, slow
