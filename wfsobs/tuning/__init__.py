"""Settings of an observer or a controller from a search: `tune`."""

from wfsobs.tuning.trials import Evaluation, Stage
from wfsobs.tuning.tuning import EnvelopeGoal, TuningResult, tune, tuned_envelope

__all__ = ["EnvelopeGoal", "Evaluation", "Stage", "TuningResult", "tune", "tuned_envelope"]
