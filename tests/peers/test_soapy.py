"""The loop of the example in soapy: a controller in the place of its integrator."""

import pytest


def test_less_is_left_and_what_the_page_says(loop_of_the_page) -> None:
    """The seeds are those of the page. Rounding can move a draw of photons and those after it: 5 %."""
    (before, after), said = loop_of_the_page("soapy")
    assert after < before
    assert (before, after) == pytest.approx(said, rel=0.05)
