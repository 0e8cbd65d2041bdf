"""Controllers in closed loop against theory, and what must hold for all of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from wfsobs.control.closed_loop import ClosedLoop, closed_loop, design, residual_rms
from wfsobs.loop import simulate
from wfsobs.scenario import Scenario

# The loop of one 530 nm turbulence, one 50 nm line at 47.5 Hz, 20 nm of noise, and a model that is the truth.
MATCHED = Scenario().replace({
    "turbulence.rms": 0.53, "vibration.source": "ar2", "kalman.frequency": 47.5,
    "vibration.peaks": [{"frequency": 47.5, "damping": 0.03, "rms": [0.05, 0.05]}],
    "sensors.lgs_count": 1, "sensors.lgs_noise": 0.02, "sensors.lgs_low_frequency_rms": 0.0,
})
LINEAR = ("none", "integrator", "lqg-kf-lgs", "lqg-multirate", "lqg-multirate-optimal")
QUICK = {"run.duration": 2.0, "run.warm_up": 0.5, "gpr_offline.training_size": 60, "gpr_offline.depth": 20,
         "gpr_online.training_size": 40, "gpr_online.depth": 20}


def run(changes: dict[str, Any], controllers: tuple[str, ...] | None = None, base: Scenario = MATCHED) -> ClosedLoop:
    scenario = base.replace(changes)
    return closed_loop(simulate(scenario), design(scenario, controllers))


def pooled(results: list[ClosedLoop], controller: str) -> float:
    """rms [nm] over all runs and modes."""
    squares = []
    for result in results:
        (outcome,) = [o for o in result.outcomes if o.controller == controller]
        left = residual_rms(outcome, result.record, result.scenario.run.warm_up)
        assert left is not None
        squares += [x**2 for x in left]
    return float(np.sqrt(np.mean(squares))) * 1e3


def test_the_two_frame_loop_leaves_what_theory_says() -> None:
    """21.63 nm is the bound, 34.1 the integrator at its best, g = 0.64, and 36.9 at g = 0.5, by theory."""
    several = [run({"run.seed": seed, "run.duration": 60.0}, ("integrator", "lqg-kf-lgs")) for seed in range(1, 6)]
    (lqg,) = {d.predicted for d in several[0].design.laws["lqg-kf-lgs"]}
    (best,) = {d.law.gain for d in several[0].design.laws["integrator"] if d.law}
    assert lqg == pytest.approx(21.63e-3, abs=0.005e-3) and best == pytest.approx(0.64, abs=0.005)
    half = design(MATCHED.replace({"control.integrator": "manual", "control.gain": 0.5}), ("integrator",))
    assert half.laws["integrator"][0].predicted == pytest.approx(36.9e-3, abs=0.05e-3)
    assert several[0].design.laws["integrator"][0].predicted == pytest.approx(34.1e-3, abs=0.05e-3)
    # 10 minutes of loop; 2 % is what is asked, and four times the spread of these means
    assert pooled(several, "lqg-kf-lgs") == pytest.approx(21.63, rel=0.02)
    assert pooled(several, "integrator") == pytest.approx(34.1, rel=0.02)
