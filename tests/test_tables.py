"""The tables of what `wfsobs` gives, by pandas: a row each, in the order and with the numbers of the object."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import pandas as pd
import pytest

import wfsobs
from wfsobs.campaign.sweep import parse_axis, plan_sweep, run_sweep
from wfsobs.closed_loop.run import rows as loop_rows
from wfsobs.observers.gp import Matern

SCENARIO = wfsobs.PRESETS["paper"]().replace({"run.duration": 4.0, "run.warm_up": 1.0})


def peaks(found: Any) -> list[dict[str, Any]]:
    """Lines and resonances as they were found."""
    return [{"mode": mode.name, "frequency_hz": p.frequency.value} for mode in found.modes for p in mode.peaks]


TABLES: dict[str, tuple[Callable[[], Any], Callable[[Any], list[dict[str, Any]]]]] = {
    "Result": (
        lambda: wfsobs.run(SCENARIO, observers=["kf-lgs", "zero"]),
        lambda it: [{"observer": s.observer, "target": s.target, "mode": s.mode, "rms_um": s.rms} for s in it.scores],
    ),
    "Identification": (lambda: wfsobs.identify(wfsobs.simulate(SCENARIO)), peaks),
    "KernelFits": (
        lambda: wfsobs.fit_kernels(wfsobs.simulate(SCENARIO.replace({"run.duration": 1.5})), turbulence=[Matern(0.3, 0.05, 3)]),
        lambda it: [
            {"mode": mode.name, "number": name, "value": x.value, "std": x.std}
            for mode in it.modes
            for name, x in mode.numbers.items()
        ],
    ),
    "TuningResult": (
        lambda: wfsobs.tune(SCENARIO, "kf-lgs", evaluations=3),
        lambda it: [{**dict.fromkeys(it.paths), **e.changes, "rms_um": e.rms} for e in it.history],
    ),
    "ClosedLoop": (
        lambda: wfsobs.close_loop(SCENARIO, controllers=["integrator"]),
        lambda it: loop_rows(it, SCENARIO.run.seed),
    ),
    "PlantEnvelope": (lambda: wfsobs.plant_envelope(SCENARIO, controllers=["integrator"]), lambda it: it.rows()),
    "SweepResults": (
        lambda: run_sweep(plan_sweep(SCENARIO, [parse_axis("sensors.lgs_noise=0.01,0.02")], 1, ["kf-lgs", "zero"])),
        lambda it: it.rows(),
    ),
}
"""Class -> an object of it, and rows of its table."""


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLES)
def test_a_table_has_the_numbers_of_its_object(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    make, rows_of = TABLES[name]
    made = make()
    assert type(made).__name__ == name
    frame, rows = made.to_dataframe(), pd.DataFrame(rows_of(made))
    if name == "Identification":
        frame = frame[frame["what"].isin(["line", "resonance"])].reset_index()
    assert len(rows)
    pd.testing.assert_frame_equal(frame[list(rows)], rows, check_dtype=False, check_exact=True)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"^pandas is not installed: pip install wfsobs\[arrays\]$"):
        made.to_dataframe()
