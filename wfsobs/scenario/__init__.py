"""All settings of a run: the simulation, and the models of the observers."""

from wfsobs.scenario.scenario import Scenario

__all__ = ["Scenario"]
