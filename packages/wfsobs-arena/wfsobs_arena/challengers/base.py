"""The types of challengers, and how one that predicts the whole disturbance answers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wfsobs.control.base import Controller
from wfsobs.observers.base import TURBULENCE, VIBRATION, Observer
from wfsobs.record import NEXT_Z, TOTAL, Estimates
from wfsobs.typing import Array


class Challenger(NamedTuple):
    """An observer or a controller that enters the arena alone.

    algorithm : with an id of its own
    tracks    : ids of those that it was made for
    source    : publication
    """

    algorithm: Observer | Controller
    tracks: tuple[str, ...]
    source: str


WHOLE = ("disturbance", "next", "events")
"""Tracks of predictors of the whole disturbance."""


def whole_estimate(values: Array, sd: Array | None = None) -> Estimates:
    """Return the estimates of a predictor of the whole disturbance, which does not part it: all of it is called turbulence.

    values : (n_steps, n_modes) [um];  sd : of the next measurement less it, the same shape [um]
    """
    known = {} if sd is None else {NEXT_Z: sd}
    return Estimates({TURBULENCE: values, VIBRATION: np.zeros_like(values)}, known)


__all__ = ["NEXT_Z", "TOTAL", "WHOLE", "Challenger", "whole_estimate"]
