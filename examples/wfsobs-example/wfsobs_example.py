"""An observer for wfsobs, all of it in one file: a first-order low-pass takes the slow part of z for the turbulence."""

from math import exp, pi

from scipy.signal import lfilter

from wfsobs.observers.base import TURBULENCE, Look, Observer, Tunable
from wfsobs.settings import Group, Real, Section


class LowPass(Group):
    """A first-order low-pass on z."""

    corner = Real(150.0, bounds=(0.1, 10_000.0), softbounds=(10.0, 400.0), label="Corner", doc="Cut-off frequency [Hz].")


def low_pass(measurements, prior, settings, watch):
    """Take the slow part of z for the turbulence: a first-order low-pass."""
    watch.check()
    share = 1.0 - exp(-2.0 * pi * settings.corner * measurements.dt)
    return {TURBULENCE: lfilter([share], [1.0, share - 1.0], measurements.z, axis=0)}


LOW_PASS = Observer(
    "low-pass",
    "Low-pass",
    (TURBULENCE,),
    low_pass,
    help="the slow part of z",
    settings=Section("low_pass", "Low-pass", LowPass),
    tunable=Tunable(("low_pass.corner",)),
    look=Look(light="#8A4B00", dark="#E0A050", dash=(6, 2, 1, 2)),
)
