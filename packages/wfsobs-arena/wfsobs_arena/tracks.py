"""The tracks: what is asked in each, of whose measurements, and what an answer is judged by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from wfsobs.observers.base import TARGETS, TURBULENCE, VIBRATION

if TYPE_CHECKING:
    from wfsobs.observers.base import Observer

DISTURBANCE, NEXT, RESIDUAL = "disturbance", "next", "residual"
"""Targets beside those of observers: turbulence and vibration together, the next measurement, and what a controller leaves."""

LGS, BOTH = ("lgs",), ("lgs", "ngs")


@dataclass(frozen=True)
class Track:
    """A track.

    Attributes
    ----------
    id, label : str
        For files, and for people.
    target : str
        What is estimated, of "turbulence", "vibration", "disturbance" (both together), "next" (the next measurement), or
        "residual" (what a controller leaves).
    sensors : tuple of str
        Whose measurements an entry receives, of "lgs" and "ngs".
    help : str
        One line.
    """

    id: str
    label: str
    target: str
    sensors: tuple[str, ...]
    help: str

    @property
    def is_loop(self) -> bool:
        """Whether controllers enter, not observers."""
        return self.target == RESIDUAL

    @property
    def targets(self) -> tuple[str, ...]:
        """Targets of an observer whose sum is the answer."""
        return (self.target,) if self.target in TARGETS else TARGETS

    def admits(self, observer: Observer) -> bool:
        """Return whether an observer answers what is asked, from what it receives here."""
        return not self.is_loop and set(self.targets) <= set(observer.targets) and set(observer.sensors) <= set(self.sensors)


TRACKS: dict[str, Track] = {}
"""Tracks by id, in the order of tables."""


def add_track(track: Track) -> None:
    """Add a track. Raises ValueError where the id is taken."""
    if track.id in TRACKS:
        raise ValueError(f"track {track.id!r}: the id is taken")
    TRACKS[track.id] = track


for _track in (
    Track("vibration", "Vibration", VIBRATION, LGS, "the vibration, from the LGS"),
    Track("turbulence", "Turbulence", TURBULENCE, LGS, "the turbulence, from the LGS"),
    Track("disturbance", "Disturbance", DISTURBANCE, LGS, "turbulence and vibration together, from the LGS"),
    Track("next", "Next measurement", NEXT, LGS, "the next measurement of telemetry; records are given by --record"),
    Track("two-sensors", "Two sensors", TURBULENCE, BOTH, "the turbulence, from LGS and NGS"),
    Track("closed-loop", "Closed loop", RESIDUAL, BOTH, "what a controller leaves of the disturbance"),
    Track("events", "Events", DISTURBANCE, BOTH, "turbulence and vibration together, while something happens"),
):
    add_track(_track)
