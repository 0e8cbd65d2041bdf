"""An extension of griffe, which reads the docstrings for the reference: examples are code, fields a list.

Sections as numpydoc has them are left to griffe.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

DOCTEST = re.compile(r"^>>> .*(?:\n.+)*", flags=re.M)
"""From a prompt to the next blank line."""


FIELD = re.compile(r"^(\w[\w, ]*?) +: (.*(?:\n +\S.*)*)", flags=re.M)
"""A line `name, name : meaning`, and the indented ones after it."""

UNDERLINE = re.compile(r"^-{3,}$", flags=re.M)


def as_markdown(text: str) -> str:
    r"""Return the text with its examples as blocks and its fields as a list of Markdown.

    >>> as_markdown("Twice.\n\n>>> 2 * 1\n2\n\nMore.").splitlines()
    ['Twice.', '', '```pycon', '>>> 2 * 1', '2', '```', '', 'More.']
    >>> as_markdown("A\n\nx, y : of a\n  point\nn    : how many").splitlines()
    ['A', '', '- `x, y`: of a', '  point', '- `n`: how many']
    """
    if not UNDERLINE.search(text):
        text = FIELD.sub(r"- `\1`: \2", text)
    return DOCTEST.sub(lambda match: f"```pycon\n{match.group()}\n```", text)


class Docstrings(griffe.Extension):
    """Applies that to every docstring."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for every object but the package."""
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Called for the package."""
        self.on_object(obj=pkg)
