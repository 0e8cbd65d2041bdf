"""A check of controllers written elsewhere.

>>> from wfsobs.control.controllers import CONTROLLERS
>>> from wfsobs.testing import check_controller
>>> check_controller(CONTROLLERS["lqg-kf-lgs"], alone=False)
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from wfsobs.control.base import Controller, Settings
from wfsobs.control.law import Law
from wfsobs.control.mirror import Plant
from wfsobs.prior import Prior
from wfsobs.priors_from.controllers import controller_arguments, own_settings, plant_of, prior_for
from wfsobs.record import Measurements, Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.testing.common import QUICK, SAME, CheckError, change_from, in_a_fresh_process
from wfsobs.testing.reach import SEED, given_away, walk_references
from wfsobs.testing.steps import run_loop
from wfsobs.typing import Array

LOST = 7
"""Measurements in a row that are missing."""


class ControllerInputs(NamedTuple):
    """All that a controller receives."""

    measurements: Measurements
    prior: Prior
    plant: Plant
    settings: Settings


def check_controller(controller: Controller, scenario: Scenario | None = None, alone: bool = True) -> None:
    """Run a controller on a short simulated record and check what holds for all of them.

    It reaches neither truth nor scenario nor seed. Its laws are stable. Its commands are numbers of the shape of the measurements
    and the same twice. Nothing that comes after a step changes its command of the step. It leaves its arguments as they are and
    gets over missing samples. Where it can run frame by frame, it then commands the same. In a fresh process,
    which has never seen the truth, it commands the same.

    Parameters
    ----------
    controller
        Entry that is checked; it need not be registered.
    scenario
        What is simulated, 1.5 s of the preset paper unless given; its seed is replaced by one that can be recognised.
    alone
        Whether to start the fresh process; a script that does needs the guard `if __name__ == "__main__"`.

    Raises
    ------
    CheckError
        With the rule that it does not keep.
    ValueError
        Where the controller has no law for the scenario.
    """
    s = (scenario or PRESETS["paper"]().replace(QUICK)).replace({"run.seed": SEED})
    record = simulate(s)
    given = _inputs(controller, record, s)
    laws = _check_laws(controller, given)
    if found := given_away(record, controller, laws, *given):
        raise CheckError(f"{controller.id}: uses more than it is given: it reaches {', '.join(sorted(found))}")
    base = _commands(controller, given)
    _check_shape(controller, base, given.measurements)
    again = _inputs(controller, record, s)
    twice = "run twice on the same measurements it gives two results: it keeps something between runs, or draws random numbers"
    _compare(controller, _commands(controller, again), base, twice, exact=True)
    _check_untouched(controller, given, _inputs(controller, record, s))
    _check_causal(controller, given, base)
    _check_gaps(controller, given)
    _check_steps(controller, given)
    if alone:
        there = in_a_fresh_process(controller.id, _commands, controller, again)
        what = "in a fresh process, with measurements and prior alone, it commands something else: it uses more than it is given"
        _compare(controller, there, base, what)


def _inputs(controller: Controller, record: Record, scenario: Scenario) -> ControllerInputs:
    settings = own_settings(controller, scenario)
    measured, prior = controller_arguments(controller, record, settings, prior_for(controller, scenario))
    return ControllerInputs(measured, prior, plant_of(scenario), settings)


def _laws(controller: Controller, inputs: ControllerInputs) -> tuple[Law, ...]:
    return controller.laws(inputs.prior, inputs.plant, inputs.settings, inputs.measurements.n_modes)


def _commands(controller: Controller, inputs: ControllerInputs) -> Array:
    laws = _laws(controller, inputs)
    try:
        return controller.commands(laws, *inputs)[0]
    except ValueError as error:
        raise CheckError(f"{controller.id}: cannot run: {error}") from error


def _check_laws(controller: Controller, inputs: ControllerInputs) -> tuple[Law, ...]:
    laws = _laws(controller, inputs)
    for law in laws:
        if not isinstance(law, Law):
            raise CheckError(f"{controller.id}: law takes a wfsobs.control.law.Law, not a {type(law).__name__}")
        if not law.stable:
            raise CheckError(f"{controller.id}: a pole of its closed loop is not within the unit circle")
    return laws


def _check_shape(controller: Controller, u: Any, measurements: Measurements) -> None:
    if not isinstance(u, np.ndarray) or u.dtype != float or u.shape != measurements.y_lgs.shape:
        raise CheckError(f"{controller.id}: its commands take numbers of shape {measurements.y_lgs.shape}, (n_steps, n_modes)")
    if not np.isfinite(u).all():
        raise CheckError(f"{controller.id}: a command is NaN or infinite")


def _check_untouched(controller: Controller, inputs: ControllerInputs, fresh: ControllerInputs) -> None:
    for name, now, was in zip(ControllerInputs._fields, inputs, fresh, strict=True):
        same = not isinstance(was, Settings) or _settings(now) == _settings(was)
        if not same or not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(_arrays(now), _arrays(was), strict=True)):
            raise CheckError(f"{controller.id}: changes its arguments ({name})")


def _arrays(root: Any) -> list[Array]:
    return [x for x in walk_references(root) if isinstance(x, np.ndarray) and x.dtype == float]


def _settings(own: Any) -> dict[str, Any]:
    return {name: group.to_dict() for name, group in vars(own).items()}


def _check_causal(controller: Controller, inputs: ControllerInputs, base: Array) -> None:
    """Check that u[k] uses y[0..k] and u[0..k-1] alone."""
    measured, n = inputs.measurements, inputs.measurements.n_steps
    for k in (n // 2, n // 2 + 3, n - 5):
        rng = np.random.default_rng(k)
        later = replace(
            measured,
            y_lgs=change_from(measured.y_lgs, k + 1, rng),
            u=change_from(measured.u, k, rng),
            y_ngs=None if measured.y_ngs is None else change_from(measured.y_ngs, k + 1, rng),
        )
        what = f"looks ahead: measurements after step {k} change its command of that step or an earlier one"
        _compare(controller, _commands(controller, inputs._replace(measurements=later)), base, what, stop=k + 1)


def _check_gaps(controller: Controller, inputs: ControllerInputs) -> None:
    y, start = inputs.measurements.y_lgs.copy(), inputs.measurements.n_steps // 2
    y[start : start + LOST] = np.nan
    u = _commands(controller, inputs._replace(measurements=replace(inputs.measurements, y_lgs=y)))
    if not np.isfinite(u).all():
        raise CheckError(f"{controller.id}: a command is NaN or infinite after missing samples")
    if controller.law is not None and not np.ptp(u[start + LOST :], axis=0).any():
        raise CheckError(f"{controller.id}: does not recover after missing samples")


def _check_steps(controller: Controller, inputs: ControllerInputs) -> None:
    """Check that frame by frame it commands what it commands over a record, unless it cannot run frame by frame."""
    if controller.predict is not None and controller.step_predict is None:
        return
    y, start = inputs.measurements.y_lgs.copy(), inputs.measurements.n_steps // 2
    y[start : start + LOST] = np.nan
    measured = replace(inputs.measurements, y_lgs=y)
    got = run_loop(controller.design(inputs.prior, inputs.plant, inputs.settings, measured.sampling), measured)
    _compare(
        controller,
        got,
        _commands(controller, inputs._replace(measurements=measured)),
        "frame by frame it commands something else",
    )


def _compare(controller: Controller, got: Array, base: Array, what: str, stop: int | None = None, exact: bool = False) -> None:
    bound = 0.0 if exact else SAME * float(np.std(base))
    if not np.allclose(got[:stop], base[:stop], rtol=0.0, atol=bound):
        raise CheckError(f"{controller.id}: {what}")
