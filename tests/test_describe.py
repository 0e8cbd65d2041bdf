"""The described numbers against what the filters themselves do."""

from __future__ import annotations

import numpy as np
import pytest

from wfsobs.evaluation.description import Description, describe
from wfsobs.execution import run_observer
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.typing import Array


def impulse_response(observer: str, scenario: Scenario, steps: int, lgs: int | None = None, ngs: int | None = None) -> Array:
    """Estimates (steps, targets) of a record that is 1 um of LGS or NGS at one step and zero elsewhere."""
    y_lgs, y_ngs = np.zeros((steps, 2)), np.full((steps, 2), np.nan)
    n = scenario.sensors.exposure_ratio
    y_ngs[n::n] = 0.0
    if lgs is not None:
        y_lgs[lgs] = 1.0
    if ngs is not None:
        y_ngs[ngs] = 1.0
    record = Record(y_lgs, np.zeros((steps, 2)), scenario.dt, y_ngs, n)
    values = run_observer(observer, record, scenario)
    return np.column_stack([v[:, 0] for v in values.values()])


@pytest.fixture(scope="module", params=list(PRESETS))
def scenario(request: pytest.FixtureRequest) -> Scenario:
    return PRESETS[request.param]()


@pytest.fixture(scope="module")
def told(scenario: Scenario) -> Description:
    return describe(scenario, 0)


def follows(values: Array, poles: Array) -> bool:
    """Whether a free response obeys the recursion with these poles."""
    recursion = np.poly(poles).real
    windows = np.lib.stride_tricks.sliding_window_view(values, recursion.size)[:, ::-1]
    return np.abs(windows @ recursion).max() < 1e-8 * np.abs(values).max() * np.abs(recursion).sum()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("observer", "gain", "at"),
    [
        ("kf-lgs", "LGS", {"lgs": 0}),
        ("multirate", "LGS alone", {"lgs": 3}),
        ("multirate", "LGS with NGS", {"lgs": 5}),
        ("multirate", "NGS", {"ngs": 5}),
        ("multirate-optimal", "LGS, step 1", {"lgs": 1}),
        ("multirate-optimal", "LGS with NGS", {"lgs": 5}),
        ("multirate-optimal", "NGS", {"ngs": 5}),
    ],
)
def test_gains_are_first_answers(scenario: Scenario, told: Description, observer: str, gain: str, at: dict[str, int]) -> None:
    step = next(iter(at.values()))
    answer = impulse_response(observer, scenario, 20, **at)[step]
    assert np.allclose(answer, told.filters[observer].gains[gain][[0, 2]][: answer.size], rtol=1e-9)


@pytest.mark.slow
def test_ngs_gain(scenario: Scenario, told: Description) -> None:
    answer = impulse_response("kf-ngs", scenario, 20, ngs=5)
    assert np.allclose(answer[5:10, 0], told.filters["kf-ngs"].gains["NGS"][0])


@pytest.mark.slow
@pytest.mark.parametrize(("observer", "every"), [("kf-lgs", 1), ("kf-ngs", 5), ("multirate", 5), ("multirate-optimal", 5)])
def test_poles_are_those_of_the_answer(scenario: Scenario, told: Description, observer: str, every: int) -> None:
    facts = told.filters[observer]
    assert facts.period == pytest.approx(every * scenario.dt)
    values = impulse_response(observer, scenario, 400, lgs=2, ngs=5)[10::every, 0]
    assert follows(values[:60], facts.poles)
    assert facts.radius is not None and facts.radius < 1.0
    assert not follows(values[:60], 0.98 * facts.poles)


def test_matrices_are_those_of_the_processes(scenario: Scenario, told: Description) -> None:
    assert told.A[0, :2].tolist() == [told.turbulence.a1, told.turbulence.a2]
    assert told.A[2, 2:4].tolist() == [told.vibration.a1, told.vibration.a2]
    assert told.vibration.omega == pytest.approx(2 * np.pi * scenario.kalman.frequency)
    assert told.C.tolist() == [0, 1, 0, 1, 0, 1] and told.mode == "tip"


def test_gpr() -> None:
    told = describe(Scenario(), 0)
    assert told.gprs["gpr-offline"].ridge == pytest.approx(15.21)
    assert told.gprs["gpr-online"].ridge == pytest.approx(1.0)
    assert told.gprs["gpr-offline"].window == pytest.approx(0.407)
    assert told.gprs["gpr-online"].training == pytest.approx(0.680)


def test_an_unstable_cycle_says_why() -> None:
    s = PRESETS["paper"]().replace(
        {"multirate.measurement_noise": "manual", "multirate.lgs_noise": 0.04, "multirate.ngs_noise": 0.001}
    )
    told = describe(s, 0)
    assert "unstable" in told.filters["multirate"].reason and told.filters["multirate"].radius is None
    assert told.filters["kf-lgs"].reason == "" and told.filters["multirate-optimal"].radius is not None


def test_edges() -> None:
    """No vibration, an NGS as fast as the LGS: numbers all the same."""
    told = describe(Scenario().replace({"vibration.source": "none", "sensors.exposure_ratio": 1}), 1)
    assert told.mode == "tilt" and all(f.reason == "" for f in told.filters.values())
    assert told.filters["kf-lgs"].gains["LGS"][2] == 0.0
    assert set(told.filters["multirate-optimal"].gains) == {"LGS with NGS", "NGS"}


@pytest.mark.slow
def test_sensors_by_themselves() -> None:
    """A coarse NGS on frozen flow takes the mean gradient for the tip, 166 nm off; AR(2) turbulence is seen as it is."""
    s = PRESETS["ut4"]().replace({"sensors.lenslets.ngs_subapertures": 2, "sensors.ngs_noise": 0.03})
    facts = describe(s, 1).sensors
    assert facts["NGS"].aliasing == pytest.approx(0.1657, abs=1e-3) and facts["NGS"].noise == pytest.approx(0.03)
    assert 0.0 < facts["LGS"].aliasing < 0.003 and facts["LGS"].noise == pytest.approx(s.sensors.lgs_noise)
    assert describe(s.replace({"turbulence.source": "ar2"}), 1).sensors["NGS"].aliasing == 0.0
