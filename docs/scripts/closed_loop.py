"""The tables of docs/closed_loop.md: `python docs/scripts/closed_loop.py [table ...]`; a few minutes for all."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from statistics import median

import numpy as np

from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.run import closed_loop, label, rows
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.laws import highest_stable_gain
from wfsobs.control.mirror import Mirror
from wfsobs.evaluation.scores import BOUND, BOUNDS
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate

MATCHED = Scenario().replace(
    {
        "turbulence.rms": 0.53,
        "vibration.source": "ar2",
        "kalman.frequency": 47.5,
        "vibration.peaks": [{"frequency": 47.5, "damping": 0.03, "rms": [0.05, 0.05]}],
        "sensors.lgs_count": 1,
        "sensors.lgs_noise": 0.02,
        "sensors.lgs_low_frequency_rms": 0.0,
    }
)
"""One turbulence of 530 nm, one line of 50 nm, 20 nm of noise, and a filter that knows them."""

SEEDS = range(1, 11)
"""Of the tables of presets."""

NO_CONE = {"turbulence.source": "ar2", "turbulence.rms": 0.53, "sensors.lgs_low_frequency_rms": 0.0}
"""LGS that see what is on the axis."""

LINEAR = [name for name, c in CONTROLLERS.items() if c.is_quick and name != "none"]


def two_frames() -> None:
    """The two-frame loop, by theory and simulated: 20 seeds of 60 s, tip and tilt."""
    half = {"control.integrator": "manual", "control.gain": 0.5}
    print("| Controller | Theory, nm | Simulated, nm | over theory |\n|---|---|---|---|")
    cases = (
        ("Integrator, g = 0.5", "integrator", half),
        ("Integrator, best gain", "integrator", {}),
        ("LQG, LGS KF", "lqg-kf-lgs", {}),
    )
    for name, controller, changes in cases:
        left = _left(MATCHED.replace({"run.duration": 60.0, **changes}), [controller], range(1, 21))[controller]
        plan = design(MATCHED.replace(changes), [controller])
        one = plan.laws[controller][0]
        gain = f" (g = {one.law.gain:.2f})" if one.law and one.law.gain and not changes else ""
        simulated, theory = _pooled(left), (one.predicted_rms or 0.0) * 1e3
        print(f"| {name}{gain} | {theory:.2f} | {simulated:.2f} | {simulated / theory:.3f} |")
    print(f"| Bound | {plan.bounds[BOUND][0] * 1e3:.2f} | | |")


def presets() -> None:
    """Every preset with tip and tilt: medians of 10 seeds, and how much less than the integrator."""
    for name in ("paper", "ut4"):
        _compare(f"`{name}`", PRESETS[name](), [name for name, c in CONTROLLERS.items() if c.step_law is None], SEEDS)


def adaptive() -> None:
    """Controllers told nothing beside those told all, from 5 s on: medians of 10 records of 30 s; and a line that jumps."""
    names = ["integrator", "lqg-kf-multi", "lqg-kf-adaptive", "lqg-multirate-multi", "lqg-multirate-adaptive"]
    for name in ("paper", "ut4"):
        _compare(f"`{name}`", PRESETS[name]().replace({"run.duration": 30.0, "run.warm_up": 5.0}), names, SEEDS)
    jump = PRESETS["peak-jump"]()
    _compare("`peak-jump`, from 4 s after the jump on", jump.replace({"run.warm_up": 12.0}), names, SEEDS)


def no_cone() -> None:
    """The lines of UT4 where the LGS see what is on the axis."""
    _compare("The lines of `ut4`, no cone effect", PRESETS["ut4"]().replace(NO_CONE), LINEAR, SEEDS)


def delays() -> None:
    """The two-frame loop with other delays, by theory."""
    print("| Delay, frames | stable below | best gain | Integrator, nm | LQG, nm | Bound, nm | margins of LQG |")
    print("|---|---|---|---|---|---|---|")
    for delay in (1.0, 1.5, 2.0, 2.5, 3.0, 4.0):
        plan = design(MATCHED.replace({"control.delay": delay}), ["integrator", "lqg-kf-lgs"])
        integrator, lqg = plan.laws["integrator"][0], plan.laws["lqg-kf-lgs"][0]
        assert integrator.law and integrator.law.gain and integrator.predicted_rms and lqg.predicted_rms and lqg.margins
        m = lqg.margins
        highest = highest_stable_gain(Mirror(delay), 1.0)
        left = " | ".join(f"{x * 1e3:.2f}" for x in (integrator.predicted_rms, lqg.predicted_rms, plan.bounds[BOUND][0]))
        db, turn, late = 20 * np.log10(m.gain or np.inf), np.degrees(m.phase or 0.0), (m.delay or 0.0) * 1e3
        print(f"| {delay:g} | {highest:.3f} | {integrator.law.gain:.3f} | {left} | {db:.1f} dB, {turn:.0f}°, {late:.2f} ms |")


def _left(scenario: Scenario, controllers: Sequence[str], seeds: Sequence[int]) -> dict[str, list[list[float]]]:
    """Controller -> per seed the residual of every mode [nm], the bound among them."""
    plan = design(scenario, controllers)
    out: dict[str, list[list[float]]] = {}
    for seed in seeds:
        result = closed_loop(simulate(scenario.replace({"run.seed": seed})), plan)
        for name in (*controllers, *BOUNDS):
            residual = [r["residual_rms_nm"] for r in rows(result, seed) if r["controller"] == name]
            if residual:  # the bound of every star apart has a row only where the stars see different air
                out.setdefault(name, []).append(residual)
    return out


def _pooled(left: list[list[float]]) -> float:
    return float(np.sqrt(np.mean(np.square(left))))


def _compare(title: str, scenario: Scenario, controllers: Sequence[str], seeds: Sequence[int]) -> None:
    left = _left(scenario, controllers, seeds)
    middle = {name: [median(column) for column in zip(*values, strict=True)] for name, values in left.items()}
    best = middle["integrator"]
    print(f"{title}\n\n| Controller | Tip, nm | Tilt, nm | less than the integrator |\n|---|---|---|---|")
    for name in sorted(middle, key=lambda n: sum(middle[n])):
        less = ", ".join(f"{100 * (1 - here / there):.0f} %" for here, there in zip(middle[name], best, strict=True))
        shown = "" if name in ("integrator", "none") else less
        print(f"| {label(name)} | {middle[name][0]:.1f} | {middle[name][1]:.1f} | {shown} |")
    print()


TABLES: dict[str, Callable[[], None]] = {
    "two_frames": two_frames,
    "presets": presets,
    "adaptive": adaptive,
    "no_cone": no_cone,
    "delays": delays,
}

if __name__ == "__main__":
    for table in sys.argv[1:] or TABLES:
        TABLES[table]()
        print()
