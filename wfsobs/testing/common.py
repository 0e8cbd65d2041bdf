"""What the checks of observers and of controllers share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import get_context
from typing import Any, TypeVar

import numpy as np

from wfsobs.progress import Watch
from wfsobs.record import Measurements, hold_last
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


def error_line(error: BaseException) -> str:
    """Return an error in one line; an error of the code has its type."""
    text = " ".join(str(error).split())
    return text if isinstance(error, (ValueError, AssertionError)) and text else f"{type(error).__name__}: {text}".strip(": ")


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
