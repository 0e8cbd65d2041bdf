"""Every widget: generated from the settings, in step with the store, its refusals beside it."""

from __future__ import annotations

from typing import Any

import numpy as np
import param
import pytest

from wfsobs.app.controls.fields import RowEditor, SliderField, parse_number
from wfsobs.app.controls.panel import AT_HAND, Controls, status_of
from wfsobs.app.display import label_of
from wfsobs.app.work import RunResults
from wfsobs.evaluation.result import Result
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.names import setting_name
from wfsobs.scenario.presets import PRESETS
from wfsobs.units import unit_text

PATH = "vibration.peaks"


def nothing(scenario: Scenario, *_: object) -> RunResults:
    """An empty result, at once."""
    record = Record(y_lgs=np.zeros((8, 2)), u=np.zeros((8, 2)), dt=1e-3)
    return RunResults(Result(scenario, record, (), ()))


@pytest.fixture
def controls(make_store: Any, loop: Any) -> Controls:
    """The drawer over a store whose first run is done."""
    store = make_store(nothing)
    controls = Controls(store)
    controls.view()
    store.start()
    loop.finish(store)
    return controls


def open_all(controls: Controls) -> None:
    for name in controls.topics:
        controls.topic_list.open(name)


def field_of(controls: Controls, path: str) -> Any:
    """The field of a setting, its topic opened."""
    controls.open_topic(path.partition(".")[0])
    return controls.fields[path]


def release(slider: Any, value: float) -> None:
    """What the browser sends when a slider is let go."""
    with param.edit_constant(slider):
        slider.param.update(value=value, value_throttled=value)


def test_a_slider_moved_on_is_not_called_back(controls: Controls) -> None:
    """The browser's messages come in batches: where the slider stands now, and where it was let go before."""
    field = field_of(controls, "turbulence.wind_speed")
    slider = field.widgets[0]
    with param.edit_constant(slider):
        slider.param.update(value=16.0, value_throttled=15.5)
    assert controls.store.scenario.turbulence.wind_speed == 15.5 and slider.value == 16.0
    assert field.widgets[-1].value == "15.5"
    controls.store.undo()
    assert slider.value == slider.value_throttled == 15.0
    release(slider, 15.5)
    assert controls.store.scenario.turbulence.wind_speed == 15.5


def error_of(controls: Controls, path: str) -> str:
    return "".join(pane.html for pane in controls.fields[path].view[1:])


def test_every_setting_has_one_field(controls: Controls) -> None:
    open_all(controls)
    lists = [path for path, _ in controls.store.scenario.lists()]
    settings = [path for path, _, _ in controls.store.scenario.walk() if not any(path.startswith(f"{at}.") for at in lists)]
    assert sorted(controls.fields) == sorted([*settings, *lists])
    assert sorted(lists) == ["events", "turbulence.layers", "turbulence.processes", PATH]
    for path in lists:
        assert len(controls.fields[path].table.rows) == len(controls.store.value(path))


def test_labels_come_from_the_settings(controls: Controls) -> None:
    field = field_of(controls, "turbulence.wind_speed")
    assert label_of(field.parameter) == "Wind speed V₀ [m/s]" == field.widgets[0].label
    assert field.widgets[0].description == field.parameter.doc
    assert label_of(field_of(controls, "sensors.lgs_noise").parameter) == "LGS noise [µm]"
    assert unit_text("um^2/Hz") == "µm²/Hz"


def test_what_matters_most_stands_first(controls: Controls) -> None:
    first = ("turbulence.wind_speed", "sensors.exposure_ratio")
    assert AT_HAND == (*first, *(f"gpr_online.{name}" for name in ("length_scale", "signal_std", "training_size")), PATH)
    assert set(AT_HAND) <= controls.fields.keys(), "made with the drawer"
    assert list(controls.topics)[:3] == ["vibration", "gpr_offline", "gpr_online"]


def test_topics_are_filled_when_opened(controls: Controls) -> None:
    assert "loop.gain" not in controls.fields
    controls.topic_list.open("loop")
    assert "loop.gain" in controls.fields


def test_a_slider_that_is_let_go_runs(controls: Controls, loop: Any) -> None:
    before = controls.store.run.result
    field = field_of(controls, "turbulence.wind_speed")
    release(field.widgets[0], 22.0)
    assert controls.store.scenario.turbulence.wind_speed == 22.0
    assert field.widgets[1].value == "22", "the typed number follows"
    loop.finish(controls.store)
    assert controls.store.run.result is not before
    assert controls.store.run.result.scenario.turbulence.wind_speed == 22.0


