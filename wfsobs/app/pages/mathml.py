"""Formulas as MathML, which browsers set themselves: nothing is fetched.

Few systems have a font for mathematics, so nothing here needs one: no sign that grows with what it encloses, no root.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import ArrayLike

from wfsobs.app.display import number

DIGITS = 5


def math(*parts: str) -> str:
    """A formula on a line of its own."""
    return f'<math display="block">{"".join(parts)}</math>'


def name(text: str, below: str = "", above: str = "") -> str:
    """A letter, with what stands below and above it."""
    letter, sub, sup = (f"<mi>{escape(t)}</mi>" if t else "" for t in (text, below, above))
    if sub and sup:
        return f"<msubsup>{letter}{sub}{sup}</msubsup>"
    return f"<msub>{letter}{sub}</msub>" if sub else f"<msup>{letter}{sup}</msup>" if sup else letter


def hat(text: str, below: str = "") -> str:
    """A letter with a hat: an estimate."""
    return name(f"{text}\u0302", below)


def at(letter: str, step: str) -> str:
    """A signal at a step, x[k]."""
    return f"{letter}<mo>[</mo>{text(step)}<mo>]</mo>"


def text(words: str) -> str:
    """Upright text."""
    return f"<mtext>{escape(words)}</mtext>"


def gap() -> str:
    """Between two formulas on a line."""
    return text(",\u2003")


def op(sign: str) -> str:
    """An operator."""
    return f"<mo>{escape(sign)}</mo>"


def value(x: float, digits: int = DIGITS) -> str:
    """A number; a whole one as it is."""
    return f"<mn>{short(x, digits)}</mn>"


def short(x: float, digits: int = DIGITS) -> str:
    """A number with some digits, without zeros at its end.

    >>> short(0.5), short(-1.0), short(1.98735, 4)
    ('0.5', '−1', '1.987')
    """
    written = number(float(x), digits)
    return written.rstrip("0").rstrip(".") if "." in written and "e" not in written else written


def matrix(entries: ArrayLike, digits: int = DIGITS) -> str:
    """A matrix of numbers; a vector is a row."""
    rows = np.atleast_2d(np.asarray(entries, dtype=float))
    return table([[value(x, digits) for x in row] for row in rows])


def column(entries: Sequence[str]) -> str:
    """A column of formulas."""
    return table([[entry] for entry in entries])


def table(rows: Sequence[Sequence[str]]) -> str:
    """A matrix of formulas."""
    body = "".join(f"<mtr>{''.join(f'<mtd>{cell}</mtd>' for cell in row)}</mtr>" for row in rows)
    return f'<mtable class="matrix">{body}</mtable>'
