"""HTML from the templates in `templates/`, which escape every text that Python gives them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from math import isnan
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import ArrayLike

NOTHING = "–"
"""In place of a number that there is not."""


def number(value: float | None, digits: int = 3) -> str:
    """Write a number with some significant digits, without an exponent where it is of common size; a dash for none, or NaN."""
    if value is None or isnan(value):
        return NOTHING
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    text = f"{value:#.{digits}g}"
    return (f"{value:.0f}" if "e" in text else text.rstrip(".")).replace("-", "−")


def signs(text: str) -> str:
    """Write the signs of numbers as the pages do.

    >>> signs("-0.5 +- 0.02, as in band-pass")
    '−0.5 ± 0.02, as in band-pass'
    """
    return re.sub(r"\B-(?=\d)", "−", text.replace("+-", "±"))


def hundredths(value: float | None) -> str:
    """Write a number of a table with three digits, but none beyond the second decimal.

    >>> hundredths(7.7e-6), hundredths(0.0349), hundredths(12.345)
    ('0.00', '0.03', '12.3')
    """
    return number(value) if value is None or abs(value) >= 1.0 else f"{value:z.2f}".replace("-", "−")


def short(x: float, digits: int = 5) -> str:
    """Write a number with some digits, without zeros at its end.

    >>> short(0.5), short(-1.0), short(1.98735, 4)
    ('0.5', '−1', '1.987')
    """
    written = number(float(x), digits)
    return written.rstrip("0").rstrip(".") if "." in written and "e" not in written else written


def with_decimals_of(like: str, x: float, sign: str = "") -> str:
    """Write a number with as many decimals as one that `number` has written; sign : "+" to write that as well.

    >>> with_decimals_of("14.7", 0.89), with_decimals_of("14.7", -0.66, "+"), with_decimals_of("14.7", 0.01, "+")
    ('0.9', '−0.7', '0')
    """
    text = f"{x:{sign}z.{0 if 'e' in like else len(like.partition('.')[2])}f}".replace("-", "−")
    return "0" if sign and not text.strip("+0.") else text


def change(before: float, now: float | None) -> str:
    """Write a change in per cent, signed.

    >>> change(20.0, 15.0)
    '−25.0'
    """
    if now is None or before == 0:
        return NOTHING
    return f"{100.0 * (now / before - 1.0):+.1f}".replace("-", "−")


def render(template: str, **values: Any) -> str:
    """Fill a template; every name that it uses must be among the values."""
    return ENVIRONMENT.get_template(template).render(values)


def macro(name: str, *values: Any) -> Markup:
    """Fill a macro of `macros.html`: a piece that goes into other templates as it is."""
    return getattr(ENVIRONMENT.get_template("macros.html").module, name)(*values)


def missing(why: str) -> Markup:
    """Write a dash in place of a number, with the reason why there is none."""
    return macro("missing", why)


class Row(NamedTuple):
    """A row of a table: its heading, its cells, and attributes by which scripts and tests find it."""

    head: str
    cells: Sequence[str]
    data: Mapping[str, str] = {}


def table(
    label: str, columns: Mapping[str, str], rows: Iterable[Row] = (), *, groups: Iterable[tuple[str, Iterable[Row]]] = ()
) -> str:
    """Write a table that scrolls sideways; columns: heading -> explanation, groups: in place of rows, title and rows of each."""
    return str(macro("table", label, columns, groups or [("", rows)]))


def matrix(entries: ArrayLike) -> Markup:
    r"""Write a matrix of numbers as LaTeX; a vector is a row.

    >>> print(matrix([[1, 0], [0.5, -2]]))
    \begin{matrix}1 & 0 \\ 0.5 & −2\end{matrix}
    """
    rows = (" & ".join(map(short, row)) for row in np.atleast_2d(np.asarray(entries, dtype=float)))
    return Markup(r"\begin{matrix}" + r" \\ ".join(rows) + r"\end{matrix}")


HAT = re.compile('<mover accent="true">(?:<mrow>)?<mi>(.)</mi>(?:</mrow>)?<mo>&#x0005E;</mo></mover>')
"""Without a font for mathematics, which few systems have, a hat stands beside its letter; a combining character stands on it."""


@lru_cache(maxsize=256)
def tex(formula: str, display: str = "block") -> Markup:
    """Convert LaTeX to MathML, which browsers set without a font or a script being fetched."""
    from latex2mathml.converter import convert  # here: reports have no formulas

    mathml = convert(formula.replace("−", "-"), xmlns="", display=display).replace(' xmlns=""', "")
    return Markup(HAT.sub("<mi>\\1\u0302</mi>", mathml))


ENVIRONMENT = Environment(
    loader=PackageLoader("wfsobs.app"),
    autoescape=True,
    auto_reload=False,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
ENVIRONMENT.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
ENVIRONMENT.filters.update(number=number, change=change, hundredths=hundredths, short=short, matrix=matrix, tex=tex, py=repr)
