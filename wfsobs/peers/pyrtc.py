"""Observers as predictors of pyRTC: `type: wfsobs` in the `predictor` of a loop.

pyRTC imports the module that a component names. A loop of `class_name: Loop` and `class_file: .../wfsobs/peers/pyrtc.py` is
pyRTC's own, with the predictor registered; its base class is pyRTC's and is asked for when it runs, as pyRTC has another licence.
"""

from __future__ import annotations

from typing import Any

from wfsobs.peers.predictor import LoopPredictor

NAME = "wfsobs"


def register_predictor() -> type[LoopPredictor]:
    """Register the predictor `wfsobs` with pyRTC and return its class.

    Raises
    ------
    ImportError
        pyRTC is not installed.
    """
    from pyrtc import predictive  # pyright: ignore[reportMissingImports]

    return predictive.register_predictor(NAME)(type("ObserverPredictor", (LoopPredictor, predictive.ModalPredictor), {}))


def __getattr__(name: str) -> Any:
    """Return pyRTC's `Loop`, the predictor registered."""
    if name != "Loop":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from pyrtc.loop import Loop  # pyright: ignore[reportMissingImports]

    register_predictor()
    return Loop
