"""The pages beside the first: made when opened, true to the results, at rest while hidden."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import panel as pn
import pytest

from wfsobs import Record, observe
from wfsobs.app.dashboard import Dashboard
from wfsobs.app.pages import figures as figures_page
from wfsobs.app.pages.figures import Figures
from wfsobs.app.pages.pages import AWAY, EXPLORE, FIGURES, MODEL
from wfsobs.app.pages.parts import example
from wfsobs.app.render import matrix, short, tex
from wfsobs.app.style import look
from wfsobs.app.work import TRUTH, RunResults
from wfsobs.evaluation.description import describe
from wfsobs.plot.paper import PSD_TOP_HZ
from wfsobs.scenario import Scenario


def opened(dashboard: Dashboard, name: str) -> Any:
    dashboard.pages.current = name
    return dashboard.pages.by_name[name]


class Checker(HTMLParser):
    """Fails where tags do not nest."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.words = ""

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_startendtag(self, tag: str, attrs: Any) -> None:
        pass

    def handle_data(self, data: str) -> None:
        self.words += data


def words(html: str) -> str:
    checker = Checker()
    checker.feed(html)
    assert checker.open == []
    return checker.words


def seen(dashboard: Dashboard) -> list[str]:
    return [name for name, room in dashboard.pages.rooms.items() if room.styles != AWAY]


class TestPages:
    def test_nothing_is_made_before_it_is_opened(self, dashboard: Dashboard) -> None:
        assert list(dashboard.pages.by_name) == [EXPLORE]
        assert seen(dashboard) == [EXPLORE]

    def test_turning(self, dashboard: Dashboard) -> None:
        first = opened(dashboard, FIGURES)
        assert seen(dashboard) == [FIGURES]
        assert not dashboard.pages.rooms[MODEL].objects
        dashboard.pages.current = EXPLORE
        assert seen(dashboard) == [EXPLORE]
        assert opened(dashboard, FIGURES) is first

    @pytest.mark.usefixtures("quick")
    def test_a_hidden_page_rests(self, dashboard: Dashboard, loop: Any) -> None:
        figures, equations = opened(dashboard, FIGURES), opened(dashboard, MODEL)
        assert not figures.visible and equations.visible
        data, html = figures.sheets[2].plots[0].sources[TRUTH].data, equations.pane.html
        dashboard.pages.current = EXPLORE
        dashboard.store.change("turbulence.wind_speed", 30)
        loop.finish(dashboard.store)
        assert figures.sheets[2].plots[0].sources[TRUTH].data is data and equations.pane.html == html
        assert opened(dashboard, MODEL).pane.html != html
        assert not np.array_equal(opened(dashboard, FIGURES).sheets[2].plots[0].sources[TRUTH].data["y"], data["y"])


class TestFigures:
    @pytest.fixture
    def figures(self, shared: Dashboard) -> Figures:
        return opened(shared, FIGURES)

    def test_every_line_has_data(self, figures: Figures) -> None:
        plots = [plot for sheet in figures.sheets for plot in sheet.plots]
        assert len(plots) == 2 + 2 + 2 + 3
        for plot in plots:
            for source in plot.sources.values():
                y = np.asarray(source.data["y"])
                assert y.size > 50 and np.isfinite(y).mean() > 0.9 and len(source.data["x"]) == y.size

    def test_values(self, figures: Figures, shared: Dashboard) -> None:
        shown = shared.store.run.result
        turbulence = figures.sheets[2]
        tilt = np.asarray(turbulence.plots[1].sources["multirate"].data["y"])
        assert np.nanmax(tilt) == pytest.approx(1e3 * shown.values("multirate", "turbulence")[500:, 1].max(), rel=1e-6)
        zoomed = figures.sheets[0].plots[1].sources["butterworth-ol"].data
        first = round(zoomed["x"][0] / 1e-3)
        values = shown.values("butterworth-ol", "vibration")[first : first + len(zoomed["x"]), 0]
        assert np.allclose(zoomed["y"], 1e3 * values, rtol=1e-5)
        psd = figures.sheets[3].plots[2].sources["gpr-online"].data
        assert psd["x"][-1] <= PSD_TOP_HZ
        n = len(psd["x"])
        assert np.allclose(psd["y"], 1e6 * shown.spectra["gpr-online", "vibration"].signal[1 : n + 1, 0])

    def test_colours_and_captions(self, figures: Figures, shared: Dashboard) -> None:
        for sheet in figures.sheets:
            for plot in sheet.plots:
                assert {n: line.renderer.glyph.line_color for n, line in plot.lines.items()} == {
                    n: look(n).light for n in plot.lines
                }
        heads = [words(sheet.head.html) for sheet in figures.sheets]
        assert [head.split(" of the paper")[0] for head in heads] == ["Figure 4a", "Figure 4b", "Figure 5", "Figure 6"]
        captions = [words(sheet.caption.html) for sheet in figures.sheets]
        assert "RMS error of tilt [nm]: LGS KF" in captions[2]
        assert re.search(r"LGS KF [\d.]+ \(paper 16\.6\)", captions[3]), "beside the one of the run, in its unit"
        shared.display.param.update(unit="mas", dark=True)
        # an rms coefficient of 16.6 nm is a slope of four times that over 8 m, 8.3 nrad
        assert f"(paper {8.3e-9 * np.degrees(1.0) * 3.6e6:.2f})" in words(figures.sheets[3].caption.html)
        assert figures.sheets[0].plots[0].figure.yaxis.axis_label == "tip [mas]"
        assert figures.sheets[0].plots[0].lines[TRUTH].renderer.glyph.line_color == look(TRUTH).dark

    @pytest.mark.usefixtures("quick")
    def test_without_a_vibration(self, dashboard: Dashboard, loop: Any) -> None:
        opened(dashboard, FIGURES)
        dashboard.store.change("vibration.source", "none")
        loop.finish(dashboard.store)
        assert dashboard.store.run.state == "done"

    def test_of_one_mode(self, dashboard: Dashboard) -> None:
        figures = opened(dashboard, FIGURES)
        record = dashboard.store.run.result.result.record
        tip = Record(y_lgs=record.y_lgs[:, :1], u=record.u[:, :1], dt=record.dt)
        result = RunResults(observe(tip, dashboard.store.scenario, observers=["kf-lgs"]))
        for sheet in figures.sheets:
            sheet.draw(result, dashboard.display)
        assert [plot.figure.visible for plot in figures.sheets[2].plots] == [True, False]


