"""The tables of the closed loop, plain HTML."""

from __future__ import annotations

from collections.abc import Sequence

from markupsafe import Markup

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.glossary import NEEDS, STREHL, TERMS
from wfsobs.app.loop_work import LoopResults
from wfsobs.app.numerals import NOTHING, number
from wfsobs.app.render import Row, macro, table
from wfsobs.app.style import swatch
from wfsobs.app.views.table import SMALLEST
from wfsobs.closed_loop.rows import LIMITED, NOT_APPLICABLE, label
from wfsobs.evaluation.rows import Row as Score
from wfsobs.evaluation.scores import BOUNDS

UNSTABLE = macro("tag", "above", "unstable")


def of_mode(results: LoopResults, display: Display) -> list[Score]:
    """Select the rows of the mode shown, least residual first, those without one last."""
    rows = [r for r in results.rows if r["mode"] == display.mode]
    return sorted(rows, key=lambda r: float("inf") if r["residual_rms_nm"] is None else r["residual_rms_nm"])


def loop_html(results: LoopResults, display: Display) -> str:
    """Residual and Strehl of every controller, and the bounds."""
    unit = display.unit_label
    columns = {
        "Controller": "",
        f"Residual [{unit}]": "rms after the warm-up",
        f"Theory [{unit}]": "from the true spectra, for an endless record",
        f"Strehl at {results.result.scenario.control.wavelength:g} µm": TERMS[STREHL],
        "Gain": "of the integrator",
        "At a limit [%]": "steps in which a limit of the mirror changed the command",
        "Needs": TERMS[NEEDS],
    }
    rows = of_mode(results, display)
    smallest = next((r["controller"] for r in rows if r["controller"] not in BOUNDS and r["residual_rms_nm"] is not None), None)
    scale = 1e-3 * per_micrometre(display.unit, results.result.scenario.telescope.diameter)
    body = [_row(r, display, scale, r["controller"] == smallest) for r in rows]
    notes = {r["note"]: label(r["controller"]) for r in reversed(rows) if r["note"] and not r["limited"]}
    failures = macro("texts", "failure", [f"{name}: {note}" for note, name in notes.items()])
    return f"{table('Controllers', columns, [('', body)])}{limits_note(rows)}{failures}"


def limits_note(rows: Sequence[Score]) -> str:
    """Why some of the rows have no theory and no margins; nothing where no limit of the mirror acts."""
    return f"<p>{NOT_APPLICABLE}: {LIMITED}</p>" if any(r["limited"] for r in rows) else ""


def linear_text(row: Score, value: str) -> str:
    """Write a result of the linear loop: not applicable where a limit of the mirror acts."""
    return Markup('<span title="{}">{}</span>').format(LIMITED, NOT_APPLICABLE) if row["limited"] else value


def _row(row: Score, display: Display, scale: float, smallest: bool) -> Row:
    def scaled(key: str) -> str:
        return NOTHING if row[key] is None else number(row[key] * scale)

    residual = UNSTABLE if row["stable"] is False else scaled("residual_rms_nm")
    cells = [
        (SMALLEST if smallest else "") + residual,
        linear_text(row, scaled("predicted_rms_nm")),
        NOTHING if row["strehl"] is None else f"{row['strehl']:.4f}",
        number(row["gain"]),
        NOTHING if row["limited"] is None else number(100.0 * row["limited"], 2),
        row["needs"],
    ]
    return _line(row, display, cells)


def margins_html(results: LoopResults, display: Display) -> str:
    """Margins of the loops that have a transfer function."""
    columns = {
        "Controller": "",
        "Gain margin [dB]": "factor that the loop gain can rise by before the loop is unstable",
        "Phase margin [°]": "phase lag that can be added before the loop is unstable",
        "Delay margin [ms]": "delay that can be added before the loop is unstable",
    }
    rows = [r for r in of_mode(results, display) if r["phase_margin_deg"] is not None]
    keys = ("gain_margin_db", "phase_margin_deg", "delay_margin_ms")
    return str(table("Margins", columns, [("", [_line(r, display, [number(r[key]) for key in keys]) for r in rows])]))


def _line(row: Score, display: Display, cells: list[str]) -> Row:
    name = row["controller"]
    return Row(swatch(name, display.dark) + label(name), cells, {"controller": name})
