"""Settings of the loop, of the run, and of what the plant of the closed loop does that its controllers do not know."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import param

from wfsobs.settings.group import Group, UsedWhen
from wfsobs.settings.values import Choice, Real, Reals, Whole


class Mount(NamedTuple):
    """Dynamics of a tip-tilt mount, a second-order system of gain 1: natural frequency [Hz] and damping ratio."""

    resonance: float
    damping: float


MOUNTS = {
    # FSM-CD300B manual, "Typical Specifications", at their limits: peaking of 3 dB, lag of 60 degrees at 400 Hz. Its
    # amplitude is 3 dB down at 692 Hz then (specified: at 800 Hz or above), which no second order has with that lag.
    "newport-fsm-300": Mount(498.2, 0.3832),
    # Secondary mirror with fast drives, design study of the European Solar Telescope: 3 dB down at 150 Hz. No damping is
    # published: that of the flattest response is assumed.
    "est-m2": Mount(150.0, 0.7071),
}
"""Tip-tilt mounts by name, from their data sheets."""


class PlantErrors(Group):
    """Differences between the plant of the closed loop and the one that the controllers are designed for; at 0 there are none.

    The plant of the controllers is the mirror of `control`, of gain 1, and its delay.
    """

    used_when: ClassVar[UsedWhen] = {"resonance": ("mount", ("custom",)), "damping": ("mount", ("custom",))}

    start: Real = Real(
        0.0,
        (0.0, 3600.0),
        "Errors begin at",
        "Time from which the plant differs [s]; a live loop has its errors at once.",
        softbounds=(0.0, 60.0),
        step=0.5,
    )
    delay_error: Real = Real(
        0.0,
        (-9.0, 10.0),
        "Delay error",
        "Delay of the plant less `control.delay` [frames]; together at least 1.",
        softbounds=(-1.0, 1.0),
        step=0.05,
    )
    delay_jitter: Real = Real(
        0.0,
        (0.0, 0.5),
        "Delay jitter",
        "Deviation of each command's delay, uniform between minus and plus this [frames], independent of the others.",
        step=0.05,
    )
    gain_error: Reals = Reals(
        [0.0, 0.0],
        (-3.0, 10.0),
        (0, 64),
        "Gain error per mode",
        "Gain of the mirror less 1, one number per mode: tip, tilt, ...; zero for modes beyond the list.",
    )
    rotation: Real = Real(
        0.0,
        (-180.0, 180.0),
        "Rotation",
        "Angle of the mirror against the sensor, from the axis of tip to that of tilt [deg].",
        softbounds=(-30.0, 30.0),
        step=1.0,
    )
    coupling: Real = Real(
        0.0,
        (-0.9, 0.9),
        "Coupling",
        "Share of a command that also acts in the other mode of its pair, such as that of tip in tilt.",
        softbounds=(-0.3, 0.3),
        step=0.01,
    )
    mount: Choice = Choice(
        ["custom", *MOUNTS],
        "Mount",
        "Tip-tilt mount whose data sheet gives the dynamics of the mirror; custom: Resonance and its damping do.",
    )
    resonance: Real = Real(
        0.0,
        (0.0, 50_000.0),
        "Resonance",
        "Natural frequency of the mirror, a second-order system of gain 1 [Hz]; 0 is a mirror without dynamics.",
        softbounds=(0.0, 1000.0),
        step=10.0,
    )
    damping: Real = Real(0.3, (0.001, 0.99), "Resonance, damping", "Damping ratio of the mirror's resonance.", step=0.01)
    lost_commands: Real = Real(
        0.0,
        (0.0, 0.9),
        "Lost commands",
        "Share of frames, at random, whose command does not arrive: the mirror keeps the one before.",
        softbounds=(0.0, 0.2),
        step=0.01,
    )
    quantum: Real = Real(
        0.0,
        (0.0, 10.0),
        "Actuator step",
        "Smallest step of a mode's command [um]: commands are rounded to multiples of it; 0 is none.",
        softbounds=(0.0, 0.1),
        step=0.001,
    )
    hysteresis: Real = Real(
        0.0,
        (0.0, 0.4),
        "Hysteresis",
        "Width of the hysteresis loop over its height, for commands that go from one end of the range below to the other. "
        "Prandtl-Ishlinskii model; small motions have a gain lower by twice as much.",
        softbounds=(0.0, 0.2),
        step=0.01,
    )
    hysteresis_range: Real = Real(
        1.0,
        (0.001, 100.0),
        "Hysteresis, range",
        "Commands either way at which the gain of the model is 1 [um].",
        softbounds=(0.1, 5.0),
        step=0.1,
    )
    optical_gain_drift: Real = Real(
        0.0,
        (-1.0, 1.0),
        "Optical gain, drift",
        "Change of the gain of the LGS measurements from 1 [1/s], noise included.",
        softbounds=(-0.05, 0.05),
        step=0.001,
    )
    optical_gain_rms: Real = Real(
        0.0,
        (0.0, 1.0),
        "Optical gain, rms",
        "Random change of the gain of the LGS measurements, standard deviation (first-order Gauss-Markov process).",
        softbounds=(0.0, 0.3),
        step=0.01,
    )
    optical_gain_time: Real = Real(
        1.0, (0.001, 1e4), "Optical gain, time", "Correlation time of that change [s].", softbounds=(0.1, 100.0), step=0.1
    )

    @property
    def dynamics(self) -> Mount:
        """Dynamics of the mirror, by its mount or by resonance and damping."""
        return MOUNTS.get(self.mount) or Mount(self.resonance, self.damping)


class Loop(Group):
    """The control loop that makes the record."""

    used_when: ClassVar[UsedWhen] = {"gain": ("closed", (True,)), "leak": ("closed", (True,))}

    closed: param.Boolean[bool] = param.Boolean(True, label="Closed loop", doc="Drive the deformable mirror; off keeps u = 0.")
    gain: Real = Real(
        0.3,
        (0.0, 1.0),
        "Integrator gain g",
        "u[k] = leak u[k-1] - g y_lgs[k]; not given in the paper. Stable below 1.",
        inclusive_bounds=(True, False),
        step=0.01,
    )
    leak: Real = Real(1.0, (0.0, 1.0), "Integrator leak", "1 is a pure integrator.", step=0.001)


class Run(Group):
    """Length of the record, what is scored, and the seed."""

    duration: Real = Real(10.0, (0.1, 3600.0), "Duration", "Length of the record [s].", softbounds=(2.0, 60.0))
    warm_up: Real = Real(1.0, (0.0, 600.0), "Warm-up", "Start of the record that no score counts [s].", softbounds=(0.0, 5.0))
    seed: Whole = Whole(1, (0, 2**32 - 1), "Seed", "Seed of all random numbers of the run.", softbounds=(0, 1000))


class Control(Group):
    """The mirror and the controllers of the closed-loop comparison; the loop's own integrator makes the record."""

    used_when: ClassVar[UsedWhen] = {"gain": ("integrator", ("manual",))}

    delay: Real = Real(
        2.0,
        (1.0, 10.0),
        "Delay",
        "Steps from a command to the first measurement that sees it, fractions allowed [frames] (paper: 2). The "
        "record has that of the paper.",
        step=0.1,
    )
    stroke: Real = Real(
        0.0,
        (0.0, 100.0),
        "Stroke limit",
        "Maximum command of a mode, either way [um]; 0 is no limit.",
        softbounds=(0.0, 5.0),
        step=0.1,
    )
    rate: Real = Real(
        0.0,
        (0.0, 100.0),
        "Rate limit",
        "Maximum change of a mode's command [um/ms]; 0 is no limit.",
        softbounds=(0.0, 1.0),
        step=0.01,
    )
    integrator: Choice = Choice(
        ["optimised", "manual"],
        "Integrator gain from",
        "optimised: optimal gain for the scenario's true spectra, mode by mode; manual: the gain below.",
    )
    gain: Real = Real(
        0.5,
        (0.0, 5.0),
        "Integrator gain",
        "g of u[k] = leak u[k-1] - g y[k], for integrator manual. With a delay of two frames stable below 1.",
        softbounds=(0.0, 1.0),
        step=0.01,
    )
    leak: Real = Real(1.0, (0.0, 1.0), "Integrator leak", "1 is a pure integrator.", step=0.001)
    caution: Real = Real(
        1.0,
        (0.1, 1000.0),
        "Caution",
        "Factor on the noise that LQG takes measurements to have, where that is not set by hand, and divisor of an "
        "integrator's optimised gain; above 1 a loop bears more errors of the plant.",
        softbounds=(0.5, 10.0),
        step=0.1,
    )
    supervised: param.Boolean[bool] = param.Boolean(
        False,
        label="Supervised",
        doc="An integrator closes the loop for 1000 frames, and takes over from every other controller where its loop is worse "
        "than it should be.",
    )
    fallback_gain: Real = Real(
        0.2,
        (0.0, 5.0),
        "Gain of the fallback",
        "Gain of that integrator, and of the one with which adaptive controllers begin, of the leak above; stable for every "
        "plant that may come.",
        softbounds=(0.0, 1.0),
        step=0.01,
    )
    wavelength: Real = Real(2.2, (0.1, 30.0), "Science wavelength", "Wavelength of the Strehl ratio [um].", step=0.05)
