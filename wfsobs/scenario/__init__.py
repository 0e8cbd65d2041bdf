"""Every setting of a run: what is simulated, and what observers are made with."""

from wfsobs.scenario.scenario import Scenario

__all__ = ["Scenario"]
