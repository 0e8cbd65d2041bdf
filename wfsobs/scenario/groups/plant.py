"""Settings of the loop, of the run, and of what the plant of the closed loop does that its controllers do not know."""

from __future__ import annotations

from types import MappingProxyType
from typing import ClassVar, NamedTuple

import param

from wfsobs.settings.group import Group, UsedWhen
from wfsobs.settings.parameters import Real, Reals, Whole


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


class Loop(Group):
    """The control loop that makes the record."""

    used_when: ClassVar[UsedWhen] = MappingProxyType({"gain": ("closed", (True,)), "leak": ("closed", (True,))})

    closed: param.Boolean[bool] = param.Boolean(True, label="Closed loop", doc="Drive the deformable mirror; off keeps u = 0.")
    gain: Real = Real(
        0.3,
        bounds=(0.0, 1.0),
        inclusive_bounds=(True, False),
        step=0.01,
        label="Integrator gain g",
        doc="u[k] = leak u[k-1] - g y_lgs[k]; not given in the paper. Stable below 1.",
    )
    leak: Real = Real(1.0, bounds=(0.0, 1.0), step=0.001, label="Integrator leak", doc="1 is a pure integrator.")


class Run(Group):
    """Length of the record, what is scored, and the seed."""

    duration: Real = Real(10.0, bounds=(0.1, 3600.0), softbounds=(2.0, 60.0), label="Duration", doc="Length of the record [s].")
    warm_up: Real = Real(
        1.0, bounds=(0.0, 600.0), softbounds=(0.0, 5.0), label="Warm-up", doc="Start of the record that no score counts [s]."
    )
    seed: Whole = Whole(
        1, bounds=(0, 2**32 - 1), softbounds=(0, 1000), label="Seed", doc="Seed of all random numbers of the run."
    )


class Control(Group):
    """The mirror and the controllers of the closed-loop comparison; the loop's own integrator makes the record."""

    used_when: ClassVar[UsedWhen] = MappingProxyType({"gain": ("integrator", ("manual",))})

    delay: Real = Real(
        2.0,
        bounds=(1.0, 10.0),
        step=0.1,
        label="Delay",
        doc="Steps from a command to the first measurement that sees it, fractions allowed [frames] (paper: 2). The "
        "record has that of the paper.",
    )
    stroke: Real = Real(
        0.0,
        bounds=(0.0, 100.0),
        softbounds=(0.0, 5.0),
        step=0.1,
        label="Stroke limit",
        doc="Maximum command of a mode, either way [um]; 0 is no limit.",
    )
    rate: Real = Real(
        0.0,
        bounds=(0.0, 100.0),
        softbounds=(0.0, 1.0),
        step=0.01,
        label="Rate limit",
        doc="Maximum change of a mode's command [um/ms]; 0 is no limit.",
    )
    integrator: param.Selector[str] = param.Selector(
        default="optimised",
        objects=["optimised", "manual"],
        label="Integrator gain from",
        doc="optimised: optimal gain for the scenario's true spectra, mode by mode; manual: the gain below.",
    )
    gain: Real = Real(
        0.5,
        bounds=(0.0, 5.0),
        softbounds=(0.0, 1.0),
        step=0.01,
        label="Integrator gain",
        doc="g of u[k] = leak u[k-1] - g y[k], for integrator manual. With a delay of two frames stable below 1.",
    )
    leak: Real = Real(1.0, bounds=(0.0, 1.0), step=0.001, label="Integrator leak", doc="1 is a pure integrator.")
    caution: Real = Real(
        1.0,
        bounds=(0.1, 1000.0),
        softbounds=(0.5, 10.0),
        step=0.1,
        label="Caution",
        doc="Factor on the noise that LQG takes measurements to have, where that is not set by hand, and divisor of an "
        "integrator's optimised gain; above 1 a loop bears more errors of the plant.",
    )
    supervised: param.Boolean[bool] = param.Boolean(
        False,
        label="Supervised",
        doc="An integrator closes the loop for 1000 frames, and takes over from every other controller where its loop is worse "
        "than it should be.",
    )
    fallback_gain: Real = Real(
        0.2,
        bounds=(0.0, 5.0),
        softbounds=(0.0, 1.0),
        step=0.01,
        label="Gain of the fallback",
        doc="Gain of that integrator, and of the one with which adaptive controllers begin, of the leak above; stable for every "
        "plant that may come.",
    )
    wavelength: Real = Real(
        2.2, bounds=(0.1, 30.0), step=0.05, label="Science wavelength", doc="Wavelength of the Strehl ratio [um]."
    )
