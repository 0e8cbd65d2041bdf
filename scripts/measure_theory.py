"""Time the predictions that follow a handle: 60 frames of a drag, on presets.

    python scripts/measure_theory.py [PRESET ...]

Every frame moves one setting a little further, as a drag does, and predicts in one mode, as coarsely as a drag does, all linear
observers of the LGS, then each of the others, then all by turns, as the page does: a frame has those for which there is time, and
the next one begins with the others. It prints the median, the 95th percentile and the maximum [ms], and the median of
the processor's time, which does not count others at work on the machine; the first frame of a drag, which computes what the
others share, stands by itself.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from math import inf
from time import monotonic, perf_counter, process_time

import numpy as np

from wfsobs.app.views.spectrum_editor import DRAGGED, FRAME, LOOSE
from wfsobs.app.work import one_blas_thread
from wfsobs.evaluation.exact_errors import Theory, is_predicted
from wfsobs.evaluation.scores import BOUND
from wfsobs.observers import OBSERVERS
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS

FRAMES = 60
BY_TURNS = "all, by turns"


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


Move = Callable[[Scenario, int], Scenario | None]

DRAGS: dict[str, tuple[str, Move]] = {
    "peak": ("vibration", moved_peak),
    "Kalman peak": ("vibration", moved_model),
    "band": ("vibration", moved_band),
    "turbulence corner": ("turbulence", moved_corner),
}


def main(names: list[str]) -> None:
    """Print a line per preset and drag."""
    one_blas_thread()
    print(f"{'preset':10}{'drag':19}{'observers':19}{'first':>9}{'p50':>9}{'p95':>9}{'max':>9}{'CPU':>9}   ms, {FRAMES} frames")
    for name in names:
        for drag, (target, move) in DRAGS.items():
            for label, observers in groups(target).items():
                times, busy = drag_times(name, target, move, observers, label == BY_TURNS)
                if times:
                    p50, p95 = np.percentile(times[1:], [50, 95])
                    print(f"{name:10}{drag:19}{label:19}{times[0]:9.1f}{p50:9.1f}{p95:9.1f}", end="")
                    print(f"{max(times[1:]):9.1f}{np.median(busy[1:]):9.1f}", flush=True)


def groups(target: str) -> dict[str, list[str]]:
    """Return what is predicted together: the observers of the LGS and the bound, and each other one."""
    linear = [o for o in OBSERVERS.values() if is_predicted(o, target)]
    fast = [o.id for o in linear if o.sensors == ("lgs",)]
    every = [*(o.id for o in linear), BOUND]
    return {"of the LGS": [*fast, BOUND], **{o.id: [o.id] for o in linear if o.id not in fast}, BY_TURNS: every}


def drag_times(name: str, target: str, move: Move, observers: list[str], by_turns: bool) -> tuple[list[float], list[float]]:
    """Return the time and the processor's time of every frame of a drag [ms]; none where there is nothing to move."""
    theory, times, busy = Theory(most=DRAGGED, left=LOOSE), [], []
    for i in range(FRAMES + 1):
        scenario = move(PRESETS[name](), i)
        if scenario is None:
            break
        start, at_work = perf_counter(), process_time()
        found = theory.predict(scenario, 0, target, observers, until=monotonic() + FRAME if by_turns and i else inf)
        served = {p.observer for p in found}
        times.append(1e3 * (perf_counter() - start))
        busy.append(1e3 * (process_time() - at_work))
        observers = sorted(observers, key=lambda one: one in served)
    return times, busy


if __name__ == "__main__":
    main(sys.argv[1:] or ["paper", "ut4"])
