"""Settings as links, command lines, Python and files: there and back."""

from __future__ import annotations

import itertools
import json
import shlex
from typing import Any

import numpy as np
import param
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

import wfsobs
from wfsobs.app.share import LONGEST, MOST, changes, from_file, from_query, to_command, to_file, to_python, to_query
from wfsobs.cli import main
from wfsobs.identification import identify
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.atmosphere import Layer, Peak, Process
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.group import Group
from wfsobs.settings.values import SettingError
from wfsobs.simulation.loop import simulate

QUICK = {
    "run.duration": 1.0,
    "run.warm_up": 0.5,
    "gpr_online.training_size": 20,
    "gpr_offline.training_size": 50,
    "adaptive.window": 0.4,
}
LEAVES = [(path, p) for path, _, p in Scenario().walk() if not path.startswith("vibration.peaks")]


def allowed(p: Any) -> st.SearchStrategy[Any]:
    """Values that a setting takes."""
    if isinstance(p, param.Boolean):
        return st.booleans()
    if isinstance(p, param.Selector):
        return st.sampled_from(list(p.objects))
    if isinstance(p, param.List):
        low, high = p.item_bounds  # type: ignore[attr-defined]
        return st.lists(st.floats(low, high), min_size=p.bounds[0], max_size=min(5, p.bounds[1]))
    low, high = p.bounds
    if isinstance(p, param.Integer):
        return st.integers(low, high)
    above, below = p.inclusive_bounds
    return st.floats(low, high, exclude_min=not above, exclude_max=not below)


def items(kind: type[Group]) -> st.SearchStrategy[list[dict[str, Any]]]:
    fields = {name: allowed(p) for name, p in kind.settings().items()}
    return st.lists(st.fixed_dictionaries(fields), max_size=4)


def usable(scenario: Scenario) -> bool:
    try:
        scenario.validate()
    except SettingError:
        return False
    return True


def some_of(p: Any, rng: np.random.Generator) -> list[Any]:
    """Return up to two values that a setting takes, numbers anywhere within its bounds with all their digits."""
    if isinstance(p, param.Boolean):
        return [True, False]
    if isinstance(p, param.Selector):
        return list(rng.permutation(p.objects)[:2].tolist())
    if isinstance(p, param.List):
        low, high = p.item_bounds  # type: ignore[attr-defined]
        return [rng.uniform(low, high, n).tolist() for n in (p.bounds[0], min(5, p.bounds[1]))]
    low, high = p.bounds
    if isinstance(p, param.Integer):
        return [int(rng.integers(low, high, endpoint=True)), high]
    near_low = low + (high - low) * 10.0 ** rng.uniform(-9.0, -1.0)
    return [near_low, rng.uniform(low, high)]


def together(base: Scenario, values: dict[str, Any]) -> Scenario:
    """Return a scenario changed in all of these, or in those of them that go with the ones before."""
    made = base.replace(values)
    if usable(made):
        return made
    for path, value in values.items():
        changed = base.replace({path: value})
        base = changed if usable(changed) else base
    return base


def test_every_setting_survives_a_link_and_a_file(subtests: pytest.Subtests) -> None:
    """Two values of each, with those of its group in one link, on two presets."""
    rng, survived = np.random.default_rng(1), set()
    given = {path: some_of(p, rng) for path, p in LEAVES}
    groups = dict.fromkeys(path.split(".")[0] for path in given)
    for group, i in itertools.product(groups, range(2)):
        values = {path: found[i] for path, found in given.items() if path.startswith(f"{group}.") and i < len(found)}
        preset = str(rng.choice(list(PRESETS)))
        scenario = together(PRESETS[preset](), values)
        with subtests.test(group, values=values, preset=preset):
            query = to_query(scenario, preset)
            assert query is not None
            link = from_query(f"?{query}")
            assert (link.scenario, link.preset, link.errors) == (scenario, preset if query else "paper", ())
            assert from_file(to_file(scenario, preset)) == link
        survived |= {path for path, value in values.items() if scenario.lookup(path) == value}
    assert len(survived) > 0.9 * len(LEAVES), "hardly any goes only with changes of others"


@settings(max_examples=20, deadline=None, derandomize=True)
@given(peaks=items(Peak), layers=items(Layer), processes=items(Process))
def test_lists_of_groups_survive_a_link(
    peaks: list[dict[str, Any]], layers: list[dict[str, Any]], processes: list[dict[str, Any]]
) -> None:
    scenario = Scenario().replace(
        {"vibration.peaks": peaks, "turbulence.layers": layers, "turbulence.processes": processes, "sensors.lgs_rate": 100_000.0}
    )
    if not usable(scenario):
        return
    query = to_query(scenario, "ut4")
    assert query is not None and from_query(query).scenario == scenario


