"""What goes out: the estimate while all is well, else zero or the last good one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from wfsobs.typing import Array

Fallback = Literal["zero", "hold"]

SIGMAS = 6.0
"""An error of the next measurement is out of its band beyond so many standard deviations."""
BEYOND = 5
"""Frames in a row with such an error after which the estimate is out."""


@dataclass(frozen=True)
class Safety:
    """When an estimate is not sent.

    fallback : what is sent in its place
    largest  : magnitude that no estimate may have [um]
    missing  : frames in a row that may be missing
    calm     : frames in a row, all well, after which the estimate is sent again
    """

    fallback: Fallback = "zero"
    largest: float = float("inf")
    missing: int = 10
    calm: int = 1000


class Watchdog:
    """Decides in every frame what is sent.

    Parameters
    ----------
    n_modes : int
        Number of modes.
    safety : Safety
        When an estimate is not sent.
    say : callable
        Receives one line whenever that changes.
    warm_up : int
        Frames before the first estimate is sent.

    Attributes
    ----------
    reason : str
        Why the estimate is not sent; "" while it is.
    trips : int
        Times that it fell back.
    """

    def __init__(self, n_modes: int, safety: Safety, say: Callable[[str], None], warm_up: int = 0):
        self.reason, self.trips = ("the observer starts" if warm_up else ""), 0
        self._safety, self._say = safety, say
        self._good, self._left = np.zeros(n_modes), warm_up
        self._beyond = 0

    def output(self, estimate: Array, error: Array, band: Array, missing: int) -> Array:
        """Return what is sent after a frame.

        Parameters
        ----------
        estimate : Array
            Of the observer, (n_modes,) [um].
        error, band : Array
            Error of what was expected of this measurement, and the standard deviation that the observer states for it, (n_modes,)
            [um]; NaN where there is none.
        missing : int
            Frames missing in a row before this one.
        """
        if found := self._fault(estimate, error, band, missing):
            self.fall_back(found)
        elif self._left:
            self._left -= 1
            if not self._left:
                self._return()
        if not self.reason:
            self._good[:] = estimate
            return estimate
        return self.safe

    @property
    def safe(self) -> Array:
        """What is sent in place of an estimate, (n_modes,) [um]."""
        return self._good if self._safety.fallback == "hold" else np.zeros_like(self._good)

    def fall_back(self, reason: str) -> None:
        """Send no estimate until all has been well for a while."""
        if not self.reason:
            self.trips += 1
            self._say(f"{reason}: output falls back to {self._safety.fallback}")
        self.reason, self._left = reason, self._safety.calm

    def _return(self) -> None:
        self._say(f"output on again after {self._safety.calm} good frames" if self.trips else "output on")
        self.reason = ""

    def _fault(self, estimate: Array, error: Array, band: Array, missing: int) -> str:
        if not np.isfinite(estimate).all():
            return "the estimate is not finite"
        if np.abs(estimate).max() > self._safety.largest:
            return f"the estimate exceeds {self._safety.largest:g} um"
        if missing > self._safety.missing:
            return f"{missing} frames in a row are missing"
        with np.errstate(invalid="ignore"):
            self._beyond = self._beyond + 1 if (np.abs(error) > SIGMAS * band).any() else 0
        if self._beyond >= BEYOND:
            return f"the estimate left its band: {BEYOND} measurements in a row {SIGMAS:g} standard deviations off"
        return ""
