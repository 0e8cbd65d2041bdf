"""The RMS table of the first page."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

from tests.app.conftest import OneSeed, compute_once
from wfsobs.app.display import Display
from wfsobs.app.idle_work import Budgets
from wfsobs.app.jobs import DONE
from wfsobs.app.sources import LoadedRecord
from wfsobs.app.store import Store
from wfsobs.app.views.cards import Cards
from wfsobs.app.views.errors import MainLines, Strip, Table
from wfsobs.evaluation.bound import NO_BOUND
from wfsobs.evaluation.result import Failure
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.simulation.loop import simulate


@pytest.mark.usefixtures("quick")
def test_lines_are_true_for_the_simulation_of_the_settings_and_given_for_a_loaded_record(make_store: Any, loop: Any) -> None:
    store: Store = make_store(compute_once)
    table = Table(Display(), OneSeed(store))
    store.start()
    loop.until(lambda: store.run.state == DONE)
    assert "Prior knowledge: peak frequencies<" in table.pane.html and "given peak" not in table.pane.html
    store.run_on(LoadedRecord(simulate(store.scenario), "mine", "key"), store.scenario)
    loop.until(lambda: store.run.state == DONE and store.run.result.is_recorded)
    assert "Prior knowledge: given peak frequencies<" in table.pane.html and ": peak freq" not in table.pane.html


def test_what_has_no_error_says_its_own_reason(make_store: Any, loop: Any) -> None:
    store: Store = make_store(compute_once)
    seeds = OneSeed(store)
    table = Table(display := Display(), seeds)
    lines = MainLines(display, seeds)
    strip = Strip("vibration", display, lines, Budgets(seeds, lines.names))
    store.start()
    loop.finish(store)
    full = store.run.result.result
    part = replace(
        full,
        estimates=tuple(e for e in full.estimates if e.observer != "kf-lgs"),
        scores=tuple(replace(s, interval=(0.0, 11.0 * s.rms)) for s in full.scores if s.observer not in ("kf-lgs", *BOUNDS)),
        failures=(Failure("kf-lgs", "kf-lgs left out: it is not here"),),
    )
    store.run.result = replace(store.run.result, result=part)
    for why in (NO_BOUND, "it is not here"):
        assert f'<span title="{why}">–</span>' in table.html()
    (card,) = (item for item in strip.items() if item["name"] == "kf-lgs")
    assert table.html().count("interval unknown") == sum(s.mode == "tip" for s in part.scores), "it reaches beyond tenfold"
    assert "<button" in strip.cards.html and "<button" not in Cards().html, "of no row"
    assert card["note"] == "left out" and "it is not here" in card["about"]


def test_before_a_run_there_is_a_row_for_what_will_run(make_store: Any, loop: Any) -> None:
    store: Store = make_store(compute_once)
    table = Table(Display(), OneSeed(store))

    def rows() -> list[str]:
        return re.findall('data-observer="([^"]+)"', table.html())

    before = rows()
    store.start()
    loop.finish(store)
    assert sorted(before) == sorted(rows())


def test_every_dash_has_a_reason_and_no_number_an_exponent(make_store: Any, loop: Any) -> None:
    store: Store = make_store(compute_once)
    table = Table(Display(), OneSeed(store))
    assert table.html().count("–") == len(re.findall('<span title="[^"]+">–</span>', table.html())) > 20
    store.start()
    loop.until(lambda: store.run.state == DONE)
    html = table.html()
    assert html.count("–") == len(re.findall('<span title="[^"]+">–</span>', html)) + html.count('" title="where')
    assert not re.search(r"\de[-−]\d", html)
