"""Time the predictions that follow a handle: 60 frames of a drag, on presets.

    python scripts/measure_theory.py [PRESET ...]

Every frame moves one setting a little further, as a drag does, and predicts all linear observers of the target in one mode. It
prints the median, the 95th percentile and the maximum [ms], and the median of the processor's time, which does not count others
at work on the machine; the first frame of a drag, which computes what the others share, stands by itself.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from time import perf_counter, process_time

import numpy as np

from wfsobs.app.work import one_blas_thread
from wfsobs.evaluation.theory import Theory
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS

FRAMES = 60


def moved_peak(s: Scenario, i: int) -> Scenario | None:
    """Move the strongest peak."""
    if s.vibration.source not in ("peaks", "ar2"):
        return None
    at = max(range(len(s.vibration.peaks)), key=lambda j: s.vibration.peaks[j].rms[0])
    return s.replace({f"vibration.peaks.{at}.frequency": s.vibration.peaks[at].frequency * (1.0 + 0.002 * i)})


def moved_model(s: Scenario, i: int) -> Scenario:
    """Move the peak of the Kalman filters."""
    return s.replace({"kalman.frequency": s.kalman.frequency * (1.0 + 0.002 * i)})


def moved_band(s: Scenario, i: int) -> Scenario:
    """Move a band of the GPR."""
    first, *others = s.butterworth.frequencies
    return s.replace({"butterworth.frequencies": [first * (1.0 + 0.002 * i), *others]})


def moved_corner(s: Scenario, i: int) -> Scenario:
    """Move the corner of the turbulence."""
    return s.replace({"turbulence.wind_speed": s.turbulence.wind_speed * (1.0 + 0.002 * i)})


DRAGS: dict[str, tuple[str, Callable[[Scenario, int], Scenario | None]]] = {
    "peak": ("vibration", moved_peak),
    "Kalman peak": ("vibration", moved_model),
    "band": ("vibration", moved_band),
    "turbulence corner": ("turbulence", moved_corner),
}


def main(names: list[str]) -> None:
    """Print a line per preset and drag."""
    one_blas_thread()
    print(f"{'preset':16}{'drag':20}{'first':>9}{'p50':>9}{'p95':>9}{'max':>9}{'CPU':>9}   ms, {FRAMES} frames")
    for name in names:
        for drag, (target, move) in DRAGS.items():
            theory, times, busy = Theory(), [], []
            for i in range(FRAMES + 1):
                scenario = move(PRESETS[name](), i)
                if scenario is None:
                    break
                start, at_work = perf_counter(), process_time()
                theory.predict(scenario, 0, target)
                times.append(1e3 * (perf_counter() - start))
                busy.append(1e3 * (process_time() - at_work))
            if times:
                p50, p95 = np.percentile(times[1:], [50, 95])
                print(f"{name:16}{drag:20}{times[0]:9.1f}{p50:9.1f}{p95:9.1f}{max(times[1:]):9.1f}{np.median(busy[1:]):9.1f}")


if __name__ == "__main__":
    main(sys.argv[1:] or ["paper", "ut4"])