def test_events_survive_a_link() -> None:
    scenario = PRESETS["lost-frames"]().replace({"events.2": {"kind": "wind", "start": 1.5, "wind_factor": 0.3}})
    query = to_query(scenario, "paper")
    assert query is not None and from_query(f"?{query}").scenario == scenario


def test_a_link_holds_what_differs_and_can_be_read() -> None:
    scenario = PRESETS["ut4"]().replace(
        {
            "turbulence.wind_speed": 20,
            "loop.closed": False,
            "butterworth.frequencies": [17, 20.5],
            "vibration.peaks": [{"frequency": 45, "damping": 0.03, "rms": [0.01, 0.02]}] * 2,
        }
    )
    assert to_query(scenario, "ut4") == (
        "preset=ut4&turbulence.wind_speed=20&vibration.peaks=45,0.03,0.01,0.02;45,0.03,0.01,0.02&loop.closed=false"
        "&butterworth.frequencies=17,20.5"
    )
    assert to_query(PRESETS["paper"](), "paper") == ""
    assert to_query(PRESETS["ut4"](), "ut4") == "preset=ut4"


def test_a_bad_field_is_named_and_the_rest_applies() -> None:
    link = from_query("?preset=ut4&turbulence.wind_speed=200&loop.gain=0.2&nonsense=1&run.seed=7")
    assert changes(link.scenario, "ut4") == {"loop.gain": 0.2, "run.seed": 7}
    first, second = link.errors
    assert first == "turbulence.wind_speed = 200: takes a number from 0.1 to 100 m/s"
    assert second.startswith("nonsense: no such setting")


@pytest.mark.parametrize(
    "query",
    [
        "preset=other",
        "preset=",
        "run.seed=",
        "run.seed=__import__('os')",
        "run.duration=/etc/passwd",
        "telescope=1",
        "loop.closed=yes",
        "vibration.peaks=1,2",
        "turbulence.layers=1,1,1",
        "turbulence.layers=1,1,1,1,1",
        "vibration.peaks=a,b,c",
        "vibration.peaks=1,0,nan",
        "run.duration=nan",
        "run.seed=1.5",
        "turbulence.wind_speed=1e999",
        f"run.seed={'9' * 5000}",
        "loop.=1",
        ".=1",
        "=1",
        "vibration.peaks.x=1",
        "vibration.peaks.999.frequency=3",
        "turbulence.wind_speed=%FF%00",
        "_refused=1",
        "name=x",
        "turbulence.name=x",
        "kalman.frequency=600",
        "run.warm_up=20",
        f"x={'a' * LONGEST}",
    ],
)
def test_what_cannot_be_used_changes_nothing_and_has_one_line(query: str) -> None:
    link = from_query(query)
    assert link.scenario == PRESETS["paper"]() and link.preset == "paper"
    assert len(link.errors) == 1
    assert "\n" not in link.errors[0] and len(link.errors[0]) <= 200


def test_what_is_dropped_of_a_link_is_said() -> None:
    twice = from_query("?run.duration=3&run.duration=2&theme=dark&theme=light")
    assert twice.scenario.run.duration == 2.0
    assert twice.errors == ("run.duration = 2: given more than once, the last counts",)
    (line,) = from_query("?simulation&simulation.run.duration=nan").errors
    assert line.startswith("simulation.run.duration = nan: ")
    link = from_query("&".join([f"x{i}=0" for i in range(MOST)] + ["run.duration=2"]))
    assert link.errors[0] == f"The link has {MOST + 1} fields: the first {MOST} are read."


def test_fields_that_only_go_together_in_any_order_beside_one_that_never_does() -> None:
    for query in ("run.warm_up=20&run.duration=30&loop.gain=0.1", "loop.gain=0.1&run.duration=30&run.warm_up=20"):
        link = from_query(f"{query}&kalman.frequency=600")
        assert changes(link.scenario, "paper") == {"run.warm_up": 20.0, "run.duration": 30.0, "loop.gain": 0.1}
        assert len(link.errors) == 1 and "kalman.frequency = 600" in link.errors[0]


def test_settings_too_long_for_a_link_travel_as_a_file() -> None:
    frequencies = [float(f) for f in np.linspace(1, 80, 2000)]
    scenario = PRESETS["paper"]().replace({"vibration.psd": {"frequency": frequencies, "tip": frequencies, "tilt": frequencies}})
    assert to_query(scenario, "paper") is None
    assert to_command(scenario, "paper") == "wfsobs run --config wfsobs.toml"
    assert 'configfile.load_scenario("wfsobs.toml")' in to_python(scenario, "paper")
    assert from_file(to_file(scenario, "paper")).scenario == scenario


