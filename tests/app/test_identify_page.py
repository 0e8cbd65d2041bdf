"""The page of the identification: true to the core, beside the page, within limits; and what is done beside a run at all."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.display import per_micrometre
from wfsobs.app.jobs import DONE, FAILED, RUNNING
from wfsobs.app.limits import PUBLIC, Limits
from wfsobs.app.pages import identify as module
from wfsobs.app.pages.identify import EARLIER, IDENTIFIED, NEXT, IdentifyPage, same_content, seconds
from wfsobs.app.pages.pages import EXPLORE, IDENTIFY
from wfsobs.app.sources import LoadedRecord, SimulatedRecord
from wfsobs.app.style import LOOKS
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.identification import Identification, identify
from wfsobs.identification.identification import format_number, whiteness_lines
from wfsobs.identification.process import Number
from wfsobs.pipeline import observe
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.formats import format_of
from wfsobs.telemetry.records import read_record, record_arrays

LINE = 25.0
"""A pure line of 50 nm in tip [Hz]; the warm-up of the figures plays no part in it."""


@pytest.fixture
def short(short: Scenario) -> Scenario:
    """Turbulence, noise and one line."""
    peak = {"frequency": LINE, "damping": 0.0, "rms": [0.05, 0.0]}
    return short.replace({"vibration.source": "peaks", "vibration.peaks": [peak]})


@pytest.fixture
def page(dashboard: Dashboard, loop: Any) -> IdentifyPage:
    """The page, the record measured."""
    dashboard.pages.current = IDENTIFY
    page = dashboard.pages.by_name[IDENTIFY]
    assert isinstance(page, IdentifyPage)
    loop.until(lambda: page.of is not None)
    return page


def identified(page: IdentifyPage, loop: Any) -> Identification:
    """What the page found, once it has."""
    page.starter.start.param.trigger("clicks")
    assert page.work.state == RUNNING and not page.starter.cancel.disabled
    loop.until(lambda: page.work.state != RUNNING)
    assert page.work.state == DONE, page.work.message
    return page.work.result[0]


@pytest.mark.usefixtures("quick")
def test_it_shows_what_the_core_finds(page: IdentifyPage, dashboard: Dashboard, loop: Any) -> None:
    of = dashboard.store.run.result
    assert of is not None and page.of is not None and not len(page.figure.total.data["x"]) and page.starter.uses[0].disabled
    found, expected = identified(page, loop), identify(of.result.record)
    assert found.modes == expected.modes and not page.stale.visible
    for line in whiteness_lines(expected):
        assert line.replace("<", "&lt;") in page.verdict.html
    (line,) = (p for p in expected.modes[0].peaks if p.pure)
    assert line.frequency.value == pytest.approx(LINE, abs=0.1)
    noise = Number(*(1e3 * x for x in expected.modes[0].noise))
    for number in (line.frequency, noise, Number(*(1e3 * x for x in line.rms))):
        assert f"<td>{format_number(number).replace('+-', '±')}</td>" in page.table.html
    the_measured_spectrum_holds_the_variance(page)
    dashboard.display.param.update(unit="mas")
    scale = per_micrometre("mas", 8.0) ** 2
    total = page.figure.total.data
    np.testing.assert_allclose(total["y"], scale * expected.modes[0].spectrum.psd(np.asarray(total["x"])))
    np.testing.assert_allclose(total["y"], np.sum(page.figure.parts.data["ys"], axis=0), rtol=1e-9)
    the_line_stands_as_high_as_the_measured_spectrum(page)
    dashboard.display.param.update(mode="tilt", dark=True)
    assert not len(page.figure.spikes.data["x"]), "the line is in tip alone"
    assert "of z, tilt [mas²/Hz]" in page.figure.figure.yaxis.axis_label


def the_line_stands_as_high_as_the_measured_spectrum(page: IdentifyPage) -> None:
    """Up to what falls between two bins (0.9 dB of a taper that is nearly a rectangle: at most a factor 2.5) and noise."""
    spikes, known = page.figure.spikes.data, page.figure.measurement.data
    (at,) = np.asarray(spikes["x"])
    near = np.abs(np.asarray(known["x"]) - at) < 1.0
    ratio = np.asarray(known["highest"])[near].max() / np.asarray(spikes["high"])[0]
    assert 0.35 < ratio < 1.2
    assert np.all(np.asarray(known["highest"]) >= np.asarray(known["mean"]))


def the_measured_spectrum_holds_the_variance(page: IdentifyPage) -> None:
    """Parseval: the mean over all bins of the tapered z, in bins of the axis weighted with what is in each."""
    assert page.of is not None
    z = page.of.record.z[page.of.record.delay :, 0]
    duration = len(z) * page.of.record.dt
    count = np.round(np.diff(page.of.frequency, append=500.0) * duration)  # of narrow bins; wide ones are near enough
    total = np.sum(page.of.mean[:, 0] * np.maximum(count, 1.0)) / duration
    assert total == pytest.approx(np.var(z), rel=0.35)  # the taper leaves out the ends of slow turbulence


def rms(dashboard: Dashboard) -> dict[tuple[str, str, str], float]:
    shown = dashboard.store.run.result
    assert shown is not None
    return {(s.observer, s.target, s.mode): s.rms for s in shown.result.scores}


def test_filters_only(page: IdentifyPage, dashboard: Dashboard, loop: Any) -> None:
    """The record, its truth and its bound stay, and the observers run on it as they do on the same record from a file."""
    store, before = dashboard.store, dashboard.store.run.result
    assert before is not None
    told = identified(page, loop).scenario(store.scenario)
    page.starter.uses[0].param.trigger("clicks")
    assert store.scenario == told != before.scenario
    assert dashboard.upload.picker.source_title.startswith("The simulation with 1 peak is kept")
    loop.finish(store)
    shown = store.run.result
    assert shown is not None and shown.is_recorded and not store.stale and not page.stale.visible
    for name in ("y_lgs", "u", "turbulence", "vibration"):
        np.testing.assert_array_equal(getattr(shown.result.record, name), getattr(before.result.record, name))
    expected = {(s.observer, s.target, s.mode): s.rms for s in observe(before.result.record, told).scores}
    bounds = {key: value for key, value in rms(dashboard).items() if key[0] in BOUNDS}
    assert rms(dashboard) == expected | bounds
    assert bounds and bounds == {(s.observer, s.target, s.mode): s.rms for s in before.result.scores if s.observer in BOUNDS}
    store.change("kalman.ngs_between_frames", "propagate")  # other settings of the filters leave the record alone, too
    loop.finish(store)
    np.testing.assert_array_equal(store.run.result.result.record.y_lgs, before.result.record.y_lgs)
    store.undo()
    store.undo()
    assert (store.scenario, store.source) == (before.scenario, None) and dashboard.upload.picker.source_title == ""
    store.redo()
    assert store.scenario == told and isinstance(store.source, SimulatedRecord), "and not the simulation of the model"
    dashboard.upload.handle({"action": "simulate"})
    assert (store.scenario, store.source) == (before.scenario, None), "back to the simulation is back to its settings"
    page.starter.uses[0].param.trigger("clicks")
    store.choose("ut4")
    assert store.source is None, "a preset is a start"


@pytest.mark.usefixtures("quick")
def test_as_a_new_simulation(page: IdentifyPage, dashboard: Dashboard, loop: Any) -> None:
    before = dashboard.store.scenario
    expected = identified(page, loop).scenario(before)
    page.starter.uses[0].param.trigger("clicks")
    page.starter.uses[1].param.trigger("clicks")
    assert dashboard.store.scenario == expected != before and dashboard.store.source is None
    loop.finish(dashboard.store)
    loop.until(lambda: page.stale.visible)  # the simulation of the model is another record
    assert "A simulation of the model has replaced the record" in page.stale.object
    dashboard.store.change("run.seed", 99)
    loop.finish(dashboard.store)
    loop.until(lambda: page.stale.object == EARLIER)
    dashboard.store.undo()
    dashboard.store.undo()
    loop.finish(dashboard.store)
    assert isinstance(dashboard.store.source, SimulatedRecord)
    dashboard.store.undo()
    assert dashboard.store.scenario == before
    loop.finish(dashboard.store)
    loop.until(lambda: not page.stale.visible)
    dashboard.store.change("kalman.vibration_rms", 0.2)
    loop.finish(dashboard.store)
    shown = dashboard.store.run.result
    loop.until(lambda: page.of is not None and shown is not None and page.of.record is shown.result.record)
    assert not page.stale.visible, "an observer's setting is not the record's"


def load_record(dashboard: Dashboard, loop: Any, scenario: Scenario) -> Record:
    """Load the record of a night, whose truth nobody knows."""
    file = io.BytesIO()
    record = simulate(scenario.replace({"run.seed": 9}))
    format_of(".npz").write(file, record_arrays(replace(record, turbulence=None, vibration=None)))
    file.seek(0)
    dashboard.store.run_on(LoadedRecord(loaded := read_record(file, "night.npz"), "night.npz", "key"), dashboard.store.scenario)
    loop.finish(dashboard.store)
    return loaded


@pytest.mark.usefixtures("quick")
def test_the_first_suggestion_for_a_loaded_record(dashboard: Dashboard, loop: Any, short: Scenario) -> None:
    """One button identifies it, has the observers use the model, and says so; undo brings the suggestion back."""
    it = dashboard.pages.suggestion
    assert not it.view.visible, "of a simulation the settings are known"
    load_record(dashboard, loop, short)
    assert it.view.visible and it.button.visible and NEXT in it.words.html
    before = dashboard.store.run.result
    it.button.param.trigger("clicks")
    assert it.button.disabled and "Identifying" in it.words.html
    loop.until(lambda: IDENTIFIED in it.words.html)
    loop.finish(dashboard.store)
    assert not it.button.visible and dashboard.pages.current == EXPLORE
    (peak,) = dashboard.store.scenario.vibration.peaks
    assert peak.frequency == pytest.approx(LINE, abs=0.2)
    after = dashboard.store.run.result
    assert before is not None and after is not None and after.result.record is before.result.record
    sentence = re.sub("<.*?>", "", dashboard.explore.verdicts["turbulence"].html())
    assert "next measurement" in sentence.lower() and "peak" in sentence
    dashboard.store.undo()
    assert it.button.visible and NEXT in it.words.html


@pytest.mark.usefixtures("quick")
def test_a_loaded_record_stays(page: IdentifyPage, dashboard: Dashboard, loop: Any, short: Scenario) -> None:
    loaded = load_record(dashboard, loop, short)
    identified(page, loop)
    page.starter.uses[0].param.trigger("clicks")
    loop.finish(dashboard.store)
    shown = dashboard.store.run.result
    assert shown is not None and shown.is_recorded and shown.result.record is loaded
    assert shown.scenario.kalman.process_noise == "matched" and not page.stale.visible
    it = dashboard.pages.suggestion
    assert IDENTIFIED in it.words.html and not it.button.visible, "nor is it suggested again"


@pytest.mark.usefixtures("quick")
def test_what_cannot_be_done_is_said_in_one_line(page: IdentifyPage, loop: Any) -> None:
    for level, lowest, reason in (
        ("2", "5", "Level = '2': takes a number from 1e-09 to 0.5"),
        ("0.04", "soon", "Lowest peak [Hz] = 'soon': takes a number from 0.001 to 10000"),
        ("0.04", "300", "lowest peak frequency = 300 Hz: must be below a quarter of the rate, 250 Hz"),
    ):
        page.level.value, page.lowest.value = level, lowest
        page.starter.begin()
        loop.until(lambda: page.work.state != RUNNING)
        assert (page.work.state, page.starter.status.note) == (FAILED, reason)
        assert page.starter.uses[0].disabled


@pytest.mark.usefixtures("quick")
def test_limits_of_a_public_server(loop: Any, short: Scenario, enter: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the estimate, and by the time that it takes after all."""
    dashboard = Dashboard(loop.queue.put, enter(limits=Limits(seconds=5.0)), short)
    loop.closing.append(dashboard)
    dashboard.page()
    dashboard.start()
    loop.finish(dashboard.store)
    page = IdentifyPage(dashboard.store, dashboard.display)
    shown = dashboard.store.run.result
    assert shown is not None
    dashboard.store.limits = Limits(seconds=0.1)
    page.starter.begin()
    assert page.work.message == "The identification would take about 0 s, at most 0.1 on this server"
    monkeypatch.setattr(module, "seconds", lambda record: 0.0)
    dashboard.store.limits = Limits(seconds=1e-6)
    page.starter.begin()
    loop.until(lambda: page.work.state != RUNNING)
    assert page.work.message == "It took more than 1e-06 s, which is what this server allows"
    longest = Record(np.zeros((120_000, 2)), np.zeros((120_000, 2)), shown.result.record.dt)
    PUBLIC.job("identify", "identification", lambda _watch, _tell: None, seconds(longest))


@pytest.mark.usefixtures("quick")
def test_it_comes_back_as_the_switches_are_by_then(page: IdentifyPage, dashboard: Dashboard) -> None:
    """Theme, mode and unit may be changed while another page is shown."""
    dashboard.pages.current = EXPLORE
    dashboard.display.param.update(dark=True, mode="tilt", unit="mas")
    dashboard.pages.current = IDENTIFY
    line = page.figure.figure.renderers[1]
    assert line.glyph.line_color == LOOKS["measured"].dark and LOOKS["measured"].dark in page.legend.html
    assert page.figure.figure.yaxis.axis_label == "PSD of z, tilt [mas²/Hz]"


def test_same_records(short: Scenario) -> None:
    record = simulate(short)
    y = record.y_lgs.copy()
    y[3] = np.nan
    lost = replace(record, y_lgs=y)
    assert same_content(lost, replace(lost, y_lgs=y.copy())) and same_content(record, record)
    for other in (lost, replace(record, delay=3), replace(record, dt=2e-3), replace(record, y_lgs=2.0 * y)):
        assert not same_content(record, other)
