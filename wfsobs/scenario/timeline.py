"""When events change what: functions of a list of events and of time alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wfsobs.scenario.groups.events import Event
from wfsobs.typing import Array


def done(event: Event, t: Array) -> Array:
    """How much of an event's change has happened at the times t [s], 0 to 1."""
    if event.duration == 0:
        return np.where(t >= event.start, 1.0, 0.0)
    return np.clip((t - event.start) / event.duration, 0.0, 1.0)


def during(event: Event, t: Array) -> Array:
    """Whether an event that ends is on at the times t [s]."""
    return (t >= event.start) & (t < event.start + event.duration)


def shift(events: Sequence[Event], t: Array) -> Array:
    """What events add to a peak's frequency at the times t [Hz]; those of several add up."""
    return np.sum([np.zeros_like(t), *(event.frequency_shift * done(event, t) for event in events)], axis=0)


def turns(events: Sequence[Event], t: Array) -> Array:
    """The integral of `shift` from 0 to t: what it adds to the peak's phase, in turns."""
    return np.sum([np.zeros_like(t), *(event.frequency_shift * _done_integral(event, t) for event in events)], axis=0)


def strength(events: Sequence[Event], t: Array) -> Array:
    """The factor on a peak's rms at the times t [s]; those of several events multiply."""
    return np.prod([np.ones_like(t), *(1.0 + (event.strength - 1.0) * done(event, t) for event in events)], axis=0)


def wind(events: Sequence[Event], t: Array) -> Array:
    """The factor on the wind speed at the times t [s]; those of several events multiply."""
    return np.prod([np.ones_like(t), *(1.0 + (event.wind_factor - 1.0) * done(event, t) for event in events)], axis=0)


def air_time(events: Sequence[Event], t: Array) -> Array:
    """The integral of `wind` from the first of the times t [s], evenly spaced, (n,) [s]."""
    factor = wind(events, t)
    return np.concatenate([[0.0], np.cumsum(0.5 * (factor[1:] + factor[:-1]) * np.diff(t))])


def _done_integral(event: Event, t: Array) -> Array:
    since = np.maximum(t - event.start, 0.0)
    ramp = np.minimum(since, event.duration)
    return since - ramp + (0.5 * ramp**2 / event.duration if event.duration > 0 else 0.0)
