"""Settings of events during a record."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import param

from wfsobs.settings.group import Group
from wfsobs.settings.parameters import Real, Whole

PEAK, WIND, LASER, FRAMES = "peak", "wind", "laser", "frames"
OF_KIND: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {PEAK: ("peak", "frequency_shift", "strength"), WIND: ("wind_factor",), LASER: ("lasers",), FRAMES: ("sensor", "share")}
)
"""Settings of each kind alone."""


class Event(Group):
    """A change during the record that no observer is told of; the training record has no events.

    Changes of a peak and of the wind ramp up over `duration` and stay; a laser outage and missing frames end after it.
    """

    used_when = MappingProxyType({name: ("kind", (kind,)) for kind, names in OF_KIND.items() for name in names})

    kind = param.Selector(
        default=PEAK,
        objects=[PEAK, WIND, LASER, FRAMES],
        label="Kind",
        doc="peak: a vibration peak changes in frequency and strength; wind: the wind changes; laser: laser guide "
        "stars drop out; frames: frames are missing at random.",
    )
    start = Real(
        5.0,
        bounds=(0.0, 3600.0),
        softbounds=(0.0, 60.0),
        step=0.5,
        label="Start",
        doc="Start of the event, from the start of the record [s].",
    )
    duration = Real(
        0.0,
        bounds=(0.0, 3600.0),
        softbounds=(0.0, 60.0),
        step=0.5,
        label="Duration",
        doc="Duration of the event [s]; 0 is a jump of a peak or of the wind.",
    )
    peak = Whole(0, bounds=(0, 99), label="Peak", doc="For kind peak: number of the peak in vibration.peaks, from 0.")
    frequency_shift = Real(
        0.0,
        bounds=(-5000.0, 5000.0),
        softbounds=(-10.0, 10.0),
        step=0.1,
        label="Frequency shift",
        doc="For kind peak: change of its frequency [Hz].",
    )
    strength = Real(
        1.0,
        bounds=(0.0, 100.0),
        softbounds=(0.0, 4.0),
        step=0.1,
        label="Strength factor",
        doc="For kind peak: factor on its rms.",
    )
    wind_factor = Real(
        1.0,
        bounds=(0.1, 10.0),
        softbounds=(0.2, 4.0),
        step=0.1,
        label="Wind factor",
        doc="For kind wind: factor on the wind speed of every layer.",
    )
    lasers = Whole(
        1,
        bounds=(1, 16),
        label="Lasers lost",
        doc="For kind laser: number of LGS that drop out, the last ones first; with none left there is no LGS measurement.",
    )
    sensor = param.Selector(
        default="lgs", objects=["lgs", "ngs"], label="Sensor", doc="For kind frames: sensor with missing frames."
    )
    share = Real(0.1, bounds=(0.0, 1.0), step=0.01, label="Share of frames", doc="For kind frames: share of missing frames.")
