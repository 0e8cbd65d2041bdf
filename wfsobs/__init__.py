"""Wavefront-based disturbance observers for large telescopes.

    >>> import wfsobs
    >>> scenario = wfsobs.PRESETS["paper"]().replace({"run.duration": 2.0})
    >>> result = wfsobs.run(scenario, observers=["kf-lgs", "zero"])
    >>> [(s.observer, s.target, s.mode) for s in result.scores][:2]
    [('kf-lgs', 'turbulence', 'tip'), ('kf-lgs', 'turbulence', 'tilt')]

The names below are imported when they are first used: `import wfsobs` alone takes no time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from wfsobs.version import __version__ as __version__

if TYPE_CHECKING:
    from wfsobs.app.notebook_page import explore
    from wfsobs.app.report.page import export
    from wfsobs.closed_loop.envelope import plant_envelope
    from wfsobs.closed_loop.run import close_loop
    from wfsobs.evaluation.bound import bound
    from wfsobs.evaluation.budget import error_budget
    from wfsobs.evaluation.result import Result
    from wfsobs.evaluation.scores import score
    from wfsobs.identification.identification import identify
    from wfsobs.identification.kernels import fit_kernels
    from wfsobs.pipeline import observe, run
    from wfsobs.record import Record, RecordError
    from wfsobs.scenario import Scenario
    from wfsobs.scenario.presets import PRESETS
    from wfsobs.scenario.scenario import register
    from wfsobs.settings.values import SettingError
    from wfsobs.signal.spectrum import psd
    from wfsobs.simulation.loop import simulate
    from wfsobs.stepping import design
    from wfsobs.telemetry.records import load, save
    from wfsobs.tuning.tuning import tune


_HOMES = {
    "bound": "evaluation.bound",
    "explore": "app.notebook_page",
    "export": "app.report.page",
    "close_loop": "closed_loop.run",
    "plant_envelope": "closed_loop.envelope",
    "design": "stepping",
    "error_budget": "evaluation.budget",
    "score": "evaluation.scores",
    "fit_kernels": "identification.kernels",
    "identify": "identification.identification",
    "Result": "evaluation.result",
    "observe": "pipeline",
    "run": "pipeline",
    "Record": "record",
    "RecordError": "record",
    "register": "scenario.scenario",
    "Scenario": "scenario",
    "PRESETS": "scenario.presets",
    "SettingError": "settings.values",
    "psd": "signal.spectrum",
    "simulate": "simulation.loop",
    "load": "telemetry.records",
    "save": "telemetry.records",
    "tune": "tuning.tuning",
}
"""Public name -> the module below wfsobs that defines it."""

__all__ = [
    "PRESETS",
    "Record",
    "RecordError",
    "Result",
    "Scenario",
    "SettingError",
    "bound",
    "close_loop",
    "design",
    "error_budget",
    "explore",
    "export",
    "fit_kernels",
    "identify",
    "load",
    "observe",
    "plant_envelope",
    "psd",
    "register",
    "run",
    "save",
    "score",
    "simulate",
    "tune",
]


def open_plots(source: object) -> Any:
    """Return the figures of an object; what draws them is imported now. Raises ImportError."""
    try:
        from wfsobs.plot.figures import plots_of
    except ModuleNotFoundError as error:
        raise ImportError(f"figures need {error.name}: pip install wfsobs[plot]") from None
    return plots_of(source)


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    except ModuleNotFoundError as error:  # of the core everything is there
        raise ImportError(f"{name} needs {error.name}: pip install wfsobs[app]") from None
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Public names, imported or not; completion offers no others."""
    return list(__all__)
