"""Spectra of estimates and of their errors: of a record, and as theory predicts them without a simulation.

Predictions follow from the true spectra of the scenario (`true_spectra`) and the responses of an observer (`exact_errors`). They
are the expectation over records after an infinitely long start. A record is one of them, and the scores of a short one scatter
around it.

Observers that are linear, every mode by itself, have a prediction. Those that train on a record or learn during it have none,
nor has one that looks ahead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from math import sqrt
from time import monotonic
from typing import Any

import numpy as np

from wfsobs.evaluation.exact_errors import (
    SETTLED,
    SHORTEST,
    SensorResponse,
    cycle_spectra,
    has_exact_error,
    impulse_responses,
    over_cycle,
    target_spectra,
)
from wfsobs.evaluation.scores import BOUND
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import Observer
from wfsobs.prior import Beams, LgsError, LgsStars, Lines, Prior
from wfsobs.priors_from.scenario import beams_of, lgs_error_of, lines_of, lines_turbulence, observer_settings, prior_of
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.signal.ar3 import Ar3Fits
from wfsobs.signal.spectrum import expected_psd, psd
from wfsobs.signal.wiener import circle_mean
from wfsobs.simulation.flow_spectra import TurbulenceSpectra
from wfsobs.simulation.guide_stars import MEAN
from wfsobs.simulation.true_spectra import MOST, TrueSpectra, has_known_spectra, n_frequencies, true_spectra, turbulence_spectra
from wfsobs.typing import Array

TRUTH = "truth"
"""Name of the prediction of the target itself: the error of an estimate of zero."""

FEWEST = 16
"""Samples of a spectrum, at least."""

AIR = ("telescope", "turbulence", "sensors", "run")
"""Groups of settings that the turbulence and its sensors depend on."""


# ---------------------------------------------------------------------- of a record


def scored_samples(record: Record, truth: Array, value: Array, warm_up: float) -> tuple[Array, Array]:
    """Return (truth, estimate) without the warm-up [s] and without the steps where the estimate is NaN."""
    start = round(warm_up / record.dt)
    known = ~np.isnan(value[start:]) & ~np.isnan(truth[start:])
    return truth[start:][known], value[start:][known]


def spectra(
    record: Record, target: str, values: Array, warm_up: float, modes: Sequence[int] | None = None
) -> tuple[Array, Array, Array] | None:
    """Compute the spectra of an estimate and of its error.

    Over all samples after the warm-up [s] that have an estimate; without a truth the error is zero.

    Parameters
    ----------
    record : Record
        Record, with the truth where there is one.
    target : str
        "turbulence" or "vibration".
    values : Array
        Estimate, (n_steps, n_modes) [um].
    warm_up : float
        Start of the record that does not count [s].
    modes : sequence of int, optional
        Columns; by default all.

    Returns
    -------
    tuple of Array or None
        Frequency [Hz], density of the estimate and of its error [um^2/Hz], a column per mode; None with too few samples.
    """
    truth = record.truth(target)
    truth = values if truth is None else truth
    chosen = range(record.n_modes) if modes is None else modes
    columns = [scored_samples(record, truth[:, mode], values[:, mode], warm_up) for mode in chosen]
    shortest = min(true.size for true, _ in columns)
    if shortest < FEWEST:
        return None
    true, value = (np.column_stack([x[-shortest:] for x in of]) for of in zip(*columns, strict=True))
    frequency, density = psd(np.hstack([value, value - true]), record.dt)
    signal, error = np.hsplit(density, 2)
    return frequency, signal, error


def band_rms(frequency: Array, density: Array, low: float, high: float) -> float:
    """Return the root of the variance at the frequencies [Hz] from `low` to `high`, both included; density (n,)."""
    inside = (frequency >= low) & (frequency <= high)
    return float(np.sqrt(density[inside].sum() * (frequency[1] - frequency[0])))


def cumulative_rms(frequency: Array, density: Array) -> Array:
    """Return the root of the variance above each frequency, from high to low (the AO habit); same shape as `density`."""
    df = frequency[1] - frequency[0]
    return np.sqrt(np.cumsum(density[::-1], axis=0)[::-1] * df)


# ---------------------------------------------------------------------- as predicted


@dataclass(frozen=True)
class Prediction:
    """Prediction of one observer, target and mode.

    Attributes
    ----------
    observer, target : str
        Of what: an observer, BOUND, or TRUTH for the target itself.
    rms : float
        Rms error [um].
    frequency : Array
        Frequencies, (n,) [Hz].
    density : Array
        Expected Welch estimate of the spectrum of the error, or of the estimate, (n,) [um^2/Hz].
    """

    observer: str
    target: str
    rms: float
    frequency: Array
    density: Array


def is_predicted(observer: Observer | None, target: str) -> bool:
    """Return whether an observer's errors have a prediction; None stands for the bound."""
    return observer is None or (has_exact_error(observer) and target in observer.targets)


