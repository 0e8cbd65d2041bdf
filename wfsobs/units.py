"""Units of a wavefront in files and tables; inside, coefficients are Noll-normalised micrometres rms.

A tip or tilt of a [m] rms over an aperture D tilts the wavefront by 4 a / D [rad].

>>> round(0.1 / micrometres_per("mas", 8.0), 4)  # 100 nm on 8 m, in mas
10.3132
"""

from __future__ import annotations

import math
import re

LENGTHS = {"um": 1.0, "nm": 1e-3, "m": 1e6}
"""Micrometres per unit."""

ANGLES = {"rad": 1.0, "arcsec": math.radians(1.0 / 3600.0), "mas": math.radians(1.0 / 3.6e6)}
"""Radians per unit."""

SECONDS = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "d": 86400.0}
"""Seconds per unit of time."""

DAYS = ("mjd", "jd")
"""Names of a time in days."""

UNITS = ("um", "nm", "mas", "arcsec", "rad")
"""Units that a user can give for a file."""

_SYNONYMS = {"µm": "um", "micron": "um", "microns": "um", "\u03bcm": "um", "meter": "m", "arcseconds": "arcsec", "radian": "rad"}


_ENDING = re.compile(r"[_ \[(]+(?P<unit>[A-Za-zµμ]+)[\])]?$")


def unit_text(unit: str) -> str:
    """Write a unit as people do.

    >>> unit_text("um^2/Hz")
    'µm²/Hz'
    """
    return re.sub(r"\bum\b", "µm", unit).replace("^2", "²")


def micrometres_per(unit: str, diameter: float) -> float:
    """Return the micrometres rms of tip or tilt per `unit`, on an aperture of `diameter` [m]."""
    return LENGTHS[unit] if unit in LENGTHS else ANGLES[unit] * 1e6 * diameter / 4.0


def parse_unit(text: str) -> str | None:
    """Return the unit of a file's text, or None for an unknown one.

    >>> parse_unit("micron"), parse_unit("mas"), parse_unit("V")
    ('um', 'mas', None)
    """
    name = _SYNONYMS.get(text.strip(), text.strip())
    return name if name in LENGTHS or name in ANGLES else None


def split_unit(heading: str, beside: str = "") -> tuple[str, str]:
    """Return the name in a heading without its unit, and the unit, that stated `beside` first; empty where neither is one.

    >>> split_unit("slope x [nm]"), split_unit("t_ms"), split_unit("cmd_x"), split_unit("T", "ns")
    (('slope x', 'nm'), ('t', 'ms'), ('cmd_x', ''), ('T', 'ns'))
    """
    if heading.lower() in DAYS:
        return heading, "d"
    match = _ENDING.search(heading)
    ending = _parse_any(match["unit"]) if match else ""
    name = heading[: match.start()] if match and ending else heading
    return name, _parse_any(beside.strip()) or ending


def _parse_any(text: str) -> str:
    return parse_unit(text) or (text if text in SECONDS else "")
