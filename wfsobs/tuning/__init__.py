"""Settings of an observer from a search: `tune`."""

from wfsobs.tuning.tuning import Evaluation, Stage, TuningResult, tune

__all__ = ["Evaluation", "Stage", "TuningResult", "tune"]
