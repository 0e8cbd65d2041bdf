"""What docs/higher-orders.md says of the observers' order, on one short record with ideal sensors."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

SCRIPT = Path(__file__).parents[2] / "docs" / "scripts" / "higher_orders.py"
QUICK: dict[str, Any] = {"run.duration": 4.0, "sensors.kind": "zernike"}


@pytest.fixture(scope="module")
def script() -> Any:
    spec = importlib.util.spec_from_file_location("higher_orders", SCRIPT)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.SEEDS = (1,)
    return module


def test_with_the_mean_it_lies_between(script: Any) -> None:
    found = script.errors({**script.CASES["two LGS on the axis, their mean"], **QUICK})
    for n in (2, 3, 4):
        assert found[n, "multirate-optimal"] < found[n, "kf-ngs"] < found[n, "multirate"] < found[n, "kf-lgs"] < found[n, "zero"]


def test_with_the_cone_undone_it_wins(script: Any) -> None:
    found = script.errors({**script.CASES['four LGS at 17.5", minimum variance'], **QUICK})
    for n in (2, 3, 4):
        assert found[n, "multirate"] < min(found[n, "kf-ngs"], found[n, "kf-lgs"])
        assert found[n, "multirate-optimal"] == pytest.approx(found[n, "multirate"], rel=0.1)
