"""Templates: texts are escaped, and a name that is missing is an error."""

from __future__ import annotations

import pytest
from jinja2 import UndefinedError

from wfsobs.app.render import ENVIRONMENT, macro, render

HOSTILE = "<script>alert(1)</script>\"'&"


def test_texts_are_escaped() -> None:
    assert "<script" not in macro("tag", "best", HOSTILE) and "&lt;script&gt;" in macro("tag", "best", HOSTILE)


def test_a_missing_name_is_an_error() -> None:
    with pytest.raises(UndefinedError, match="undefined"):
        render("report/origin.html", facts={})


@pytest.mark.parametrize("name", ENVIRONMENT.list_templates())
def test_every_template_compiles(name: str) -> None:
    assert name.endswith(".html")
    ENVIRONMENT.get_template(name)
