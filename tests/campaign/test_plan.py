"""Plans of campaigns."""

import json
from pathlib import Path

import pytest

from wfsobs.campaign.plan import Campaign, parse_plan
from wfsobs.observers import OBSERVERS
from wfsobs.scenario.presets import PRESETS
from wfsobs.settings.values import SettingError

TEXT = """
name = "Wind"
seeds = 3
first_seed = 7
observers = ["kf-multi", "kf-lgs"]
[settings]
run.duration = 2.0
[[scenario]]
preset = "paper"
[[scenario]]
name = "noisy"
preset = "ut4"
settings = { sensors.lgs_noise = 0.05 }
[grid]
turbulence.wind_speed = [5, 15]
"""


def test_cells_are_the_scenarios_of_the_presets_with_their_settings():
    plan = parse_plan(TEXT, Path())
    assert plan.n_runs == 2 * 2 * 3 and list(plan.seeds) == [7, 8, 9]
    assert plan.observers == tuple(name for name in OBSERVERS if name in ("kf-lgs", "kf-multi"))
    expected = [PRESETS["paper"]().replace({"run.duration": 2.0, "turbulence.wind_speed": v}) for v in (5, 15)]
    expected += [
        PRESETS["ut4"]().replace({"run.duration": 2.0, "sensors.lgs_noise": 0.05, "turbulence.wind_speed": v}) for v in (5, 15)
    ]
    assert [cell.scenario() for cell in plan.cells] == expected


def test_a_plan_survives_its_file():
    plan = parse_plan(TEXT + "[stop]\nfirst = 2\nhalf_width = 0.1\n", Path())
    again = Campaign.from_dict(json.loads(json.dumps(plan.to_dict())))
    assert again == plan
    assert again.identity() == plan.identity() == parse_plan(TEXT.replace("seeds = 3", "seeds = 9"), Path()).identity()
    assert parse_plan(TEXT.replace("15]", "16]"), Path()).identity() != plan.identity()


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (("seeds = 3", "seeds = 0"), "seeds = 0: takes a whole number from 1"),
        (("seeds = 3", "seed = 3"), "seed: not part of a plan; takes name, seeds"),
        (('"kf-lgs"', '"kf-lg"'), "observers: 'kf-lg' is not one of"),
        (("15]", "150]"), r"scenario 1 \(paper\): turbulence.wind_speed = 150: takes a number from 0.1 to 100"),
        (("wind_speed", "windspeed"), "turbulence.windspeed: no such setting"),
        (('preset = "ut4"', 'preset = "ut5"'), "preset = 'ut5': takes one of"),
        (('name = "noisy"', 'name = "paper"'), "scenario.1.name = 'paper': there are two"),
        (("run.duration = 2.0", "run.duration = 0.5"), "run.warm_up = 1: must be below run.duration"),
        (("[grid]", "[stop]\nfirst = 4\n[grid]"), "stop.first = 4: takes a whole number from 2 to seeds = 3"),
        (("[grid]", "[grid"), "not TOML"),
    ],
)
def test_what_cannot_be_used_is_one_line(change, line):
    with pytest.raises(SettingError, match=line):
        parse_plan(TEXT.replace(*change), Path())
