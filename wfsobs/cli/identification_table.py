"""An identification as a table for people."""

from __future__ import annotations

from rich.table import Table

from wfsobs.identification.process import Number
from wfsobs.identification.report import format_number, mode_rows
from wfsobs.identification.result import Identification


def identification_table(result: Identification) -> Table:
    """Noise, turbulence and peaks of every mode."""
    title = f"Identified from {result.duration:.1f} s, with standard deviations"
    out = Table(title=title, caption="rms of lines and resonances: within this record")
    for name in ("Mode", "What"):
        out.add_column(name, no_wrap=True)
    for name in ("frequency, Hz", "damping", "rms, nm"):
        out.add_column(name, justify="right", no_wrap=True)
    for m in result.modes:
        out.add_section()
        for what, frequency, damping, rms in mode_rows(m):
            numbers = (frequency, damping, None if rms is None else _nm(rms))
            out.add_row(m.name, what, *("" if n is None else format_number(n) for n in numbers))
    return out


def _nm(n: Number) -> Number:
    return Number(n.value * 1e3, n.std * 1e3)
