"""The error budgets of the first page: of what is shown, in idle time, as bars beside the errors."""

from __future__ import annotations

from typing import Any

import pytest

from tests.app.conftest import OneSeed, compute_once
from wfsobs.app import idle_work
from wfsobs.app.display import Display
from wfsobs.app.idle_work import Budgets, compute_budgets
from wfsobs.app.render import number
from wfsobs.app.sources import LoadedRecord
from wfsobs.app.store import Store
from wfsobs.app.style import TERM_COLOURS
from wfsobs.app.views.errors import MainLines, Strip, VerdictLine
from wfsobs.app.work import RunResults
from wfsobs.evaluation.budget import TERMS, Budget
from wfsobs.evaluation.result import own_bound
from wfsobs.observers import OBSERVERS
from wfsobs.progress import Cancelled, Watch
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import simulate

MAIN = ("multirate-multi", "gpr-online")
"""One observer that is linear and one that is not."""


class Page:
    """A table of the vibration with its budgets."""

    def __init__(self, store: Store):
        self.store, self.display = store, Display()
        seeds = OneSeed(store)
        self.budgets = Budgets(seeds, lambda _target: MAIN)
        self.strip = Strip("vibration", self.display, MainLines(self.display, seeds), self.budgets)

    def row(self, observer: str) -> dict[str, Any]:
        return next(item for item in self.strip.cards.items if item["name"] == observer)

    def terms(self, observer: str, mode: str) -> dict[str, float]:
        budget = self.budgets.budget(observer, "vibration", mode)
        assert budget is not None
        return budget.terms


@pytest.fixture
def short(short: Scenario) -> Scenario:
    """Each observer that is not linear runs sixteen times."""
    return short.replace({"run.duration": 1.5})


@pytest.fixture
def page(make_store: Any) -> Page:
    store = make_store(compute_once)
    store.session.service.queue.rest = 0.0
    return Page(store)


