"""The closed loop: the same disturbance and the same noise under every controller.

    phi_res[k] = phi_dist[k] + phi_corr[k]

A controller sees z and knows what it commanded; what the mirror does of it is `wfsobs.control.mirror`, or where the scenario has
errors of the plant, which no controller knows, `wfsobs.control.true_plant`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from wfsobs.closed_loop.design import Design, LawDesign, design
from wfsobs.closed_loop.rows import ClosedLoop, Outcome
from wfsobs.control.base import Controller
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.supervisor import SupervisedController
from wfsobs.control.true_plant import drive
from wfsobs.dependence import Memo, digest, record_digest
from wfsobs.pipeline import as_stated
from wfsobs.priors_from.scenario import controller_arguments, full_plant_of, own_settings, supervision_of
from wfsobs.progress import QUIET, Watch, detach_watch
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.scenario import used_settings
from wfsobs.settings.values import error_line
from wfsobs.simulation.loop import simulate
from wfsobs.typing import Array


def close_loop(scenario: Scenario, *, controllers: Sequence[str] | None = None, watch: Watch = QUIET) -> ClosedLoop:
    """Simulate a disturbance and close the loop on it with every controller.

    Parameters
    ----------
    scenario : Scenario
        Settings of the run.
    controllers : sequence of str, optional
        Ids of the controllers; by default all.
    watch : Watch, optional
        Receives the progress, and is asked at every block of work whether to stop.

    Returns
    -------
    ClosedLoop
        Design, record and outcomes, in the order of the registry.

    Raises
    ------
    SettingError
        Two settings exclude each other, or a controller is unknown.
    Cancelled
        `watch` asks to stop.

    See Also
    --------
    wfsobs.run : Run observers, which do not act on the loop.
    """
    plan = design(scenario, controllers)
    return closed_loop(simulate(scenario, watch=watch.silent), plan, watch)


def closed_loop(record: Record, plan: Design, watch: Watch = QUIET) -> ClosedLoop:
    """Run every controller of a design on the disturbance and noise of a record.

    Raises RecordError if the record has no truth, or another rate, exposure ratio or number of modes, Cancelled.
    """
    total = sum(CONTROLLERS[name].weight for name in plan.laws)
    outcomes, done = [], 0.0
    for name in plan.laws:
        weight = CONTROLLERS[name].weight
        outcomes += each_outcome(record, plan, watch.part(done / total, weight / total), [name])
        done += weight
    return ClosedLoop(plan, record, tuple(outcomes))


def each_outcome(
    record: Record, plan: Design, watch: Watch = QUIET, controllers: Sequence[str] | None = None, *, memo: Memo | None = None
) -> Iterator[Outcome]:
    """Run the controllers of a design (all unless named) and yield each one's outcome as soon as it is done.

    Each receives measurements, its prior and its settings: neither record nor scenario. One whose outcome is known in the memo
    by what it depends on does not run.
    """
    disturbance = truth(record)
    if as_stated(record, plan.scenario) is not plan.scenario:
        raise RecordError("the record was made with another rate or exposure ratio than the controllers")
    if record.n_modes != len(plan.scenario.modes):
        modes = f"{record.n_modes} mode" + "s" * (record.n_modes > 1)
        raise RecordError(f"the record has {modes}, the controllers are for {len(plan.scenario.modes)}")
    for name, designed in plan.laws.items():
        if controllers is None or name in controllers:
            watch.check()
            run = partial(_outcome, CONTROLLERS[name], designed, record, disturbance, plan, watch)
            known_by = _name(CONTROLLERS[name], designed, record, plan) if memo is not None else ""
            yield memo.keep(known_by, run) if memo is not None and known_by else run()


def truth(record: Record) -> Array:
    """phi_dist (n_steps, n_modes) [um] of a record. Raises RecordError."""
    if record.turbulence is None or record.vibration is None:
        raise RecordError("the record has no truth, from which the residual of another controller is computed")
    return record.turbulence + record.vibration


def _name(controller: Controller, designs: Sequence[LawDesign], record: Record, plan: Design) -> str:
    """Return the name of an outcome: what it depends on; empty where a law or a prior has no value to compare."""
    used, settings = used_settings(plan.scenario), own_settings(controller, plan.scenario)
    own = controller.counts(settings) if controller.counts else None
    if own is None and not controller.is_linear:
        own = [used.get(name) for name in controller.groups]
    laws = [(d.law, d.stable, d.note) for d in designs]
    try:
        _, prior = controller_arguments(controller, record, settings, plan.priors[controller.id])
        acting = () if plan.true is None else (plan.true, plan.scenario.run.seed)
        which = supervision_of(controller, plan.scenario)
        return digest("outcome", controller.id, laws, own, record_digest(record), prior, plan.plant, plan.start, which, *acting)
    except (TypeError, ValueError):
        return ""


def _outcome(
    controller: Controller, designs: Sequence[LawDesign], record: Record, disturbance: Array, plan: Design, watch: Watch
) -> Outcome:
    stable = tuple(d.stable for d in designs)
    notes = [d.note for d in designs if d.note]
    if notes or not all(stable):
        note = notes[0] if notes else "a pole of the closed loop is not within the unit circle"
        return Outcome(controller.id, stable, note=note)
    laws, settings = [d.law for d in designs if d.law is not None], own_settings(controller, plan.scenario)
    try:
        measured, prior = controller_arguments(controller, record, settings, plan.priors[controller.id])
        sampling = measured.sampling if controller.ngs else measured.sampling._replace(ratio=None)
        learns = controller.learns(settings, sampling) if controller.learns else 0
        if record.n_steps <= learns:
            raise RecordError(f"the record has {record.n_steps} steps, its first window is full after {learns}")
        with detach_watch(watch) as alone:
            supervision, alarms = supervision_of(controller, plan.scenario), None
            if plan.true is None and supervision is None:
                u, _ = controller.commands(laws, measured, prior, plan.plant, settings, alone)
                correction = plan.mirror.correction(u)
            else:
                stepper = controller.assemble(laws, prior, plan.plant, settings, measured.sampling)
                acting = stepper if supervision is None else SupervisedController(stepper, supervision)
                true = plan.true or full_plant_of(plan.scenario)
                u, correction = drive(acting, measured, true, _plant_generator(plan.scenario), alone)
                if isinstance(acting, SupervisedController):
                    alarms = tuple((frame * record.dt, reason) for frame, reason in acting.alarms)
    except ValueError as error:
        return Outcome(controller.id, tuple(None for _ in stable), note=error_line(error))
    if not np.isfinite(correction).all():
        frame = int(np.argmin(np.isfinite(correction).all(axis=1)))
        return Outcome(controller.id, tuple(False for _ in stable), note=f"the loop diverges: frame {frame}")
    start = round(plan.start / record.dt)
    limited = plan.mirror.at_limit(u)
    residual = disturbance + correction
    return Outcome(
        controller.id,
        stable,
        residual,
        u,
        tuple(limited[start:].mean(axis=0).tolist()),
        alarms=alarms,
        own_from=learns * record.dt,
    )


def _plant_generator(scenario: Scenario) -> np.random.Generator:
    """Return the generator of the plant's random numbers: the same for every controller, none of those of the record."""
    return np.random.default_rng(scenario.run.seed).spawn(3)[2]
