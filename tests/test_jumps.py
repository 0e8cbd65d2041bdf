"""The count of calls that go up: it finds one that is planted, and none where calls go down."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from wfsobs.progress import Watch
from wfsobs.scenario.presets import PRESETS

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def script() -> Any:
    path = Path(__file__).parents[1] / "scripts" / "count_jumps.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_call_that_goes_up_is_found_and_one_that_goes_down_is_not(script: Any) -> None:
    """`progress` is the lowest room: whatever it calls back stands above it, also where foreign code lies between."""
    scenario = PRESETS["paper"]()
    direct = Watch(is_cancelled=scenario.validate)
    behind = Watch(is_cancelled=lambda: np.vectorize(lambda _: bool(scenario.validate()), otypes=[bool])([0]).any())
    for watch in (direct, behind):
        ((caller, callee, times),) = [j for j in script.jumps(script.traced(watch.check)) if j[0].room == "progress"]
        assert (callee.room, times) == ("scenario", 1)
        assert caller.name == "progress.py:Watch.check" and callee.name.endswith("validate")
    down = script.traced(scenario.validate)
    assert down and script.jumps(down) == []
