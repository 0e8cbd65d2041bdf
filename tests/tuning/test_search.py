"""The search: within its cube and its evaluations, failures no end to it, and near enough to a minimum that is known."""

from __future__ import annotations

from math import inf

import numpy as np
import param
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.observers import OBSERVERS
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.tuning.records import space
from wfsobs.tuning.trials import NoEvaluationLeft, minimise

pytestmark = pytest.mark.slow

BASES = {name: PRESETS[name]() for name in ("paper", "ut4", "strong-turbulence")}


class Asked:
    """Keeps what a search asks, and ends it."""

    def __init__(self, f, most: int):
        self.f, self.most, self.points, self.values = f, most, [], []

    def __call__(self, point):
        if len(self.points) == self.most:
            raise NoEvaluationLeft
        self.points.append(np.array(point))
        self.values.append(self.f(point))
        return self.values[-1]


@pytest.mark.parametrize("d", [1, 2, 3, 4])
def test_finds_the_bottom_of_a_bowl(d: int) -> None:
    where = np.linspace(0.2, 0.7, d)
    asked = Asked(lambda x: 1.0 + float(np.sum(np.arange(1, d + 1) * (x - where) ** 2)), 60)
    minimise(asked, np.full(d, 0.95), 60, np.random.default_rng(1))
    # A start of no use is up to 4.6 above 1, a random point of the cube 0.1 d^2 or so
    assert min(asked.values) < 1.0 + 0.01 * d
    assert all(np.all((p >= 0.0) & (p <= 1.0)) for p in asked.points)


def test_failures_are_no_end() -> None:
    asked = Asked(lambda x: inf if x[0] > 0.4 else 1.0 + (x[0] - 0.3) ** 2 + (x[1] - 0.6) ** 2, 60)
    minimise(asked, np.array([0.9, 0.9]), 60, np.random.default_rng(2))
    assert asked.values[0] == inf and min(asked.values) < 1.001
    nothing = Asked(lambda x: inf, 60)
    minimise(nothing, np.array([0.5]), 60, np.random.default_rng(2))
    assert len(nothing.values) == 21  # start and hypercube


OBSERVED = [o for o in OBSERVERS if OBSERVERS[o].tunable.usual]


@settings(max_examples=20, deadline=None)
@given(st.data())
def test_what_is_tried_is_what_the_settings_allow(data: st.DataObject) -> None:
    """Anywhere in the cube, whatever the scenario; the corners are the ends, and the start is the scenario's own numbers."""
    s, observer = BASES[data.draw(st.sampled_from(sorted(BASES)))], data.draw(st.sampled_from(OBSERVED))
    names = [n for n in (path for paths in OBSERVERS[observer].tunable for path in paths) if not n.endswith("highpass")]
    chosen = data.draw(st.lists(st.sampled_from(names), min_size=1, max_size=4, unique=True))
    s = s.replace({path: data.draw(anything_for(s, path)) for path in chosen})
    found = space(s, observer, chosen)
    point = np.array(data.draw(st.lists(st.floats(0, 1), min_size=len(chosen), max_size=len(chosen))))
    changed = s.replace(found.changes(point))  # refuses what is out of bounds
    start, before = found.changes(found.start(s)), found.values(s)
    for a in found.axes:
        assert a.low <= changed.lookup(a.path) <= a.high
        assert a.value(0.0) == pytest.approx(a.low, rel=1e-5) and a.value(1.0) == pytest.approx(a.high, rel=1e-5)
        assert start[a.path] == pytest.approx(max(before[a.path], a.low), rel=1e-5)


def anything_for(s: Scenario, path: str) -> st.SearchStrategy[float]:
    p = next(p for known, _, p in s.walk() if known == path)
    low, high = p.bounds  # type: ignore[attr-defined]
    return st.integers(low, high) if isinstance(p, param.Integer) else st.floats(low, high)


def test_every_observer_with_settings_says_what_of_it_is_tuned() -> None:
    assert {name for name, o in OBSERVERS.items() if not o.tunable.usual} == {"persistence", "zero"}
