"""Settings that are found, and the headings of the drawer that say what differs from the preset."""

from __future__ import annotations

import re

from wfsobs.app.controls.panel import settings_found
from wfsobs.app.dashboard import Dashboard
from wfsobs.scenario import Scenario


def titles(dashboard: Dashboard) -> dict[str, str]:
    return dict(dashboard.controls.topic_list.titles)


class TestSearch:
    def test_every_setting_has_a_name_and_a_topic(self) -> None:
        found = {item["path"]: item for item in settings_found()}
        scenario = Scenario()
        lists = dict(scenario.lists())
        single = {path for path, _, _ in scenario.walk() if not any(path.startswith(f"{it}.") for it in lists)}
        assert set(found) == single | set(lists)
        assert len({item["name"] for item in found.values()}) == len(found), "each its own"
        assert found["turbulence.wind_speed"]["name"] == "Wind speed V₀ [m/s] · Turbulence"
        assert found["vibration.peaks"]["name"].endswith(" · Vibration")

    def test_the_browser_gets_them_when_it_asks(self, dashboard: Dashboard) -> None:
        search = dashboard.controls.search
        assert search.items == [], "not with the page"
        search._handle_msg({"open": True})
        assert len(search.items) == len(settings_found())

    def test_the_topic_of_the_one_chosen_opens(self, dashboard: Dashboard) -> None:
        search, controls = dashboard.controls.search, dashboard.controls
        search._handle_msg({"open": True})
        assert "kalman.vibration_rms" not in controls.fields
        search._handle_msg({"find": "kalman.vibration_rms"})
        assert "kalman.vibration_rms" in controls.fields
        assert controls.topic_list.open_topics == ["kalman"]
        for text in ("no.such", 3, "wind speed"):
            search._handle_msg({"find": text})
        assert controls.topic_list.open_topics == ["kalman"], "nothing to open: unknown, or above the topics"


class TestHeadings:
    def test_what_no_heading_says_opens_nothing(self, dashboard: Dashboard) -> None:
        topics = dashboard.controls.topic_list
        (headings,) = topics.view
        for message in ({}, {"key": "no.such"}, {"key": ["kalman"]}, {"key": None, "action": "toggle"}):
            headings._handle_msg(message)
        assert topics.open_topics == [] and topics.view.objects == [headings]
        for name in ("run", "kalman"):
            headings._handle_msg({"action": "toggle", "key": name})
        assert [type(part).__name__ for part in topics.view] == ["Headings", "Column", "Headings", "Column", "Headings"]
        assert re.findall(r'data-key="(\w+)" aria-expanded="true"', "".join(it.html for it in topics.view[::2])) == [
            "kalman",
            "run",
        ]
        headings._handle_msg({"action": "toggle", "key": "run"})
        assert topics.open_topics == ["kalman"] and len(topics.view) == 3

    def test_they_count_what_differs_from_the_preset(self, dashboard: Dashboard) -> None:
        dashboard.store.choose("paper")
        plain = titles(dashboard)
        assert plain == dashboard.controls.topics
        written: list[object] = []
        dashboard.controls.topic_list.view.param.watch(written.append, "objects")
        dashboard.store.replace({"kalman.vibration_rms": 0.1, "kalman.turbulence_rms": 0.4, "run.seed": 5})
        assert titles(dashboard) == plain | {
            "kalman": f"{plain['kalman']} · 2 changed",
            "run": f"{plain['run']} · 1 changed",
        }
        assert not written, "only texts change: for other parts the whole page is laid out anew"
        dashboard.store.undo()
        assert titles(dashboard) == plain
