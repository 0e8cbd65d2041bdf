"""Pinning a run and comparing with it; what the table and the spectra do besides."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from wfsobs.app.compared import differences, find_score, name_of_difference, thin_lines
from wfsobs.app.dashboard import Dashboard
from wfsobs.app.render import change, hundredths, number
from wfsobs.app.style import observers_of
from wfsobs.app.work import TRUTH
from wfsobs.evaluation.evidence import gather_evidence
from wfsobs.evaluation.result import group_by_knowledge
from wfsobs.observers.base import TARGETS
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.spectrum import rms


def press(dashboard: Dashboard) -> None:
    dashboard.explore.pinning.button.param.trigger("clicks")


@pytest.fixture
def pinned(dashboard: Dashboard, loop: Any) -> Dashboard:
    """A dashboard that shows a windier run than the pinned one."""
    press(dashboard)
    dashboard.store.change("turbulence.wind_speed", 30)
    loop.finish(dashboard.store)
    return dashboard


def order(dashboard: Dashboard, target: str) -> list[str]:
    return re.findall(rf'data-observer="([\w-]+)" data-target="{target}"', dashboard.explore.table.pane.html)


class TestPin:
    def test_the_table_shows_the_change(self, pinned: Dashboard) -> None:
        (kept,), shown = pinned.display.compared_runs, pinned.store.run.result
        before = find_score(kept.scores, "kf-lgs", "turbulence", "tip").rms
        now = next(s for s in shown.result.scores if (s.observer, s.target, s.mode) == ("kf-lgs", "turbulence", "tip")).rms
        assert now != before
        html = pinned.explore.table.pane.html
        assert f'<td><span class="range">{change(before, now)} %</span> {number(1e3 * before)}</td>' in html
        assert ">A [nm]<" in html and "RMS error in Preset Paper" in html

    def test_errors_are_compared_over_the_seeds_that_both_have(self, dashboard: Dashboard, loop: Any) -> None:
        """A run beside itself has not changed, whatever the other seeds have."""
        press(dashboard)
        scores = dashboard.store.run.result.result.scores
        others = [[replace(s, rms=factor * s.rms) for s in scores] for factor in (1.0, 2.0, 3.0)]
        dashboard.explore.seeds.evidence = gather_evidence(others)
        (run,) = dashboard.display.compared_runs
        assert run.evidence is dashboard.explore.seeds.evidence and "+0.0 %" in dashboard.explore.table.pane.html
        key = "kf-lgs", "vibration", "tip"
        rms = find_score(scores, *key).rms
        assert run.beside(scores, gather_evidence(others[:2]), key) == pytest.approx((1.5 * rms, 1.5 * rms))
        assert run.beside(scores, None, key) == (rms, rms), "of one record beside one record"
        other = [replace(s, rms=4.0 * s.rms) for s in scores]
        dashboard.explore.seeds.evidence = gather_evidence([other, other, other])  # of another run, which is not shown yet
        assert dashboard.display.compared_runs == [run]

    def test_the_cards_have_value_beside_value(self, pinned: Dashboard) -> None:
        (kept,), shown = pinned.display.compared_runs, pinned.store.run.result
        cards = {card["name"]: card["compared"] for card in pinned.explore.strips["turbulence"].cards.items}
        for name in ("kf-lgs", TRUTH):
            before, now = (
                next(s.truth_rms if name == TRUTH else s.rms for s in scores if (s.observer, s.target, s.mode) == of)
                for of in [("kf-lgs", "turbulence", "tip")]
                for scores in (kept.scores, shown.result.scores)
            )
            assert cards[name] == [["A", number(1e3 * before), f"{change(before, now)} %"]]

    def test_the_name_says_what_differs(self, pinned: Dashboard, loop: Any) -> None:
        assert "Wind speed V₀ 15 → 30 m/s" in pinned.explore.pinning.note.html and pinned.explore.pinning.note.visible
        pinned.store.change("turbulence.wind_speed", 15)
        loop.finish(pinned.store)
        assert "the same settings" in pinned.explore.pinning.note.html

    def test_faint_lines(self, pinned: Dashboard) -> None:
        pinned.display.param.update(show="signal", hidden_lines={})
        ran = [n for n in observers_of("turbulence") if pinned.store.run.result.values(n, "turbulence") is not None]
        trace, kept = pinned.explore.traces.traces["turbulence"], pinned.display.compared_runs[0].lines
        data = trace.faint.source.data
        assert len(data["xs"]) == len(data["colour"]) == 1 + len(ran)
        assert np.nanmax(data["ys"][0]) == pytest.approx(1e3 * np.nanmax(kept.signals[TRUTH, "turbulence"][:, 0]))
        spectrum = pinned.explore.spectra.spectra["vibration"].faint.source.data
        assert np.allclose(spectrum["ys"][0], 1e6 * kept.spectra[TRUTH, "vibration"].signal[1:, 0])
        pinned.display.show = "error"
        assert len(trace.faint.source.data["xs"]) == len(ran), "the truth has no error"
        pinned.display.hidden_lines = {"turbulence": ["kf-lgs"]}
        assert len(trace.faint.source.data["xs"]) == len(ran) - 1

    def test_a_zoom_cuts_the_pinned_lines(self, pinned: Dashboard) -> None:
        pinned.explore.traces.x_range.update(start=1.0, end=1.1)
        x = np.asarray(pinned.explore.traces.traces["vibration"].faint.source.data["xs"][0])
        assert x[0] == pytest.approx(0.975, abs=2e-3) and x[-1] == pytest.approx(1.125, abs=3e-3)

    def test_unpin(self, pinned: Dashboard) -> None:
        assert pinned.explore.pinning.button.label == "Unpin"
        press(pinned)
        assert pinned.display.compared_runs == [] and pinned.explore.pinning.button.label == "Pin"
        assert ">A [nm]<" not in pinned.explore.table.pane.html and not pinned.explore.pinning.note.visible
        assert pinned.explore.traces.traces["turbulence"].faint.source.data["xs"] == []

    def test_nothing_is_drawn_before(self, shared: Dashboard) -> None:
        assert all(shared.explore.traces.traces[target].faint.source is None for target in TARGETS)

    def test_all_samples_of_a_short_record_are_kept(self, shared: Dashboard) -> None:
        shown = shared.store.run.result
        kept = thin_lines(shown)
        values = shown.values("kf-lgs", "vibration")
        assert np.allclose(kept.signals["kf-lgs", "vibration"], values, atol=1e-6)
        assert np.allclose(kept.errors["kf-lgs", "vibration"], values - shown.values(TRUTH, "vibration"), atol=1e-6)


class TestWords:
    def test_differences(self) -> None:
        one = Scenario()
        other = one.replace(
            {
                "turbulence.damping": 0.8,
                "loop.closed": False,
                "kalman.process_noise": "manual",
                "turbulence.rms": 0.4,
                "butterworth.frequencies": [20.0],
            }
        )
        assert differences(one, other) == [
            "Turbulence: Damping ξ 0.9 → 0.8",
            "Strength, rms 0.5 → 0.4 µm",
            "Closed loop on → off",
            "Process noise Q matched → manual",
            "Centre frequencies changed",
        ]
        assert name_of_difference(one, other).endswith("and 2 more")
        assert name_of_difference(one, one.copy()) == "the same settings"
        assert "Peaks changed" in differences(PRESETS["paper"](), PRESETS["ut4"]())

    def test_differences_of_one_peak(self) -> None:
        one = PRESETS["paper"]()
        peaks = [peak.to_dict() for peak in one.vibration.peaks]
        moved = [*peaks[:6], {**peaks[6], "frequency": 18.5, "rms": [0.01, peaks[6]["rms"][1]]}, *peaks[7:]]
        for others, words in (
            ([*peaks, {**peaks[0], "frequency": 70.0}], ["Peak 16 added"]),
            ([*peaks[:3], *peaks[4:]], ["Peak 4 removed"]),
            (moved, ["Peak 7: f 17.25 → 18.5 Hz", "Peak 7: tip 0.0074 → 0.01 µm"]),
            (moved[1:], ["Peaks changed"]),
            ([{**peaks[0], "damping": 0.5}, *moved[1:]], ["Peaks changed"]),
        ):
            assert differences(one, one.replace({"vibration.peaks": others})) == words

    def test_change(self) -> None:
        assert change(20.0, 25.0) == "+25.0" and change(20.0, None) == change(0.0, 1.0) == "–"


class TestTable:
    def test_best_first(self, shared: Dashboard) -> None:
        rms_of = {s.observer: s.rms for s in shared.store.run.result.result.scores if (s.target, s.mode) == ("vibration", "tip")}
        groups = group_by_knowledge(sorted(rms_of, key=lambda name: rms_of[name]))
        assert order(shared, "vibration") == [name for of in groups.values() for name in of]
        html = shared.explore.table.pane.html.partition(">Vibration, tip")[2]
        places = [html.index(f">{title}<") for title in groups]
        assert places == sorted(places) and "Prior knowledge: none" in groups

    def test_marks(self, shared: Dashboard) -> None:
        html = shared.explore.table.pane.html
        assert html.count(">smallest<") == 3, "one causal observer per target and for both together, of one record"
        assert ">best<" not in html
        worse = [
            s
            for s in shared.store.run.result.result.scores
            if s.mode == "tip" and s.normalised_rms is not None and s.normalised_rms > 1
        ]
        assert html.count(">worse than zero<") == len(worse) > 0

    def test_real_time_factor(self, shared: Dashboard) -> None:
        score = next(s for s in shared.store.run.result.result.scores if s.observer == "gpr-online" and s.mode == "tip")
        shown = f"<td>{hundredths(1e6 * score.seconds_per_step)}</td><td>{hundredths(1e3 * score.seconds_per_step)}</td>"
        assert shown in shared.explore.table.pane.html


def test_cumulative_rms(shared: Dashboard) -> None:
    """At the lowest frequency it is the rms of what is shown, the mean aside."""
    shared.display.param.update(spectrum="cumulative", show="signal")
    shown, view = shared.store.run.result, shared.explore.spectra.spectra["vibration"]
    y = np.asarray(view.sources["kf-lgs"].data["y"])
    assert np.all(np.diff(y) <= 0)
    signal = shown.values("kf-lgs", "vibration")[500:, 0]
    assert y[0] == pytest.approx(1e3 * rms(signal), rel=0.15)
    assert view.figure.yaxis.axis_label == "cumulative rms, tip [nm]"
    shared.display.show = "error"
    error = signal - shown.values(TRUTH, "vibration")[500:, 0]
    assert np.asarray(view.sources["kf-lgs"].data["y"])[0] == pytest.approx(1e3 * rms(error), rel=0.15)
    assert view.figure.yaxis.axis_label == "cumulative rms of error, tip [nm]"
