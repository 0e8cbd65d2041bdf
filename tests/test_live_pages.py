"""How far pages of a live loop are behind, from what they have told: the oracle is made by hand."""

import importlib
from pathlib import Path

import pytest


def test_lags_are_against_the_source_of_that_instant(monkeypatch):
    """The source began at 100 s; the first answer took 0.2 s longer than the second."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "scripts"))
    lags_of = importlib.import_module("live_pages").lags_of
    polls = [(110.2, 10.0), (115.0, 15.0)]
    told = [(0, (109.0, 8.9)), (0, (110.0, 9.9)), (0, (110.2, 10.0)), (1, (110.5, 10.1)), (0, (110.4, 10.3))]
    found = lags_of(told, polls, start=109.5)
    assert found["pictures_per_s"] == [5.0, 0.0]
    # as they come: 0.1, 0.2, 0.1 and 0.4 s; page 0 shows 9.9 s until 110.2 s and 10.0 s until 110.4 s
    assert found["page_behind_s"] == pytest.approx({"median": 0.2, "max": 0.4})
    assert found["page_behind_before_next_s"] == pytest.approx({"median": 0.4, "max": 0.4})
    assert lags_of([], polls, start=0.0)["page_behind_s"] is None
