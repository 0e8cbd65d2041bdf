"""What the checks of observers and of controllers share."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pickle import PicklingError
from typing import Any, TypeVar

import numpy as np

from wfsobs.record import hold_last
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


def change_from(x: Array, start: int, rng: np.random.Generator) -> Array:
    """Return x (n_steps, n_modes) with other numbers from the step `start` on."""
    out = x.copy()
    out[start:] += 3.0 * np.std(hold_last(x.reshape(len(x), -1))) * rng.standard_normal(out[start:].shape)
    return out


def in_a_fresh_process(name: str, run: Callable[..., R], *arguments: Any) -> R:
    """Return what `run` gives in a process that is started for it and receives the arguments, and functions by their names.

    Raises CheckError where they cannot be sent.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(run, *arguments).result()
        except (PicklingError, AttributeError, TypeError) as error:
            raise CheckError(f"{name}: cannot run in a fresh process: {error}") from error
