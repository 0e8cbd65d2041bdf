"""Bound of both sensors: the minimum error of any causal linear observer of the mean of the LGS and of the NGS.

Like the bound of the LGS alone (`bound`) it is that of the true spectra and noises, after an infinitely long record, and a mean
over records; undamped lines are then known, others have the width that the record has. It is periodic: least when an NGS frame
has just been read. An observer that takes every LGS by itself, or modes together, may be better where these see different
turbulence.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import pi

import numpy as np
from scipy.special import diric

from wfsobs.evaluation.bound import of_every_target
from wfsobs.observers.estimates import TOTAL
from wfsobs.scenario import Scenario
from wfsobs.signal.slow_sensor import SlowSensor, SlowTarget, variance_from_frames
from wfsobs.signal.wiener import Complex, advance_spectrum, circle_mean
from wfsobs.simulation.true_spectra import TrueSpectra, true_spectra
from wfsobs.typing import Array


@dataclass(frozen=True)
class PeriodicError:
    """Minimum error of both sensors.

    Attributes
    ----------
    variance : Array
        Variance in a step with an NGS frame, one step later, ..., (ratio,) [um^2].
    """

    variance: Array

    @property
    def rms(self) -> float:
        """Rms over all steps [um]."""
        return float(np.sqrt(self.variance.mean()))

    @property
    def phases(self) -> tuple[float, ...]:
        """Rms in a step with an NGS frame, one step later, ... [um]."""
        return tuple(np.sqrt(self.variance).tolist())


def least_errors_of_both(spectra: TrueSpectra, ahead: int = 0) -> dict[str, PeriodicError]:
    """Compute the minimum error of phi[k + ahead] from all of z and all NGS frames up to step k.

    Parameters
    ----------
    spectra : TrueSpectra
        Spectra of one mode.
    ahead : int
        Steps of prediction.

    Returns
    -------
    dict of str to PeriodicError
        Target -> error; TOTAL is that of both together.
    """
    known = spectra.without_lines
    ngs, whitener = known.ngs, known.whitener
    frames, exposure = ngs_frames(known)
    wanted = [
        SlowTarget(*known.estimate(name, ahead=ahead)[:2], advance_spectrum(ngs.cross[name] * exposure.conj(), ahead))
        for name in known.parts
    ]
    return target_errors(known, ahead, variance_from_frames(wanted, whitener, frames))


def ngs_frames(spectra: TrueSpectra) -> tuple[SlowSensor, Complex]:
    """Return the NGS as a slow sensor beside z, and the response of its exposure."""
    ngs, exposure = spectra.ngs, exposure_response(spectra.ngs.ratio, spectra.measurement.size)
    cross = advance_spectrum(ngs.measurement_cross * exposure, 1)
    return SlowSensor(ngs.signal * np.abs(exposure) ** 2, cross, ngs.noise, ngs.ratio), exposure


def target_errors(spectra: TrueSpectra, ahead: int, reduction: Array) -> dict[str, PeriodicError]:
    """Return the minimum error of each target, and of both together.

    Parameters
    ----------
    spectra : TrueSpectra
        Without the lines that are known.
    ahead : int
        Steps of prediction.
    reduction : Array
        Covariance of what the other sensors tell of the targets, (ratio, targets, targets) [um^2].
    """
    parts = spectra.parts
    found = {name: circle_mean(spectra.estimate(name, ahead=ahead).error) - reduction[:, i, i] for i, name in enumerate(parts)}
    if len(parts) > 1:
        found[TOTAL] = circle_mean(spectra.estimate(*parts, ahead=ahead).error) - reduction.sum(axis=(1, 2))
    errors = {name: PeriodicError(np.maximum(variance, 0.0)) for name, variance in found.items()}
    return of_every_target(errors, spectra, PeriodicError(np.zeros(len(reduction))))


@lru_cache(maxsize=2)
def exposure_response(ratio: int, size: int) -> Complex:
    """Return the response of the mean of the last `ratio` steps before the present one, at `size` frequencies from 0 to 1/2."""
    omega = pi * np.arange(size) / (size - 1)
    out = np.asarray(np.exp(-0.5j * (ratio + 1) * omega) * diric(omega, ratio), dtype=np.complex128)
    out.flags.writeable = False
    return out


def bound_rms_of_both(scenario: Scenario, mode: int, ahead: int = 0) -> dict[str, float]:
    """Return target -> rms [um] of the minimum error, as `least_errors_of_both`, of one mode of a scenario."""
    return {name: error.rms for name, error in least_errors_of_both(true_spectra(scenario, mode), ahead).items()}
