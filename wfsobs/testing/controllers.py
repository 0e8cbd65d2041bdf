"""A check of controllers written elsewhere.

>>> from wfsobs.control.controllers import CONTROLLERS
>>> from wfsobs.testing import check_controller
>>> check_controller(CONTROLLERS["lqg-kf-lgs"], alone=False)
"""

from __future__ import annotations

import gc
from collections.abc import Iterator
from functools import partial
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np

from wfsobs.control.base import Controller, Settings
from wfsobs.control.mirror import Law, Plant
from wfsobs.prior import Prior
from wfsobs.priors_from.controllers import controller_arguments, own_settings, plant_of, prior_for
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Measurements, Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.plant import Run
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.testing.common import (
    LOST,
    QUICK,
    SAME,
    STEPS,
    CheckError,
    changed_after,
    check_numbers,
    in_a_fresh_process,
    report_errors,
    run_loop,
    steps_to_check,
    with_gap,
)
from wfsobs.typing import Array

SEED = 918_273_645
"""A seed that is found where it should not be: no other number is likely to be the same."""


def walk_references(*roots: Any) -> Iterator[Any]:
    """Yield everything reachable from the roots, by references, bases of arrays, closures, defaults and partials.

    Classes and modules are the program, and so are the globals of a function.
    """
    seen, waiting = set[int](), list(roots)
    while waiting:
        x = waiting.pop()
        if id(x) in seen or isinstance(x, (type, ModuleType, BuiltinFunctionType)):
            continue
        seen.add(id(x))
        yield x
        if isinstance(x, FunctionType):
            waiting += [cell.cell_contents for cell in x.__closure__ or ()]
            waiting += [x.__defaults__, x.__kwdefaults__, x.__dict__]
        elif isinstance(x, partial):
            waiting += [x.func, x.args, x.keywords]
        else:
            waiting += gc.get_referents(x)
            if isinstance(x, np.ndarray):
                waiting.append(x.base)


def given_away(record: Record, *roots: Any, seed: int = SEED) -> set[str]:
    """Find what can be reached from the roots that should not: names of types, of signals of the truth, or "seed"."""
    found = set()
    for x in walk_references(*roots):
        if isinstance(x, (Scenario, Run, Record)):
            found.add(type(x).__name__)
        elif isinstance(x, int) and x == seed:
            found.add("seed")
        elif isinstance(x, np.ndarray) and x.dtype == float:
            for name in ("turbulence", "vibration"):
                truth = getattr(record, name)
                if np.shares_memory(x, truth) or any(np.isin(column, x).all() for column in truth.T if column.any()):
                    found.add(name)
    return found


class ControllerInputs(NamedTuple):
    """All that a controller receives."""

    measurements: Measurements
    prior: Prior
    plant: Plant
    settings: Settings


class ControllerRuns(NamedTuple):
    """A controller that is checked, and what is asked before each of its runs whether to stop."""

    controller: Controller
    watch: Watch

    def laws(self, inputs: ControllerInputs) -> tuple[Law, ...]:
        """Return its laws, which are stable. Raises CheckError."""
        id_ = self.controller.id
        with report_errors(id_, self.watch):
            laws = _laws(self.controller, inputs)
            for law in laws:
                if not law.stable:
                    raise CheckError(f"{id_}: a pole of its closed loop is not within the unit circle")
        return laws

    def commands(self, inputs: ControllerInputs, then: str = "") -> Array:
        """Return its commands, numbers of the right shape; then : when they were none. Raises CheckError."""
        id_ = self.controller.id
        with report_errors(id_, self.watch):
            u = _commands(self.controller, inputs)
            check_numbers(id_, "its command", u, inputs.measurements.y_lgs.shape)
            if not np.isfinite(u).all():
                raise CheckError(f"{id_}: a command is NaN or infinite{then}")
        return u

    def compare(self, got: Array, base: Array, what: str, stop: int | None = None, *, exact: bool = False) -> None:
        """Raise CheckError where two results differ before a step by more than rounding."""
        bound = 0.0 if exact else SAME * float(np.std(base))
        if not np.allclose(got[:stop], base[:stop], rtol=0.0, atol=bound):
            raise CheckError(f"{self.controller.id}: {what}")


