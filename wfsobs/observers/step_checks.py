"""Checks of what comes into a step observer; every error is one line."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf, isnan

import numpy as np
from numpy.typing import ArrayLike

from wfsobs.typing import Array


class StepError(ValueError):
    """Error: a step that cannot be taken, or an observer that has none; one line with the reason."""


def check_frame(id: str, x: ArrayLike, name: str, n_modes: int, frame: int) -> tuple[Array, bool]:
    """Return one number per mode as an array, and whether it has no NaN, which is missing. Raises StepError."""
    x = np.asarray(x, dtype=float)
    if x.shape != (n_modes,):
        raise StepError(f"{id}: {name} takes the shape {(n_modes,)}, one number per mode, not {x.shape}")
    is_whole = bool(x.dot(x) < inf)
    if not is_whole and np.isinf(x).any():
        raise StepError(f"{id}: {name} is infinite in frame {frame}; NaN stands for a missing number")
    return x, is_whole


def check_each(id: str, each: ArrayLike | None, shape: tuple[int, int], frame: int) -> Array:
    """Return the measurement of every LGS by itself as an array, NaN where one is out. Raises StepError."""
    x = None if each is None else np.asarray(each, dtype=float)
    if x is None or x.shape != shape:
        raise StepError(f"{id}: takes every LGS by itself: update(z, each=...) of the shape {shape}, (n_lgs, n_modes)")
    if np.isinf(x).any():
        raise StepError(f"{id}: each is infinite in frame {frame}; NaN stands for a star that is out")
    return x


def check_not_due(id: str, ngs: ArrayLike | None, ratio: int, frame: int) -> None:
    """Raise StepError for an NGS frame where none is due."""
    if ngs is not None and not np.isnan(ngs).all():
        raise StepError(f"{id}: an NGS frame in frame {frame}: one is due in every {ratio}th, {ratio}, {2 * ratio}, ...")


def check_state(id: str, state: Mapping[str, ArrayLike], own: Mapping[str, Array]) -> dict[str, Array]:
    """Return a state as arrays. Raises StepError where names or shapes are not those of one's own."""
    given = {name: np.asarray(x) for name, x in state.items()}
    for name in sorted(own.keys() | given.keys()):
        if name not in given or name not in own or given[name].shape != own[name].shape:
            shape = "no such state" if name not in own else f"takes the shape {own[name].shape}"
            raise StepError(f"{id}: load_state_dict: the state is that of another design: {name}: {shape}")
    return given


def whole_frames(frames: float, what: str) -> int:
    """Return frames as a whole number. Raises StepError."""
    if isnan(frames) or frames < 0 or frames != int(frames):
        raise StepError(f"{what}: takes a whole number of frames ahead, 0 or more, not {frames:g}")
    return int(frames)
