"""What comes of a closed loop, as plain rows too, and what is said of a row in every table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import degrees, log10, pi
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from wfsobs.closed_loop.design import Design
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.evidence import means_differ
from wfsobs.evaluation.result import NOT_OBSERVERS, TRUE_SPECTRA, Row, knowledge_of
from wfsobs.evaluation.scores import BOUND_BOTH, BOUNDS, batch_means, rms_interval
from wfsobs.evaluation.verdict import Contender, Verdict
from wfsobs.notebook import PlotAccessor, import_extra
from wfsobs.prior import TRUE, PriorSource, Spectra, words_for
from wfsobs.priors_from.scenario import own_settings
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.signal.spectrum import rms
from wfsobs.typing import Array
from wfsobs.units import micrometres_per

if TYPE_CHECKING:
    import pandas

LIMITED = "theory and margins are not applicable: a limit of the mirror acts, and the loop is no longer linear"
"""Why a row has neither."""

SUPERVISED = "no theory and no margins under supervision: an integrator may take over"
"""Why the others have none."""

LEARNT = "an integrator closes its loop until its first window is full, at {:.2f} s; residuals count from {:.2f} s: not ranked"
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


def loop_verdict(result: ClosedLoop, mode: str) -> Verdict | None:
    """Return the verdict on the controllers by their residuals in one mode, with the limit; None where none ran.

    The intervals and which residuals do not differ significantly from the least are by the scatter within the record. One
    whose own laws close the loop for a part of that time alone is left out.
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
            not worse[i],
            TRUE_SPECTRA if "spectra" in controller_needs(name, result.scenario) else knowledge_of(CONTROLLERS[name].prior),
            0,
            limit,
            label(name),
        )
        for i, name in enumerate(left)
    ]
    return Verdict("residual", mode, tuple(sorted(places, key=lambda place: place.rms)), 0, ())


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
