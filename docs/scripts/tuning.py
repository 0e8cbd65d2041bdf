"""The figures of docs/tuning.md: what tuning gains, and what of it carries over.

`tuning.py [gains] [lengths] [likelihood] [presets]`: all tables unless told, of the presets named alone where any is.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import minimize

from wfsobs import PRESETS, Scenario, observe, simulate
from wfsobs.tuning import TuningResult, tune
from wfsobs.tuning.trials import likelihood

SEEDS, FEW = range(1, 11), range(1, 5)
USUAL = ("paper", "strong-turbulence", "ut4")
"""Presets of the tables."""
KERNEL = ["gpr_online.length_scale", "gpr_online.noise_std", "gpr_online.depth"]
BANDWIDTH = ["butterworth.bandwidth_online", "gpr_online.noise_std"]
RMS = Callable[[TuningResult], float]


def row(name: str, tuned: list[TuningResult]) -> str:
    """Medians over seeds and, of the ratios, the range; in how many seeds the test error fell."""

    def column(of: RMS, scale: float = 1e3) -> list[float]:
        return [of(t) * scale for t in tuned]

    def error(stage: str, record: str) -> list[float]:
        return column(lambda t: getattr(getattr(t, stage), record).rms)

    cells = [f"{np.median(error(stage, record)):.2f}" for record in ("validation", "test") for stage in ("before", "after")]
    for record in ("validation", "test"):
        ratio = np.divide(error("after", record), error("before", record))
        cells.append(f"{np.median(ratio):.3f} ({ratio.min():.3f} - {ratio.max():.3f})")
    better = sum(a <= b for a, b in zip(error("after", "test"), error("before", "test"), strict=True))
    return " | ".join(["", name, *cells, f"{better} of {len(tuned)}", ""]).strip()


def of_seeds(preset: str, observer: str, seeds: range, names: list[str] | None = None, **more: float) -> list[TuningResult]:
    """A tuning per seed."""
    return [tune(PRESETS[preset]().replace({"run.seed": seed}), observer, names, **more) for seed in seeds]  # type: ignore[arg-type]


def gains(presets: Sequence[str]) -> None:
    """Usual settings by preset and observer; of the online GPR kernel and depth, and the width of its bands."""
    for preset in presets:
        for observer in ("kf-lgs", "gpr-offline", "butterworth-cl"):
            print(row(f"`{preset}` | `{observer}`", of_seeds(preset, observer, SEEDS)), flush=True)
        print(row(f"`{preset}` | `gpr-online`, kernel and depth", of_seeds(preset, "gpr-online", FEW, KERNEL)), flush=True)
    for preset in [p for p in presets if p != "ut4"]:
        found = of_seeds(preset, "gpr-online", FEW, BANDWIDTH, evaluations=20)
        print(row(f"`{preset}` | `gpr-online`, bandwidth and noise", found), flush=True)


def lengths(presets: Sequence[str]) -> None:
    """Validation records of several lengths, `paper`."""
    for seconds in (1.5, 2.5, 5.0, 10.0) if "paper" in presets else ():
        for observer in ("kf-lgs", "gpr-offline"):
            print(row(f"{seconds:g} s | `{observer}`", of_seeds("paper", observer, SEEDS, validation=seconds)), flush=True)


def likeliest(scenario: Scenario) -> Scenario:
    """The scenario with the kernel of the offline GPR that makes its training targets most likely, all three numbers free."""
    record, g = simulate(scenario), scenario.gpr_offline
    names = ("length_scale", "signal_std", "noise_std")

    def at(x: np.ndarray) -> Scenario:
        return scenario.replace({f"gpr_offline.{name}": float(np.exp(v)) for name, v in zip(names, x, strict=True)})

    def cost(x: np.ndarray) -> float:
        try:
            found = likelihood("gpr-offline", record, at(x))
        except ValueError:
            found = None
        return 1e9 if found is None else -sum(found)

    starts = [np.log([g.length_scale, g.signal_std, g.noise_std]), np.log([3.0, 0.02, 0.005]), np.log([30.0, 0.1, 0.002])]
    found = [minimize(cost, x, method="Nelder-Mead", options={"maxfev": 150, "xatol": 0.02, "fatol": 0.5}) for x in starts]
    return at(min(found, key=lambda f: f.fun).x)


def likelihoods(presets: Sequence[str]) -> None:
    """The offline GPR with the paper's kernel, the tuned one, the likeliest."""
    for preset in [p for p in presets if p != "ut4"]:
        for seed in (1, 2, 3):
            s = PRESETS[preset]().replace({"run.seed": seed})
            names = ["gpr_offline.length_scale", "gpr_offline.noise_std"]
            kernels = {"paper's": s, "tuned": tune(s, "gpr-offline", names).scenario, "likeliest": likeliest(s)}
            for name, kernel in kernels.items():
                g, record = kernel.gpr_offline, simulate(kernel)
                errors = [x.rms for x in observe(record, kernel, observers=["gpr-offline"]).scores]
                print(
                    f"| {preset} | {seed} | {name} | {g.length_scale:.4g} | {g.signal_std:.3g} | {g.noise_std:.3g} | "
                    f"{sum(likelihood('gpr-offline', record, kernel) or ()):.0f} | "
                    f"{1e3 * np.sqrt(np.mean(np.square(errors))):.2f} |",
                    flush=True,
                )


if __name__ == "__main__":
    tables, words = {"gains": gains, "lengths": lengths, "likelihood": likelihoods}, sys.argv[1:]
    for name in [name for name in tables if name in words] or tables:
        tables[name]([preset for preset in USUAL if preset in words] or USUAL)
