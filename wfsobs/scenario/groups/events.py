"""Settings of what happens during a record."""

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
"""Settings that a kind has of its own."""


class Event(Group):
    """Something that changes during the record, which no observer is told; the training record has none of it.

    Changes of a peak and of the wind ramp up over `duration` and stay; a laser and lost frames are over after it.
    """

    kind = param.Selector(
        default=PEAK,
        objects=[PEAK, WIND, LASER, FRAMES],
        label="Kind",
        doc="peak: a vibration peak moves in frequency and strength; wind: the wind changes; laser: laser guide stars drop out; "
        "frames: frames are lost at random.",
    )
    start = Real(
        5.0,
        bounds=(0.0, 3600.0),
        softbounds=(0.0, 60.0),
        step=0.5,
        label="Start",
        doc="When it starts [s], from the start of the record.",
    )
    duration = Real(
        0.0,
        bounds=(0.0, 3600.0),
        softbounds=(0.0, 60.0),
        step=0.5,
        label="Duration",
        doc="How long it takes [s]; 0 is a jump of a peak or of the wind.",
    )
    peak = Whole(0, bounds=(0, 99), label="Peak", doc="For kind peak: the number of the peak in vibration.peaks, from 0.")
    frequency_shift = Real(
        0.0,
        bounds=(-5000.0, 5000.0),
        softbounds=(-10.0, 10.0),
        step=0.1,
        label="Frequency shift",
        doc="For kind peak: by how much its frequency moves [Hz].",
    )
    strength = Real(
        1.0,
        bounds=(0.0, 100.0),
        softbounds=(0.0, 4.0),
        step=0.1,
        label="Strength factor",
        doc="For kind peak: the factor that its rms changes by.",
    )
    wind_factor = Real(
        1.0,
        bounds=(0.1, 10.0),
        softbounds=(0.2, 4.0),
        step=0.1,
        label="Wind factor",
        doc="For kind wind: the factor that the wind speed changes by, in every layer.",
    )
    lasers = Whole(
        1,
        bounds=(1, 16),
        label="Lasers lost",
        doc="For kind laser: how many LGS drop out, the last ones first; without any there is no LGS measurement.",
    )
    sensor = param.Selector(default="lgs", objects=["lgs", "ngs"], label="Sensor", doc="For kind frames: whose frames are lost.")
    share = Real(0.1, bounds=(0.0, 1.0), step=0.01, label="Share lost", doc="For kind frames: the share of them that is lost.")

    def idle(self) -> tuple[str, ...]:
        """Those of the other kinds."""
        return tuple(name for kind, names in OF_KIND.items() if kind != self.kind for name in names)
