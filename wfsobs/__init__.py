"""Wavefront-based disturbance observers for large telescopes.

    >>> import wfsobs
    >>> scenario = wfsobs.PRESETS["paper"]().replace({"run.duration": 2.0})
    >>> result = wfsobs.run(scenario, observers=["kf-lgs", "zero"])
    >>> [(s.observer, s.target, s.mode) for s in result.scores][:2]
    [('kf-lgs', 'turbulence', 'tip'), ('kf-lgs', 'turbulence', 'tilt')]
"""

from wfsobs.pipeline import Result, observe, run
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.scenario.settings import SettingError
from wfsobs.simulation.loop import simulate

__version__ = "0.1.0"

__all__ = ["PRESETS", "Record", "RecordError", "Result", "Scenario", "SettingError", "observe", "run", "simulate"]
