"""How long a run is said to take, against what was measured."""

from __future__ import annotations

from math import nan

import pytest

from wfsobs.cost import frozen_flow_seconds, part_seconds, run_seconds
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import Observer
from wfsobs.observers.gpr.offline import OfflineGpr, offline_seconds
from wfsobs.observers.gpr.online import OnlineGpr, online_seconds
from wfsobs.scenario.presets import paper, ut4


@pytest.mark.parametrize(
    ("m", "depth", "measured"),
    [
        (20, 170, 0.32),
        (100, 170, 0.123),
        (256, 170, 0.115),
        (511, 170, 0.26),
        (511, 1000, 0.21),
        (1000, 170, 0.72),
        (2048, 170, 2.34),
    ],
)
def test_online_gpr_near_what_was_measured(m: int, depth: int, measured: float) -> None:
    assert 0.7 < online_seconds(OnlineGpr(training_size=m, depth=depth), 10_000, 1, 1e-3) / measured < 1.5


@pytest.mark.parametrize(("m", "depth", "measured"), [(100, 407, 0.017), (1000, 407, 0.055), (2048, 407, 0.138)])
def test_offline_gpr_near_what_was_measured(m: int, depth: int, measured: float) -> None:
    assert 0.7 < offline_seconds(OfflineGpr(training_size=m, depth=depth), 10_000, 1, 1e-3) / measured < 1.8


@pytest.mark.parametrize(
    ("changes", "measured"),
    [
        ({}, 0.10),
        ({"run.duration": 60}, 0.74),
        ({"adaptive.window": 1}, 0.077),
        ({"adaptive.window": 8, "run.duration": 20}, 0.26),
        ({"adaptive.interval": 0.1}, 0.38),
        ({"sensors.lgs_rate": 4000}, 0.15),
        ({"adaptive.window": 11}, 0.0),
    ],
)
def test_adaptive_filter_near_what_was_measured(changes: dict[str, float], measured: float) -> None:
    one_mode = part_seconds(paper().replace(changes))["kf-adaptive"] / 2
    assert 0.6 * measured <= one_mode <= 1.6 * measured


@pytest.mark.parametrize(("changes", "measured"), [({}, 0.62), ({"run.duration": 60}, 4.1)])
def test_whole_runs_of_the_benchmarks_page(changes: dict[str, float], measured: float) -> None:
    """The page is older than `gpr-adaptive`."""
    others = [name for name in OBSERVERS if name != "gpr-adaptive"]
    assert 0.7 < run_seconds(paper().replace(changes), others) / measured < 1.3


@pytest.mark.parametrize(("changes", "measured"), [({}, 0.22), ({"adaptive.window": 2}, 0.13), ({"run.duration": 30}, 1.13)])
def test_adaptive_gpr_near_what_was_measured(changes: dict[str, float], measured: float) -> None:
    """Processor time of a machine that did nothing else."""
    assert 0.7 < part_seconds(paper().replace(changes))["gpr-adaptive"] / 2 / measured < 1.3


@pytest.mark.parametrize(
    ("order", "layers", "duration", "sensors", "measured"),
    [
        (1, 1, 10.0, {}, 0.23),
        (1, 1, 60.0, {}, 0.71),
        (6, 1, 10.0, {}, 0.59),
        (5, 10, 10.0, {}, 11.2),
        (1, 1, 60.0, {"sensors.kind": "zernike"}, 0.090),
        (5, 10, 10.0, {"sensors.kind": "zernike"}, 1.41),
    ],
)
def test_frozen_flow_near_what_was_measured(order: int, layers: int, duration: float, sensors: dict, measured: float) -> None:
    s = paper().replace(
        {
            "turbulence.source": "frozen-flow",
            "telescope.radial_order": order,
            "run.duration": duration,
            **sensors,
            "turbulence.layers": [{"wind_factor": 0.4 + 0.2 * i if layers > 1 else 1.0} for i in range(layers)],
            "sensors.lgs_count": 4 if layers > 1 else 2,
            "sensors.lgs_radius": 64.0 if layers > 1 else 0.0,
        }
    )
    assert 0.5 < frozen_flow_seconds(s, s.n_steps) / measured < 2.0


def test_other_turbulence_costs_no_waves() -> None:
    assert frozen_flow_seconds(paper(), 10_000) == 0.0


def test_the_presets_are_a_moment() -> None:
    assert run_seconds(paper()) < 1.5 and run_seconds(ut4()) < 1.5


@pytest.mark.parametrize("estimate", [lambda *_: 1 / 0, lambda *_: nan, lambda *_: -1.0, lambda *_: "long"])
def test_a_time_that_is_none_leaves_that_of_the_others(estimate, monkeypatch: pytest.MonkeyPatch) -> None:
    others = run_seconds(paper())
    monkeypatch.setitem(OBSERVERS, "mine", Observer("mine", "Mine", ("vibration",), lambda *_: {}, seconds=estimate))
    assert run_seconds(paper()) == others


def test_parts_add_up_and_grow_with_the_record() -> None:
    short, long = (paper().replace({"run.duration": seconds}) for seconds in (20, 40))
    assert sum(part_seconds(short).values()) == run_seconds(short) < run_seconds(long)
    assert (
        part_seconds(paper().replace({"run.duration": 1.1, "run.warm_up": 0.1, "gpr_online.training_size": 2048}))["gpr-online"]
        == 0.0
    ), "too short to start"