def test_a_slider_over_decades_is_logarithmic(controls: Controls) -> None:
    open_all(controls)
    wide = {
        path: softbounds
        for path, field in controls.fields.items()
        if isinstance(field, SliderField)
        and (softbounds := field.parameter.softbounds)[0] > 0
        and softbounds[1] / softbounds[0] >= 1e3
    }
    assert {"gpr_online.length_scale", "gpr_online.signal_std", "gpr_offline.length_scale"} <= wide.keys()
    for path, (low, high) in wide.items():
        slider = controls.fields[path].widgets[0]
        assert slider.start == pytest.approx(np.log10(low)) and slider.end >= np.log10(high) and slider.step == 0.01
    assert not controls.fields["turbulence.wind_speed"].is_log


def test_a_logarithmic_slider_keeps_typed_values(controls: Controls) -> None:
    store, (slider, box) = controls.store, field_of(controls, "gpr_online.length_scale").widgets
    release(slider, 2.0)
    assert store.scenario.gpr_online.length_scale == 100.0 and box.value == "100"
    release(slider, np.log10(2.0))
    assert store.scenario.gpr_online.length_scale == 2.0, "a value of three digits, not a power of ten"
    box.value = "123.4567"
    assert store.scenario.gpr_online.length_scale == 123.4567 and slider.value == np.log10(123.4567)
    store.undo()
    assert store.scenario.gpr_online.length_scale == 2.0 and slider.value == slider.value_throttled == np.log10(2.0)
    controls.take({"setting": "gpr_online.length_scale", "value": 1.5})  # where it stood while the server was away
    assert store.scenario.gpr_online.length_scale == 31.6


def test_a_slider_under_way_does_not_run(controls: Controls) -> None:
    field_of(controls, "turbulence.wind_speed").widgets[0].value = 22.0
    assert controls.store.scenario.turbulence.wind_speed == 15.0


def test_a_slider_let_go_where_it_once_was_runs(controls: Controls, loop: Any) -> None:
    slider = field_of(controls, "turbulence.wind_speed").widgets[0]
    release(slider, 22.0)
    controls.store.change("turbulence.wind_speed", 15)
    release(slider, 22.0)
    assert controls.store.scenario.turbulence.wind_speed == 22.0
    loop.finish(controls.store)


def test_a_whole_number_stays_whole(controls: Controls, loop: Any) -> None:
    release(field_of(controls, "sensors.exposure_ratio").widgets[0], 8)
    assert controls.store.scenario.sensors.exposure_ratio == 8
    loop.finish(controls.store)


def test_a_typed_value_runs(controls: Controls, loop: Any, subtests: pytest.Subtests) -> None:
    cases: list[tuple[str, str, Any]] = [
        ("turbulence.wind_speed", "12.5", 12.5),
        ("run.seed", " 7 ", 7),
        ("gpr_online.noise_std", "1e-2", 0.01),
        ("butterworth.frequencies", "20, 30; 40", [20.0, 30.0, 40.0]),
        ("telescope.diameter", "39", 39.0),
    ]
    for path, text, value in cases:
        with subtests.test(path):
            field_of(controls, path).widgets[-1].value = text
            assert controls.store.value(path) == value and error_of(controls, path) == ""
            loop.finish(controls.store)
            assert controls.store.run.result.scenario == controls.store.scenario


def test_a_bad_value_shows_beside_its_setting(controls: Controls, subtests: pytest.Subtests) -> None:
    shown, scenario = controls.store.run.result, controls.store.scenario
    for path, text, says in [
        ("turbulence.wind_speed", "200", "Wind speed V₀ = 200: takes a number from 0.1 to 100 m/s"),
        ("turbulence.wind_speed", "15,5", "use a point: 15.5"),
        ("turbulence.wind_speed", "fast", "a number"),
        ("turbulence.wind_speed", "", "a number"),
        ("run.seed", "1.5", "a whole number"),
        ("gpr_online.length_scale", "nan", "0.1"),
        ("butterworth.frequencies", "20, x", "a list of"),
        ("kalman.frequency", "900", "half the LGS rate"),
        ("run.warm_up", "3", "Duration"),
    ]:
        with subtests.test(path, text=text):
            field = field_of(controls, path)
            good, field.widgets[-1].value = field.widgets[-1].value, text
            assert says in error_of(controls, path)
            assert field.widgets[-1].error_state and field.widgets[-1].value == text, "what was typed stays, to be corrected"
            assert controls.store.run.result is shown and controls.store.scenario is scenario
            assert status_of(controls.store)[2] == f"Not accepted: {setting_name(path)}" == controls.status.note
            field.widgets[-1].value = good
            assert error_of(controls, path) == ""


