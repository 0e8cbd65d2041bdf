"""Checks of observers and controllers written elsewhere, in the manner of scikit-learn's `check_estimator`."""

from wfsobs.testing.common import QUICK, CheckError
from wfsobs.testing.controllers import check_controller
from wfsobs.testing.observers import check_observer

__all__ = ["QUICK", "CheckError", "check_controller", "check_observer"]
