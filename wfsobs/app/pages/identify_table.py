"""The numbers of an identification, plain HTML."""

from __future__ import annotations

from wfsobs.app.display import Display, per_micrometre
from wfsobs.app.render import Row, macro, table
from wfsobs.identification import Identification
from wfsobs.identification.process import Number
from wfsobs.identification.report import format_number, mode_rows, whiteness_lines
from wfsobs.identification.result import IdentifiedMode

WHITE, COLOURED = macro("tag", "best", "white"), macro("tag", "above", "not white")


def identification_html(mode: IdentifiedMode, display: Display, diameter: float) -> str:
    """Noise, turbulence and peaks of a mode, each number with its standard deviation."""
    scale = per_micrometre(display.unit, diameter)
    columns = {
        "What": "by frequency",
        "Frequency [Hz]": "natural frequency; of turbulence the corner",
        "Damping": "0 for a line",
        f"Rms [{display.unit_label}]": "standard deviation of it in z; of a peak within this record",
    }
    body = []
    for what, frequency, damping, rms in mode_rows(mode):
        scaled = None if rms is None else Number(rms.value * scale, rms.std * scale)
        body.append(Row(what, ["" if n is None else deviation_text(n) for n in (frequency, damping, scaled)]))
    return str(table(f"Identified in {mode.name}", columns, [("", body)]))


def deviation_text(number: Number) -> str:
    """Write a number and its standard deviation, where there is one.

    >>> deviation_text(Number(47.43812, 0.0264)), deviation_text(Number(1.9, float("nan")))
    ('47.438 ± 0.026', '1.9')
    """
    return format_number(number).replace("+-", "±").replace("-", "−").removesuffix(" ± −")


def verdict_html(result: Identification) -> str:
    """Whether anything is left, mode by mode."""
    lines = [
        (WHITE if mode.whiteness.white else COLOURED) + f"{line}."
        for mode, line in zip(result.modes, whiteness_lines(result), strict=True)
    ]
    return f'<div role="status">{macro("texts", "text", lines)}</div>'