def test_what_is_being_typed_stays_when_another_setting_changes(controls: Controls) -> None:
    box = field_of(controls, "turbulence.wind_speed").widgets[-1]
    box.value_input = "2"  # on the way to 20
    controls.store.change("run.seed", 5)
    assert box.value_input == "2"
    controls.store.change("turbulence.wind_speed", 30)
    assert box.value == box.value_input == "30"


def test_correcting_a_bad_value_clears_the_message(controls: Controls, loop: Any) -> None:
    path = "turbulence.wind_speed"
    text = field_of(controls, path).widgets[-1]
    text.value = "200"
    text.value = "20"
    assert error_of(controls, path) == "" and not text.error_state
    text.value = "200"
    text.value = "20"
    assert error_of(controls, path) == "" and not text.error_state, "back to the value that stands"
    loop.finish(controls.store)


def test_a_slider_grows_to_hold_a_typed_value(controls: Controls, loop: Any) -> None:
    field = field_of(controls, "turbulence.wind_speed")
    field.widgets[-1].value = "80"
    assert field.widgets[0].end == 80.0 and field.widgets[0].value == 80.0
    controls.store.change("turbulence.wind_speed", 10)
    assert field.widgets[0].end == 40.0
    loop.finish(controls.store)


def test_a_long_number_fits_its_box(controls: Controls) -> None:
    """A box beside a slider has room for seven characters; what is kept has all digits."""
    slider, box = field_of(controls, "turbulence.wind_speed").widgets
    controls.store.change("turbulence.wind_speed", 18.475123456)
    assert (box.value, slider.value) == ("18.4751", 18.475123456)
    box.param.trigger("value")
    assert controls.store.value("turbulence.wind_speed") == 18.475123456


def test_choices_and_switches_run(controls: Controls, loop: Any) -> None:
    field_of(controls, "kalman.process_noise").widgets[0].value = "matched"
    field_of(controls, "loop.closed").widgets[0].value = False
    assert controls.store.scenario.kalman.process_noise == "matched"
    assert controls.store.scenario.loop.closed is False
    loop.finish(controls.store)
    assert controls.store.run.result.scenario.loop.closed is False


def test_every_widget_follows_the_store(controls: Controls, loop: Any) -> None:
    open_all(controls)
    controls.store.load(PRESETS["ut4"]().replace({"run.duration": 2.0, "run.warm_up": 0.5, "loop.closed": False}))
    controls.store.run.cancel()
    for path, field in controls.fields.items():
        if isinstance(field, RowEditor):
            continue
        value = controls.store.value(path)
        for widget in field.widgets:
            expected = field.to_text(value) if widget is field.widgets[-1] and hasattr(field, "to_text") else value
            if widget is field.widgets[0] and getattr(field, "is_log", False):
                expected = np.log10(value)
            assert widget.value == expected, path
    for field in controls.fields.values():
        if isinstance(field, SliderField):
            assert field.widgets[0].value_throttled == field.widgets[0].value


def test_choosing_a_preset(controls: Controls) -> None:
    controls.preset.value = "ut4"
    assert controls.store.scenario == PRESETS["ut4"]() and controls.store.run.state == "running"
    assert controls.reset.disabled and "measured at VLT UT4" in controls.preset.helper_text == controls.preset.description
    controls.store.change("loop.gain", 0.1)
    assert setting_name("loop.gain") in controls.preset.helper_text and not controls.reset.disabled
    controls.reset.clicks += 1
    assert controls.store.scenario == PRESETS["ut4"]()
    controls.store.run.cancel()


def test_run_and_cancel(controls: Controls, loop: Any) -> None:
    assert controls.cancel.disabled and "Done" in controls.status.text
    controls.run.clicks += 1
    assert not controls.cancel.disabled and "Running" in controls.status.text
    controls.cancel.clicks += 1
    assert controls.cancel.disabled and "Cancelled" in controls.status.text
    controls.run.clicks += 1
    loop.finish(controls.store)
    assert controls.status.progress == 1.0


