"""What a loop may rely on: measurements that cannot be are missing, and estimates go out while all is well."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from wfsobs.typing import Array

Fallback = Literal["zero", "hold"]

SIGMAS = 6.0
"""A measurement is out of its band beyond so many standard deviations of its prediction."""
BEYOND = 5
"""Measurements in a row that are out of their band before they are believed rather than the estimate."""
LIMIT = 10.0
"""Magnitude that no estimate may have unless told, over the rms of a measurement by the prior."""
PACE = 0.02
"""By how much of itself a deviation that follows the errors changes with each of them: it forgets in 1 / PACE of them."""
LEAST = 1e-3
"""The least that it falls to, over the rms of a measurement by the prior."""
MEDIAN = 0.6745
"""Median of the magnitude of a Gaussian variable, over its standard deviation."""


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


class Gate:
    """Replaces measurements that cannot be by missing ones.

    A measurement beyond `SIGMAS` deviations of its prediction is missing; after `BEYOND` in a row they are taken, as then the
    disturbance has moved. One far beyond any estimate that may be sent is always missing, so that none stays in a filter.

    The deviation is the one that the filter states, or where that is larger the one that its errors show: the running median of
    their magnitude, which starts at the rms of a measurement by the prior. Where the filter states none the latter stands alone.

    Parameters
    ----------
    spread : Array
        Rms of a measurement by the prior, (n_modes,) [um].
    largest : Array
        Magnitude that no estimate may have, (n_modes,) [um].

    Attributes
    ----------
    mean, sd : Array
        Prediction of the next measurement, and the standard deviation that the filter states for it, (n_modes,) [um]; NaN where
        there is none.
    beyond : Array of int
        Measurements out of their band in a row, (n_modes,).
    """

    mean: Array
    sd: Array
    beyond: Array

    def __init__(self, spread: Array, largest: Array):
        self._spread, self._possible = spread, largest + SIGMAS * spread
        self.restart()

    def restart(self) -> None:
        """Begin anew with a filter that does."""
        self.mean = self.sd = np.full(self._spread.size, np.nan)
        self.beyond = np.zeros(self._spread.size, dtype=int)
        self._deviation = self._spread

    def accept(self, z: Array) -> Array:
        """Return a measurement, any numbers (n_modes,) [um], with NaN where it cannot be."""
        is_possible, followed = np.abs(z) <= self._possible, self._deviation
        error = np.abs(np.where(is_possible, z, np.nan) - np.where(np.isnan(self.mean), 0.0, self.mean))
        is_in = error <= SIGMAS * np.where(np.isnan(self.sd), followed, self.sd)
        self.beyond = np.where(is_in, 0, self.beyond + ~np.isnan(z))
        is_taken = (error <= SIGMAS * np.fmax(followed, self.sd)) | is_possible & (self.beyond >= BEYOND)
        pace = PACE * np.sign(np.nan_to_num(error - MEDIAN * followed))
        self._deviation = np.maximum(followed * np.exp(pace), LEAST * self._spread)
        return np.where(is_taken, z, np.nan)


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
            Measurements out of their band in a row, this one among them (`Gate`).
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
        if beyond >= BEYOND:
            return f"the estimate left its band: {BEYOND} measurements in a row {SIGMAS:g} standard deviations off"
        return ""
