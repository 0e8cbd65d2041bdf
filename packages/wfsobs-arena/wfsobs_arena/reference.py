"""The reference where no bound is known: least squares on the last 30 measurements, trained on the truth of another record."""

from __future__ import annotations

import numpy as np

from wfsobs.observers.gpr.ridge import PLAIN, TAPS, fit, predict
from wfsobs.record import hold_last
from wfsobs.typing import Array

__all__ = ["TAPS", "taps_error"]


def taps_error(training_z: Array, training_truth: Array, z: Array, truth: Array) -> Array:
    """Return the error of a predictor of TAPS taps.

    Parameters
    ----------
    training_z, training_truth : Array
        Measurements and what is asked, of the record that it is trained on, (n, n_modes) [um].
    z, truth : Array
        Those of the record, (n_steps, n_modes) [um]; missing measurements are held.

    Returns
    -------
    Array
        Errors, (n_steps, n_modes) [um]; those of estimating zero before the first full window.
    """
    out = np.empty_like(truth)
    train, given = hold_last(training_z), hold_last(z)
    for mode in range(truth.shape[1]):
        own = train[:, [mode]]
        m = len(own) - TAPS
        fitted = fit(own, training_truth[:, mode], TAPS, m, PLAIN * m * float(np.mean(own**2)))
        out[:, mode] = np.nan_to_num(predict(given[:, [mode]], *fitted)) - truth[:, mode]
    return out
