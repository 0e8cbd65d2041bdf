"""Bound of the coupled modes: the minimum error of any linear observer that has the LGS measurements of all modes.

It is as `bound`, which is that of every mode by itself: of the mean of the LGS, or of what `sensors.lgs_combination` makes of
them, for the true spectra and noise and an endless record; lines are as wide as those of the record at least. It is what the best
weights of very many means of the past leave, exponential ones of all times in a geometric series, turning ones among them
(`signal.joint_states`): such means come as near to any function of the past as one likes. More of them change the figures of the
preset `higher-orders` by 0.1 % at most; three times as many frequencies in the sums, and more about the lines, those of it, `ut4`
and `galacsi-nfm` by 0.06 %. Near narrow lines what is found is up to 2.5 % above the least there is, as single modes show, whose
bound is known: a row is the lesser of the two.
"""

from __future__ import annotations

from wfsobs.evaluation.bound_both import PeriodicError
from wfsobs.observers.base import TARGETS
from wfsobs.observers.estimates import TOTAL
from wfsobs.observers.kalman.coupled import CoupledModel
from wfsobs.prior import Flow, Lines
from wfsobs.priors_from.scenario import prior_of
from wfsobs.scenario import Scenario
from wfsobs.signal.joint_states import running_means
from wfsobs.simulation.mode_spectra import are_coupled
from wfsobs.simulation.synthesis import line_width

FINE = running_means([0.0, *(1.6**i for i in range(20))], turns=(0.0, 2.0, 4.0, 6.0))
"""Means over 1 to 7600 steps."""

NOT_COUPLED = "the modes of this scenario are independent: the bound of each is its own"
"""Why there is no bound of all of them."""

TRUE_MODEL = {"kalman.process_noise": "matched", "kalman.measurement_noise": "matched", "multipeak.turbulence_order": 3}
"""Settings of the filters whose states stand beside the means: a row does not depend on what the observers are set to."""


def least_errors_of_modes(scenario: Scenario, ahead: float = 0.0) -> list[dict[str, PeriodicError]]:
    """Return the minimum error of phi[k + ahead] from all modes of z[k], z[k-1], ....

    Parameters
    ----------
    scenario : Scenario
        Settings.
    ahead : float
        Steps of prediction.

    Returns
    -------
    list of dict
        Per mode: target -> error, the same at all steps; TOTAL is that of both together.

    Raises
    ------
    ValueError
        The modes are independent, so that each has its own bound.
    """
    if not are_coupled(scenario):
        raise ValueError(NOT_COUPLED)
    told = scenario.replace({**TRUE_MODEL, "multipeak.line_width": line_width(scenario)})
    model = CoupledModel(prior_of(told, None, (Lines, Flow)), told.multipeak, FINE)
    found = {target: model.plan(ahead, target)[1] for target in (*TARGETS, TOTAL)}
    modes = range(len(scenario.modes))
    return [{target: PeriodicError(sd[mode : mode + 1] ** 2) for target, sd in found.items()} for mode in modes]


def bound_rms_of_modes(scenario: Scenario, ahead: float = 0.0) -> list[dict[str, float]]:
    """Return target -> rms [um] of each mode, of `least_errors_of_modes`."""
    return [{target: error.rms for target, error in of_mode.items()} for of_mode in least_errors_of_modes(scenario, ahead)]
