"""Checks of observers and controllers written elsewhere, in the manner of scikit-learn's `check_estimator`.

>>> from wfsobs.control.controllers import CONTROLLERS
>>> from wfsobs.observers import OBSERVERS
>>> from wfsobs.testing import check_controller, check_observer
>>> check_observer(OBSERVERS["persistence"], alone=False)
>>> check_controller(CONTROLLERS["lqg-kf-lgs"], alone=False)
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np

from wfsobs.control.base import Controller, Settings
from wfsobs.control.mirror import Law, Plant
from wfsobs.control.step import StepController
from wfsobs.control.true_plant import TruePlant, drive
from wfsobs.observers.base import TARGETS, Observer
from wfsobs.observers.step import StepObserver, frames_of
from wfsobs.prior import Prior
from wfsobs.priors_from.controllers import controller_arguments, own_settings, plant_of, prior_for
from wfsobs.priors_from.scenario import arguments
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Measurements, Record, hold_last
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.plant import Run
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.values import error_line
from wfsobs.simulation.loop import simulate
from wfsobs.typing import Array

__all__ = ["QUICK", "CheckError", "check_controller", "check_observer"]

SAME = 1e-9
"""Difference over the rms of an estimate that is rounding: blocks of another length add up in another order."""

QUICK: dict[str, Any] = {
    "run.duration": 1.5,
    "run.warm_up": 0.2,
    "adaptive.window": 0.25,
    "gpr_offline.training_size": 60,
    "gpr_offline.depth": 25,
    "gpr_online.training_size": 60,
    "gpr_online.depth": 25,
}


class CheckError(AssertionError):
    """An observer or a controller that does not keep a rule: one line naming it and the rule."""


@contextmanager
def report_errors(name: str, watch: Watch, what: str = "cannot run") -> Iterator[None]:
    """Raise CheckError for whatever is raised inside; ask first whether to stop."""
    watch.check()
    try:
        yield
    except CheckError:
        raise
    except (Exception, SystemExit) as error:
        raise CheckError(f"{name}: {what}: {error_line(error)}") from error


def check_numbers(name: str, what: str, values: Any, shape: tuple[int, ...]) -> None:
    """Raise CheckError unless values are an array of this shape, (n_steps, n_modes), and of float64."""
    if not isinstance(values, np.ndarray) or values.dtype != float:
        kind = values.dtype if isinstance(values, np.ndarray) else type(values).__name__
        raise CheckError(f"{name}: {what} takes an array of float64, not {kind}")
    if values.shape != shape:
        raise CheckError(f"{name}: {what} takes the shape {shape}, (n_steps, n_modes), not {values.shape}")


def arrays_of(measurements: Measurements) -> dict[str, Array]:
    """Return every array of measurements by name."""
    return {name: x for name, x in vars(measurements).items() if isinstance(x, np.ndarray)}


LOST = 7
"""Measurements in a row that are missing."""


def with_gap(measurements: Measurements) -> Measurements:
    """Return measurements without LOST samples in the middle."""
    y, start = measurements.y_lgs.copy(), measurements.n_steps // 2
    y[start : start + LOST] = np.nan
    return replace(measurements, y_lgs=y)


RESIDUES = 7
COMMON_MULTIPLE = 420
"""Of the whole numbers up to RESIDUES."""


def steps_to_check(n: int) -> list[int]:
    """Return steps of a record of n after which a check changes what is measured.

    Two are near the start. The others are spread at random over the record, with neighbouring residues of COMMON_MULTIPLE, and
    hence every residue of the numbers up to RESIDUES: what looks ahead at every fifth step alone does so at one of them.
    """
    rng, last = np.random.default_rng(n), n - 2
    period = min(COMMON_MULTIPLE, last + 1)
    residues = (rng.integers(period) + np.arange(RESIDUES)) % period
    spread = [int(rng.choice(np.arange(residue, last + 1, period))) for residue in residues]
    return [min(int(rng.integers(10)), last), min(int(rng.integers(10, 100)), last), *spread]


def changed_after(measurements: Measurements, step: int, *, commands_from: int = 1) -> Measurements:
    """Return measurements with other numbers in every array after a step; commands_from : of u, steps from there on."""
    rng = np.random.default_rng(step)
    first = {"u": step + commands_from}
    return replace(
        measurements, **{name: _change_from(x, first.get(name, step + 1), rng) for name, x in arrays_of(measurements).items()}
    )


def _change_from(x: Array, start: int, rng: np.random.Generator) -> Array:
    out = x.copy()
    if x.dtype.kind == "f":
        scale = 3.0 * (np.std(hold_last(x.reshape(len(x), -1))) or 1.0)
        out[start:] += scale * rng.standard_normal(out[start:].shape)
    else:
        out[start:] = rng.integers(0, x.max() + 1, out[start:].shape)
    return out


Estimates = dict[str, Array]
"""What an observer estimates of each target, or the command of a controller."""


class Runs(NamedTuple):
    """How something is run that is checked.

    name  : id
    watch : is asked before each run whether to stop
    work  : gives the result of measurements and of what else is received; it can be sent to another process
    check : raises CheckError where a result is none of these measurements; the last argument says when it was given
    """

    name: str
    watch: Watch
    work: Callable[..., Estimates]
    check: Callable[[Estimates, Measurements, str], None]

    def run(self, measurements: Measurements, *others: Any, then: str = "") -> Estimates:
        """Return the result, which is checked. Raises CheckError."""
        with report_errors(self.name, self.watch):
            found = self.work(measurements, *others)
            self.check(found, measurements, then)
        return found

    def compare(self, got: Estimates, base: Estimates, what: str, steps: slice = slice(None), *, exact: bool = False) -> None:
        """Raise CheckError where two results differ in some steps by more than rounding."""
        for name, values in base.items():
            bound = 0.0 if exact else SAME * float(np.nanstd(values))
            if not np.allclose(got[name][steps], values[steps], rtol=0.0, atol=bound, equal_nan=True):
                raise CheckError(f"{self.name}: {what} ({name})")

    def check_twice(self, inputs: Sequence[Any], base: Estimates) -> None:
        """Check that equal arguments give an equal result."""
        what = "run twice on the same measurements it gives two results: it keeps something between runs, or draws random numbers"
        self.compare(self.run(*inputs), base, what, exact=True)

    def check_causal(self, inputs: Sequence[Any], base: Estimates, commands_from: int = 1) -> None:
        """Check that what is measured after a step, of commands so many steps after it, changes nothing up to the step."""
        measured, *rest = inputs
        for k in steps_to_check(measured.n_steps):
            what = f"looks ahead: measurements after step {k} change what it gives at that step or an earlier one"
            later = changed_after(measured, k, commands_from=commands_from)
            self.compare(self.run(later, *rest), base, what, slice(k + 1))

    def check_alone(self, inputs: Sequence[Any], base: Estimates) -> None:
        """Check that the result is the same in a process that is started for it and receives the arguments alone."""
        with (
            report_errors(self.name, self.watch, "cannot run in a fresh process"),
            ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool,
        ):
            there = pool.submit(self.work, *inputs).result()
        self.check(there, inputs[0], "")
        what = "in a fresh process, with measurements and prior alone, it gives another result: it uses more than it is given"
        self.compare(there, base, what)


STEPS = "cannot run frame by frame"


def run_steps(observer: StepObserver, measurements: Measurements, steps: Sequence[int] | None = None) -> Estimates:
    """Return `predict(0)` after every frame of measurements, target -> (n_steps, n_modes) [um]; steps : those to take.

    A lost command is held, as the mirror holds its position; NGS frames are given where they are due, NaN where they are lost.
    """
    measurements = replace(measurements, u=hold_last(measurements.u))
    out = {target: np.full_like(measurements.z, np.nan) for target in observer.targets}
    steps = range(measurements.n_steps) if steps is None else steps
    for k, frame in zip(steps, frames_of(measurements, steps=steps), strict=True):
        observer.update(frame.z, frame.ngs, frame.u, stars=frame.stars, each=frame.each)
        for target, values in out.items():
            values[k] = observer.predict(0, target)[0]
    return out


def run_loop(controller: StepController, measurements: Measurements) -> Array:
    """Return the commands (n_steps, n_modes) [um] in a loop with the mirror and these pseudo-open-loop measurements."""
    plant = TruePlant(np.eye(measurements.n_modes), controller.plant.mirror.delay)
    return drive(controller, measurements, plant, np.random.default_rng(0))[0]


def step_difference(observer: Observer, measurements: Measurements, prior: Prior, settings: Any) -> float:
    """Return the largest difference between steps and batch over the standard deviation of the estimate; inf where NaN differ."""
    batch = observer.estimate(measurements, prior, settings)
    got = run_steps(observer.design(prior, settings, measurements.sampling), measurements)
    worst = 0.0
    for target in observer.targets:
        a, b = got[target], batch[target]
        if not np.array_equal(np.isnan(a), np.isnan(b)):
            return float("inf")
        if not np.isnan(b).all():
            worst = max(worst, float(np.nanmax(np.abs(a - b))) / (float(np.nanstd(b)) or 1.0))
    return worst


def check_steps(runs: Runs, observer: Observer, measurements: Measurements, prior: Prior, settings: Any) -> None:
    """Check an observer that can run frame by frame.

    After every frame its estimate is that of its run over the record, without gaps and with. It goes on from a saved state as if
    there had been no break, and a reset takes it back to the start.

    Raises
    ------
    CheckError
        With the rule that it does not keep.
    """
    if observer.step is None:
        return
    broken, half = with_gap(measurements), measurements.n_steps // 2
    by_frame = partial(report_errors, runs.name, runs.watch, STEPS)
    with by_frame():
        differences = [step_difference(observer, seen, prior, settings) for seen in (measurements, broken)]
        if not max(differences) <= SAME:
            raise CheckError(f"{runs.name}: frame by frame its estimate is not that of its run over the record")
    with by_frame():
        ours, other = (observer.design(prior, settings, broken.sampling) for _ in range(2))
        base = run_steps(ours, broken)
    with by_frame():
        run_steps(other, broken, range(half))
        ours.reset()
        ours.load_state_dict(other.state_dict())
        got = run_steps(ours, broken, range(half, broken.n_steps))
        runs.compare(got, base, "from a saved state it goes on elsewhere", slice(half, None), exact=True)
    with by_frame():
        ours.reset()
        runs.compare(run_steps(ours, broken), base, "after a reset it is not what it was at the start", exact=True)


def check_observer(observer: Observer, scenario: Scenario | None = None, alone: bool = True, *, watch: Watch = QUIET) -> None:
    """Run an observer on a short simulated record and check the rules for all observers.

    It returns every target that it names, as numbers of the shape of the measurements; the same twice; unless it is marked as not
    causal, no later sample of any of its inputs changes an estimate; it does not change its arguments; it works with
    missing samples; where it can run frame by frame, its estimates are then the same; and in a fresh process, which has never had
    the truth, its estimates are the same.

    Parameters
    ----------
    observer : Observer
        The observer.
    scenario : Scenario, optional
        Settings of the simulation; by default 1.5 s of the preset paper.
    alone : bool
        Whether to start the fresh process; a script that does needs the guard `if __name__ == "__main__"`.
    watch : Watch
        Is asked before every run of the observer whether to stop.

    Raises
    ------
    CheckError
        The observer breaks a rule or raises an error; one line naming the observer and the rule.
    ValueError
        The scenario has no prior for the observer.
    Cancelled
        `watch` asks to stop.
    """
    s = scenario or PRESETS["paper"]().replace(QUICK)
    record = simulate(s)
    if missing := observer.missing(record):
        raise CheckError(f"{observer.id}: needs {', '.join(missing)}, which no record has")
    runs = Runs(observer.id, watch, partial(_estimate_targets, observer), partial(_check_estimates, observer))
    given = arguments(observer, record, s)
    base = runs.run(*given)
    if empty := [target for target in observer.targets if np.isnan(base[target]).all()]:
        raise CheckError(f"{observer.id}: {empty[0]} has no estimate in any step")
    again = arguments(observer, record, s)
    runs.check_twice(again, base)
    _check_untouched(observer, given[0], observer.measurements(record))
    if observer.causal:
        runs.check_causal(given, base)
    _check_recovery(runs, *given)
    check_steps(runs, observer, *given)
    if alone:
        runs.check_alone(again, base)


def _estimate_targets(observer: Observer, *inputs: Any) -> Estimates:
    """Return what an observer estimates of its targets, without what else it returns."""
    found = observer.estimate(*inputs)
    return {target: found[target] for target in observer.targets}


def _check_estimates(observer: Observer, estimates: Estimates, measurements: Measurements, _then: str) -> None:
    for target in observer.targets:
        if target not in TARGETS:
            raise CheckError(f"{observer.id}: target {target!r} is none of {', '.join(TARGETS)}")
        check_numbers(observer.id, target, estimates[target], measurements.y_lgs.shape)
        if np.isinf(estimates[target]).any():
            raise CheckError(f"{observer.id}: {target} is infinite; NaN stands for steps without an estimate")


def _check_untouched(observer: Observer, measurements: Measurements, fresh: Measurements) -> None:
    now = arrays_of(measurements)
    for name, was in arrays_of(fresh).items():
        if not np.array_equal(now[name], was, equal_nan=True):
            raise CheckError(f"{observer.id}: changes its measurements ({name})")


def _check_recovery(runs: Runs, measurements: Measurements, *others: Any) -> None:
    for target, values in runs.run(with_gap(measurements), *others).items():
        if np.isnan(values[measurements.n_steps // 2 + 1 :]).all():
            raise CheckError(f"{runs.name}: {target} does not recover after missing samples")


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
    runs = Runs(controller.id, watch, partial(_commands, controller), partial(_check_commands, controller.id))
    if found := given_away(record, controller, _stable_laws(controller, given, watch), *given):
        raise CheckError(f"{controller.id}: uses more than it is given: it reaches {', '.join(sorted(found))}")
    base = runs.run(*given)
    again = _inputs(controller, record, s)
    runs.check_twice(again, base)
    _check_unchanged(controller, given, _inputs(controller, record, s))
    runs.check_causal(given, base, commands_from=0)  # u[k] uses y[0..k] and u[0..k-1] alone
    _check_gaps(controller, runs, given)
    _check_commands_by_frame(controller, runs, given)
    if alone:
        runs.check_alone(again, base)


def _inputs(controller: Controller, record: Record, scenario: Scenario) -> ControllerInputs:
    settings = own_settings(controller, scenario)
    measured, prior = controller_arguments(controller, record, settings, prior_for(controller, scenario))
    return ControllerInputs(measured, prior, plant_of(scenario), settings)


def _laws(controller: Controller, measurements: Measurements, prior: Prior, plant: Plant, settings: Settings) -> tuple[Law, ...]:
    return controller.laws(prior, plant, settings, measurements.n_modes)


def _stable_laws(controller: Controller, inputs: ControllerInputs, watch: Watch) -> tuple[Law, ...]:
    with report_errors(controller.id, watch):
        laws = _laws(controller, *inputs)
        if not all(law.stable for law in laws):
            raise CheckError(f"{controller.id}: a pole of its closed loop is not within the unit circle")
    return laws


def _commands(controller: Controller, *inputs: Any) -> Estimates:
    return {"command": controller.commands(_laws(controller, *inputs), *inputs)[0]}


def _check_commands(name: str, outputs: Estimates, measurements: Measurements, then: str) -> None:
    check_numbers(name, "its command", u := outputs["command"], measurements.y_lgs.shape)
    if not np.isfinite(u).all():
        raise CheckError(f"{name}: a command is NaN or infinite{then}")


def _check_unchanged(controller: Controller, inputs: ControllerInputs, fresh: ControllerInputs) -> None:
    for name, now, was in zip(ControllerInputs._fields, inputs, fresh, strict=True):
        same = not isinstance(was, Settings) or _settings(now) == _settings(was)
        if not same or not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(_arrays(now), _arrays(was), strict=True)):
            raise CheckError(f"{controller.id}: changes its arguments ({name})")


def _arrays(root: Any) -> list[Array]:
    return [x for x in walk_references(root) if isinstance(x, np.ndarray) and x.dtype == float]


def _settings(own: Any) -> dict[str, Any]:
    return {name: group.to_dict() for name, group in vars(own).items()}


def _check_gaps(controller: Controller, runs: Runs, inputs: ControllerInputs) -> None:
    gap = with_gap(inputs.measurements)
    u = runs.run(*inputs._replace(measurements=gap), then=" after missing samples")["command"]
    if not controller.is_idle and not np.ptp(u[gap.n_steps // 2 + LOST :], axis=0).any():
        raise CheckError(f"{runs.name}: does not recover after missing samples")


def _check_commands_by_frame(controller: Controller, runs: Runs, inputs: ControllerInputs) -> None:
    """Check that frame by frame it commands what it commands over a record, unless it cannot run frame by frame."""
    if controller.predict is not None and controller.step_predict is None:
        return
    given = inputs._replace(measurements=with_gap(inputs.measurements))
    with report_errors(runs.name, runs.watch, STEPS):
        stepper = controller.design(given.prior, given.plant, given.settings, given.measurements.sampling)
        got = run_loop(stepper, given.measurements)
    runs.compare({"command": got}, runs.run(*given), "frame by frame it commands something else")
