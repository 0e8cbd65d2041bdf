"""HTML from the templates in `templates/`, which escape every text that Python gives them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import ArrayLike

from wfsobs.app.numerals import number, short


def render(template: str, **values: Any) -> str:
    """Fill a template; every name that it uses must be among the values."""
    return ENVIRONMENT.get_template(template).render(values)


def macro(name: str, *values: Any) -> Markup:
    """Fill a macro of `macros.html`: a piece that goes into other templates as it is."""
    return getattr(ENVIRONMENT.get_template("macros.html").module, name)(*values)


class Row(NamedTuple):
    """A row of a table: its heading, its cells, and attributes by which scripts and tests find it."""

    head: str
    cells: Sequence[str]
    data: Mapping[str, str] = MappingProxyType({})


def table(label: str, columns: Mapping[str, str], groups: Iterable[tuple[str, Iterable[Row]]]) -> Markup:
    """Write a table that scrolls sideways; columns: heading -> explanation, groups: title, or nothing, and rows."""
    return macro("table", label, columns, groups)


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
ENVIRONMENT.filters.update(number=number, short=short, matrix=matrix, tex=tex)
