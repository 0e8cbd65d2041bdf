"""The closed loop, the same disturbance and the same noise under every controller, and what comes of it, as plain rows too.

    phi_res[k] = phi_dist[k] + phi_corr[k]

A controller sees z and knows what it commanded; what the mirror does of it is `wfsobs.control.mirror`, or where the scenario has
errors of the plant, which no controller knows, `wfsobs.control.true_plant`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import degrees, log10, pi
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from wfsobs.closed_loop.design import Design, LawDesign, design
from wfsobs.control.base import Controller
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.supervisor import SupervisedController
from wfsobs.control.true_plant import drive
from wfsobs.dependence import Memo, digest, record_digest
from wfsobs.evaluation.evidence import means_differ
from wfsobs.evaluation.result import EQUAL, NOT_OBSERVERS, TRUE_SPECTRA, Row, knowledge_of
from wfsobs.evaluation.scores import BOUND_BOTH, BOUNDS, batch_means, rms_interval
from wfsobs.evaluation.verdict import Contender, Verdict
from wfsobs.notebook import PlotAccessor, import_extra
from wfsobs.pipeline import as_stated
from wfsobs.prior import TRUE, PriorSource, Spectra, words_for
from wfsobs.priors_from.controllers import controller_arguments, full_plant_of, own_settings, supervision_of
from wfsobs.progress import QUIET, Cancelled, Watch, detach_watch
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.scenario import used_settings
from wfsobs.settings.values import check_kind, error_line
from wfsobs.signal.spectrum import rms
from wfsobs.simulation.loop import simulate
from wfsobs.typing import Array
from wfsobs.units import micrometres_per

if TYPE_CHECKING:
    import pandas


LIMITED = "theory and margins are not applicable: a limit of the mirror acts, and the loop is no longer linear"
"""Why a row has neither."""

SUPERVISED = "no theory and no margins under supervision: an integrator may take over"
"""Why the others have none."""

LEARNT = "an integrator closes its loop until its first window is full, at {:.5g} s; residuals count from {:.5g} s: not ranked"
"""What the residual of a controller that learns is of."""

NOT_APPLICABLE = "n/a"

THEORY = ("predicted_rms_nm", "gain", "gain_margin_db", "phase_margin_deg", "delay_margin_ms", "disk_margin")
"""Keys of a row without a value for a bound, beside `limited` and `alarms`."""


@dataclass(frozen=True)
class Outcome:
    """What one controller left.

    residual      : (n_steps, n_modes) [um], or None where the loop is not stable or could not run
    u             : (n_steps, n_modes) commands that the mirror took [um], or None
    limited_share : share of the steps after the warm-up in which a limit changed a command, per mode
    note          : why there is no residual
    alarms        : (time [s], reason) of every time that the integrator took over; None without supervision
    own_from      : time from which its own laws close the loop, an integrator before [s]
    """

    controller: str
    stable: tuple[bool | None, ...]
    residual: Array | None = None
    u: Array | None = None
    limited_share: tuple[float, ...] = ()
    note: str = ""
    alarms: tuple[tuple[float, str], ...] | None = None
    own_from: float = 0.0


@dataclass(frozen=True)
class ClosedLoop:
    """All of a run in closed loop; outcomes in the order of the registry."""

    design: Design
    record: Record
    outcomes: tuple[Outcome, ...] = field(default=())
    plot: ClassVar[PlotAccessor] = PlotAccessor()

    def __repr__(self) -> str:
        return f"ClosedLoop({len(self.outcomes)} controllers, {self.record!r})"

    def to_dataframe(self) -> pandas.DataFrame:
        """Return `rows` as a pandas table. Raises ImportError without pandas."""
        return import_extra("pandas", "arrays").DataFrame(rows(self, self.scenario.run.seed))

    @property
    def scenario(self) -> Scenario:
        """The settings."""
        return self.design.scenario


def rows(result: ClosedLoop, seed: int | None, *, source: PriorSource = TRUE) -> list[Row]:
    """One plain dictionary per controller and mode, the bounds last: the keys of `wfsobs loop --json`.

    residual_rms_nm, residual_rms_mas, strehl : of the simulation after the warm-up, null where the loop is not stable or could
        not run (`note` says why); strehl is that of all modes together
    residual_rms_mas : of tip and tilt alone;  predicted_rms_nm : by theory;  gain : of an integrator, optimised or set
    gain_margin_db, phase_margin_deg, delay_margin_ms : null where a loop has no frequency response or no such limit
    disk_margin : `control.margins.disk_margin`
    limited : share of the steps in which a limit of the mirror changed the command. Where it is above 0 the loop is not the
        linear one that theory and margins are of: these are null, and `note` says why
    alarms : time [s] and reason of every time that the integrator took over, null without supervision; `note` has the first
    ranked : false where another controller closed the loop for a part of that time
    source : where the prior of the controllers comes from
    """
    plan, warm_up = result.design, result.design.start
    modes = result.scenario.modes
    mas = micrometres_per("mas", result.scenario.telescope.diameter)
    wavelength = result.scenario.control.wavelength

    def row(controller: str, needs: str, mode: int, stable: bool | None, left: Sequence[float] | None, **more: Any) -> Row:
        return {
            "controller": controller,
            "mode": modes[mode].name,
            "needs": needs,
            "stable": stable,
            "residual_rms_nm": None if left is None else left[mode] * 1e3,
            "residual_rms_mas": None if left is None or modes[mode].radial_order > 1 else left[mode] / mas,
            "strehl": None if left is None else strehl(left, wavelength),
            **dict.fromkeys((*THEORY, "limited", "alarms")),
            "ranked": True,
            "note": "",
            **more,
            "seed": seed,
        }

    out = []
    for outcome in result.outcomes:
        left = residual_rms(outcome, result.record, warm_up)
        for mode, designed in enumerate(plan.laws[outcome.controller]):
            limited = outcome.limited_share[mode] if outcome.limited_share else None
            if limited:
                designed = replace(designed, predicted_rms=None, margins=None)
            m = designed.margins
            out.append(
                row(
                    outcome.controller,
                    controller_needs(outcome.controller, result.scenario, source=source),
                    mode,
                    outcome.stable[mode],
                    left,
                    predicted_rms_nm=None if designed.predicted_rms is None else designed.predicted_rms * 1e3,
                    gain=designed.law.gain if designed.law else None,
                    gain_margin_db=20 * log10(m.gain) if m and m.gain else None,
                    phase_margin_deg=degrees(m.phase) if m and m.phase is not None else None,
                    delay_margin_ms=m.delay * 1e3 if m and m.delay is not None else None,
                    disk_margin=m.disk if m else None,
                    limited=limited,
                    alarms=outcome.alarms,
                    ranked=outcome.own_from <= warm_up,
                    note=outcome.note
                    or took_over(outcome.alarms or ())
                    or (LIMITED if limited else "")
                    or (LEARNT.format(outcome.own_from, warm_up) if outcome.own_from > warm_up else ""),
                )
            )
    (spectra,) = words_for((Spectra,), source=source)
    for bound, left in plan.bounds.items():
        out += [row(bound, spectra, mode, True, left) for mode in range(len(modes))]
    return out


def loop_verdict(result: ClosedLoop, mode: str, *, source: PriorSource = TRUE) -> Verdict | None:
    """Return the verdict on the controllers by their residuals in one mode, with the limit; None where none ran.

    The intervals and which residuals do not differ significantly from the least are by the scatter within the record. One
    whose own laws close the loop for a part of that time alone is left out.

    source : where the prior of the controllers comes from
    """
    column = [m.name for m in result.scenario.modes].index(mode)
    first = round(result.design.start / result.record.dt)
    left = {
        o.controller: o.residual[first:, column]
        for o in result.outcomes
        if o.residual is not None and o.controller != "none" and o.own_from <= result.design.start
    }
    if not left:
        return None
    squares = batch_means(np.column_stack([*left.values()]) ** 2)
    errors = np.array([rms(of) for of in left.values()])
    best = int(np.argmin(errors))
    worse = means_differ(squares, in_order=True)[best]
    bounds = result.design.bounds
    limit = (bounds[BOUND_BOTH][column], BOUND_BOTH) if BOUND_BOTH in bounds else None
    places = [
        Contender(
            name,
            float(errors[i]),
            rms_interval(float(errors[i]), squares[:, i : i + 1]),
            not (worse[i] or errors[i] > (1.0 + EQUAL) * errors[best]),
            TRUE_SPECTRA if "spectra" in controller_needs(name, result.scenario) else knowledge_of(CONTROLLERS[name].prior),
            0,
            limit,
            label(name),
        )
        for i, name in enumerate(left)
    ]
    return Verdict("residual", mode, tuple(sorted(places, key=lambda place: place.rms)), 0, (), source=source)


def controller_needs(controller: str, scenario: Scenario, *, source: PriorSource = TRUE) -> str:
    """Return what a controller needs beside measurements, for people; source : where its prior comes from."""
    return CONTROLLERS[controller].needs_text(own_settings(CONTROLLERS[controller], scenario), source=source)


def label(controller: str) -> str:
    """Return a controller's label."""
    return NOT_OBSERVERS[controller] if controller in BOUNDS else CONTROLLERS[controller].label


