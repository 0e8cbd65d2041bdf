"""What notebooks use of every result: HTML tables, figures, and libraries that come with an extra."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib import import_module
from typing import Any


def html_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return an HTML table of plain texts.

    >>> html_table(("Mode", "rms"), [("tip", "< 1 nm")])
    '<table><thead><tr><th>Mode</th><th>rms</th></tr></thead><tbody><tr><td>tip</td><td>&lt; 1 nm</td></tr></tbody></table>'
    """
    from html import escape

    def row(cells: Sequence[str], tag: str) -> str:
        return f"<tr>{''.join(f'<{tag}>{escape(cell)}</{tag}>' for cell in cells)}</tr>"

    return f"<table><thead>{row(head, 'th')}</thead><tbody>{''.join(row(cells, 'td') for cells in rows)}</tbody></table>"


def import_extra(name: str, extra: str) -> Any:
    """Import a library that is not always there. Raises ImportError, one line naming the extra that brings it."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise ImportError(f"{error.name} is not installed: pip install wfsobs[{extra}]") from None


class PlotAccessor:
    """The attribute `plot` of a result: its figures, made by `wfsobs.plot`, which is imported when it is first used."""

    def __get__(self, source: object, owner: type | None = None) -> Any:
        """Return the figures of an object."""
        if source is None:
            return self
        return import_module("wfsobs").open_plots(source)  # the package itself: what is drawn knows nothing of what draws it
