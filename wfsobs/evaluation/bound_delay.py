"""Bound of the closed loop: the least residual of any causal linear controller of a mirror without limits.

With a delay of whole frames it is the minimum error of a prediction. With a fraction f of a frame besides, the mirror makes
c[k] = (1 - f) u[k] + f u[k-1] of the commands. Up to half a frame any c follows from commands that stay finite, and the fraction
costs nothing. Beyond, u[k-1] = (1/f) sum_j w^j c[k+j], w = -(1 - f) / f, has to be known at step k - 1: what step k brings
to this sum cannot be used. The nearest c that brings nothing leaves, beside the error of the whole frames,

    (1 - w^2) (variance of sum_j w^j phi[k+j] given step k - 1, less that given step k),

which for f = 1 is what one frame more costs (inner-outer factorisation of the mirror, by steps).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from wfsobs.evaluation.bound import LeastError, least_errors
from wfsobs.evaluation.bound_both import PeriodicError, least_errors_of_both
from wfsobs.evaluation.scores import BOUND, BOUND_BOTH
from wfsobs.observers.estimates import TOTAL
from wfsobs.simulation.true_spectra import TrueSpectra

Least = Callable[[TrueSpectra, int], Mapping[str, LeastError] | Mapping[str, PeriodicError]]

WAYS: Mapping[str, Least] = {BOUND: least_errors, BOUND_BOTH: least_errors_of_both}
"""Row -> the minimum error of a prediction."""


def least_residual(spectra: TrueSpectra, delay: float, least: Least) -> float:
    """Return the rms [um] of the least residual.

    Parameters
    ----------
    spectra : TrueSpectra
        Spectra of one mode.
    delay : float
        Of the mirror [frames], at least 1.
    least : callable
        Minimum error of a prediction, of one of WAYS.
    """
    ahead, fraction = int(delay) - 1, delay - int(delay)
    variance = least(spectra, ahead)[TOTAL].rms ** 2
    if fraction > 0.5:
        w = -(1.0 - fraction) / fraction
        later = summed_ahead(spectra, w)
        one, next_one = (least(later, steps)[TOTAL].rms ** 2 for steps in (ahead, ahead + 1))
        variance += (1.0 - w**2) * max(next_one - one, 0.0)
    return float(np.sqrt(variance))


def summed_ahead(spectra: TrueSpectra, w: float) -> TrueSpectra:
    """Return the spectra with sum_j w^j s[k+j], j from 0, in place of every target s[k]; |w| below 1."""
    known = spectra.without_lines
    size = known.measurement.size
    weight = 1.0 / (1.0 - w * np.exp(1j * np.pi * np.arange(size) / (size - 1)))
    return TrueSpectra(
        known.measurement,
        {name: signal * np.abs(weight) ** 2 for name, signal in known.signal.items()},
        {name: cross * weight for name, cross in known.cross.items()},
        replace(known.ngs, cross={name: cross * weight for name, cross in known.ngs.cross.items()}),
    )
