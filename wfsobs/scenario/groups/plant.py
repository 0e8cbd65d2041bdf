"""Settings of what the plant of the closed loop does that its controllers do not know."""

from __future__ import annotations

from types import MappingProxyType
from typing import ClassVar, NamedTuple

import param

from wfsobs.settings.group import Group, UsedWhen
from wfsobs.settings.parameters import Real, Reals


class Mount(NamedTuple):
    """Dynamics of a tip-tilt mount, a second-order system of gain 1: natural frequency [Hz] and damping ratio."""

    resonance: float
    damping: float


MOUNTS = MappingProxyType(
    {
        # FSM-CD300B manual, "Typical Specifications", at their limits: peaking of 3 dB, lag of 60 degrees at 400 Hz. Its
        # amplitude is 3 dB down at 692 Hz then (specified: at 800 Hz or above), which no second order has with that lag.
        "newport-fsm-300": Mount(498.2, 0.3832),
        # Secondary mirror with fast drives, design study of the European Solar Telescope: 3 dB down at 150 Hz. No damping is
        # published: that of the flattest response is assumed.
        "est-m2": Mount(150.0, 0.7071),
    }
)
"""Tip-tilt mounts by name, from their data sheets."""


class PlantErrors(Group):
    """Differences between the plant of the closed loop and the one that the controllers are designed for; at 0 there are none.

    The plant of the controllers is the mirror of `control`, of gain 1, and its delay.
    """

    used_when: ClassVar[UsedWhen] = MappingProxyType({"resonance": ("mount", ("custom",)), "damping": ("mount", ("custom",))})

    start: Real = Real(
        0.0,
        bounds=(0.0, 3600.0),
        softbounds=(0.0, 60.0),
        step=0.5,
        label="Errors begin at",
        doc="Time from which the plant differs [s]; a live loop has its errors at once.",
    )
    delay_error: Real = Real(
        0.0,
        bounds=(-9.0, 10.0),
        softbounds=(-1.0, 1.0),
        step=0.05,
        label="Delay error",
        doc="Delay of the plant less `control.delay` [frames]; together at least 1.",
    )
    delay_jitter: Real = Real(
        0.0,
        bounds=(0.0, 0.5),
        step=0.05,
        label="Delay jitter",
        doc="Deviation of each command's delay, uniform between minus and plus this [frames], independent of the others.",
    )
    gain_error: Reals = Reals(
        [0.0, 0.0],
        item_bounds=(-3.0, 10.0),
        bounds=(0, 64),
        label="Gain error per mode",
        doc="Gain of the mirror less 1, one number per mode: tip, tilt, ...; zero for modes beyond the list.",
    )
    rotation: Real = Real(
        0.0,
        bounds=(-180.0, 180.0),
        softbounds=(-30.0, 30.0),
        step=1.0,
        label="Rotation",
        doc="Angle of the mirror against the sensor, from the axis of tip to that of tilt [deg].",
    )
    coupling: Real = Real(
        0.0,
        bounds=(-0.9, 0.9),
        softbounds=(-0.3, 0.3),
        step=0.01,
        label="Coupling",
        doc="Share of a command that also acts in the other mode of its pair, such as that of tip in tilt.",
    )
    mount: param.Selector[str] = param.Selector(
        default="custom",
        objects=["custom", *MOUNTS],
        label="Mount",
        doc="Tip-tilt mount whose data sheet gives the dynamics of the mirror; custom: Resonance and its damping do.",
    )
    resonance: Real = Real(
        0.0,
        bounds=(0.0, 50_000.0),
        softbounds=(0.0, 1000.0),
        step=10.0,
        label="Resonance",
        doc="Natural frequency of the mirror, a second-order system of gain 1 [Hz]; 0 is a mirror without dynamics.",
    )
    damping: Real = Real(
        0.3, bounds=(0.001, 0.99), step=0.01, label="Resonance, damping", doc="Damping ratio of the mirror's resonance."
    )
    lost_commands: Real = Real(
        0.0,
        bounds=(0.0, 0.9),
        softbounds=(0.0, 0.2),
        step=0.01,
        label="Lost commands",
        doc="Share of frames, at random, whose command does not arrive: the mirror keeps the one before.",
    )
    quantum: Real = Real(
        0.0,
        bounds=(0.0, 10.0),
        softbounds=(0.0, 0.1),
        step=0.001,
        label="Actuator step",
        doc="Smallest step of a mode's command [um]: commands are rounded to multiples of it; 0 is none.",
    )
    hysteresis: Real = Real(
        0.0,
        bounds=(0.0, 0.4),
        softbounds=(0.0, 0.2),
        step=0.01,
        label="Hysteresis",
        doc="Width of the hysteresis loop over its height, for commands that go from one end of the range below to the other. "
        "Prandtl-Ishlinskii model; small motions have a gain lower by twice as much.",
    )
    hysteresis_range: Real = Real(
        1.0,
        bounds=(0.001, 100.0),
        softbounds=(0.1, 5.0),
        step=0.1,
        label="Hysteresis, range",
        doc="Commands either way at which the gain of the model is 1 [um].",
    )
    optical_gain_drift: Real = Real(
        0.0,
        bounds=(-1.0, 1.0),
        softbounds=(-0.05, 0.05),
        step=0.001,
        label="Optical gain, drift",
        doc="Change of the gain of the LGS measurements from 1 [1/s], noise included.",
    )
    optical_gain_rms: Real = Real(
        0.0,
        bounds=(0.0, 1.0),
        softbounds=(0.0, 0.3),
        step=0.01,
        label="Optical gain, rms",
        doc="Random change of the gain of the LGS measurements, standard deviation (first-order Gauss-Markov process).",
    )
    optical_gain_time: Real = Real(
        1.0,
        bounds=(0.001, 1e4),
        softbounds=(0.1, 100.0),
        step=0.1,
        label="Optical gain, time",
        doc="Correlation time of that change [s].",
    )

    @property
    def dynamics(self) -> Mount:
        """Dynamics of the mirror, by its mount or by resonance and damping."""
        return MOUNTS.get(self.mount) or Mount(self.resonance, self.damping)
