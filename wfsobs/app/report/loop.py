"""What every controller leaves in closed loop, as plain tables."""

from __future__ import annotations

from html import escape
from itertools import groupby

from wfsobs.app.display import NOTHING, number
from wfsobs.app.report.data import Report, State
from wfsobs.app.report.text import state_name
from wfsobs.control.rows import LIMITED, NOT_APPLICABLE, label
from wfsobs.evaluation.rows import Row

INTRO = (
    "The same disturbance and noise under every controller, with the delay and the limits of the mirror that the settings under "
    "<code>control</code> say. Strehl counts the simulated modes alone; theory is by the true spectra, for an endless record. "
    "Multi-rate loops have no frequency response, and so no margins. " + f"{NOT_APPLICABLE}: {LIMITED}."
)


def loop_section(report: Report) -> str:
    """A table per state, that of the settings as they were unfolded."""
    names = [state_name(report, state, i) or "All modes" for i, state in enumerate(report.states)]
    tables = "".join(
        f"<details{' open' * (i == report.start)}><summary>{escape(name)}</summary>{_table(state, name)}</details>"
        for i, (name, state) in enumerate(zip(names, report.states, strict=True))
    )
    return f'<p class="text">{INTRO}</p>{tables}'


def _table(state: State, name: str) -> str:
    columns = (
        "Controller",
        "Residual [nm]",
        "Residual [mas]",
        f"Strehl at {state.scenario.control.wavelength:g} µm",
        "Theory [nm]",
        "Gain",
        "Gain margin [dB]",
        "Phase margin [°]",
        "Delay margin [ms]",
        "At a limit [%]",
        "Needs",
    )
    head = "".join(f"<th scope=col>{column}</th>" for column in columns)
    bodies = "".join(
        _body(mode, list(rows), len(columns))
        for mode, rows in groupby(sorted(state.loop, key=_order(state)), key=lambda row: row["mode"])
    )
    return (
        f'<div class="scroll" tabindex=0 role=region aria-label="Closed loop: {escape(name)}">'
        f'<table class="rms"><thead><tr>{head}</tr></thead>{bodies}</table></div>'
    )


def _order(state: State):
    """Modes as they come, least residual first."""
    modes = list(dict.fromkeys(row["mode"] for row in state.loop))
    return lambda row: (modes.index(row["mode"]), float("inf") if row["residual_rms_nm"] is None else row["residual_rms_nm"])


def _body(mode: str, rows: list[Row], columns: int) -> str:
    title = f'<tr><th colspan={columns} class="target" scope=rowgroup>{escape(mode[0].upper() + mode[1:])}</th></tr>'
    return f'<tbody data-mode="{escape(mode)}">{title}{"".join(map(_row, rows))}</tbody>'


def _row(row: Row) -> str:
    residual = '<span class="tag above">unstable</span>' if row["stable"] is False else number(row["residual_rms_nm"])
    strehl = NOTHING if row["strehl"] is None else f"{row['strehl']:.4f}"
    keys = ("predicted_rms_nm", "gain", "gain_margin_db", "phase_margin_deg", "delay_margin_ms")
    known = {key: NOT_APPLICABLE if row["limited"] and key != "gain" else number(row[key]) for key in keys}
    limited = NOTHING if row["limited"] is None else number(100.0 * row["limited"], 2)
    cells = [residual, number(row["residual_rms_mas"]), strehl, *known.values(), limited, escape(row["needs"])]
    values = "".join(f"<td>{cell}</td>" for cell in cells)
    return f'<tr data-controller="{row["controller"]}"><th scope=row>{escape(label(row["controller"]))}</th>{values}</tr>'
