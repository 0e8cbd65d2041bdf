"""What the checks of observers and of controllers share, and an observer frame by frame against its run over a record."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import get_context
from typing import Any, TypeVar

import numpy as np

from wfsobs.control.step import StepController
from wfsobs.observers.base import Observer
from wfsobs.observers.step import StepObserver, frames_of
from wfsobs.prior import Prior
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Measurements, hold_last
from wfsobs.settings.errors import error_line
from wfsobs.typing import Array

R = TypeVar("R")

SAME = 1e-9
"""Difference over the rms of an estimate that is rounding: blocks of another length add up in another order."""

QUICK: dict[str, Any] = {
    "run.duration": 1.5,
    "run.warm_up": 0.2,
    "adaptive.window": 0.25,
    "gpr_offline.training_size": 60,
    "gpr_offline.depth": 25,
    "gpr_online.training_size": 60,
    "gpr_online.depth": 25,
}


class CheckError(AssertionError):
    """An observer or a controller that does not keep a rule: one line naming it and the rule."""


@contextmanager
def report_errors(name: str, watch: Watch, what: str = "cannot run") -> Iterator[None]:
    """Raise CheckError for whatever is raised inside; ask first whether to stop."""
    watch.check()
    try:
        yield
    except CheckError:
        raise
    except (Exception, SystemExit) as error:
        raise CheckError(f"{name}: {what}: {error_line(error)}") from error


def check_numbers(name: str, what: str, values: Any, shape: tuple[int, ...]) -> None:
    """Raise CheckError unless values are an array of this shape, (n_steps, n_modes), and of float64."""
    if not isinstance(values, np.ndarray) or values.dtype != float:
        kind = values.dtype if isinstance(values, np.ndarray) else type(values).__name__
        raise CheckError(f"{name}: {what} takes an array of float64, not {kind}")
    if values.shape != shape:
        raise CheckError(f"{name}: {what} takes the shape {shape}, (n_steps, n_modes), not {values.shape}")


def arrays_of(measurements: Measurements) -> dict[str, Array]:
    """Return every array of measurements by name."""
    return {name: x for name, x in vars(measurements).items() if isinstance(x, np.ndarray)}


LOST = 7
"""Measurements in a row that are missing."""


def with_gap(measurements: Measurements) -> Measurements:
    """Return measurements without LOST samples in the middle."""
    y, start = measurements.y_lgs.copy(), measurements.n_steps // 2
    y[start : start + LOST] = np.nan
    return replace(measurements, y_lgs=y)


RESIDUES = 7
COMMON_MULTIPLE = 420
"""Of the whole numbers up to RESIDUES."""


def steps_to_check(n: int) -> list[int]:
    """Return steps of a record of n after which a check changes what is measured.

    Two are near the start. The others are spread at random over the record, with neighbouring residues of COMMON_MULTIPLE, and
    hence every residue of the numbers up to RESIDUES: what looks ahead at every fifth step alone does so at one of them.
    """
    rng, last = np.random.default_rng(n), n - 2
    period = min(COMMON_MULTIPLE, last + 1)
    residues = (rng.integers(period) + np.arange(RESIDUES)) % period
    spread = [int(rng.choice(np.arange(residue, last + 1, period))) for residue in residues]
    return [min(int(rng.integers(10)), last), min(int(rng.integers(10, 100)), last), *spread]


def changed_after(measurements: Measurements, step: int, *, commands_from: int = 1) -> Measurements:
    """Return measurements with other numbers in every array after a step; commands_from : of u, steps from there on."""
    rng = np.random.default_rng(step)
    first = {"u": step + commands_from}
    return replace(
        measurements, **{name: _change_from(x, first.get(name, step + 1), rng) for name, x in arrays_of(measurements).items()}
    )


def _change_from(x: Array, start: int, rng: np.random.Generator) -> Array:
    out = x.copy()
    if x.dtype.kind == "f":
        scale = 3.0 * (np.std(hold_last(x.reshape(len(x), -1))) or 1.0)
        out[start:] += scale * rng.standard_normal(out[start:].shape)
    else:
        out[start:] = rng.integers(0, x.max() + 1, out[start:].shape)
    return out


def in_a_fresh_process(name: str, watch: Watch, run: Callable[..., R], *arguments: Any) -> R:
    """Return what `run` gives in a process that is started for it and receives the arguments, and functions by their names.

    Raises CheckError where they cannot be sent, or it fails there.
    """
    with (
        report_errors(name, watch, "cannot run in a fresh process"),
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool,
    ):
        return pool.submit(run, *arguments).result()


Estimates = dict[str, Array]

STEPS = "cannot run frame by frame"


def run_steps(observer: StepObserver, measurements: Measurements, steps: Sequence[int] | None = None) -> Estimates:
    """Return `predict(0)` after every frame of measurements, target -> (n_steps, n_modes) [um]; steps : those to take.

    A lost command is held, as the mirror holds its position; NGS frames are given where they are due, NaN where they are lost.
    """
    measurements = replace(measurements, u=hold_last(measurements.u))
    out = {target: np.full_like(measurements.z, np.nan) for target in observer.targets}
    steps = range(measurements.n_steps) if steps is None else steps
    for k, frame in zip(steps, frames_of(measurements, steps=steps), strict=True):
        observer.update(frame.z, frame.ngs, frame.u, stars=frame.stars, each=frame.each)
        for target, values in out.items():
            values[k] = observer.predict(0, target)[0]
    return out


def run_loop(controller: StepController, measurements: Measurements) -> Array:
    """Return the commands (n_steps, n_modes) [um] in a loop with the mirror and these pseudo-open-loop measurements."""
    measurements = replace(measurements, u=hold_last(measurements.u))
    n, mirror = measurements.ratio or 1, controller.plant.mirror
    u, seen = np.zeros_like(measurements.z), np.zeros_like(measurements.z)
    back = np.arange(1, mirror.taps.size)
    for k, frame in enumerate(frames_of(measurements)):
        past = back[back <= k]
        seen[k] = mirror.taps[past] @ u[k - past]
        ngs = None if frame.ngs is None else frame.ngs + seen[k + 1 - n : k + 1].mean(axis=0)
        u[k] = controller.update(frame.z + seen[k], ngs, stars=frame.stars)
    return u


def step_difference(observer: Observer, measurements: Measurements, prior: Prior, settings: Any) -> float:
    """Return the largest difference between steps and batch over the standard deviation of the estimate; inf where NaN differ."""
    batch = observer.estimate(measurements, prior, settings)
    got = run_steps(observer.design(prior, settings, measurements.sampling), measurements)
    worst = 0.0
    for target in observer.targets:
        a, b = got[target], batch[target]
        if not np.array_equal(np.isnan(a), np.isnan(b)):
            return float("inf")
        if not np.isnan(b).all():
            worst = max(worst, float(np.nanmax(np.abs(a - b))) / (float(np.nanstd(b)) or 1.0))
    return worst


def check_steps(observer: Observer, measurements: Measurements, prior: Prior, settings: Any, watch: Watch = QUIET) -> None:
    """Check an observer that can run frame by frame.

    After every frame its estimate is that of its run over the record, without gaps and with. It goes on from a saved state as if
    there had been no break, and a reset takes it back to the start.

    Raises
    ------
    CheckError
        With the rule that it does not keep.
    """
    if observer.step is None:
        return
    broken, half = with_gap(measurements), measurements.n_steps // 2
    with report_errors(observer.id, watch, STEPS):
        differences = [step_difference(observer, seen, prior, settings) for seen in (measurements, broken)]
    measurements = broken
    if not max(differences) <= SAME:
        raise CheckError(f"{observer.id}: frame by frame its estimate is not that of its run over the record")
    with report_errors(observer.id, watch, STEPS):
        ours, other = (observer.design(prior, settings, measurements.sampling) for _ in range(2))
        base = run_steps(ours, measurements)
    with report_errors(observer.id, watch, STEPS):
        run_steps(other, measurements, range(half))
        ours.reset()
        ours.load_state_dict(other.state_dict())
        got = run_steps(ours, measurements, range(half, measurements.n_steps))
    _compare(observer, got, base, half, "from a saved state it goes on elsewhere")
    with report_errors(observer.id, watch, STEPS):
        ours.reset()
        got = run_steps(ours, measurements)
    _compare(observer, got, base, 0, "after a reset it is not what it was at the start")


def _compare(observer: Observer, got: Estimates, base: Estimates, start: int, what: str) -> None:
    for target in observer.targets:
        if not np.array_equal(got[target][start:], base[target][start:], equal_nan=True):
            raise CheckError(f"{observer.id}: {what} ({target})")