class TestPeaks:
    def test_add(self, controls: Controls, loop: Any) -> None:
        n = len(controls.fields[PATH].table.rows)
        controls.fields[PATH].table._handle_msg({"action": "add"})
        assert len(controls.store.scenario.vibration.peaks) == n + 1 == len(controls.fields[PATH].table.rows)
        assert controls.store.run.state == "running"
        loop.finish(controls.store)

    def test_remove(self, controls: Controls, loop: Any) -> None:
        second = controls.store.scenario.vibration.peaks[1]
        controls.fields[PATH].table._handle_msg({"action": "remove", "key": "0"})
        assert controls.store.scenario.vibration.peaks[0] == second
        loop.finish(controls.store)

    def test_remove_all(self, controls: Controls, loop: Any) -> None:
        while controls.fields[PATH].table.rows:
            controls.fields[PATH].table._handle_msg({"action": "remove", "key": "0"})
        loop.finish(controls.store)
        assert controls.store.run.state == "done"

    @pytest.mark.parametrize(
        ("key", "text", "expected"),
        [
            ("frequency", "33.3", 33.3),
            ("damping", "0", 0.0),
            ("rms.0", "0.02", 0.02),
            ("rms.1", "2e-3", 0.002),
        ],
    )
    def test_edit_in_place(self, controls: Controls, loop: Any, key: str, text: str, expected: float) -> None:
        before = controls.store.run.result
        controls.fields[PATH].table._handle_msg({"action": "edit", "key": f"2.{key}", "name": text})
        assert controls.store.value(f"{PATH}.2.{key}") == expected
        assert controls.fields[PATH].table.errors == {}
        loop.finish(controls.store)
        assert controls.store.run.result is not before
        assert controls.store.run.result.scenario == controls.store.scenario

    def test_a_long_number_fits_its_cell(self, controls: Controls) -> None:
        """What is kept has all digits."""
        peak = {"frequency": 17.25123, "damping": 0.0123456, "rms": [0.0084123, 0.02]}
        controls.store.replace({PATH: [peak]})
        assert controls.fields[PATH].table.rows == [["17.2512", "0.01235", "0.00841", "0.02"]]
        assert controls.store.value(PATH)[0].to_dict() == peak

    def test_bad_cell(self, controls: Controls, subtests: pytest.Subtests) -> None:
        shown, table = controls.store.run.result, controls.fields[PATH].table
        rows = table.rows
        for key, text, says in [
            ("frequency", "-3", "from 0.01"),
            ("frequency", "600", "half the LGS rate"),
            ("damping", "two", "Peak 3: ξ = 'two': takes a number"),
            ("rms.1", "-1", "Peak 3: rms = [0.0025, -1]: takes"),
            ("rms.1", "0,5", "use a point: 0.5"),
        ]:
            with subtests.test(key, text=text):
                table._handle_msg({"action": "edit", "key": f"2.{key}", "name": text})
                error = table.errors[f"2.{key}"]
                assert error["text"] == text and says in error["reason"]
                assert f'value="{text}"' in table.html and table.html.count('aria-invalid="true"') == 1
                assert controls.store.run.result is shown and table.rows == rows
                good = {"frequency": rows[2][0], "damping": rows[2][1], "rms.1": rows[2][3]}[key]
                table._handle_msg({"action": "edit", "key": f"2.{key}", "name": good})
                assert table.errors == {} and controls.store.run.result is shown

    def test_removing_a_bad_row_removes_its_error(self, controls: Controls, loop: Any) -> None:
        controls.fields[PATH].table._handle_msg({"action": "edit", "key": "0.damping", "name": "7"})
        controls.fields[PATH].table._handle_msg({"action": "remove", "key": "0"})
        assert controls.fields[PATH].table.errors == {}
        loop.finish(controls.store)


def test_parsed() -> None:
    assert parse_number("3") == 3 and isinstance(parse_number("3"), int)
    assert parse_number("−1.5e-3") == -0.0015
    assert parse_number("three") == "three"


def test_what_did_not_arrive_is_done_again(controls: Controls, loop: Any) -> None:
    """As a browser sends it that was cut off; a topic that nobody has opened, and nonsense, among it."""
    controls.take({"setting": "turbulence.wind_speed", "value": "22"})
    controls.take({"setting": "turbulence.wind_speed", "value": 200.0})
    controls.take({"setting": "loop.gain", "value": 0.4})
    controls.take({"setting": PATH, "message": {"action": "edit", "key": "0.frequency", "name": "6.5"}})
    for nonsense in (
        {},
        {"setting": 3},
        {"setting": "run.x", "value": 1},
        {"setting": "preset", "value": "x"},
        {"setting": PATH, "message": 1},
        {"setting": PATH, "message": {"action": "remove", "key": "99"}},
        {"setting": "run.duration", "value": None},
    ):
        controls.take(nonsense)
    store = controls.store
    assert [store.value(path) for path in ("turbulence.wind_speed", "loop.gain", f"{PATH}.0.frequency")] == [22.0, 0.4, 6.5]
    assert set(store.errors) == {"turbulence.wind_speed"}
    assert field_of(controls, "turbulence.wind_speed").widgets[-1].value == "200"
    controls.take({"setting": "preset", "value": "ut4"})
    assert store.preset == "ut4" and store.errors == {}
    store.run.cancel()
