"""The page of the tuning: true to the core, beside the page, within limits."""

from __future__ import annotations

import re
from dataclasses import replace
from math import inf
from typing import Any

import numpy as np
import pytest

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.jobs import CANCELLED, DONE, FAILED, RUNNING
from wfsobs.app.limits import Limits
from wfsobs.app.pages.pages import TUNE
from wfsobs.app.pages.parts import Starter
from wfsobs.app.pages.tune import TunePage, choices, seconds, unit_for
from wfsobs.app.render import number
from wfsobs.app.service import BackgroundTask
from wfsobs.app.sources import LoadedRecord
from wfsobs.observers import OBSERVERS
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import changed_settings
from wfsobs.scenario.names import setting_label
from wfsobs.simulation.loop import simulate
from wfsobs.tuning import Evaluation, TuningResult, tune
from wfsobs.tuning.trials import Errors
from wfsobs.tuning.tuning import best_so_far


@pytest.fixture
def page(dashboard: Dashboard) -> TunePage:
    dashboard.pages.current = TUNE
    page = dashboard.pages.by_name[TUNE]
    assert isinstance(page, TunePage)
    page.observer.value, page.evaluations.value = "kf-lgs", "8"
    return page


def tuned(page: TunePage, loop: Any) -> TuningResult:
    """What the page came to, once it has."""
    page.starter.start.param.trigger("clicks")
    assert page.work.state == RUNNING and page.starter.uses[0].disabled
    loop.until(lambda: page.work.state != RUNNING)
    assert page.work.state == DONE, page.work.message
    return page.work.result


def row(table: str, section: str, name: str) -> list[str]:
    """The cells of a row of the table."""
    pattern = rf'<tr data-section="{section}"><th scope=row>(?:<b>)?{re.escape(name)}(?:</b>)?</th>(.*?)</tr>'
    (found,) = re.findall(pattern, table)
    return re.findall("<td[^>]*>(.*?)</td>", found)


@pytest.mark.usefixtures("quick")
def test_it_shows_what_the_core_finds(page: TunePage, dashboard: Dashboard, loop: Any) -> None:
    expected = tune(dashboard.store.scenario, "kf-lgs", evaluations=8, target="vibration")
    found = tuned(page, loop)
    assert found.history == expected.history and found.scenario == expected.scenario != expected.before.scenario
    (before, after), table = (expected.before, expected.after), page.table.html
    for section, errors in (("validation", [s.validation for s in (before, after)]), ("test", [s.test for s in (before, after)])):
        one, other = errors
        assert one and other
        for name, a, b in (("tip", one.modes["tip"], other.modes["tip"]), ("rms over modes", one.rms, other.rms)):
            cells = row(table, section, name)
            assert cells[:2] == [number(1e3 * a, 4), number(1e3 * b, 4)]
            assert float(cells[2].replace("−", "-")) == pytest.approx(100 * (b / a - 1), abs=0.051)
    assert before.other and after.other
    assert row(table, "other target", "rms over modes")[:2] == [number(1e3 * s.rms, 4) for s in (before.other, after.other)]
    for path, value in changed_settings(expected.scenario, before.scenario).items():
        text = f"{value:.6g}" if isinstance(value, float) else str(value)
        assert row(table, "setting", setting_label(expected.scenario, path))[1] == text
    assert "likelihood" not in table, "it is no GPR"
    data = page.figure.source.data
    np.testing.assert_allclose(data["tried"], [1e3 * e.rms for e in expected.history])
    np.testing.assert_allclose(data["best"], np.minimum.accumulate(data["tried"]))
    using_it_leaves_the_other_settings(page, dashboard, found)


def using_it_leaves_the_other_settings(page: TunePage, dashboard: Dashboard, found: TuningResult) -> None:
    store = dashboard.store
    assert not page.stale.visible
    store.change("run.seed", 5)
    assert page.stale.visible
    page.starter.uses[0].param.trigger("clicks")
    expected = found.before.scenario.replace({"run.seed": 5, **changed_settings(found.scenario, found.before.scenario)})
    assert store.scenario == expected
    store.undo()
    store.undo()
    assert store.scenario == found.before.scenario and not page.stale.visible