CHANGED = {
    **QUICK,
    "turbulence.wind_speed": 22.5,
    "loop.gain": 0.25,
    "kalman.measurement_noise": "manual",
    "multirate.model_lgs_error": False,
    "butterworth.frequencies": [24.3, 47.7],
    "vibration.source": "ar2",
    "vibration.peaks": [{"frequency": 47, "damping": 0.01, "rms": [0.02, 1e-5]}],
    "events": [{"kind": "peak", "start": 0.7, "frequency_shift": 2.0}],
}


@pytest.mark.parametrize("preset", ["paper", "ut4"])
def test_the_command_line_prints_the_very_numbers(preset: str) -> None:
    scenario = PRESETS[preset]().replace(CHANGED | {"sensors.kind": "zernike", "telescope.radial_order": 1})
    program, *arguments = shlex.split(to_command(scenario, preset))
    assert program == "wfsobs"
    result = CliRunner().invoke(main, [*arguments, "--json"], catch_exceptions=False)
    got = {(r["observer"], r["target"], r["mode"]): r["rms_um"] for r in json.loads(result.stdout)}
    assert got == {(s.observer, s.target, s.mode): s.rms for s in wfsobs.run(scenario).scores}


def test_the_command_line_has_the_very_scenario(subtests: pytest.Subtests, monkeypatch: pytest.MonkeyPatch) -> None:
    """In every preset, changed and as it is."""
    received: list[Scenario] = []

    def simulate_nothing(scenario: Scenario, *_: Any) -> Any:
        received.append(scenario)
        raise SettingError("not run")

    monkeypatch.setattr("wfsobs.cli.simulate.simulate", simulate_nothing)
    for preset, make in PRESETS.items():
        for scenario in (make(), make().replace(CHANGED)):
            with subtests.test(preset, is_changed=scenario != make()):
                CliRunner().invoke(main, shlex.split(to_command(scenario, preset))[1:])
                assert received.pop() == scenario and not received


def test_the_python_makes_the_very_scenario(capsys: pytest.CaptureFixture[str]) -> None:
    scenario = PRESETS["ut4"]().replace(CHANGED)
    made: dict[str, Any] = {}
    exec(to_python(scenario, "ut4"), made)
    assert made["scenario"] == scenario
    assert len(capsys.readouterr().out.splitlines()) == len(made["result"].scores)


def test_settings_from_an_identification_are_written_in_plain_numbers(capsys: pytest.CaptureFixture[str]) -> None:
    """They come out of arrays: NumPy's repr is read by no link, file or script."""
    simulated = PRESETS["paper"]().replace({**QUICK, "run.duration": 3.0})
    found = identify(simulate(simulated)).scenario(simulated.replace({"run.duration": 1.0}))
    assert found.vibration.peaks
    query = to_query(found, "paper")
    assert query is not None
    for text in (query, to_command(found, "paper"), to_python(found, "paper"), to_file(found, "paper")):
        assert "np." not in text and "float64" not in text
    link = from_query(query)
    assert (link.scenario, link.errors) == (found, ())
    made: dict[str, Any] = {}
    exec(to_python(found, "paper"), made)
    assert made["scenario"] == found and capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a =", "not TOML"),
        ("loop.gain = 9", "loop.gain = 9"),
        ("nonsense = 1", "no such setting"),
        ("run.warm_up = 20", "run.warm_up = 20"),
        (f"run.seed = {'9' * 5000}", "not TOML"),
        (f"a = {'[' * 5000}", "nested more than 8 deep"),
        ("preset = [1]", "preset = [1]"),
        ('preset = "../x"', "preset = '../x'"),
        ("\0", "not TOML"),
    ],
)
def test_a_bad_file_says_why_in_one_line(text: str, reason: str) -> None:
    with pytest.raises(SettingError) as caught:
        from_file(text)
    assert reason in str(caught.value) and "\n" not in str(caught.value)


def test_a_file_without_a_preset_leaves_that_open() -> None:
    link = from_file("loop.gain = 0.2")
    assert link.preset == "" and link.scenario == Scenario().replace({"loop.gain": 0.2})


@pytest.mark.parametrize("path", ["turbulence.wind_speed", "vibration.peaks", "butterworth.frequencies", "vibration"])
def test_a_name_of_a_thousand_parts_is_a_line(path: str) -> None:
    link = from_query(f"?{path}{'.a' * 3000}=1&turbulence.wind_speed=20")
    assert len(link.errors) == 1 and link.errors[0].startswith(path) and len(link.errors[0]) <= 200
    assert link.scenario == PRESETS["paper"]().replace({"turbulence.wind_speed": 20.0})
