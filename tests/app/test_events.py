"""Who is thrown off by an event, in the figures; and events in the drawer."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from wfsobs.app.controls.panel import Controls
from wfsobs.app.dashboard import Dashboard
from wfsobs.app.store import Store
from wfsobs.app.views.traces import BINS
from wfsobs.evaluation.scores import running_rms
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.events import OF_KIND, Event
from wfsobs.signal.envelope import envelope

EVENTS = [
    {"kind": "wind", "start": 1.6, "duration": 0.2, "wind_factor": 2.0},
    {"kind": "peak", "start": 1.5, "frequency_shift": -3.0, "strength": 2.0},
    {"kind": "frames", "start": 1.7, "duration": 0.1, "share": 0.25},
    {"kind": "laser", "start": 1.9, "duration": 0.05},
]


@pytest.fixture
def short(short: Scenario) -> Scenario:
    return short.replace({"events": EVENTS})


def test_running_rms_and_marks(dashboard: Dashboard, loop: Any) -> None:
    shown, trace = dashboard.store.run.result, dashboard.explore.traces.traces["vibration"]
    assert shown is not None
    dashboard.display.param.update(show="running rms", mode="tilt", unit="um")
    for name in ("kf-lgs", "gpr-online"):
        estimate = shown.result.estimate(name, "vibration")
        assert estimate is not None
        expected = running_rms(shown.result.record, estimate, 1.0)[:, 1]
        expected[np.isnan(estimate.values[:, 1])] = np.nan
        np.testing.assert_allclose(trace.source.data[name], envelope(expected, BINS), rtol=1e-6)
    assert np.isnan(trace.source.data["truth"]).all()
    assert trace.figure.yaxis.axis_label == "running rms of error of tilt [µm]"
    dashboard.explore.traces.x_range.update(start=1.2, end=1.4)  # sent from 1.15 s on, which needs what was before
    at = np.asarray(trace.source.data["x"])
    estimate = shown.result.estimate("kf-lgs", "vibration")
    assert estimate is not None and at[0] == pytest.approx(1.15)
    steps = np.round(at / shown.result.record.dt).astype(int)
    np.testing.assert_allclose(trace.source.data["kf-lgs"], running_rms(shown.result.record, estimate, 1.0)[steps, 1], rtol=1e-6)
    the_marks_are_those_of_the_scenario(dashboard)
    dashboard.history.compare(dashboard.history.current)  # of a compared run, extremes are kept, of which there is no rms
    assert trace.faint.source is None


def the_marks_are_those_of_the_scenario(dashboard: Dashboard) -> None:
    for trace in dashboard.explore.traces.traces.values():
        top = trace.figure.y_range.end
        (marks,) = {mark.data_source for mark in trace.event_marks}  # type: ignore[attr-defined]
        assert list(marks.data["start"]) == [1.5, 1.6, 1.7, 1.9]
        assert list(marks.data["end"]) == pytest.approx([1.5, 1.8, 1.8, 1.95])
        assert list(marks.data["text"]) == ["5.96 Hz peak −3 Hz × 2", "wind × 2", "25 % LGS lost", "1 LGS out"]
        assert list(marks.data["top"]) == [top] * 4 and marks.data["below"] == [2, 15, 28, 2]
        values = np.concatenate([np.asarray(trace.source.data[name]) for name in trace.lines])
        assert np.nanmax(values) < top, "the words have room of their own"


def test_only_what_counts_is_in_the_drawer(make_store: Callable[..., Store]) -> None:
    controls = Controls(make_store())
    controls.view()  # has what is at hand
    for topic in ("events", "vibration", "turbulence"):
        controls.open_topic(topic)
    table, store = controls.fields["events"].table, controls.store
    keys = [column["key"] for column in table.columns]
    for row, event in zip(table.rows, EVENTS, strict=True):
        own = [key for key, text in zip(keys, row, strict=True) if text is not None]
        assert own == ["kind", "start", "duration", *OF_KIND[str(event["kind"])]]
    assert [key for names in OF_KIND.values() for key in names] == list(Event.settings())[3:]

    def seen(path: str) -> bool:
        return controls.fields[path].view.visible

    source = "Used only where Source is "
    assert controls.fields["vibration.cutoff"].idle == "" and controls.fields["vibration.peaks"].idle == ""
    grey = {"vibration.spectrum": "measured", "vibration.part": "measured", "turbulence.r0": "frozen-flow"}
    for path, value in grey.items():
        field = controls.fields[path]
        assert field.idle == source + value and seen(path) and all(widget.disabled for widget in field.widgets)
    assert controls.fields["turbulence.layers"].idle == source + "frozen-flow"
    assert source + "psd" in controls.headings["vibration.psd"].html and not seen("vibration.psd.tip")
    store.load(store.scenario.replace({"events": [], "vibration.source": "measured", "turbulence.source": "frozen-flow"}))
    assert not any(controls.fields[path].idle or controls.fields[path].widgets[0].disabled for path in grey)
    assert controls.fields["turbulence.layers"].idle == "" and controls.fields["vibration.peaks"].idle == source + "peaks or ar2"


def test_a_kind_that_needs_a_duration_waits_for_it(make_store: Callable[..., Store]) -> None:
    controls = Controls(make_store())
    controls.open_topic("events")
    editor = controls.fields["events"]
    editor.enter({"action": "edit", "key": "1.kind", "name": "laser"})
    (reason,) = editor.table.errors.values()
    assert reason["reason"] == "Event 2: duration = 0: takes a number above 0 s, for kind laser" and reason["text"] == "laser"
    editor.enter({"action": "edit", "key": "1.duration", "name": "0.2"})
    assert editor.table.errors == {} and controls.store.scenario.events[1].kind == "laser"
    assert json.dumps(editor.table.rows)  # as it goes to the browser