def test_a_gpr_and_its_likelihood(page: TunePage, dashboard: Dashboard, loop: Any) -> None:
    page.observer.value, page.evaluations.value = "gpr-offline", "3"
    assert page.target.options == ["vibration"] and "Offline GPR: Noise" in page.search_space.html
    found = tuned(page, loop)
    assert found.before.likelihood and found.after.likelihood
    cells = row(page.table.html, "likelihood", "tilt")
    assert cells == [number(found.before.likelihood[1], 4), number(found.after.likelihood[1], 4), ""]
    dashboard.display.unit = "mas"
    assert "test record, not used in the search [mas]" in page.table.html
    focus = Errors({"tip": 0.01, "defocus": 0.01})
    assert unit_for(replace(found, before=replace(found.before, validation=focus)), dashboard.display) == "nm", "it has no angle"
    assert unit_for(found, dashboard.display) == unit_for(None, dashboard.display) == "mas"


@pytest.mark.usefixtures("quick")
def test_a_loaded_record_is_cut(page: TunePage, dashboard: Dashboard, loop: Any, short: Scenario) -> None:
    record = replace(simulate(short.replace({"run.duration": 9.0, "run.seed": 4})), turbulence=None, vibration=None)
    dashboard.store.run_on(LoadedRecord(record, "night.npz", "key"), dashboard.store.scenario.replace({"run.duration": 9.0}))
    loop.finish(dashboard.store)
    found = tuned(page, loop)
    assert "RMS one-step prediction error of z on the validation record" in page.table.html
    assert page.figure.figure.yaxis.axis_label == "prediction error, validation [nm]" and "RMS error" not in page.table.html
    again = tune(dashboard.store.scenario, "kf-lgs", evaluations=8, record=record)
    assert found.target == "next z" and found.history == again.history


def test_progress_cancel_and_errors(page: TunePage, dashboard: Dashboard, loop: Any) -> None:
    page.evaluations.value = "0"
    page.starter.begin()
    assert (page.work.state, page.starter.status.note) == (FAILED, "Evaluations = '0': takes a whole number from 1 to 1000")
    page.evaluations.value = "1000"
    page.observer.value = "gpr-online"
    page.starter.begin()
    loop.until(lambda: page.work.latest is not None)
    assert re.fullmatch(r"Computing, \d+ % · \d+ evaluations, best [\d.]+ nm, [\d.]+ nm before", page.starter.status.text)
    page.starter.cancel.param.trigger("clicks")
    assert page.work.state == CANCELLED and page.starter.uses[0].disabled and len(page.figure.source.data["x"]) > 0
    dashboard.store.limits = Limits(seconds=0.01)
    page.starter.begin()
    shown = dashboard.store.run.result
    assert shown is not None
    estimate = seconds(shown, dashboard.store.scenario, "gpr-online", 1000)
    assert page.work.message == f"The tuning would take about {estimate:.0f} s, at most 0.01 on this server" and estimate > 1.0


def test_only_what_is_done_can_be_used(dashboard: Dashboard) -> None:
    """The result may be that of an earlier work."""
    for state, disabled in [(FAILED, True), (CANCELLED, True), (RUNNING, True), (DONE, False)]:
        work = BackgroundTask(dashboard.store.session)
        starter = Starter(work, lambda: None, "Start", "Progress", uses={"Use it": lambda: None})
        work.param.update(state=state, result=1)
        assert starter.uses[0].disabled == disabled, state


def test_the_least_so_far() -> None:
    errors = (Evaluation({}, None), *(Evaluation({}, Errors({"tip": x})) for x in (3.0, 5.0, 2.0)), Evaluation({}, None))
    assert best_so_far(errors) == [inf, 3.0, 3.0, 2.0, 2.0]
    assert set(OBSERVERS) - set(choices().values()) == {"persistence", "zero"}, "they have nothing to tune"
