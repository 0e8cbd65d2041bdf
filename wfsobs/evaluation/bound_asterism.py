"""Bound of an asterism: the minimum error of any linear observer of every LGS by itself in all modes, and of the NGS frames.

Of what is made of all LGS together in the place of each by itself it is the bound of the coupled modes of both sensors.

It is as `bound_stars`, which takes one mode at a time, and is found as `bound_modes`: by the best weights of very many means of
the past, of the LGS and of the NGS frames, beside the states of `kf-asterism` or `multirate-coupled`. Lines are as wide as
those of the record at least.
"""

from __future__ import annotations

from wfsobs.evaluation.bound_both import PeriodicError
from wfsobs.evaluation.bound_modes import NOT_COUPLED, TRUE_MODEL
from wfsobs.observers.base import TARGETS
from wfsobs.observers.estimates import TOTAL
from wfsobs.observers.kalman.asterism_model import AsterismModel
from wfsobs.prior import Asterism, FlowOfBoth, Lines
from wfsobs.priors_from.scenario import prior_of
from wfsobs.scenario import Scenario
from wfsobs.signal.joint_states import running_means
from wfsobs.simulation.mode_spectra import are_coupled
from wfsobs.simulation.synthesis import line_width

TURNS = (0.0, 2.0, 4.0)
FINE = running_means([0.0, *(2.0**i for i in range(12))], TURNS)
"""Means over 1 to 2048 steps."""
FINE_FRAMES = running_means([0.0, *(2.0**i for i in range(9))], TURNS)
"""Means over 1 to 256 frames."""


def least_errors_of_asterism(scenario: Scenario, ahead: float = 0.0) -> list[dict[str, PeriodicError]]:
    """Return the minimum error of phi[k + ahead] from all modes of every LGS and all NGS frames up to step k.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    ahead : float
        Steps of prediction.

    Returns
    -------
    list of dict
        Per mode: target -> error; TOTAL is that of both together.

    Raises
    ------
    ValueError
        All LGS see the same.
    """
    return _least_errors(scenario, Asterism, ahead)


def least_errors_of_modes_of_both(scenario: Scenario, ahead: float = 0.0) -> list[dict[str, PeriodicError]]:
    """Return that from all modes of the LGS together and all NGS frames up to step k.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    ahead : float
        Steps of prediction.

    Returns
    -------
    list of dict
        As `least_errors_of_asterism`.

    Raises
    ------
    ValueError
        The modes are independent, so that each has its own bound.
    """
    if not are_coupled(scenario):
        raise ValueError(NOT_COUPLED)
    return _least_errors(scenario, FlowOfBoth, ahead)


def _least_errors(scenario: Scenario, part: type[Asterism], ahead: float) -> list[dict[str, PeriodicError]]:
    told = scenario.replace({**TRUE_MODEL, "multipeak.line_width": line_width(scenario)})
    prior = prior_of(told, None, (Lines, part))
    model = AsterismModel(prior, told.multipeak, scenario.sensors.exposure_ratio, FINE, FINE_FRAMES)
    found = {target: model.plan(ahead, target)[1][:-1] ** 2 for target in (*TARGETS, TOTAL)}
    return [{target: PeriodicError(of[:, mode]) for target, of in found.items()} for mode in range(len(scenario.modes))]


def bound_rms_of_asterism(scenario: Scenario, ahead: float = 0.0) -> list[dict[str, float]]:
    """Return target -> rms over all steps [um] of each mode, of `least_errors_of_asterism`."""
    return [{target: error.rms for target, error in of_mode.items()} for of_mode in least_errors_of_asterism(scenario, ahead)]


def bound_rms_of_modes_of_both(scenario: Scenario, ahead: float = 0.0) -> list[dict[str, float]]:
    """Return target -> rms over all steps [um] of each mode, of `least_errors_of_modes_of_both`."""
    return [
        {target: error.rms for target, error in of_mode.items()} for of_mode in least_errors_of_modes_of_both(scenario, ahead)
    ]
