"""The closed loop as rows for machines and as a table for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import degrees, log10
from statistics import median
from typing import Any

from rich.table import Table

from wfsobs.cli.tables import NOT_OBSERVERS, Row
from wfsobs.control.closed_loop import ClosedLoop, residual_rms, strehl
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.scores import BOUND
from wfsobs.observers.base import SPECTRA
from wfsobs.units import micrometres_per

LIMITED = "theory and margins are not applicable: a limit of the mirror acts, and the loop is no longer linear"
"""Why a row has neither."""

NOT_APPLICABLE = "n/a"


def rows(result: ClosedLoop, seed: int | None) -> list[Row]:
    """One plain dictionary per controller and mode, the bound last: the keys of `wfsobs loop --json`.

    residual_rms_nm, residual_rms_mas, strehl : of the simulation after the warm-up, null where the loop is not stable or could
        not run (`note` says why); strehl is that of all modes together
    residual_rms_mas : of tip and tilt alone;  predicted_rms_nm : by theory;  gain : of an integrator, optimised or set
    gain_margin_db, phase_margin_deg, delay_margin_ms : null where a loop has no frequency response or no such limit
    limited : share of the steps in which a limit of the mirror changed the command. Where it is above 0 the loop is not the
        linear one that theory and margins are of: these are null, and `note` says why
    """
    plan, warm_up = result.design, result.scenario.run.warm_up
    modes = result.scenario.modes
    mas = micrometres_per("mas", result.scenario.telescope.diameter)
    wavelength = result.scenario.control.wavelength

    def row(controller: str, needs: str, mode: int, stable: bool | None, left: Sequence[float] | None, **more: Any) -> Row:
        known = {name: more.get(name) for name in (
            "predicted_rms_nm", "gain", "gain_margin_db", "phase_margin_deg", "delay_margin_ms", "limited")}
        return {
            "controller": controller, "mode": modes[mode].name, "needs": needs, "stable": stable,
            "residual_rms_nm": None if left is None else left[mode] * 1e3,
            "residual_rms_mas": None if left is None or modes[mode].radial_order > 1 else left[mode] / mas,
            "strehl": None if left is None else strehl(left, wavelength),
            **known, "note": more.get("note", ""), "seed": seed,
        }

    out = []
    for outcome in result.outcomes:
        left = residual_rms(outcome, result.record, warm_up)
        for mode, designed in enumerate(plan.laws[outcome.controller]):
            limited = outcome.limited[mode] if outcome.limited else None
            if limited:
                designed = replace(designed, predicted=None, margins=None)
            m = designed.margins
            out.append(row(
                outcome.controller, CONTROLLERS[outcome.controller].needed(result.scenario), mode, outcome.stable[mode], left,
                predicted_rms_nm=None if designed.predicted is None else designed.predicted * 1e3,
                gain=designed.law.gain if designed.law else None,
                gain_margin_db=20 * log10(m.gain) if m and m.gain else None,
                phase_margin_deg=degrees(m.phase) if m and m.phase is not None else None,
                delay_margin_ms=m.delay * 1e3 if m and m.delay is not None else None,
                limited=limited, note=outcome.note or (LIMITED if limited else ""),
            ))
    if plan.bound is not None:
        out += [row(BOUND, SPECTRA, mode, True, plan.bound) for mode in range(len(modes))]
    return out


def label(controller: str) -> str:
    """A controller's name for people."""
    return NOT_OBSERVERS[BOUND] if controller == BOUND else CONTROLLERS[controller].label


def table(rows: Sequence[Row]) -> Table:
    """The residual table, best controller first; over several seeds the medians, with the spread (smallest to largest)."""
    several = len({r["seed"] for r in rows}) > 1
    out = Table(title="Residual in closed loop after warm-up" + (", median over seeds" if several else ""))
    for name in ("Mode", "Controller", "Needs"):
        out.add_column(name, no_wrap=True)
    spread = ("spread, nm",) if several else ()
    for name in ("rms, nm", *spread, "mas", "Strehl", "theory, nm", "gain", "margins", "delay, ms", "at limit, %"):
        out.add_column(name, justify="right", no_wrap=True)
    last = None
    for mode, controller in sorted({(r["mode"], r["controller"]) for r in rows}, key=_order(rows)):
        same = [r for r in rows if (r["mode"], r["controller"]) == (mode, controller)]
        if last not in (None, mode):
            out.add_section()
        last = mode
        stable = all(r["stable"] for r in same)
        left = [r["residual_rms_nm"] for r in same if r["residual_rms_nm"] is not None]
        shown = _number(same, "residual_rms_nm", 2) if left else "unstable" if not stable else "-"
        if all(r["stable"] is None for r in same):
            shown = "none"
        out.add_row(
            mode, label(controller), same[0]["needs"], shown,
            *((f"{min(left):.2f} - {max(left):.2f}" if left else "-",) if several else ()),
            _number(same, "residual_rms_mas", 3), _number(same, "strehl", 4), linear(same, _number(same, "predicted_rms_nm", 2)),
            _number(same, "gain", 3), linear(same, _margins(same[0])), linear(same, _number(same, "delay_margin_ms", 2)),
            _share(same),
        )
    if any(r["limited"] for r in rows):
        out.caption = f"{NOT_APPLICABLE}: {LIMITED}"
    return out


def linear(same: Sequence[Row], value: str) -> str:
    """What is shown of the linear loop: not applicable where a limit of the mirror acts in any of the rows."""
    return NOT_APPLICABLE if any(r["limited"] for r in same) else value


def _share(same: Sequence[Row]) -> str:
    """Share of the limited steps in per cent, the median over seeds."""
    shares = [100.0 * r["limited"] for r in same if r["limited"] is not None]
    return f"{median(shares):.2f}" if shares else "-"


def _margins(row: Row) -> str:
    gain, phase = row["gain_margin_db"], row["phase_margin_deg"]
    return "-" if phase is None else f"{'-' if gain is None else f'{gain:.1f}'} dB, {phase:.0f}°"


def _number(same: Sequence[Row], key: str, digits: int) -> str:
    values = [r[key] for r in same if r[key] is not None]
    return f"{median(values):.{digits}f}" if values else "-"


def _order(rows: Sequence[Row]):
    """Modes as they come, least residual first, what has none last."""
    modes = list(dict.fromkeys(r["mode"] for r in rows))

    def key(group: tuple[str, str]) -> tuple:
        left = [r["residual_rms_nm"] for r in rows if (r["mode"], r["controller"]) == group]
        return modes.index(group[0]), median(float("inf") if x is None else x for x in left)

    return key
