"""How numbers are written."""

from __future__ import annotations

NOTHING = "–"
"""In place of a number that there is not."""


def number(value: float | None, digits: int = 3) -> str:
    """Write a number with some significant digits, and without an exponent where it is of common size."""
    if value is None:
        return NOTHING
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    text = f"{value:#.{digits}g}"
    return (f"{value:.0f}" if "e" in text else text.rstrip(".")).replace("-", "−")


def short(x: float, digits: int = 5) -> str:
    """Write a number with some digits, without zeros at its end.

    >>> short(0.5), short(-1.0), short(1.98735, 4)
    ('0.5', '−1', '1.987')
    """
    written = number(float(x), digits)
    return written.rstrip("0").rstrip(".") if "." in written and "e" not in written else written


def change(before: float, now: float | None) -> str:
    """Write a change in per cent, signed.

    >>> change(20.0, 15.0)
    '−25.0'
    """
    if now is None or before == 0:
        return NOTHING
    return f"{100.0 * (now / before - 1.0):+.1f}".replace("-", "−")
