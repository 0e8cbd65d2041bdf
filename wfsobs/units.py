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

ARCSECOND = math.radians(1.0 / 3600.0)

ANGLES = {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "nrad": 1e-9, "arcsec": ARCSECOND, "mas": 1e-3 * ARCSECOND}
"""Radians per unit."""

SECONDS = {
    name: seconds
    for names, seconds in (
        ("s sec secs second seconds", 1.0),
        ("ms msec millisecond milliseconds", 1e-3),
        ("us µs \u03bcs usec microsecond microseconds", 1e-6),
        ("ns nsec nanosecond nanoseconds", 1e-9),
        ("d day days", 86400.0),
    )
    for name in names.split()
}
"""Seconds per unit of time."""

DAYS = ("mjd", "jd")
"""Names of a time in days."""

UNITS = ("um", "nm", "mas", "arcsec", "rad")
"""Units that a user can give for a file."""

_SYNONYMS = {
    name: unit
    for unit, names in {
        "um": "µm \u03bcm micron microns micrometer micrometers micrometre micrometres",
        "m": "meter meters metre metres",
        "nm": "nanometer nanometers nanometre nanometres",
        "rad": "radian radians",
        "urad": "µrad \u03bcrad microradian microradians",
        "arcsec": "arcsecond arcseconds",
        "mas": "milliarcsec milliarcsecond milliarcseconds",
    }.items()
    for name in names.split()
}


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

    >>> parse_unit("Micron"), parse_unit("mas"), parse_unit("V")
    ('um', 'mas', None)
    """
    name = _SYNONYMS.get(text.strip().lower(), text.strip())
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


def stated_unit(heading: str, beside: str = "") -> str:
    """Return the unit of a heading as `split_unit` does; where that knows none, the text beside the heading or in brackets.

    >>> stated_unit("t_ms"), stated_unit("slope [V]"), stated_unit("slope (x)"), stated_unit("slope", "pixel")
    ('ms', 'V', '', 'pixel')
    """
    match = _ENDING.search(heading)
    bracketed = match["unit"] if match and heading[-1] in ")]" and match["unit"].lower() not in NO_UNITS else ""
    return split_unit(heading, beside)[1] or beside.strip() or bracketed


NO_UNITS = frozenset("x y tip tilt lgs ngs wfs dm ttm utc tai gps unix rel abs".split())
"""Words in brackets that name an axis, a part of the loop or a time scale."""


def _parse_any(text: str) -> str:
    return parse_unit(text) or (text if text in SECONDS else "")


def unit_refusal(values: object) -> str:
    """Return why values, or arrays in a list, that bring a unit with them are refused; "" without one."""
    for one in (values, *(values if isinstance(values, (list, tuple)) else ())):
        if (unit := getattr(one, "unit", None)) is not None:
            return f'has the unit {str(unit) or 1}; takes plain numbers in um, such as those of to_value("um")'
    return ""
