"""Predicted error spectra: what the linear observers of a scenario do on average, without a simulation.

They follow from the true spectra of the scenario (`true_spectra`) and the response of an observer from z to its estimate
(`linear_response`), the transform of the estimates from a single sample of one. That is the expectation over records after an
infinitely long start. A record is one of them, and the scores of a short one scatter around it.

Observers that are linear, every mode by itself, have a prediction; those of NGS frames by their responses over the cycle of a
frame (`cycle_response`). Those that train on a record or learn during it have none, nor has one that looks ahead.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from math import sqrt
from time import monotonic
from typing import Any

import numpy as np

from wfsobs.evaluation.cycle_response import CycleTaps, both_sensors, cycle_spectra, cycle_taps
from wfsobs.evaluation.linear_response import SETTLED, SHORTEST, estimate_and_error, impulse_response
from wfsobs.evaluation.memory import Identity, Memory
from wfsobs.evaluation.scores import BOUND
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import Observer
from wfsobs.prior import Beams, LgsError, LgsStars, Lines, Prior, Training
from wfsobs.priors_from.scenario import lines_of, observer_settings, prior_of
from wfsobs.priors_from.turbulence import beams_of, lgs_error_of, lines_turbulence
from wfsobs.scenario import Scenario
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3, Ar3Fits
from wfsobs.signal.welch import expected_psd
from wfsobs.signal.wiener import Complex, advance_spectrum, circle_mean, error_spectrum
from wfsobs.simulation.guide_stars import MEAN
from wfsobs.simulation.true_spectra import MOST, TrueSpectra, has_known_spectra, n_frequencies, true_spectra
from wfsobs.simulation.turbulence_spectra import TurbulenceSpectra, turbulence_spectra
from wfsobs.typing import Array

TRUTH = "truth"
"""Name of the prediction of the target itself: the error of an estimate of zero."""


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
    known = observer is None or (observer.linear and not observer.couples_modes and observer.causal)
    return known and (observer is None or (target in observer.targets and Training not in observer.prior))


@dataclass
class Theory:
    """Predictions for one scenario after another; what two of them share is computed once.

    Attributes
    ----------
    resolution : float
        Resolution of the Welch estimates [Hz].
    most : int or None
        The most frequencies to compute with, a power of two; None for as many as the scenario needs. With fewer, lines that are
        narrower than their spacing are coarse, and fits of turbulence start from those before.
    left : float
        What may be left at the end of a response, over its maximum.
    """

    resolution: float = 0.5
    most: int | None = None
    left: float = SETTLED
    _memory: Memory = field(default_factory=Memory, repr=False)
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
        spectra = self.spectra(scenario, mode)
        cross = self._memory.keep(f"cross {target}", Identity(spectra), lambda: advance_spectrum(spectra.cross[target], 1))
        n_steps = scenario.n_steps - round(scenario.run.warm_up / scenario.dt)
        out = []
        for name in (TRUTH, *([*OBSERVERS, BOUND] if observers is None else observers)):
            observer = OBSERVERS.get(name)
            if not is_predicted(observer, target):
                continue
            if len(out) > 1 and monotonic() > until:
                break
            response = None if observer is None else self._response(observer, scenario, mode, target, spectra.n)
            made_of = Identity(spectra), Identity(response), n_steps, of_error

            def make(name: str = name, response: Complex | CycleTaps | None = response) -> Prediction:
                if response is None:
                    signal, error = _own(spectra, name, target)
                elif isinstance(response, CycleTaps):
                    both = self._memory.keep(f"both {target}", Identity(spectra), lambda: both_sensors(spectra, target))
                    signal, error = cycle_spectra(response, both)
                else:
                    signal, error = estimate_and_error(response, spectra.measurement, spectra.signal[target], cross)
                frequency, density = expected_psd(error if of_error else signal, scenario.dt, n_steps, self.resolution)
                return Prediction(name, target, sqrt(max(circle_mean(error), 0.0)), frequency, density)

            out.append(self._memory.keep(f"{name}, {target}", made_of, make))
        return out

    # ------------------------------------------------------------------ what is kept

    def spectra(self, scenario: Scenario, mode: int) -> TrueSpectra:
        """Return the true spectra of a mode."""
        key = mode, self.most, _groups(scenario, *AIR, "vibration")
        return self._memory.keep("spectra", key, lambda: true_spectra(scenario, mode, self._air(scenario, mode)))

    def _air(self, scenario: Scenario, mode: int) -> TurbulenceSpectra:
        n = min(n_frequencies(scenario, mode), self.most or MOST)
        return self._memory.keep("air", (mode, n, _groups(scenario, *AIR)), lambda: turbulence_spectra(scenario, mode, n))

    def _response(self, observer: Observer, scenario: Scenario, mode: int, target: str, n: int) -> Complex | CycleTaps:
        settings, prior, name = observer_settings(observer, scenario), self._prior(observer, scenario, mode), observer.id
        ratio, left = scenario.sensors.exposure_ratio, self.left
        first = self._lengths.get((name, left), SHORTEST)

        def over_cycle() -> dict[str, CycleTaps]:
            found = cycle_taps(observer, prior, settings, scenario.dt, ratio, n, first, left)
            self._lengths[name, left] = found[target].fast.shape[1]
            return found

        def taps() -> dict[str, Array]:
            found = impulse_response(observer, prior, settings, scenario.dt, n, first, left)
            self._lengths[name, left] = len(found[target])
            return found

        if "ngs" in observer.sensors:
            return self._memory.keep(f"response {name}", (prior, settings, n, left, ratio), over_cycle)[target]
        h = self._memory.keep(f"response {name}", (prior, settings, n, left), taps)[target]
        return self._memory.keep(f"response {name}, {target}", Identity(h), lambda: np.fft.rfft(h, n))

    def _prior(self, observer: Observer, scenario: Scenario, mode: int) -> Prior:
        parts = observer.parts(observer_settings(observer, scenario))
        cheap = [part for part in parts if part not in (Lines, Beams, LgsError, LgsStars)]
        prior = prior_of(scenario, None, cheap, modes=[mode])
        if Beams in observer.prior:  # where its turbulence is
            prior = replace(prior, lines=(lines_of(scenario, mode, turbulence=()),))
        elif Lines in observer.prior:
            prior = replace(prior, lines=(self._lines(scenario, mode),))
        if Beams in observer.prior:
            prior = replace(prior, beams=(self._beams(scenario, mode),))
        if LgsError in observer.prior:
            key = self._key_of_beams(scenario, mode)
            error = self._memory.keep("LGS error", key, lambda: lgs_error_of(scenario, mode, scenario.dt))
            prior = replace(prior, lgs_error=(error,))
        return prior

    def _lines(self, scenario: Scenario, mode: int) -> Lines:
        air, k = self._air(scenario, mode), scenario.kalman
        order = scenario.multipeak.turbulence_order
        key = Identity(air), order, k.process_noise, k.turbulence_rms, k.measurement_noise, k.lgs_noise
        fits = self._start_of_fits(mode)

        def make() -> tuple[Ar2 | Ar3, ...]:
            return lines_turbulence(scenario, mode, scenario.dt, air.measurement, fits)

        turbulence = self._memory.keep("turbulence", key, make)
        return lines_of(scenario, mode, turbulence=turbulence)

    def _beams(self, scenario: Scenario, mode: int) -> Beams:
        air, fits = self._air(scenario, mode), self._start_of_fits(mode)
        key = self._key_of_beams(scenario, mode)
        return self._memory.keep("beams", key, lambda: beams_of(scenario, mode, scenario.dt, air, fits))

    def _key_of_beams(self, scenario: Scenario, mode: int) -> Any:
        """Return what the turbulence in the beams depends on: the vibration too, where it moves best weights of the LGS."""
        mean = scenario.sensors.lgs_combination == MEAN
        return Identity(self._air(scenario, mode)), _groups(scenario, "kalman", "multipeak", *([] if mean else ["vibration"]))

    def _start_of_fits(self, mode: int) -> Ar3Fits:
        """Return the fits of a mode to start from: none before one with all frequencies."""
        if self.most is None:
            self._fits.clear()
        return self._fits.setdefault(mode, Ar3Fits())


AIR = ("telescope", "turbulence", "sensors", "run")
"""Groups of settings that the turbulence and its sensors depend on."""


def _groups(scenario: Scenario, *names: str) -> list[dict[str, Any]]:
    return [getattr(scenario, name).to_dict() for name in names]


def _own(spectra: TrueSpectra, name: str, target: str) -> tuple[Array, Array]:
    """Return, twice, the spectrum of the target, or that of the minimum error from the mean of the LGS."""
    if name == TRUTH:
        return spectra.signal[target], spectra.signal[target]
    known = spectra.without_lines
    least = error_spectrum(known.signal[target], advance_spectrum(known.cross[target], 1), known.whitener)
    return least, least
