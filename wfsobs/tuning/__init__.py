"""Settings of an observer from a search: `tune`."""

from wfsobs.tuning.trials import Evaluation, Stage
from wfsobs.tuning.tuning import TuningResult, tune

__all__ = ["Evaluation", "Stage", "TuningResult", "tune"]
