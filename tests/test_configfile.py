"""TOML files and typed settings."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.scenario import Scenario, configfile
from wfsobs.scenario.configfile import parse_variation
from wfsobs.scenario.groups.atmosphere import Peak
from wfsobs.scenario.presets import PRESETS, paper
from wfsobs.settings.values import SettingError


@pytest.mark.parametrize("name", PRESETS)
def test_round_trip_is_exact(name, tmp_path):
    scenario = PRESETS[name]()
    assert configfile.from_toml(configfile.to_toml(scenario)) == scenario
    configfile.save_scenario(scenario, tmp_path / "s.toml")
    assert configfile.load_scenario(tmp_path / "s.toml") == scenario
    assert [p.name for p in tmp_path.iterdir()] == ["s.toml"]
    (tmp_path / "s.toml").write_text(configfile.to_toml(scenario), encoding="utf-8-sig")
    assert configfile.load_scenario(tmp_path / "s.toml") == scenario


def test_peaks_are_tables():
    text = configfile.to_toml(paper())
    assert text.count("[[vibration.peaks]]") == len(paper().vibration.peaks)


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=50)
@given(
    frequency=st.floats(0.01, 5000),
    rms=st.lists(st.floats(0, 100), min_size=1, max_size=5),
    wind=st.floats(0.1, 100),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_float_survives(frequency, rms, wind, seed):
    scenario = Scenario()
    scenario.set("vibration.peaks", [{"frequency": frequency, "rms": rms}])
    scenario.set("turbulence.wind_speed", wind)
    scenario.set("run.seed", seed)
    again = configfile.from_toml(configfile.to_toml(scenario))
    assert again.to_dict() == scenario.to_dict()


def test_a_partial_file_changes_only_what_it_names():
    scenario = configfile.from_toml('preset = "ut4"\n[turbulence]\nwind_speed = 8')
    assert scenario == PRESETS["ut4"]().replace({"turbulence.wind_speed": 8.0})
    on_top = configfile.from_toml("[[vibration.peaks]]\nfrequency = 30.0", base=paper())
    assert on_top.vibration.peaks == [Peak(frequency=30.0)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[turbulence]\nwind_speed = 500", r"^f.toml: turbulence.wind_speed = 500: takes a number from 0.1 to 100 m/s$"),
        ("[turbulence]\nwind = 5", r"^f.toml: turbulence.wind: no such setting; 'wind' is not one of source, "),
        ("[[vibration.peaks]]\nfrequency = -1", r"^f.toml: vibration.peaks.0.frequency = -1: takes a number from 0.01"),
        ("[vibration]\npeaks = 3", r"^f.toml: vibration.peaks = 3: takes a list of tables$"),
        ("turbulence = 3", r"^f.toml: turbulence = 3: "),
        ("a = ", r"^f.toml: not TOML: "),
        ('preset = "nope"', r"^f.toml: preset = 'nope': takes one of paper, "),
        ("[run]\nseed = nan", r"^f.toml: run.seed = nan: takes a whole number"),
    ],
)
def test_bad_files_give_one_line(text, message):
    with pytest.raises(SettingError, match=message) as caught:
        configfile.from_toml(text, where="f.toml")
    assert "\n" not in str(caught.value)


DEEP = 100_000  # far more than any interpreter's stack


@pytest.mark.parametrize("value", ["[" * DEEP + "]" * DEEP, "{a = " * 3000 + "1" + "}" * 3000, "[" * 20 + "]" * 20])
def test_what_is_nested_deep_is_refused_in_one_line(tmp_path, value):
    """By every reader: a file, the preset that it names, an assignment, a variation."""
    file = tmp_path / "deep.toml"
    file.write_text(f"butterworth.frequencies = {value}")
    for where, read in {
        f"{file}: ": lambda: configfile.scenario_from(None, file, ()),
        f"{file}:  ": lambda: configfile.preset_name(None, file),
        "--set butterworth.frequencies: ": lambda: configfile.parse_assignment(f"butterworth.frequencies={value}"),
        "--vary butterworth.frequencies: ": lambda: parse_variation(f"butterworth.frequencies={value}"),
    }.items():
        with pytest.raises(SettingError) as caught:
            read()
        assert str(caught.value) == f"{where.rstrip()} tables or lists nested more than 8 deep"


@pytest.mark.parametrize(
    "text",
    [
        f"butterworth.frequencies = [{'9' * 5000}]",
        f"turbulence.wind_speed.{'a.' * DEEP}a = 1",
        f"{'a . ' * DEEP}a = 1",
        "[" + '"a".' * DEEP + "a]\nb = 1",
        f"a = {{{'1.' * DEEP}a = 1}}",
        f"a = {'b' * DEEP}",
    ],
)
def test_other_monsters_are_refused_in_one_line(text):
    with pytest.raises(SettingError, match=r"^TOML: .{10,200}$"):
        configfile.from_toml(text)


def test_a_value_nested_deep_is_no_setting():
    value = 1.0
    for _ in range(DEEP):
        value = [value]
    for path in ("turbulence.wind_speed", "butterworth.frequencies", "vibration.source", "vibration.peaks"):
        with pytest.raises(SettingError, match=rf"^{path}(\.0)? = \[.{{1,100}}: takes "):
            Scenario().replace({path: value})


def test_unreadable_files_give_one_line(tmp_path):
    with pytest.raises(SettingError, match="cannot be read: No such file"):
        configfile.load_scenario(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SettingError, match="not UTF-8"):
        configfile.load_scenario(tmp_path / "binary.toml")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a.b=1", ("a.b", 1)),
        ("a=1e-3", ("a", 1e-3)),
        ("a = true", ("a", True)),
        ("a=word", ("a", "word")),
        ('a="w=x"', ("a", "w=x")),
        ("a=[1, 2.5]", ("a", [1, 2.5])),
        ("a=[{rms=[1]}]", ("a", [{"rms": [1]}])),
        ("a=1\nb=2", ("a", "1\nb=2")),
    ],
)
def test_typed_settings(text, expected):
    assert configfile.parse_assignment(text) == expected


@pytest.mark.parametrize("text", ["a", "=1", ""])
def test_typed_settings_need_a_name_and_a_value(text):
    with pytest.raises(SettingError, match="takes name=value"):
        configfile.parse_assignment(text)


def test_order_of_precedence(tmp_path):
    (tmp_path / "f.toml").write_text('preset = "ut4"\n[run]\nseed = 5\nduration = 3.0\n')
    scenario = configfile.scenario_from(None, tmp_path / "f.toml", ("run.seed=7",))
    assert scenario == PRESETS["ut4"]().replace({"run.seed": 7, "run.duration": 3.0})
    told = configfile.scenario_from("paper", tmp_path / "f.toml", ())
    assert told == paper().replace({"run.seed": 5, "run.duration": 3.0})
    with pytest.raises(SettingError, match=r"run.warm_up = 30: must be below run.duration = 10 s"):
        configfile.scenario_from(None, None, ("run.warm_up=30",))


def test_a_quoted_name_with_dots_is_the_unquoted_one():
    want = configfile.from_toml("[run]\nduration = 4.0\nseed = 3\n")
    assert configfile.from_toml('"run.duration" = 4.0\n[run]\nseed = 3\n') == want
    assert configfile.from_toml('run = {duration = 4.0}\n"run.seed" = 3\n') == want
    peaks = configfile.parse_toml('x = [{"a.b" = 1, a.c = 2}]\n"" = 3\n')
    assert peaks == {"x": [{"a": {"b": 1, "c": 2}}], "": 3}
    for text in ('"run.duration" = 4.0\n[run]\nduration = 5.0\n', '[run]\nduration = 5.0\n["run.duration"]\nx = 1\n'):
        with pytest.raises(SettingError, match=r"^TOML: run\.duration: is set twice$"):
            configfile.from_toml(text)