def linear(same: Sequence[Row], value: str) -> str:
    """Return the text of a number of the linear loop: not applicable where a limit of the mirror acts in any of the rows."""
    return NOT_APPLICABLE if any(r["limited"] for r in same) else value


def took_over(alarms: Sequence[tuple[float, str]]) -> str:
    """Say when the integrator took over, (time [s], reason) of each time; empty for none."""
    if not alarms:
        return ""
    (time, reason), *more = alarms
    return f"Integrator took over at {time:.2f} s: {reason}" + (f"; {len(more)} times more" if more else "")


def no_theory(rows: Sequence[Row]) -> str:
    """Say why some of the rows have no theory and no margins; empty where all have what their laws have."""
    said = {
        f"{NOT_APPLICABLE}: {LIMITED}": any(r["limited"] for r in rows),
        SUPERVISED: any(r["alarms"] is not None for r in rows),
    }
    return "; ".join(text for text, applies in said.items() if applies)


def residual_rms(outcome: Outcome, record: Record, warm_up: float) -> list[float] | None:
    """Return the rms [um] of the residual after the warm-up [s], one per mode; None without a residual."""
    if outcome.residual is None:
        return None
    return [rms(column) for column in outcome.residual[round(warm_up / record.dt) :].T]


def strehl(rms_per_mode: Sequence[float], wavelength: float) -> float:
    """Return the Strehl ratio exp(-(2 pi sigma / lambda)^2), the extended Marechal approximation (Mahajan 1983).

    sigma^2 is the variance of the simulated modes together: no other error counts. rms and wavelength [um].

    >>> round(strehl([0.1, 0.1], 2.2), 4)
    0.8495
    """
    return float(np.exp(-((2.0 * pi / wavelength) ** 2) * np.sum(np.square(rms_per_mode))))


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
    check_kind("close_loop", scenario, Scenario)
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
                # the same for every controller, none of the random numbers of the record
                rng = np.random.default_rng(plan.scenario.run.seed).spawn(3)[2]
                u, correction = drive(acting, measured, true, rng, alone)
                if isinstance(acting, SupervisedController):
                    alarms = tuple((frame * record.dt, reason) for frame, reason in acting.alarms)
    except (Cancelled, MemoryError):
        raise
    except (Exception, SystemExit) as error:  # by a controller of another package, perhaps: the others keep their outcomes
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
