"""The figures, the cards and the table against the results they show."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from bokeh.models import CrosshairTool

from tests.records import ON_PAPER
from wfsobs.app.dashboard import Dashboard
from wfsobs.app.display import RUNNING_RMS, SIGNAL, per_micrometre
from wfsobs.app.downloads import data_csv
from wfsobs.app.render import number
from wfsobs.app.sources import LoadedRecord
from wfsobs.app.style import look
from wfsobs.app.views.traces import BINS
from wfsobs.app.work import TRUTH
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import PLAIN
from wfsobs.scenario import Scenario
from wfsobs.signal.envelope import envelope, envelope_times
from wfsobs.simulation.loop import simulate


def trace(dashboard: Dashboard, target: str) -> dict[str, Any]:
    return dict(dashboard.explore.traces.traces[target].source.data)


class TestEnvelope:
    def test_short_signals_stay_as_they_are(self) -> None:
        x = np.arange(20.0)
        assert np.array_equal(envelope(x, 10), x)
        assert np.array_equal(envelope_times(5, 25, 10, 0.1), np.arange(5, 25) * 0.1)

    @pytest.mark.parametrize("n", [21, 999, 1000, 1003, 60_007])
    def test_every_extreme_is_kept(self, n: int, rng: np.random.Generator) -> None:
        x = rng.normal(size=n)
        x[-1] = 99.0  # in the last, ragged bin
        small = envelope(x, 10)
        assert small.size == 20 == envelope_times(0, n, 10, 1.0).size
        edges = np.linspace(0, n, 11).astype(int)
        for i, (a, b) in enumerate(pairwise(edges)):
            assert sorted(small[2 * i : 2 * i + 2]) == [x[a:b].min(), x[a:b].max()]
            assert np.all(envelope_times(0, n, 10, 1.0)[2 * i : 2 * i + 2] >= a)
            assert np.all(envelope_times(0, n, 10, 1.0)[2 * i : 2 * i + 2] < b)

    def test_nan_is_left_out(self) -> None:
        x = np.full(100, np.nan)
        x[55:] = 1.0
        small = envelope(x, 10)
        assert np.isnan(small[:10]).all() and (small[10:] == 1.0).all()


class TestTraces:
    def test_signal(self, shared: Dashboard) -> None:
        shared.display.show = "signal"
        shown = shared.store.run.result
        data = trace(shared, "turbulence")
        assert set(data) == {"x", TRUTH, *(o.id for o in OBSERVERS.values() if "turbulence" in o.targets)} - {"zero"}
        expected = 1e3 * envelope(shown.values("kf-lgs", "turbulence")[:, 0], BINS)
        assert np.allclose(data["kf-lgs"], expected, rtol=1e-6)
        assert data["x"][0] >= 0 and data["x"][-1] <= 2.0 and data["x"].size == data[TRUTH].size

    def test_error(self, shared: Dashboard) -> None:
        assert shared.display.show == "error", "at first"
        shown = shared.store.run.result
        error = shown.values("kf-lgs", "vibration") - shown.values(TRUTH, "vibration")
        data = trace(shared, "vibration")
        assert np.allclose(data["kf-lgs"], 1e3 * envelope(error[:, 0], BINS), rtol=1e-5)
        assert np.isnan(data[TRUTH]).all()
        assert "error of tip [nm]" in shared.explore.traces.traces["vibration"].figure.yaxis.axis_label

    def test_a_line_alone_has_its_band(self, dashboard: Dashboard) -> None:
        """Of 95 %, 1.96 standard deviations around the estimate, or around no error; none with more lines, nor of no model."""
        drawn = dashboard.explore.traces.traces["turbulence"]
        shown = dashboard.store.run.result.result.estimate("multirate-optimal", "turbulence")
        assert drawn.band.renderer is None, "nothing is made for it at first"
        others = [name for name in drawn.lines if name not in (TRUTH, "multirate-optimal")]
        dashboard.display.hidden_lines = {"turbulence": others}
        assert drawn.band.renderer is not None and drawn.band.renderer.visible
        assert drawn.band.label.visible and "95 %" in drawn.band.label.text
        band, half = drawn.band.source.data, 1.959964e3 * shown.sd[:, 0]
        start = round(band["x"][100] / 1e-3)  # bins of 4 steps hold nearly every phase of 5
        assert band["high"][100] == pytest.approx(np.nanmax(half[start : start + 3]), rel=0.05)
        assert np.allclose(band["low"], -band["high"], rtol=1e-6, equal_nan=True)
        dashboard.display.show = "signal"
        middle = 0.5 * (band := drawn.band.source.data)["high"] + 0.5 * band["low"]
        line = np.array(trace(dashboard, "turbulence")["multirate-optimal"])
        assert np.nanmax(np.abs(middle - line)[10:]) < 0.1 * np.nanstd(line)
        dashboard.display.hidden_lines = {"turbulence": others[1:]}
        assert not drawn.band.renderer.visible
        dashboard.display.hidden_lines = {"turbulence": [name for name in drawn.lines if name not in (TRUTH, "persistence")]}
        assert not drawn.band.renderer.visible

    def test_mode_and_unit(self, shared: Dashboard) -> None:
        shared.display.param.update(mode="tilt", unit="mas", show="signal")
        truth = shared.store.run.result.values(TRUTH, "vibration")[:, 1]
        assert np.allclose(trace(shared, "vibration")[TRUTH], 103.132403 * envelope(truth, BINS), rtol=1e-6)
        assert shared.explore.traces.traces["vibration"].figure.yaxis.axis_label == "tilt [mas]"

    def test_figures_share_their_time_axis(self, shared: Dashboard) -> None:
        ranges = {id(t.figure.x_range) for t in shared.explore.traces.traces.values()}
        assert len(ranges) == 1
        assert (shared.explore.traces.x_range.start, shared.explore.traces.x_range.end) == (0.0, 2.0)

    def test_figures_share_their_crosshair(self, shared: Dashboard) -> None:
        spans = [
            {id(tool.overlay) for tool in t.figure.tools if isinstance(tool, CrosshairTool)}
            for t in shared.explore.traces.traces.values()
        ]
        assert len(spans) == 2 and spans[0] == spans[1] and len(spans[0]) == 1

    def test_a_zoom_sends_the_samples_of_its_window(self, shared: Dashboard) -> None:
        shared.display.show = "signal"
        shared.explore.traces.x_range.update(start=1.0, end=1.1)
        data = trace(shared, "vibration")
        step = np.diff(data["x"])
        assert np.allclose(step, 1e-3), "every sample of it"
        assert data["x"][0] == pytest.approx(0.975, abs=2e-3) and data["x"][-1] == pytest.approx(1.125, abs=3e-3)
        first = round(data["x"][0] / 1e-3)
        truth = shared.store.run.result.values(TRUTH, "vibration")[first : first + data["x"].size, 0]
        assert np.allclose(data[TRUTH], 1e3 * truth, rtol=1e-6)

    @pytest.mark.usefixtures("quick")
    def test_the_window_stays_through_a_change(self, dashboard: Dashboard, loop: Any) -> None:
        dashboard.explore.traces.zoom(0.2)
        window = (dashboard.explore.traces.x_range.start, dashboard.explore.traces.x_range.end)
        assert window == pytest.approx((0.9, 1.1))
        dashboard.store.change("turbulence.wind_speed", 30)
        loop.finish(dashboard.store)
        assert (dashboard.explore.traces.x_range.start, dashboard.explore.traces.x_range.end) == window
        dashboard.store.change("run.duration", 3)
        loop.finish(dashboard.store)
        window = (dashboard.explore.traces.x_range.start, dashboard.explore.traces.x_range.end)
        assert window == (0.75, 2.75), "two seconds in the middle of what counts"
        dashboard.explore.traces.zoom(None)
        assert (dashboard.explore.traces.x_range.start, dashboard.explore.traces.x_range.end) == (0.0, 3.0)
        assert dashboard.explore.traces.x_range.reset_end == 3.0

    def test_hidden_lines(self, shared: Dashboard) -> None:
        shared.explore.strips["vibration"].cards.hidden_lines = ["kf-lgs"]
        assert not shared.explore.traces.traces["vibration"].lines["kf-lgs"].visible
        assert not shared.explore.spectra.spectra["vibration"].lines["kf-lgs"].visible
        assert shared.explore.traces.traces["turbulence"].lines["kf-lgs"].visible
        shared.explore.strips["vibration"].cards.hidden_lines = []
        assert shared.explore.traces.traces["vibration"].lines["kf-lgs"].visible

    def test_the_axis_leaves_out_the_warm_up(self, shared: Dashboard) -> None:
        figure = shared.explore.traces.traces["turbulence"].figure
        data = trace(shared, "turbulence")
        counted = np.concatenate([np.asarray(v)[data["x"] >= 0.5] for k, v in data.items() if k != "x"])
        assert figure.y_range.start < np.nanmin(counted) < np.nanmax(counted) < figure.y_range.end


class TestSpectra:
    def test_signal_and_error(self, shared: Dashboard) -> None:
        shown, view = shared.store.run.result, shared.explore.spectra.spectra["vibration"]
        spectrum = shown.spectra["gpr-online", "vibration"]
        shared.display.show = "signal"
        assert np.allclose(view.sources["gpr-online"].data["y"], 1e6 * spectrum.signal[1:, 0])
        truth = np.asarray(view.sources[TRUTH].data["y"])
        shared.display.show = "error"
        assert np.allclose(view.sources["gpr-online"].data["y"], 1e6 * spectrum.error[1:, 0])
        assert np.array_equal(view.sources[TRUTH].data["y"], truth), "the error of answering zero"

    def test_what_is_hidden_is_sent_once_it_is_shown(self, dashboard: Dashboard) -> None:
        display, view = dashboard.display, dashboard.explore.spectra.spectra["vibration"]
        spectrum = dashboard.store.run.result.spectra["gpr-offline", "vibration"]
        assert "gpr-offline" in display.hidden_lines["vibration"] and len(view.sources["gpr-offline"].data["y"]) == 0
        assert np.isnan(trace(dashboard, "vibration")["gpr-offline"]).all()
        display.hidden_lines = {**display.hidden_lines, "vibration": []}
        assert np.allclose(view.sources["gpr-offline"].data["y"], 1e6 * spectrum.error[1:, 0])
        assert np.isfinite(trace(dashboard, "vibration")["gpr-offline"]).any()

    def test_unit(self, shared: Dashboard) -> None:
        shared.display.unit = "um"
        view = shared.explore.spectra.spectra["vibration"]
        assert np.allclose(view.sources[TRUTH].data["y"], shared.store.run.result.spectra[TRUTH, "vibration"].signal[1:, 0])
        assert "µm²/Hz" in view.figure.yaxis.axis_label

    @pytest.mark.usefixtures("quick")
    def test_peaks_are_marked(self, dashboard: Dashboard, loop: Any) -> None:
        view = dashboard.explore.spectra.spectra["vibration"]
        peaks = [p.frequency for p in dashboard.store.scenario.vibration.peaks]
        assert view.marks["peaks"].data_source.data["x"] == peaks
        legend = dashboard.explore.rooms["vibration"][0]
        assert ">peaks<" in legend.html
        assert view.marks["model"].data_source.data["x"] == [dashboard.store.scenario.kalman.frequency]
        dashboard.store.change("vibration.cutoff", 20)
        loop.finish(dashboard.store)
        assert view.marks["peaks"].data_source.data["x"] == [f for f in peaks if f <= 20]
        dashboard.store.change("vibration.source", "none")
        loop.finish(dashboard.store)
        assert view.marks["peaks"].data_source.data["x"] == []
        assert ">peaks<" not in legend.html

    def test_axes(self, shared: Dashboard) -> None:
        assert shared.explore.spectra.x_range.start == pytest.approx(0.667, abs=0.01)
        assert shared.explore.spectra.x_range.end == 500.0
        for view in shared.explore.spectra.spectra.values():
            assert 0 < view.figure.y_range.start < view.figure.y_range.end


class TestNumbers:
    def test_the_table_shows_the_scores(self, shared: Dashboard) -> None:
        html = shared.explore.table.pane.html
        for score in shared.store.run.result.result.scores:
            if score.mode == "tip":
                assert number(1e3 * score.rms) in html
        targets = [len(OBSERVERS[name].targets) for name in ON_PAPER]
        both = sum(count == 2 for count in targets)
        assert html.count("<tr data-observer") == 6 + sum(targets) + both, "two bounds of each target and of both together"
        assert "RMS error [nm]" in html and "Turbulence, tip" in html

    def test_the_table_follows_mode_and_unit(self, shared: Dashboard) -> None:
        shared.display.param.update(mode="tilt", unit="mas")
        score = next(s for s in shared.store.run.result.result.scores if s.mode == "tilt")
        assert number(score.rms * per_micrometre("mas", 8.0)) in shared.explore.table.pane.html
        assert "RMS error [mas]" in shared.explore.table.pane.html

    @pytest.mark.usefixtures("quick")
    def test_a_failure_is_named(self, dashboard: Dashboard, loop: Any) -> None:
        dashboard.store.change("multirate.measurement_noise", "manual")
        dashboard.store.change("multirate.ngs_noise", 0.5)
        loop.finish(dashboard.store)
        failures = dashboard.store.run.result.result.failures
        for failure in failures:
            assert failure.observer in dashboard.explore.table.pane.html

    def test_cards(self, shared: Dashboard) -> None:
        cards = {c["name"]: c for c in shared.explore.strips["vibration"].cards.items}
        score = next(
            s
            for s in shared.store.run.result.result.scores
            if (s.observer, s.target, s.mode) == ("gpr-online", "vibration", "tip")
        )
        assert cards["gpr-online"]["value"] == number(1e3 * score.rms)
        low, high = score.interval or (0.0, 0.0)
        assert float(cards["gpr-online"]["half"].removeprefix("± ")) == pytest.approx(500.0 * (high - low), abs=0.051)
        assert shared.explore.strips["vibration"].cards.heads["value"] == "RMS error [nm]"
        assert cards["gpr-online"]["colour"] == look("gpr-online").light
        assert cards[TRUTH]["value"] == number(1e3 * score.truth_rms)
        assert "zero" not in cards
        html = shared.explore.strips["vibration"].cards.html
        assert re.findall('class="card.*? data-name="([^"]+)"', html) == [*cards]
        folded = re.findall('class="card folded".*? data-name="([^"]+)"', html)
        assert folded == [name for name, card in cards.items() if not card["main"]]

    def test_before_the_first_result(self, enter: Any, loop: Any, short: Any) -> None:
        dashboard = Dashboard(loop.queue.put, enter(), short)
        loop.closing.append(dashboard)
        assert all(c["value"] == "–" for c in dashboard.explore.strips["vibration"].cards.items)
        assert dashboard.explore.table.pane.html.count("–") > 20

    @pytest.mark.parametrize(
        ("value", "text"),
        [
            (None, "–"),
            (0.0, "0"),
            (15.723, "15.7"),
            (406.4, "406"),
            (1234.5, "1234"),
            (0.0616, "0.0616"),
            (-0.05, "−0.0500"),
            (2e-5, "2.00e-05"),
            (100.0, "100"),
        ],
    )
    def test_number(self, value: float | None, text: str) -> None:
        assert number(value) == text


class TestLooks:
    def test_every_observer_has_one(self) -> None:
        assert all(o.look is not PLAIN for o in OBSERVERS.values())
        assert look("a-new-one").label == "a-new-one"

    @pytest.mark.parametrize(
        "together", [[TRUTH, *OBSERVERS, *BOUNDS], [*CONTROLLERS, *BOUNDS]], ids=["observers", "controllers"]
    )
    def test_lines_of_one_colour_differ_by_dash(self, together: list[str]) -> None:
        seen = [(look(name).light, look(name).dash) for name in together]
        assert len(seen) == len(set(seen))

    def test_dark_mode(self, shared: Dashboard) -> None:
        shared.display.dark = True
        line = shared.explore.traces.traces["vibration"].lines["gpr-online"]
        assert line.renderer.glyph.line_color == look("gpr-online").dark
        assert look("gpr-online").dark in shared.explore.table.pane.html


def test_tilt_on_sky() -> None:
    assert per_micrometre("mas", 8.0) / 1e3 == pytest.approx(0.1031, abs=5e-5)
    assert per_micrometre("nm", 8.0) == 1e3 and per_micrometre("um", 8.0) == 1.0


class TestHigherModes:
    @pytest.mark.usefixtures("quick")
    def test_the_switch_offers_what_the_run_has(self, dashboard: Dashboard, loop: Any) -> None:
        switch, display, store = dashboard.modes, dashboard.display, dashboard.store
        assert switch.buttons.visible and not switch.list.visible
        display.unit = "mas"
        store.replace({"telescope.radial_order": 2, "run.duration": 1.0})
        loop.finish(store)
        assert switch.list.visible and list(switch.list.options.values()) == [m.name for m in store.scenario.modes]
        switch.list.value = "defocus"
        assert (display.mode, display.column, display.unit) == ("defocus", 2, "nm")
        truth = dashboard.explore.traces.traces["turbulence"].figure
        assert "defocus" in truth.yaxis[0].axis_label and "Turbulence, defocus" in dashboard.explore.table.pane.html
        units = dashboard.units
        assert list(units.buttons.options.values()) == ["nm", "um"] and units.note.visible and units.buttons.value == "nm"
        display.mode = "oblique astigmatism"
        assert truth.yaxis[0].axis_label == "error of Z5 [nm]" and "Oblique astigmatism (Z5)" in switch.list.options
        display.mode = "tilt"
        assert "mas" in units.buttons.options.values() and not units.note.visible
        units.buttons.value = "mas"
        assert display.unit == "mas"
        switch.list.value = "defocus"
        dashboard.explore.pinning.button.param.trigger("clicks")
        store.change("telescope.radial_order", 1)
        loop.finish(store)
        assert display.mode == "tip" and switch.buttons.visible and not switch.list.visible
        store.change("telescope.radial_order", 3)
        loop.finish(store)
        switch.list.value = "oblique trefoil"  # the pinned run has no such mode
        assert display.compared_runs and display.runs_drawn == [] and "oblique trefoil" in dashboard.explore.table.pane.html

    def test_buttons_and_display_agree(self, shared: Dashboard) -> None:
        shared.modes.buttons.value = "tilt"
        assert shared.display.mode == "tilt" == shared.modes.list.value
        shared.display.mode = "tip"
        assert shared.modes.buttons.value == "tip"

    @pytest.mark.usefixtures("quick")
    def test_csv_names_every_mode(self, dashboard: Dashboard, loop: Any) -> None:
        dashboard.store.change("telescope.radial_order", 2)
        loop.finish(dashboard.store)
        shown = dashboard.store.run.result
        head = next(line for line in data_csv(shown).decode().splitlines() if line.startswith("time_s"))
        assert all(f"truth/turbulence/{mode.name}_um" in head for mode in dashboard.store.scenario.modes)


def test_the_verdict_stays_dimmed_until_the_next_one(dashboard: Dashboard, loop: Any) -> None:
    """What is below it does not move: its place is never empty, and what it says is marked as that of the run before."""
    line = dashboard.explore.verdicts["vibration"]
    said = line.pane.html
    heading = '<h2 class="title" title="Structural vibration, separated from turbulence.">Vibration, tip</h2>'
    assert said.startswith(heading)
    dashboard.store.change("turbulence.wind_speed", 30)
    assert line.pane.html == said.replace('"verdict"', '"verdict before"', 1)
    loop.finish(dashboard.store)
    assert line.pane.html.startswith(heading) and line.pane.html != said
    dashboard.store.change("turbulence.wind_speed", 20)
    dashboard.display.mode = "tilt"
    assert '<p class="verdict before"></p>' not in line.pane.html
    assert '<p class="verdict"></p>' in line.pane.html, "nothing is known of another mode yet"
    loop.finish(dashboard.store)
    assert ">Vibration, tilt</h2>" in line.pane.html and "Without prior knowledge: " in line.pane.html


@pytest.mark.usefixtures("quick")
def test_a_record_without_truth_leaves_no_choice_but_its_signals(dashboard: Dashboard, loop: Any, short: Scenario) -> None:
    switch = dashboard.explore.show_switch
    dashboard.display.show = RUNNING_RMS
    record = replace(simulate(short), turbulence=None, vibration=None)
    dashboard.store.run_on(LoadedRecord(record, "night.npz", "key"), short)
    loop.finish(dashboard.store)
    assert (dashboard.display.show, switch.value, switch.disabled) == (SIGNAL, SIGNAL, True)
    dashboard.store.run_on(None, short)
    loop.finish(dashboard.store)
    assert (dashboard.display.show, switch.value, switch.disabled) == (RUNNING_RMS, RUNNING_RMS, False)
