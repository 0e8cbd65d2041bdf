"""Observers in the programs of others; each program is imported only when it is asked for."""

from wfsobs.peers.predictor import LoopPredictor, PredictorError

__all__ = ["LoopPredictor", "PredictorError"]
