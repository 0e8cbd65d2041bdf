"""Effects of events as functions of time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wfsobs.scenario.groups.events import Event
from wfsobs.typing import Array


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
    return np.prod([np.ones_like(t), *(1.0 + (event.strength - 1.0) * progress_of_change(event, t) for event in events)], axis=0)


def wind(events: Sequence[Event], t: Array) -> Array:
    """Return the factor on the wind speed at the times t [s]; those of several events multiply."""
    return np.prod(
        [np.ones_like(t), *(1.0 + (event.wind_factor - 1.0) * progress_of_change(event, t) for event in events)], axis=0
    )


def turbulence_time(events: Sequence[Event], t: Array) -> Array:
    """Return the integral of `wind` from the first of the times t [s], evenly spaced, (n,) [s]."""
    factor = wind(events, t)
    return np.concatenate([[0.0], np.cumsum(0.5 * (factor[1:] + factor[:-1]) * np.diff(t))])


def _integral_of_change(event: Event, t: Array) -> Array:
    since = np.maximum(t - event.start, 0.0)
    ramp = np.minimum(since, event.duration)
    return since - ramp + (0.5 * ramp**2 / event.duration if event.duration > 0 else 0.0)
