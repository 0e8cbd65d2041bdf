"""The bounds of a simulated record as rows of its table: of the LGS alone, of LGS and NGS, of every star apart.

Those of all modes together take a second and more. They are computed where an observer that they are for is in the table.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

from wfsobs.evaluation.bound import LeastError, least_errors
from wfsobs.evaluation.bound_asterism import least_errors_of_asterism, least_errors_of_modes_of_both
from wfsobs.evaluation.bound_both import PeriodicError, least_errors_of_both
from wfsobs.evaluation.bound_modes import least_errors_of_modes
from wfsobs.evaluation.bound_stars import least_errors_of_stars
from wfsobs.evaluation.memory import keep_freed_memory
from wfsobs.evaluation.rows import JOINT_BOUNDS
from wfsobs.evaluation.scores import (
    BOUND,
    BOUND_BOTH,
    BOUND_STARS,
    SCORED,
    Score,
)
from wfsobs.observers import OBSERVERS
from wfsobs.priors_from.selection import has_prior
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.signal.welch import rms
from wfsobs.simulation.guide_stars import MEAN, stars_differ
from wfsobs.simulation.star_spectra import star_spectra
from wfsobs.simulation.true_spectra import has_known_spectra, true_spectra

Errors = dict[str, LeastError] | dict[str, PeriodicError]

JOINT: Mapping[str, tuple[str, Callable[[Scenario], list[dict[str, PeriodicError]]]]] = MappingProxyType(
    {
        "kf-coupled": (BOUND, least_errors_of_modes),
        "multirate-coupled": (BOUND_BOTH, least_errors_of_modes_of_both),
        "kf-asterism": (BOUND_STARS, least_errors_of_asterism),
    }
)
"""Observer of JOINT_BOUNDS -> the bound of each mode by itself, and how to compute its own."""


@dataclass(frozen=True)
class Bound:
    """Minimum error of a target in a mode of a record.

    Attributes
    ----------
    row : str
        One of BOUNDS.
    target, mode : str
        Whose.
    column : int
        Index of the mode.
    error : LeastError or PeriodicError
        The error.
    """

    row: str
    target: str
    mode: str
    column: int
    error: LeastError | PeriodicError


def record_bounds(scenario: Scenario, record: Record, observers: Collection[str] = ()) -> list[Bound]:
    """Compute the bounds of a record that was simulated from the scenario; none where its spectra are not known.

    observers : ids of those in the table, with what they estimated; where one is of JOINT, its bound is computed, too
    """
    if not has_known_spectra(scenario):
        return []
    plain = scenario.replace({"run.seed": 0})
    found = [dict(of_mode) for of_mode in _least_of_modes(plain, record.n_modes, record.n_steps)]
    for observer in joint_observers(scenario, observers):
        row, alone = JOINT_BOUNDS[observer], JOINT[observer][0]
        for of_mode, errors in zip(found, _least_together(plain, observer), strict=True):
            of_mode[row] = {target: _lesser(error, of_mode.get(alone, {}).get(target)) for target, error in errors.items()}
    return [
        Bound(row, target, it.name, i, errors[target])
        for i, it in enumerate(scenario.modes[: record.n_modes])
        for row, errors in found[i].items()
        for target in SCORED
    ]


def joint_observers(scenario: Scenario, observers: Collection[str]) -> list[str]:
    """Return those of JOINT among observers that a scenario has something for."""
    return [name for name in JOINT if name in observers and has_prior(OBSERVERS[name], scenario)]


@lru_cache(maxsize=4)
def _least_together(scenario: Scenario, observer: str) -> list[dict[str, PeriodicError]]:
    keep_freed_memory()
    return JOINT[observer][1](scenario)


def _lesser(together: PeriodicError, alone: LeastError | PeriodicError | None) -> PeriodicError:
    """Return the error of the best weights of many means of all modes, or that of a mode by itself where it is smaller.

    No number of means is enough for a narrow line, or for a continuum of the vibration that is told as a few processes.
    """
    if alone is None or together.rms <= alone.rms:
        return together
    return alone if isinstance(alone, PeriodicError) else PeriodicError(alone.covariance[:1])


@lru_cache(maxsize=4)  # no seed changes them, and they take longer than most observers
def _least_of_modes(scenario: Scenario, n_modes: int, n_steps: int) -> list[dict[str, Errors]]:
    """Compute row -> target -> error of the first modes of a scenario."""
    keep_freed_memory()

    def of_mode(mode: int) -> dict[str, Errors]:
        spectra = true_spectra(scenario, mode)
        found: dict[str, Errors] = {BOUND: least_errors(spectra, n_steps=n_steps), BOUND_BOTH: least_errors_of_both(spectra)}
        if stars_differ(scenario, mode):
            mean = spectra if scenario.sensors.lgs_combination == MEAN else None
            found[BOUND_STARS] = least_errors_of_stars(star_spectra(scenario, mode, mean))
        return found

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(of_mode, range(n_modes)))


def bound_scores(bounds: Sequence[Bound], record: Record, scores: Sequence[Score], warm_up: float) -> list[Score]:
    """Return the scores of bounds, on the samples of the observers' scores, or on all after the warm-up [s]."""
    stretches = {(s.target, s.mode): (s.start, s.stop) for s in scores if not s.apart}
    out = []
    for it in bounds:
        start, stop = stretches.get((it.target, it.mode), (None, None))
        first = round((warm_up if start is None else start) / record.dt)
        last = record.n_steps if stop is None else round(stop / record.dt)
        truth = record.truth(it.target)
        if truth is not None and first < last:
            scale = rms(truth[first:last, it.column])
            out.append(
                Score(
                    it.row,
                    it.target,
                    it.mode,
                    it.error.rms,
                    scale,
                    it.error.rms / scale if scale > 0 else None,
                    None,
                    0.0,
                    first * record.dt,
                    last * record.dt,
                    interval=it.error.interval(first, last) if isinstance(it.error, LeastError) else None,
                    phases=it.error.phases if isinstance(it.error, PeriodicError) and it.error.variance.size > 1 else None,
                )
            )
    return out