class TestModel:
    def test_the_numbers_are_there(self, shared: Dashboard) -> None:
        page = opened(shared, MODEL)
        told = describe(shared.store.scenario, 0)
        text = words(page.pane.html)
        for number in (told.turbulence.a1, -told.turbulence.a2):
            assert short(number, 7) in text
        assert short(told.filters["kf-lgs"].gains["LGS"][0]) in text
        for facts in told.filters.values():
            assert f"Radius {short(facts.radius or 0.0, 6)}" in text
        assert short(told.gprs["gpr-offline"].ridge) in text and "mode tip" in text
        for facts in told.sensors.values():
            assert short(facts.noise) in text and short(facts.aliasing) in text

    @pytest.mark.usefixtures("quick")
    def test_it_follows_settings_and_mode(self, dashboard: Dashboard) -> None:
        page = opened(dashboard, MODEL)
        dashboard.store.change("turbulence.wind_speed", 30)
        assert short(describe(dashboard.store.scenario, 0).turbulence.a1, 7) in words(page.pane.html)
        dashboard.display.mode = "tilt"
        assert "mode tilt" in words(page.pane.html)

    def test_an_unstable_cycle_says_why(self) -> None:
        told = describe(
            Scenario().replace(
                {
                    "kalman.process_noise": "manual",
                    "kalman.vibration_rms": 0.06,
                    "multirate.measurement_noise": "manual",
                    "multirate.lgs_noise": 0.04,
                    "multirate.ngs_noise": 0.001,
                }
            ),
            0,
        )
        assert "is unstable" in words(figures_page.model_html(told, dark=False))

    def test_nothing_is_fetched(self) -> None:
        html = figures_page.model_html(describe(Scenario(), 0), dark=True)
        assert "http" not in html and "src=" not in html

    def test_no_font_for_mathematics_is_needed(self) -> None:
        """Without one no sign grows with what it encloses, roots are cut off and hats stand beside their letter."""
        html = figures_page.model_html(describe(Scenario(), 0), dark=False)
        assert html.count("<math") > 20 and "<mi>x\u0302</mi>" in html and "<mi>φ\u0302</mi>" in html
        assert 'stretchy="true"' not in html and "<msqrt" not in html and "<mover" not in html

    def test_formulas(self) -> None:
        assert "<msub><mi>a</mi><mn>1</mn></msub>" in tex("a_1") and 'display="block"' in tex("a_1")
        rows = re.findall("<mtr>(.*?)</mtr>", tex(matrix([[1.0, -0.5], [2.0, 0.25]])))
        assert [re.findall("<mtd>(.*?)</mtd>", row) for row in rows] == [
            ["<mn>1</mn>", "<mo>&#x02212;</mo><mn>0.5</mn>"],
            ["<mn>2</mn>", "<mn>0.25</mn>"],
        ]

    @pytest.mark.parametrize(("x", "text"), [(0.5, "0.5"), (-1.0, "−1"), (0.0, "0"), (100.0, "100"), (2e-7, "2.0000e-07")])
    def test_short(self, x: float, text: str) -> None:
        assert short(x) == text


@pytest.mark.usefixtures("quick")
def test_the_first_page_rests_while_another_shows(dashboard: Dashboard, loop: Any) -> None:
    line = dashboard.explore.traces.traces["turbulence"].source
    spectrum = dashboard.explore.spectra.spectra["turbulence"].sources["kf-lgs"]
    before = dict(line.data), dict(spectrum.data)
    opened(dashboard, MODEL)
    dashboard.store.change("turbulence.wind_speed", 30)
    loop.finish(dashboard.store)
    assert line.data["truth"] is before[0]["truth"] and spectrum.data["y"] is before[1]["y"]
    dashboard.pages.current = EXPLORE
    assert not np.array_equal(np.asarray(line.data["truth"]), np.asarray(before[0]["truth"]))
    assert not np.array_equal(np.asarray(spectrum.data["y"]), np.asarray(before[1]["y"]))


@pytest.mark.parametrize("name", ["tune", "sweep", "live"])
def test_an_example_stands_where_there_are_no_results_yet(name: str) -> None:
    results = pn.Column(visible=False)
    pane = example(name, results)
    assert pane.visible and "Example: " in words(pane.html)
    results.visible = True
    assert not pane.visible and not example(name, results).visible
