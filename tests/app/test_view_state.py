"""The view in the address: written, read back, refused where it makes no sense."""

from __future__ import annotations

import pytest

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.idle_work import SEEDS


def other(dashboard: Dashboard, query: str) -> list[str]:
    return dashboard.view_state.open(query)


class TestViewState:
    def test_a_fresh_page_has_none(self, dashboard: Dashboard) -> None:
        assert dashboard.view_state.query == dashboard.actions.toolbar.view == ""

    def test_there_and_back(self, dashboard: Dashboard) -> None:
        dashboard.display.param.update(mode="tilt", unit="mas", show="signal", spectrum="cumulative")
        dashboard.explore.strips["vibration"].cards.hidden_lines = ["truth", "kf-lgs"]
        dashboard.explore.traces.x_range.update(start=0.75, end=1.25)
        dashboard.pages.current = "model"
        dashboard.seeds.count = 3
        query = dashboard.actions.toolbar.view
        assert query == (
            "view.page=model&view.mode=tilt&view.unit=mas&view.show=signal&view.spectrum=cumulative"
            "&view.hide.vibration=truth,kf-lgs&view.window=0.75,1.25&view.seeds=3"
        )
        assert other(dashboard, "") == []
        assert dashboard.view_state.query == "" and dashboard.pages.current == "explore"
        assert dashboard.display.show == "error" and dashboard.explore.traces.x_range.end == 2.0
        assert dashboard.seeds.count == SEEDS
        assert other(dashboard, f"?run.seed=3&{query}") == []
        assert dashboard.view_state.query == query
        assert dashboard.explore.strips["vibration"].cards.hidden_lines == ["truth", "kf-lgs"]
        assert dashboard.seeds.count == 3

    def test_what_makes_no_sense_is_named(self, shared: Dashboard, subtests: pytest.Subtests) -> None:
        for field, reason in [
            ("view.page=moon", "view.page = moon: takes one of explore, identify"),
            ("view.window=3,1", "view.window = 3,1: takes two times [s], the first one smaller"),
            ("view.window=nan,1", "view.window = nan,1: takes two times"),
            ("view.hide.vibration=truth,nobody", "nobody: no line of that name"),
            ("view.seeds=0", "view.seeds = 0: takes a whole number from 1 to 50"),
            ("view.seeds=many", "view.seeds = many: takes a whole number from 1 to 50"),
            ("view.colour=red", "view.colour: there is no such part of a view"),
        ]:
            with subtests.test(field):
                shared.display.mode, shared.actions.toolbar.notes = "tip", []
                shared.actions.handle({"action": "view", "query": f"?{field}&view.mode=tilt"})
                (note,) = shared.actions.toolbar.notes
                assert note.startswith("Not used from the link: ") and reason in note
                assert shared.display.mode == "tilt", "the rest is used"

    def test_a_theme_that_was_chosen(self, dashboard: Dashboard) -> None:
        dashboard.view_state.choose_theme(True)
        assert dashboard.actions.toolbar.view == "theme=dark"

    def test_the_settings_of_a_link_leave_the_view_alone(self, dashboard: Dashboard) -> None:
        dashboard.actions.open_link("?view.mode=tilt&theme=dark&run.duration=2")
        assert dashboard.actions.toolbar.notes == []
