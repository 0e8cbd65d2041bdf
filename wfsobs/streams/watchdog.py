"""What a loop may rely on: estimates go out while all is well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from wfsobs.signal.gate import RUN
from wfsobs.typing import Array

Fallback = Literal["zero", "hold"]

LIMIT = 10.0
"""Magnitude that no estimate may have unless told, over the rms of a measurement by the prior."""


@dataclass(frozen=True)
class Safety:
    """When an estimate is not sent.

    fallback : what is sent in its place
    largest  : magnitude that no estimate may have [um]; None is `LIMIT` times the rms of a measurement of that mode by the prior
    missing  : frames in a row that may be missing
    calm     : frames in a row, all well, after which the estimate is sent again
    """

    fallback: Fallback = "zero"
    largest: float | None = None
    missing: int = 10
    calm: int = 1000


class Watchdog:
    """Decides in every frame what is sent.

    Parameters
    ----------
    largest : Array
        Magnitude that no estimate may have, (n_modes,) [um].
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

    trips: int

    def __init__(self, largest: Array, safety: Safety, say: Callable[[str], None], warm_up: int = 0):
        self.reason, self.trips = ("the observer starts" if warm_up else ""), 0
        self._largest, self._safety, self._say = largest, safety, say
        self._good, self._left, self._missing = np.zeros(largest.size), warm_up, 0

    def output(self, estimate: Array, z: Array, beyond: int, missing: int) -> Array:
        """Return what is sent after a frame.

        Parameters
        ----------
        estimate : Array
            Of the observer, (n_modes,) [um].
        z : Array
            The measurement that it has taken, (n_modes,) [um].
        beyond : int
            Outliers in a row, this one among them.
        missing : int
            Frames missing in a row before this one.
        """
        is_missing = bool(np.isnan(z).all())
        missing += self._missing + is_missing
        self._missing = missing if is_missing else 0
        if found := self._fault(estimate, beyond, missing):
            self.fall_back(found)
        elif self._left:
            self._left -= 1
            if not self._left:
                self._return()
        if self.reason:
            return self.safe
        if not beyond:
            self._good[:] = estimate
        return estimate

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
        limits = ", ".join(f"{x:.4g}" for x in self._largest)
        again = f"output on again after {self._safety.calm} good frames"
        self._say(again if self.trips else f"output on, of estimates up to {limits} um")
        self.reason = ""

    def _fault(self, estimate: Array, beyond: int, missing: int) -> str:
        if not np.isfinite(estimate).all():
            return "the estimate is not finite"
        if (too_large := ~(np.abs(estimate) <= self._largest)).any():
            return f"the estimate exceeds {self._largest[too_large][0]:.4g} um"
        if missing > self._safety.missing:
            return f"{missing} frames in a row are missing"
        if beyond >= RUN:
            return f"{RUN} measurements in a row are outliers"
        return ""