def test_work_that_gave_way_goes_on_where_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is begun anew, with what it has found so far."""
    begun: list[str] = []
    told: list[list[str]] = []
    is_busy = True

    def budget(_result: object, observers: list[str], watch: Watch) -> list[Budget]:
        begun.extend(observers)
        if is_busy and len(begun) == 3:
            raise Cancelled
        return []

    monkeypatch.setattr(idle_work, "error_budget", budget)
    monkeypatch.setattr(RunResults, "result", None, raising=False)
    known: dict[str, list[Budget]] = {}
    results = object.__new__(RunResults)

    def work() -> None:
        compute_budgets(results, ["a", "b", "c"], known, Watch(), lambda latest: told.append([*latest]))

    with pytest.raises(Cancelled):
        work()
    is_busy = False
    work()
    assert begun == ["a", "b", "c", "c"]
    assert told == [["a"], ["a", "b"], ["a", "b", "c"]]


def test_terms_add_up_to_the_scores_in_every_mode(page: Page, loop: Any) -> None:
    page.store.start()
    loop.until(lambda: {"kf-lgs", "multirate-multi", "gpr-online"} <= page.budgets.by_observer.keys())
    result = page.store.run.result.result
    for score in (s for s in result.scores if s.observer in page.budgets.by_observer and s.observer != "zero"):
        budget = page.budgets.budget(score.observer, score.target, score.mode)
        # Rounding: the terms of a linear observer, and Shapley's shares, are exact.
        assert budget is not None and (not budget.terms or sum(budget.terms.values()) == pytest.approx(score.rms**2, rel=1e-6))


def test_a_bar_is_as_long_as_the_error_and_its_pieces_are_shares_of_its_square(page: Page, loop: Any) -> None:
    page.store.start()
    loop.until(lambda: "kf-lgs" in page.budgets.by_observer)
    for mode, unit, scale in (("tip", "nm", 1e3), ("tilt", "nm", 1e3), ("tilt", "um", 1.0)):
        page.display.param.update(mode=mode, unit=unit)
        of = {s.observer: s for s in page.store.run.result.result.scores if (s.target, s.mode) == ("vibration", mode)}
        row, terms = page.row("kf-lgs"), page.terms("kf-lgs", mode)
        assert row["size"] == pytest.approx(of["kf-lgs"].rms * scale, rel=1e-9)
        assert row["limit"] == pytest.approx(of[own_bound("kf-lgs")].rms * scale, rel=1e-9)
        assert [part[0] for part in row["parts"]] == [TERM_COLOURS[name] for name in TERMS]
        positive = sum(x for x in terms.values() if x > 0)
        assert [part[1] for part in row["parts"]] == pytest.approx([max(x, 0.0) / positive for x in terms.values()], abs=1e-12)
        assert row["parts"][2][2] == f"Unmodelled peaks {round(100 * terms['lines'] / of['kf-lgs'].rms ** 2)} %"
    assert page.strip.cards.heads["bar"] == "Error budget" and ("currentColor", "limit") in page.strip.cards.legend
    assert not page.row("butterworth-ol")["parts"], "it looks ahead"


def test_a_negative_term_has_no_piece_and_is_told(page: Page, loop: Any) -> None:
    page.store.start()
    loop.finish(page.store)
    terms = dict(zip(TERMS, (4.0, 3.0, -1.0, -0.5, 2.0), strict=True))
    page.budgets.by_observer = {"kf-lgs": [Budget("kf-lgs", "vibration", "tip", 7.5, terms)]}
    assert [(share, text.rpartition(" ")[0].split()[-1]) for _, share, text, _ in page.row("kf-lgs")["parts"]] == [
        (4.0 / 9.0, "53"),
        (3.0 / 9.0, "40"),
        (0.0, "−13"),
        (0.0, "−7"),
        (2.0 / 9.0, "27"),
    ]
    page.budgets.by_observer = {"kf-lgs": [Budget("kf-lgs", "vibration", "tip", 0.0, dict.fromkeys(TERMS, 0.0))]}
    assert {share for _, share, *_ in page.row("kf-lgs")["parts"]} == {0.0}, "without vibration there is no error of it"


def test_the_legend_has_the_causes_of_every_row_and_the_scale_holds_the_limit(page: Page, loop: Any) -> None:
    page.store.start()
    loop.finish(page.store)
    score = next(
        s for s in page.store.run.result.result.scores if (s.observer, s.target, s.mode) == ("ridge", "vibration", "tip")
    )
    limit = 2.0 * score.rms
    page.budgets.by_observer = {"ridge": [Budget("ridge", "vibration", "tip", 5.0, dict.fromkeys(TERMS, 1.0), limit**2)]}
    assert not page.row("ridge")["main"]
    assert [label for _, label in page.strip.cards.legend] == [*TERMS.values(), "limit"]
    page.strip.cards._handle_msg({"action": "all"})
    assert f"--longest: {1e3 * limit}" in page.strip.cards.html, "of the longer of both: the mark stands inside its column"


def test_those_that_are_not_linear_have_budgets_if_they_are_main_ones_or_all_are_asked_for(page: Page, loop: Any) -> None:
    page.store.start()
    loop.until(lambda: "gpr-online" in page.budgets.by_observer and page.budgets.task.state == "done")
    assert not {name for name in page.budgets.by_observer if not OBSERVERS[name].linear} - {*MAIN}
    before = dict(page.budgets.by_observer)
    page.budgets.ask_for_all()
    loop.until(lambda: "gpr-offline" in page.budgets.by_observer)
    assert all(page.budgets.by_observer[name] is of for name, of in before.items()), "they are not computed again"


def test_observers_that_would_take_too_long_have_none(page: Page, loop: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wfsobs.app.idle_work.BUDGET_PATIENCE", 0.01)
    page.budgets.ask_for_all()
    page.store.start()
    loop.until(lambda: page.budgets.task.state == "done")
    assert page.budgets.by_observer and all(OBSERVERS[name].linear for name in page.budgets.by_observer)


def test_a_new_run_has_new_budgets_and_a_loaded_record_none(page: Page, loop: Any) -> None:
    page.store.start()
    loop.until(lambda: "kf-lgs" in page.budgets.by_observer)
    before = page.row("kf-lgs")["size"]
    page.store.change("turbulence.wind_speed", 30.0)
    assert not page.budgets.by_observer
    loop.until(lambda: page.store.run.state == "done" and "kf-lgs" in page.budgets.by_observer)
    assert page.row("kf-lgs")["size"] != before
    page.store.run_on(LoadedRecord(simulate(page.store.scenario), "mine", "key"), page.store.scenario)
    loop.finish(page.store)
    assert not page.budgets.by_observer and not page.strip.cards.heads["bar"] and not page.strip.cards.legend


def test_a_change_of_a_setting_shows_the_change_of_every_error(page: Page, loop: Any) -> None:
    def errors() -> dict[str, float]:
        scores = page.store.run.result.result.scores
        return {s.observer: s.rms for s in scores if (s.target, s.mode) == ("vibration", "tip")}

    page.store.start()
    loop.finish(page.store)
    first = errors()
    assert not page.strip.cards.heads["change"] and not page.row("kf-lgs")["change"]
    page.store.change("turbulence.wind_speed", 30.0)
    loop.finish(page.store)
    second = errors()
    assert page.strip.cards.heads["change"] == f"Change [{page.display.unit_label}]"
    for name in ("kf-lgs", "multirate-multi"):
        row = page.row(name)
        decimals = len(number(1e3 * second[name]).partition(".")[2])
        # Rounding to the decimals of the error.
        assert float(row["change"].replace("−", "-")) == pytest.approx(
            1e3 * (second[name] - first[name]), abs=0.51 * 10**-decimals
        )
        assert row["change"][0] in "+−0"
    page.store.change("turbulence.wind_speed", 15.0)
    loop.finish(page.store)
    there, back = page.row("kf-lgs")["change"], number(1e3 * (first["kf-lgs"] - second["kf-lgs"]))
    assert float(there.replace("−", "-")) == pytest.approx(float(back.replace("−", "-")), abs=0.06)


def test_the_verdict_names_the_largest_term_of_those_that_do_harm_when_it_is_known(page: Page, loop: Any) -> None:
    line = VerdictLine("vibration", page.display, page.budgets)
    page.store.start()
    loop.until(lambda: "kf-lgs" in page.budgets.by_observer and page.store.run.state == "done")
    for mode in ("tip", "tilt"):
        page.display.mode = mode
        terms = page.terms("kf-lgs", mode)
        assert max(terms, key=terms.__getitem__) == "lines"
        assert "error comes from unmodelled peaks." in line.html()
        assert line.pane.html == line.html()
    page.store.run_on(LoadedRecord(simulate(page.store.scenario), "mine", "key"), page.store.scenario)
    loop.finish(page.store)
    assert "unmodelled peaks" not in line.html()