def check_controller(
    controller: Controller, scenario: Scenario | None = None, alone: bool = True, *, watch: Watch = QUIET
) -> None:
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
    watch
        Is asked before every run of the controller whether to stop.

    Raises
    ------
    CheckError
        With the rule that it does not keep, or the error that it raises.
    ValueError
        Where the scenario has no prior for the controller.
    Cancelled
        Where `watch` asks to stop.
    """
    s = (scenario or PRESETS["paper"]().replace(QUICK)).replace({"run.seed": SEED})
    record = simulate(s)
    given = _inputs(controller, record, s)
    runs = ControllerRuns(controller, watch)
    if found := given_away(record, controller, runs.laws(given), *given):
        raise CheckError(f"{controller.id}: uses more than it is given: it reaches {', '.join(sorted(found))}")
    base = runs.commands(given)
    again = _inputs(controller, record, s)
    twice = "run twice on the same measurements it gives two results: it keeps something between runs, or draws random numbers"
    runs.compare(runs.commands(again), base, twice, exact=True)
    _check_untouched(controller, given, _inputs(controller, record, s))
    _check_causal(runs, given, base)
    _check_gaps(runs, given)
    _check_steps(runs, given)
    if alone:
        there = in_a_fresh_process(controller.id, watch, _commands, controller, again)
        check_numbers(controller.id, "its command", there, base.shape)
        what = "in a fresh process, with measurements and prior alone, it commands something else: it uses more than it is given"
        runs.compare(there, base, what)


def _inputs(controller: Controller, record: Record, scenario: Scenario) -> ControllerInputs:
    settings = own_settings(controller, scenario)
    measured, prior = controller_arguments(controller, record, settings, prior_for(controller, scenario))
    return ControllerInputs(measured, prior, plant_of(scenario), settings)


def _laws(controller: Controller, inputs: ControllerInputs) -> tuple[Law, ...]:
    return controller.laws(inputs.prior, inputs.plant, inputs.settings, inputs.measurements.n_modes)


def _commands(controller: Controller, inputs: ControllerInputs) -> Array:
    return controller.commands(_laws(controller, inputs), *inputs)[0]


def _check_untouched(controller: Controller, inputs: ControllerInputs, fresh: ControllerInputs) -> None:
    for name, now, was in zip(ControllerInputs._fields, inputs, fresh, strict=True):
        same = not isinstance(was, Settings) or _settings(now) == _settings(was)
        if not same or not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(_arrays(now), _arrays(was), strict=True)):
            raise CheckError(f"{controller.id}: changes its arguments ({name})")


def _arrays(root: Any) -> list[Array]:
    return [x for x in walk_references(root) if isinstance(x, np.ndarray) and x.dtype == float]


def _settings(own: Any) -> dict[str, Any]:
    return {name: group.to_dict() for name, group in vars(own).items()}


def _check_causal(runs: ControllerRuns, inputs: ControllerInputs, base: Array) -> None:
    """Check that u[k] uses y[0..k] and u[0..k-1] alone."""
    measured = inputs.measurements
    for k in steps_to_check(measured.n_steps):
        what = f"looks ahead: measurements after step {k} change its command of that step or an earlier one"
        later = inputs._replace(measurements=changed_after(measured, k, commands_from=0))
        runs.compare(runs.commands(later), base, what, stop=k + 1)


def _check_gaps(runs: ControllerRuns, inputs: ControllerInputs) -> None:
    gap = with_gap(inputs.measurements)
    u = runs.commands(inputs._replace(measurements=gap), " after missing samples")
    if not runs.controller.is_idle and not np.ptp(u[gap.n_steps // 2 + LOST :], axis=0).any():
        raise CheckError(f"{runs.controller.id}: does not recover after missing samples")


def _check_steps(runs: ControllerRuns, inputs: ControllerInputs) -> None:
    """Check that frame by frame it commands what it commands over a record, unless it cannot run frame by frame."""
    controller = runs.controller
    if controller.predict is not None and controller.step_predict is None:
        return
    measured = with_gap(inputs.measurements)
    with report_errors(controller.id, runs.watch, STEPS):
        got = run_loop(controller.design(inputs.prior, inputs.plant, inputs.settings, measured.sampling), measured)
    base = runs.commands(inputs._replace(measurements=measured))
    runs.compare(got, base, "frame by frame it commands something else")
