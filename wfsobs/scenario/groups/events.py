"""Settings of events during a record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np

from wfsobs.settings.group import Group, UsedWhen
from wfsobs.settings.values import Choice, Real, Whole
from wfsobs.typing import Array

PEAK, WIND, LASER, FRAMES = "peak", "wind", "laser", "frames"
OF_KIND: Mapping[str, tuple[str, ...]] = {
    PEAK: ("peak", "frequency_shift", "strength"),
    WIND: ("wind_factor",),
    LASER: ("lasers",),
    FRAMES: ("sensor", "share"),
}
"""Settings of each kind alone."""


class Event(Group):
    """A change during the record that no observer is told of; the training record has no events.

    Changes of a peak and of the wind ramp up over `duration` and stay; a laser outage and missing frames end after it.
    """

    used_when: ClassVar[UsedWhen] = {name: ("kind", (kind,)) for kind, names in OF_KIND.items() for name in names}

    kind: Choice = Choice(
        [PEAK, WIND, LASER, FRAMES],
        "Kind",
        "peak: a vibration peak changes in frequency and strength; wind: the wind changes; laser: laser guide "
        "stars drop out; frames: frames are missing at random.",
    )
    start: Real = Real(
        5.0, (0.0, 3600.0), "Start", "Start of the event, from the start of the record [s].", softbounds=(0.0, 60.0), step=0.5
    )
    duration: Real = Real(
        0.0,
        (0.0, 3600.0),
        "Duration",
        "Duration of the event [s]; 0 is a jump of a peak or of the wind.",
        softbounds=(0.0, 60.0),
        step=0.5,
    )
    peak: Whole = Whole(0, (0, 99), "Peak", "For kind peak: number of the peak in vibration.peaks, from 0.")
    frequency_shift: Real = Real(
        0.0,
        (-5000.0, 5000.0),
        "Frequency shift",
        "For kind peak: change of its frequency [Hz].",
        softbounds=(-10.0, 10.0),
        step=0.1,
    )
    strength: Real = Real(
        1.0, (0.0, 100.0), "Strength factor", "For kind peak: factor on its rms.", softbounds=(0.0, 4.0), step=0.1
    )
    wind_factor: Real = Real(
        1.0,
        (0.1, 10.0),
        "Wind factor",
        "For kind wind: factor on the wind speed of every layer.",
        softbounds=(0.2, 4.0),
        step=0.1,
    )
    lasers: Whole = Whole(
        1,
        (1, 16),
        "Lasers lost",
        "For kind laser: number of LGS that drop out, the last ones first; with none left there is no LGS measurement.",
    )
    sensor: Choice = Choice(["lgs", "ngs"], "Sensor", "For kind frames: sensor with missing frames.")
    share: Real = Real(0.1, (0.0, 1.0), "Share of frames", "For kind frames: share of missing frames.", step=0.01)


def progress_of_change(event: Event, t: Array) -> Array:
    """Return the part of an event's change that has happened at the times t [s], 0 to 1."""
    if event.duration == 0:
        return np.where(t >= event.start, 1.0, 0.0)
    return np.clip((t - event.start) / event.duration, 0.0, 1.0)


def during(event: Event, t: Array) -> Array:
    """Return whether an event that ends is in progress at the times t [s]."""
    return (t >= event.start) & (t < event.start + event.duration)


def shift(events: Sequence[Event], t: Array) -> Array:
    """Return the sum of the shifts of a peak's frequency at the times t [Hz]."""
    return np.sum([np.zeros_like(t), *(event.frequency_shift * progress_of_change(event, t) for event in events)], axis=0)


def phase_turns(events: Sequence[Event], t: Array) -> Array:
    """Return the integral of `shift` from 0 to t: the added phase of the peak, in turns."""
    return np.sum([np.zeros_like(t), *(event.frequency_shift * _integral_of_change(event, t) for event in events)], axis=0)


def strength(events: Sequence[Event], t: Array) -> Array:
    """Return the factor on a peak's rms at the times t [s]; those of several events multiply."""
    return _factor("strength", events, t)


def wind(events: Sequence[Event], t: Array) -> Array:
    """Return the factor on the wind speed at the times t [s]; those of several events multiply."""
    return _factor("wind_factor", events, t)


def _factor(name: str, events: Sequence[Event], t: Array) -> Array:
    changes = (1.0 + (getattr(event, name) - 1.0) * progress_of_change(event, t) for event in events)
    return np.prod([np.ones_like(t), *changes], axis=0)


def turbulence_time(events: Sequence[Event], t: Array) -> Array:
    """Return the integral of `wind` from the first of the times t [s], evenly spaced, (n,) [s]."""
    factor = wind(events, t)
    return np.concatenate([[0.0], np.cumsum(0.5 * (factor[1:] + factor[:-1]) * np.diff(t))])


def _integral_of_change(event: Event, t: Array) -> Array:
    since = np.maximum(t - event.start, 0.0)
    ramp = np.minimum(since, event.duration)
    return since - ramp + (0.5 * ramp**2 / event.duration if event.duration > 0 else 0.0)
