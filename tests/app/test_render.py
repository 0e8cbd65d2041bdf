"""Templates: texts are escaped, and a name that is missing is an error."""

from __future__ import annotations

import pytest
from jinja2 import UndefinedError

from wfsobs.app.render import ENVIRONMENT, NOTHING, Row, macro, render, table

HOSTILE = "<script>alert(1)</script>\"'&"


def test_texts_are_escaped() -> None:
    assert "<script" not in macro("tag", "best", HOSTILE) and "&lt;script&gt;" in macro("tag", "best", HOSTILE)


def test_a_missing_name_is_an_error() -> None:
    with pytest.raises(UndefinedError, match="undefined"):
        render("report/origin.html", facts={})


@pytest.mark.parametrize("name", ENVIRONMENT.list_templates())
def test_every_template_compiles(name: str) -> None:
    ENVIRONMENT.get_template(name)


def test_a_cell_without_a_number_says_why() -> None:
    html = table("Margins", {"Controller": "", "Gain margin [dB]": "", "Strehl": ""}, [Row("a", [NOTHING, "0.9"])])
    assert f'<td title="no change of the gain makes this loop unstable">{NOTHING}</td><td>0.9</td>' in html
