"""Checks of what comes into a step observer; every error is one line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf, isnan
from textwrap import shorten

import numpy as np
from numpy.typing import ArrayLike

from wfsobs.typing import Array


class StepError(ValueError):
    """Error: a step that cannot be taken, or an observer that has none; one line with the reason."""


KNOWN = frozenset({"beside", "covariance", "frames", "held", "last", "mirror", "past", "sent", "states", "x"})
"""Parts of a state that hold finite numbers; others may have NaN where nothing is known yet."""


def check_frame(id: str, x: ArrayLike, name: str, n_modes: int, frame: int) -> tuple[Array, bool]:
    """Return one number per mode as an array, and whether it has no NaN, which is missing. Raises StepError."""
    if type(x) is not np.ndarray or x.dtype != float:
        x = as_numbers(id, x, name)
    if x.shape != (n_modes,):
        raise StepError(f"{id}: {name} takes the shape {(n_modes,)}, one number per mode, not {x.shape}")
    is_whole = bool(x.dot(x) < inf)
    if not is_whole and np.isinf(x).any():
        raise StepError(f"{id}: {name} is infinite in frame {frame}; NaN stands for a missing number")
    return x, is_whole


def as_numbers(id: str, x: ArrayLike, name: str) -> Array:
    """Return real numbers as float64. Raises StepError for anything else."""
    try:
        raw = np.asarray(x)
        if raw.dtype.kind in "biufO":
            return raw.astype(float)
    except (TypeError, ValueError):
        raise StepError(f"{id}: {name} takes real numbers, not {shorten(repr(x), 60)}") from None
    raise StepError(f"{id}: {name} takes real numbers, not {'text' if raw.dtype.kind in 'SU' else raw.dtype}")


def check_stars(id: str, stars: object) -> None:
    """Raise StepError unless stars is a number of LGS, or None for all."""
    if stars is not None and (not isinstance(stars, (int, np.integer)) or stars < 0):
        raise StepError(f"{id}: stars takes a whole number, 0 or more, not {shorten(repr(stars), 60)}")


def check_each(id: str, each: ArrayLike | None, shape: tuple[int, int], frame: int) -> Array:
    """Return the measurement of every LGS by itself as an array, NaN where one is out. Raises StepError."""
    x = None if each is None else as_numbers(id, each, "each")
    if x is None or x.shape != shape:
        raise StepError(f"{id}: takes every LGS by itself: update(z, each=...) of the shape {shape}, (n_lgs, n_modes)")
    if np.isinf(x).any():
        raise StepError(f"{id}: each is infinite in frame {frame}; NaN stands for a star that is out")
    return x


def check_ngs(id: str, ngs: ArrayLike | None, due: bool, n_modes: int, ratio: int, frame: int) -> Array | None:
    """Return an NGS frame that is due, NaN where it is missing, and None where none is due. Raises StepError."""
    if due:
        return np.full(n_modes, np.nan) if ngs is None else check_frame(id, ngs, "ngs", n_modes, frame)[0]
    if ngs is not None and not np.isnan(as_numbers(id, ngs, "ngs")).all():
        raise StepError(f"{id}: an NGS frame in frame {frame}: one is due in every {ratio}th, {ratio}, {2 * ratio}, ...")
    return None


def check_state(id: str, state: Mapping[str, ArrayLike], own: Mapping[str, Array]) -> dict[str, Array]:
    """Return a state as arrays. Raises StepError where it is that of another design, or has no numbers where there are some."""
    if not isinstance(state, Mapping):
        raise StepError(f"{id}: load_state_dict: takes what state_dict returns, not a {type(state).__name__}")
    given = {name: as_numbers(id, x, f"load_state_dict: {name}") for name, x in state.items()}
    for name in sorted(own.keys() | given.keys()):
        if name not in given or name not in own or given[name].shape != own[name].shape:
            shape = "no such state" if name not in own else f"takes the shape {own[name].shape}"
            raise StepError(f"{id}: load_state_dict: the state is that of another design: {name}: {shape}")
        is_count = own[name].dtype.kind in "biu"
        if (is_count or name.rpartition(".")[2] in KNOWN) and not np.isfinite(given[name]).all():
            raise StepError(f"{id}: load_state_dict: {name} is NaN or infinite")
        if is_count and (given[name] % 1).any():
            raise StepError(f"{id}: load_state_dict: {name} takes whole numbers")
        given[name] = given[name].astype(own[name].dtype)
    if given["frame"] < 0:
        raise StepError(f"{id}: load_state_dict: frame = {given['frame']:g}: takes 0 or more")
    return given


def only_target(id: str, targets: Sequence[str]) -> str:
    """Return the target of an observer that estimates one. Raises StepError."""
    if len(targets) != 1:
        raise StepError(f"{id}: predict takes a target: {' or '.join(targets)}")
    return targets[0]


def check_request(id: str, frames: float, target: str, targets: Sequence[str], horizon: float | None) -> None:
    """Raise StepError for a prediction that an observer of these targets, and trained for this horizon, does not make."""
    if target not in targets:
        raise StepError(f"{id}: target {target!r}: it estimates {' and '.join(targets)}")
    if not isinstance(frames, (int, float, np.number)) or not 0 <= frames < inf:
        raise StepError(f"{id}: frames = {frames!r}: takes 0 or more")
    if horizon is not None and frames != horizon:
        raise StepError(
            f"{id}: designed for {horizon:g} frames ahead; design it with horizon = {frames:g} for predict({frames:g})"
        )


def whole_frames(frames: float, what: str) -> int:
    """Return frames as a whole number. Raises StepError."""
    if isnan(frames) or frames < 0 or frames != int(frames):
        raise StepError(f"{what}: takes a whole number of frames ahead, 0 or more, not {frames:g}")
    return int(frames)
