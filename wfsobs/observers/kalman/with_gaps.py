"""Kalman filters over a record with missing measurements: the step form of the filters, frame by frame."""

from __future__ import annotations

import numpy as np

from wfsobs.observers.estimates import Estimates
from wfsobs.observers.kalman.frame_step import FrameEstimator
from wfsobs.observers.kalman.spread import by_name
from wfsobs.observers.kalman.step import KalmanEstimator
from wfsobs.progress import Watch
from wfsobs.record import Measurements


def run_frames(estimator: KalmanEstimator | FrameEstimator, measurements: Measurements, watch: Watch) -> Estimates:
    """Run filters over a record with gaps: frame by frame, for all modes at the same time."""
    z, n = measurements.z, measurements.ratio
    z_ngs = measurements.z_ngs if estimator.uses_ngs else None
    values, sd = [], []
    for k, row in enumerate(z):
        if k % 1000 == 0:
            watch.step(k / len(z))
        due = z_ngs is not None and n is not None and k > 0 and k % n == 0
        estimator.advance(row, z_ngs[k] if z_ngs is not None and due else None, None)
        now, spread = estimator.estimate()
        values.append(now.copy())
        sd.append(spread)
    return Estimates(by_name(np.array(values)), by_name(np.array(sd)))
