"""Observers as predictors of pyRTC: `type: wfsobs` in the `predictor` of a loop. Importing this registers them, where pyRTC is.

pyRTC imports the module that a component names; the loop of `class_name: Loop` and `class_file: .../wfsobs/peers/pyrtc.py` is its
own. Base class and loop are pyRTC's and are looked for when they run, as pyRTC has another licence.
"""

from __future__ import annotations

from contextlib import suppress
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
    """Return pyRTC's `Loop`."""
    if name != "Loop":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from pyrtc.loop import Loop  # pyright: ignore[reportMissingImports]

    return Loop


with suppress(ModuleNotFoundError):
    register_predictor()
