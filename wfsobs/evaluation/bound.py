"""Wiener bound: the minimum error of any causal observer of the mean of the LGS in a scenario.

It is the error of the Wiener filter (`wiener`) for the true spectra of the scenario (`true_spectra`) and its noise, after an
infinitely long record; undamped lines are then known. The gap between an observer and the bound is what a better model, better
tuning or more training can gain. An observer with more than the mean of the LGS may be better: with each star by itself, where
they see different turbulence, or with the NGS (`bound_both`). So may one that remembers a record of random phases, which is
periodic (`synthesis`).

A record is neither infinitely long nor the mean of all. `interval` is the range of the rms of an optimal observer
of all samples since the start of the record, in 95 % of records.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, log
from typing import TypeVar

import numpy as np
from scipy import fft
from scipy.stats import chi2

from wfsobs.observers.estimates import TOTAL
from wfsobs.scenario import Scenario
from wfsobs.signal.wiener import circle_mean, degrees_of_freedom, explained_variance
from wfsobs.simulation.true_spectra import TrueSpectra, true_spectra
from wfsobs.typing import Array

SHARE = 0.95
"""Share of the records whose rms lies in an interval."""

MOST_PAST = 4000
"""Measurements up to which their gain is computed.

The remaining gain falls with the inverse of their number, as it does for undamped lines.
"""

LEARNT = 5e-3
"""Share of the minimum error; where more measurements bring no more than this, nothing is left to learn."""

Error = TypeVar("Error")


@dataclass(frozen=True)
class LeastError:
    """Error of an optimal filter.

    Attributes
    ----------
    covariance : Array
        Autocovariance after an infinitely long record, (n_lags,) [um^2].
    transient : Array
        Variance after 0, 1, 2, ... measurements, as far as it falls by more than LEARNT, (n_past,) [um^2].
    n_lines : int
        Number of undamped lines, whose phases and amplitudes are learnt from the record.
    """

    covariance: Array
    transient: Array
    n_lines: int = 0

    @property
    def rms(self) -> float:
        """Rms over all records, infinitely long ones [um]."""
        return float(np.sqrt(self.covariance[0]))

    def interval(self, first: int, last: int) -> tuple[float, float]:
        """Return the range of the rms [um] over the steps `first` to `last` of a record, in SHARE of records."""
        least = float(self.covariance[0])
        excess, past = np.maximum(self.transient[first:last] - least, 0.0), self.transient.size
        later = max(self.transient[-1] - least, 0.0) * past / np.arange(max(first, past) + 1, last + 1)
        learning = float(excess.sum() + later.sum()) / (last - first)
        mean = least + learning
        if not mean > 0:
            return 0.0, 0.0
        n = degrees_of_freedom(self.covariance, last - first) if least > 0 else inf
        if self.n_lines:
            n = mean**2 / (least**2 / n + learning**2 / (2 * self.n_lines * learning_freedom(last / max(first, 1))))
        low, high = np.sqrt(mean * chi2.ppf([0.5 - 0.5 * SHARE, 0.5 + 0.5 * SHARE], n) / n)
        return float(low), float(high)


def learning_freedom(ratio: float) -> float:
    """Return the degrees of freedom of the mean square of W(t) / t from t = 1 to `ratio`.

    W(t) / t is the error of an amplitude learnt in white noise. W is Brownian, so that the mean square has the mean ln r and the
    variance 4 (ln r - 1 + 1 / r), either over r - 1, its square.
    """
    if ratio < 1.01:
        return 1.0
    return log(ratio) ** 2 / (2.0 * (log(ratio) - 1.0 + 1.0 / ratio))


def least_errors(spectra: TrueSpectra, ahead: int = 0, n_steps: int = 1) -> dict[str, LeastError]:
    """Compute the minimum error of phi[k + ahead] from z[k], z[k-1], ....

    Parameters
    ----------
    spectra : TrueSpectra
        Spectra of one mode.
    ahead : int
        Steps of prediction.
    n_steps : int
        Steps of the record of the intervals.

    Returns
    -------
    dict of str to LeastError
        Target -> error; TOTAL is that of both together.
    """
    known = spectra.without_lines
    whitener, parts = known.whitener, spectra.parts
    past = min(n_steps, MOST_PAST, whitener.n // 2)  # a correlation of half a transform, and no more, is what it is
    names = [*parts, TOTAL][: 2 * len(parts) - 1]
    best = [known.estimate(*(parts if name == TOTAL else [name]), ahead=ahead) for name in names]
    lines = np.outer([name != "turbulence" for name in names], spectra.line_covariance(past + 1 + ahead))
    cross = np.array([fft.irfft(one.cross, whitener.n)[:past] for one in best]) + spectra.gain * lines[:, 1 + ahead :]
    measured = fft.irfft(known.measurement, whitener.n)[:past] + spectra.gain**2 * spectra.line_covariance(past)
    covariance = np.array([fft.irfft(one.error, whitener.n)[: min(n_steps, whitener.n // 2)] for one in best])
    variance = lines[:, 0] + [sum(circle_mean(known.signal[part]) for part in parts if name in (part, TOTAL)) for name in names]
    gained = explained_variance(measured, cross, enough=variance - (1.0 + LEARNT) * covariance[:, 0])
    transient = variance[:, None] - np.hstack([np.zeros((len(names), 1)), gained])
    n_lines = len(spectra.pure)
    found = {name: LeastError(left, learnt, n_lines) for name, left, learnt in zip(names, covariance, transient, strict=True)}
    return of_every_target(found, spectra, LeastError(np.zeros_like(covariance[0]), np.zeros_like(transient[0])))


def of_every_target(errors: dict[str, Error], spectra: TrueSpectra, nothing: Error) -> dict[str, Error]:
    """Return the errors of every target, and of both together, from those computed; nothing : that of a target that is zero."""
    only = next(iter(errors.values()))
    return {name: errors.get(name, nothing) for name in spectra.signal} | {TOTAL: errors.get(TOTAL, only)}


def bound_rms(scenario: Scenario, mode: int, ahead: int = 0) -> dict[str, float]:
    """Return target -> rms [um] of the minimum error, as `least_errors`, of one mode of a scenario."""
    return {name: error.rms for name, error in least_errors(true_spectra(scenario, mode), ahead).items()}