@dataclass
class Theory:
    """Predictions for one scenario after another; what two of them share is computed once.

    Attributes
    ----------
    most : int or None
        The most frequencies to compute with, a power of two; None for as many as the scenario needs. With fewer, lines that are
        narrower than their spacing are coarse, and fits of turbulence start from those before.
    left : float
        What may be left at the end of a response, over its maximum.
    """

    most: int | None = None
    left: float = SETTLED
    _results: dict[str, tuple[Any, Any]] = field(default_factory=dict, repr=False)
    _lengths: dict[tuple[str, float], int] = field(default_factory=dict, repr=False)
    _fits: dict[int, Ar3Fits] = field(default_factory=dict, repr=False)

    def predict(
        self,
        scenario: Scenario,
        mode: int,
        target: str,
        observers: Iterable[str] | None = None,
        of_error: bool = True,
        until: float = np.inf,
    ) -> list[Prediction]:
        """Predict the errors of observers.

        Parameters
        ----------
        scenario : Scenario
            Settings.
        mode : int
            Index of the mode.
        target : str
            "turbulence" or "vibration".
        observers : iterable of str, optional
            Ids of the observers, and BOUND; by default all. Those without a prediction are left out.
        of_error : bool
            Whether densities are those of errors, else of estimates.
        until : float
            Time on the monotonic clock after which no more observers but the first are begun [s].

        Returns
        -------
        list of Prediction
            That of the target itself (TRUTH), then one per observer.

        Raises
        ------
        ValueError
            The spectra of the scenario are not known.
        """
        if not has_known_spectra(scenario):
            raise ValueError("no prediction: the spectra of this scenario are not known, or events change them")
        known = self.spectra(scenario, mode)
        sensors = self._keep(f"spectra {target}", self._key("spectra"), lambda: target_spectra(known, target))
        n_steps = scenario.n_steps - round(scenario.run.warm_up / scenario.dt)
        out = []
        for name in (TRUTH, *([*OBSERVERS, BOUND] if observers is None else observers)):
            observer = OBSERVERS.get(name)
            if not is_predicted(observer, target):
                continue
            if len(out) > 1 and monotonic() > until:
                break
            response = None if observer is None else self._response(observer, scenario, mode, target, known.n)
            key = self._key("spectra"), self._key(f"response {name}"), n_steps, of_error

            def make(name: str = name, response: SensorResponse | None = response) -> Prediction:
                if response is None:
                    signal = error = sensors.signal if name == TRUTH else known.without_lines.estimate(target).error
                else:
                    signal, error = cycle_spectra(response, sensors)
                frequency, density = expected_psd(error if of_error else signal, scenario.dt, n_steps)
                return Prediction(name, target, sqrt(max(circle_mean(error), 0.0)), frequency, density)

            out.append(self._keep(f"{name}, {target}", key, make))
        return out

    # ------------------------------------------------------------------ what is kept

    def _keep(self, name: str, key: Any, make: Callable[[], Any]) -> Any:
        """Return the last result of a name if its key is the same, else make it."""
        if name not in self._results or self._results[name][0] != key:
            self._results[name] = key, make()
        return self._results[name][1]

    def _key(self, name: str) -> Any:
        """Return the key of the last result of a name."""
        return self._results.get(name, (None,))[0]

    def spectra(self, scenario: Scenario, mode: int) -> TrueSpectra:
        """Return the true spectra of a mode."""
        key = mode, self.most, _groups(scenario, *AIR, "vibration")
        return self._keep("spectra", key, lambda: true_spectra(scenario, mode, self._air(scenario, mode)))

    def _air(self, scenario: Scenario, mode: int) -> TurbulenceSpectra:
        n = min(n_frequencies(scenario, mode), self.most or MOST)
        return self._keep("air", (mode, n, _groups(scenario, *AIR)), lambda: turbulence_spectra(scenario, mode, n))

    def _response(self, observer: Observer, scenario: Scenario, mode: int, target: str, n: int) -> SensorResponse:
        settings, ratio, name = observer_settings(observer, scenario), scenario.sensors.exposure_ratio, observer.id
        prior, length = self._prior(observer, scenario, mode), (name, self.left)

        def make() -> dict[str, SensorResponse]:
            first = self._lengths.get(length, SHORTEST)
            found = impulse_responses(observer, prior, settings, scenario.dt, ratio, n, first, self.left)
            self._lengths[length] = found[target].fast.shape[1]
            return found

        key = prior, settings, scenario.dt, n, self.left, ratio
        taps = self._keep(f"response {name}", key, make)[target]
        return self._keep(f"response {name}, {target}", key, lambda: over_cycle(taps, n))

    def _prior(self, observer: Observer, scenario: Scenario, mode: int) -> Prior:
        parts, of, slow = observer.parts(observer_settings(observer, scenario)), (scenario, mode, scenario.dt), dict[str, Any]()
        seen, air = self._results["air"]  # of the spectra, made before
        if self.most is None:  # fits with all frequencies start from none before
            self._fits.clear()
        fits = self._fits.setdefault(mode, Ar3Fits())
        key, k = None, scenario.kalman
        if Beams in parts or LgsError in parts:  # the vibration, too, where it moves the best weights of the LGS
            mean = scenario.sensors.lgs_combination == MEAN
            key = seen, _groups(scenario, "kalman", "multipeak", *([] if mean else ["vibration"]))
        if Beams in parts:
            slow["beams"] = (self._keep("beams", key, lambda: beams_of(*of, air, fits)),)
            slow["lines"] = (lines_of(scenario, mode, turbulence=()),)  # that of the beams is in these
        elif Lines in parts:
            used = scenario.multipeak.turbulence_order, k.process_noise, k.turbulence_rms, k.measurement_noise, k.lgs_noise
            turbulence = self._keep("turbulence", (seen, used), lambda: lines_turbulence(*of, air.measurement, fits))
            slow["lines"] = (lines_of(scenario, mode, turbulence=turbulence),)
        if LgsError in parts:
            slow["lgs_error"] = (self._keep("LGS error", key, lambda: lgs_error_of(*of)),)
        fast = [part for part in parts if part not in (Lines, Beams, LgsError, LgsStars)]
        return replace(prior_of(scenario, None, fast, modes=[mode]), **slow)


def _groups(scenario: Scenario, *names: str) -> list[dict[str, Any]]:
    return [getattr(scenario, name).to_dict() for name in names]
