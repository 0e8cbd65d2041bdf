"""The residual of a linear controller under the true spectra, computed, not measured on records; of both sensors, too.

What the mirror does against the disturbance of step k, -phi_corr[k], is an estimate of it from measurements as old as the delay
is long, so that its residual is the error of a fixed linear observer (`exact_errors`).
"""

from __future__ import annotations

import numpy as np

from wfsobs.closed_loop.design import design
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.mirror import Law, Mirror
from wfsobs.evaluation.bound import PeriodicError
from wfsobs.evaluation.exact_errors import variance_of
from wfsobs.observers.estimates import TOTAL
from wfsobs.scenario import Scenario
from wfsobs.simulation.true_spectra import has_known_spectra, true_spectra
from wfsobs.typing import Array


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
        fast, slow = _responses(found.law, plan.mirror, ratio, spectra.n // (2 * ratio) * ratio)
        out.append(PeriodicError(variance_of(fast, slow, TOTAL, spectra)))
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
