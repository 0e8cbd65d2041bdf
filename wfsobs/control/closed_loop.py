"""The closed loop: the same disturbance and the same noise under every controller.

    phi_res[k] = phi_dist[k] + phi_corr[k]

A controller sees z and knows what it commanded; what the mirror does of it is `mirror`. An integrator with a prediction of the
vibration must not correct the vibration twice. Its measurement is therefore freed of what is left of it,

    y_int[k] = y[k] - (f[k] - vib_hat[k-1]),

f the causal Butterworth bank on z, which at step k estimates phi_vib[k-1], and vib_hat[k-1] what was commanded against it. In
pseudo-open-loop terms the integrator works on z - f, and u[k] = u_int[k] - vib_hat[k+1].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from math import pi

import numpy as np

from wfsobs.control.controllers import CONTROLLERS, Controller
from wfsobs.control.integrator import limited_integrator
from wfsobs.control.law import Law
from wfsobs.control.margins import Margins, frequencies, margins
from wfsobs.control.mirror import Mirror, mirror_of
from wfsobs.control.residual import residual_variance
from wfsobs.evaluation.bound import least_errors
from wfsobs.observers.baselines import online_reference
from wfsobs.observers.kalman.multirate import UnstableCycle
from wfsobs.observers.missing import bridged
from wfsobs.pipeline import as_stated
from wfsobs.prior import Model
from wfsobs.priors_from.scenario import bands_of, prior_of
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError
from wfsobs.signal.welch import rms
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.true_spectra import TrueSpectra, is_known, true_spectra
from wfsobs.typing import Array


@dataclass(frozen=True)
class Designed:
    """A law in one mode and what theory says of it.

    law       : None for control by nothing, and where there is none
    stable    : None where there is no law
    predicted : rms [um] of the residual by the true spectra; None where the law has no frequency response or is not stable
    margins   : the same
    note      : why there is no law
    """

    law: Law | None
    stable: bool | None
    predicted: float | None = None
    margins: Margins | None = None
    note: str = ""


@dataclass(frozen=True)
class Design:
    """All controllers of a scenario, before any random number.

    laws  : controller -> one per mode
    bound : per mode, rms [um] of the least residual of any causal controller of the mean of the LGS; None where the spectrum of
        the turbulence is not known
    """

    scenario: Scenario
    mirror: Mirror
    laws: dict[str, tuple[Designed, ...]]
    bound: tuple[float, ...] | None


@dataclass(frozen=True)
class Outcome:
    """What one controller left.

    residual : (n_steps, n_modes) [um], or None where the loop is not stable or could not run
    u        : (n_steps, n_modes) commands that the mirror took [um], or None
    limited  : share of the steps after the warm-up in which a limit changed a command, per mode
    note     : why there is no residual
    """

    controller: str
    stable: tuple[bool | None, ...]
    residual: Array | None = None
    u: Array | None = None
    limited: tuple[float, ...] = ()
    note: str = ""


@dataclass(frozen=True)
class ClosedLoop:
    """All of a run in closed loop; outcomes in the order of the registry."""

    design: Design
    record: Record
    outcomes: tuple[Outcome, ...] = field(default=())

    @property
    def scenario(self) -> Scenario:
        """The settings."""
        return self.design.scenario


def design(scenario: Scenario, controllers: Sequence[str] | None = None) -> Design:
    """Make the laws of the controllers (all unless named) and judge them by theory. Raises SettingError.

    Laws are those of the scenario before its events. What they will leave is then not known by theory, nor a bound.
    """
    scenario.validate()
    before, mirror = scenario.before_events, mirror_of(scenario)
    modes = range(len(scenario.modes))
    known = is_known(before)
    spectra = [true_spectra(before, mode) if known else None for mode in modes]
    laws = {c.id: tuple(_designed(c, before, mode, mirror, spectra[mode]) for mode in modes) for c in chosen(controllers)}
    if scenario.events:
        laws = {name: tuple(replace(one, predicted=None) for one in designed) for name, designed in laws.items()}
        return Design(scenario, mirror, laws, None)
    # A fraction of a frame comes on top of the whole ones, which alone bound what can be known.
    least = tuple(least_errors(one, ahead=int(mirror.delay) - 1)["total"].rms for one in spectra if one)
    return Design(scenario, mirror, laws, least if known else None)


def chosen(controllers: Sequence[str] | None) -> list[Controller]:
    """The controllers of these ids, in the order of the registry; all for None. Raises SettingError."""
    unknown = set(controllers or ()) - set(CONTROLLERS)
    if unknown:
        raise SettingError(f"controller {sorted(unknown)[0]!r}: no such controller; there are {', '.join(CONTROLLERS)}")
    return [c for c in CONTROLLERS.values() if controllers is None or c.id in controllers]


def _designed(controller: Controller, scenario: Scenario, mode: int, mirror: Mirror, spectra: TrueSpectra | None) -> Designed:
    if controller.law is None:
        return Designed(None, True)
    try:
        law = controller.law(scenario, mode, mirror, spectra)
    except UnstableCycle as error:
        return Designed(None, False, note=str(error))
    except ValueError as error:
        return Designed(None, None, note=str(error))
    stable = law.stable
    if not stable or controller.predict is not None or not law.time_invariant:
        return Designed(law, stable)
    predicted = None if spectra is None else float(np.sqrt(residual_variance(law, spectra, mirror)))
    return Designed(
        law,
        stable,
        predicted,
        margins(lambda omega: mirror.response(omega) * law.response(omega), frequencies(law.poles), scenario.dt),
    )


def close_loop(scenario: Scenario, *, controllers: Sequence[str] | None = None, watch: Watch = QUIET) -> ClosedLoop:
    """Simulate a disturbance and close the loop on it with every controller (all unless named).

    Raises SettingError where settings do not go together or a controller is unknown, Cancelled.
    """
    plan = design(scenario, controllers)
    return closed_loop(simulate(scenario, watch=Watch(cancelled=watch.cancelled)), plan, watch)


def closed_loop(record: Record, plan: Design, watch: Watch = QUIET) -> ClosedLoop:
    """Run every controller of a design on the disturbance and noise of a record.

    Raises RecordError if the record has no truth, Cancelled.
    """
    total = sum(CONTROLLERS[name].weight for name in plan.laws)
    outcomes, done, given = [], 0.0, bridged(record, prior_of(plan.scenario, record, (Model,)))
    for name, weight in ((name, CONTROLLERS[name].weight) for name in plan.laws):
        inner = Watch(lambda f, at=done, w=weight: watch.progress((at + f * w) / total), watch.cancelled)
        outcomes += each_outcome(given, plan, inner, [name])
        done += weight
    return ClosedLoop(plan, record, tuple(outcomes))


def each_outcome(
    record: Record, plan: Design, watch: Watch = QUIET, controllers: Sequence[str] | None = None
) -> Iterator[Outcome]:
    """Run the controllers of a design (all unless named) and yield each one's outcome as soon as it is done.

    Where measurements are missing they work on what takes their place (`gaps`).
    """
    disturbance = truth(record)
    record = bridged(record, prior_of(plan.scenario, record, (Model,)))
    if as_stated(record, plan.scenario) is not plan.scenario:
        raise RecordError("the record was made with another rate or exposure ratio than the controllers")
    for name, designed in plan.laws.items():
        if controllers is None or name in controllers:
            watch.check()
            yield _outcome(CONTROLLERS[name], designed, record, disturbance, plan, watch)


def truth(record: Record) -> Array:
    """phi_dist (n_steps, n_modes) [um] of a record. Raises RecordError."""
    if record.turbulence is None or record.vibration is None:
        raise RecordError("the record has no truth: what another controller would have left of it is not known")
    return record.turbulence + record.vibration


def _outcome(
    controller: Controller, designed: Sequence[Designed], record: Record, disturbance: Array, plan: Design, watch: Watch
) -> Outcome:
    stable = tuple(d.stable for d in designed)
    notes = [d.note for d in designed if d.note]
    if controller.ngs and record.y_ngs is None:
        notes = ["the record has no NGS measurement"]
    if notes or not all(stable):
        note = notes[0] if notes else "a pole of the closed loop is not within the unit circle"
        return Outcome(controller.id, stable, note=note)
    try:
        u, limited = _commands(controller, designed, record, plan, watch)
    except ValueError as error:
        return Outcome(controller.id, tuple(None for _ in stable), note=str(error))
    start = round(plan.scenario.run.warm_up / record.dt)
    residual = disturbance + plan.mirror.correction(u)
    return Outcome(controller.id, stable, residual, u, tuple(limited[start:].mean(axis=0).tolist()))


def _commands(
    controller: Controller, designed: Sequence[Designed], record: Record, plan: Design, watch: Watch
) -> tuple[Array, Array]:
    """(commands that the mirror takes, whether a limit changed them), both (n_steps, n_modes)."""
    mirror, z = plan.mirror, record.z
    forward = np.zeros_like(z)
    if controller.law is None:
        return forward, forward > 0.0
    if controller.predict is not None:
        ahead = controller.predict(record, plan.scenario, mirror, watch)
        known = ~np.isnan(ahead)
        forward = -np.where(known, ahead, 0.0)
        z = z - np.where(known, online_reference(bands_of(plan.scenario), z, record.dt), 0.0)
    inputs = np.stack([z, np.nan_to_num(record.z_ngs)], axis=1) if controller.ngs else z[:, None]
    u, limited = np.empty_like(z), np.zeros(z.shape, dtype=bool)
    for mode, one in enumerate(designed):
        assert one.law is not None
        wanted = one.law.run(inputs[:, :, mode]) + forward[:, mode]
        u[:, mode] = wanted
        if mirror.within(wanted):
            continue
        if one.law.gain is None:
            u[:, mode] = mirror.follow(wanted)
        else:
            u[:, mode], wanted = limited_integrator(
                mirror, one.law.gain, plan.scenario.control.leak, z[:, mode], forward[:, mode]
            )
        limited[:, mode] = u[:, mode] != wanted
    return u, limited


def residual_rms(outcome: Outcome, record: Record, warm_up: float) -> list[float] | None:
    """rms [um] of the residual after the warm-up [s], one per mode; None without a residual."""
    if outcome.residual is None:
        return None
    return [rms(column) for column in outcome.residual[round(warm_up / record.dt) :].T]


def strehl(rms_per_mode: Sequence[float], wavelength: float) -> float:
    """exp(-(2 pi sigma / lambda)^2), the extended Marechal approximation (Mahajan 1983), sigma^2 the variance of the
    simulated modes together: no other error counts. rms and wavelength [um].

    >>> round(strehl([0.1, 0.1], 2.2), 4)
    0.8495
    """
    return float(np.exp(-((2.0 * pi / wavelength) ** 2) * np.sum(np.square(rms_per_mode))))
