"""What every controller leaves in closed loop."""

from __future__ import annotations

from itertools import groupby
from typing import Any

from wfsobs.app.render import NOTHING, number
from wfsobs.app.report.data import State
from wfsobs.closed_loop.rows import NOT_APPLICABLE, label
from wfsobs.evaluation.rows import Row


def loop_state_table(state: State, name: str) -> dict[str, Any]:
    """Collect what the table of a state shows: a group per mode, least residual first."""
    modes = list(dict.fromkeys(row["mode"] for row in state.loop))

    def order(row: Row) -> tuple[int, float]:
        residual = row["residual_rms_nm"]
        return modes.index(row["mode"]), float("inf") if residual is None else residual

    return {
        "name": name,
        "columns": (
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
            "Prior knowledge",
        ),
        "groups": [
            {"mode": mode, "title": mode[0].upper() + mode[1:], "rows": [_row(row) for row in rows]}
            for mode, rows in groupby(sorted(state.loop, key=order), key=lambda row: row["mode"])
        ],
    }


def _row(row: Row) -> dict[str, Any]:
    linear = ("predicted_rms_nm", "gain", "gain_margin_db", "phase_margin_deg", "delay_margin_ms")
    cells = [
        number(row["residual_rms_nm"]),
        number(row["residual_rms_mas"]),
        NOTHING if row["strehl"] is None else f"{row['strehl']:.4f}",
        *(NOT_APPLICABLE if row["limited"] and key != "gain" else number(row[key]) for key in linear),
        NOTHING if row["limited"] is None else number(100.0 * row["limited"], 2),
        row["needs"],
    ]
    return {
        "controller": row["controller"],
        "label": label(row["controller"]),
        "unstable": row["stable"] is False,
        "cells": cells,
    }
