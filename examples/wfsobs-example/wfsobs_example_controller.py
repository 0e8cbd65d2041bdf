"""A controller for wfsobs, all of it in one file: an integrator with a gain of its own."""

from wfsobs.control.base import Controller
from wfsobs.control.laws import integrator_law
from wfsobs.observers.base import Look
from wfsobs.settings import Group, Real, Section


class FixedGain(Group):
    """An integrator that is told nothing."""

    gain = Real(0.3, bounds=(0.0, 5.0), softbounds=(0.0, 1.0), label="Gain", doc="g of u[k] = u[k-1] - g y[k].")


def fixed_gain(prior, mode, plant, settings):
    """Make the law of one mode."""
    return integrator_law(plant.mirror, settings.fixed_gain.gain, leak=1.0)


FIXED_GAIN = Controller(
    "fixed-gain",
    "Fixed gain",
    fixed_gain,
    settings=(Section("fixed_gain", "Fixed gain", FixedGain),),
    look=Look(light="#5C3A00", dark="#D0B080", dash=(5, 3, 1, 3)),
)
