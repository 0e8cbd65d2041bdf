"""The numbers of an identification, plain HTML."""

from __future__ import annotations

from html import escape

from wfsobs.app.display import Display, per_micrometre
from wfsobs.identification import Identified
from wfsobs.identification.process import Number
from wfsobs.identification.report import rows, verdict, written
from wfsobs.identification.result import IdentifiedMode

WHITE = '<span class="tag best">white</span> '
COLOURED = '<span class="tag above">not white</span> '


def table_html(mode: IdentifiedMode, display: Display, diameter: float) -> str:
    """Noise, turbulence and peaks of a mode, each number with its standard deviation."""
    scale = per_micrometre(display.unit, diameter)
    columns = {
        "What": "by frequency",
        "Frequency [Hz]": "natural frequency; of turbulence the corner",
        "Damping": "0 is a pure line",
        f"Rms [{display.unit_label}]": "standard deviation of it in z",
    }
    head = "".join(f'<th scope=col title="{why}">{name}</th>' for name, why in columns.items())
    body = ""
    for what, frequency, damping, rms in rows(mode):
        scaled = None if rms is None else Number(rms.value * scale, rms.std * scale)
        cells = ["" if n is None else spoken(n) for n in (frequency, damping, scaled)]
        body += f"<tr><th scope=row>{what}</th>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"
    return (
        f'<div class="scroll" tabindex=0 role=region aria-label="Identified in {mode.name}">'
        f'<table class="rms"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    )


def spoken(number: Number) -> str:
    """A number and its standard deviation.

    >>> spoken(Number(47.43812, 0.0264))
    '47.438 ± 0.026'
    """
    return written(number).replace("+-", "±").replace("-", "−")


def verdict_html(result: Identified) -> str:
    """Whether anything is left, mode by mode."""
    lines = "".join(
        f'<p class="text">{WHITE if mode.whiteness.white else COLOURED}{escape(line)}.</p>'
        for mode, line in zip(result.modes, verdict(result), strict=True)
    )
    return f'<div role="status">{lines}</div>'
