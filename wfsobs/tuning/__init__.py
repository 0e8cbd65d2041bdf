"""Settings of an observer from a search: `tune`."""

from wfsobs.tuning.tuning import Evaluation, Stage, Tuned, tune

__all__ = ["Evaluation", "Stage", "Tuned", "tune"]
