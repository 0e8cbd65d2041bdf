"""Responses of linear observers, the errors and spectra that follow from them without a simulation, and the spectra of a record.

The responses of an observer to one measurement of the LGS at every place in the cycle of an NGS frame, and to one frame, are the
coefficients h_p and g_p of its estimates p steps after a frame,

    s_hat[k] = sum_j h_p[j] z[k-j] + sum_j g_p[j] y[k-j].

With their transforms H_p and G_p, and y = x + v as in `sensor_array`, the error s - s_hat has the variance

    mean(S_s + |H_p|^2 S_z + |G_p|^2 S_y + 2 Re(G_p S_yz H_p*) - 2 Re(S_sz H_p* + S_sy G_p*))

whatever the model that the observer is built on. Undamped lines are in neither: each adds its variance times the square of what
the observer leaves of it.

A wave exp(i w k) of z becomes n waves of the estimate,

    H_p(w) exp(i w k) = sum_l c_l(w) exp(i (w + 2 pi l / n) k),    c_l(w) = mean over p of H_p(w) exp(-2 pi i l p / n),

and one of the frames likewise. At w + 2 pi l / n the error has, on average over the cycle, |1 at l = 0, -c_l, -d_l|^2 in the
spectral matrix of s, z and y at w. (Bittanti and Colaneri, Periodic Systems, 2009, chapter 6, have these transfer functions.)

Predictions follow from the true spectra of the scenario (`true_spectra`) and the responses of an observer. They
are the expectation over records after an infinitely long start. A record is one of them, and the scores of a short one scatter
around it.

Observers that are linear, every mode by itself, have a prediction. Those that train on a record or learn during it have none,
nor has one that looks ahead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from math import sqrt
from time import monotonic
from typing import Any

import numpy as np

from wfsobs.evaluation.bound import PeriodicError, ngs_frames
from wfsobs.evaluation.scores import BOUND
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TURBULENCE, Observer
from wfsobs.prior import Beams, LgsError, LgsStars, Lines, Prior, Training
from wfsobs.priors_from.scenario import beams_of, lgs_error_of, lines_of, lines_turbulence, observer_settings, prior_of
from wfsobs.progress import QUIET
from wfsobs.record import TOTAL, Measurements, Record
from wfsobs.scenario import Scenario
from wfsobs.signal.autoregressive import Ar3Fits
from wfsobs.signal.spectrum import expected_psd, psd
from wfsobs.signal.wiener import Complex, advance_spectrum, circle_mean, square
from wfsobs.simulation.flow_spectra import TurbulenceSpectra
from wfsobs.simulation.sensing import MEAN
from wfsobs.simulation.true_spectra import (
    MOST,
    UNRESOLVED,
    TrueSpectra,
    has_known_spectra,
    n_frequencies,
    true_spectra,
    turbulence_spectra,
)
from wfsobs.typing import Array

SETTLED, EXACT = 1e-6, 1e-12
"""What may be left at the end of a response, over its maximum: of a spectrum that is shown, and of an exact error."""

SHORTEST = 2**11
"""Steps of the first look at a response; each next one is twice as long."""

START = 1000
"""Steps before the first impulse where there are frames of the NGS: gains are those that repeat."""


@dataclass(frozen=True)
class TargetSpectra:
    """Spectra of a target and of the measurements, all (n // 2 + 1,) [um^2 per sample].

    Those of the NGS are computed when an observer needs them.

    Attributes
    ----------
    signal, z, by_z : Array
        Of s and z, and the cross spectrum of s with z.
    ngs_cross : Complex
        Cross spectrum of s with the NGS before its exposure.
    spectra : TrueSpectra
        Of the mode.
    """

    signal: Array
    z: Array
    by_z: Complex
    ngs_cross: Complex
    spectra: TrueSpectra

    @cached_property
    def of_frames(self) -> tuple[Array, Complex, Complex]:
        """Spectrum of the NGS with the noise of a frame, its cross spectrum with z, and that of s with it."""
        ngs, exposure = ngs_frames(self.spectra)
        return ngs.spectrum + ngs.noise, ngs.cross, self.ngs_cross * exposure.conj()


def target_spectra(spectra: TrueSpectra, target: str) -> TargetSpectra:
    """Return the spectra of a target, or of all together for TOTAL, and of both sensors."""
    names = list(spectra.signal) if target == TOTAL else [target]
    sums = (reduce(np.add, [of[name] for name in names]) for of in (spectra.signal, spectra.cross, spectra.ngs.cross))
    signal, cross, ngs_cross = sums
    return TargetSpectra(signal, spectra.measurement, advance_spectrum(cross, 1), ngs_cross, spectra)


def impulse_responses(
    observer: Observer,
    prior: Prior,
    settings: Any,
    dt: float,
    ratio: int,
    most: int,
    first: int = SHORTEST,
    left: float = SETTLED,
) -> dict[str, Array]:
    """Compute the coefficients of a linear observer's estimates, in one mode, from one record of impulses one after the other.

    Parameters
    ----------
    observer : Observer
        The observer.
    prior, settings : Prior, Group or None
        Of one mode, and its own settings.
    dt : float
        Time step [s].
    ratio : int
        Steps of a cycle.
    most : int
        Maximum number of steps of a response.
    first : int
        Steps of the first try, twice as many in each next, until every response has settled.
    left : float
        What may be left at the end of a response, over its maximum.

    Returns
    -------
    dict of str to Array
        Target -> h_p of z and g_p of the frames, (2, ratio, length); of an observer of the LGS alone h of z, (1, 1, length).
    """
    has_frames = "ngs" in observer.sensors
    ratio = ratio if has_frames else 1
    start, longest = -(-(START if has_frames else 1) // ratio) * ratio, most // ratio * ratio
    length = min(-(-first // ratio) * ratio, longest)
    while True:
        at = [start + i * (length + ratio) + i % ratio for i in range(ratio + has_frames)]  # the last in a frame
        z = np.zeros((start + len(at) * (length + ratio), 1))
        frames = np.full_like(z, np.nan)
        frames[ratio::ratio] = 0.0
        z[at[:ratio]] = frames[at[ratio:]] = 1.0
        sensors = {"y_ngs": frames, "ratio": ratio} if has_frames else {}
        found = observer.estimate(Measurements(z, np.zeros_like(z), dt, **sensors), prior, settings, QUIET)
        out, settled = dict[str, Array](), True
        for target, values in found.items():
            taps, late = np.zeros((2, ratio, length)), np.arange(length)
            rest = np.nan_to_num(values[at[0] - ratio : at[0], 0])  # over the cycle before the first impulse
            for i, step in enumerate(at):
                response = np.nan_to_num(values[step : step + length, 0]) - rest[(late + step - at[0]) % ratio]
                settled &= bool(np.abs(response[-length // 8 :]).max() <= left * np.abs(response).max())
                taps[i // ratio, (i + late) % ratio, late] = response
            out[target] = taps[: 1 + has_frames]
        if settled or length == longest:
            return out
        length = min(2 * length, longest)


def over_cycle(taps: Array, n: int) -> Complex:
    """Return the transforms c_l and d_l of coefficients over n steps, (1 or 2, ratio, n // 2 + 1)."""
    phases = np.arange(taps.shape[1])
    places = np.exp(-2j * np.pi * np.outer(phases, phases) / phases.size) / phases.size
    return places @ np.fft.rfft(taps, n)


def cycle_spectra(response: Complex, sensors: TargetSpectra) -> tuple[Array, Array]:
    """Return the spectra of an estimate and of its error on average over the cycle, (n // 2 + 1,); response : of `over_cycle`.

    What moves to a frequency between those of the DFT is at the nearest one.
    """
    ratio, n = response.shape[1], 2 * (sensors.z.size - 1)
    out = np.zeros((2, 2 * n))
    for wave in range(ratio):
        power = _estimate_power(response[:, wave], sensors)
        parts = np.stack([power, power + _rest_of_error(response[:, wave], sensors) if wave == 0 else power])
        if ratio == 1:
            return parts[0], parts[1]
        shift = round(wave * n / ratio)
        parts[:, [0, -1]] *= 0.5  # these are their own at negative frequencies
        out[:, shift : shift + parts.shape[1]] += parts
    circle = out[:, :n] + out[:, n:]
    signal, error = (circle + np.roll(circle[:, ::-1], 1, axis=1))[:, : n // 2 + 1]
    return signal, error


def _estimate_power(response: Complex, sensors: TargetSpectra) -> Array:
    """Return the spectrum of an estimate from its responses to z and to the frames, if it has any, (1 or 2, n // 2 + 1)."""
    c, *of_frames = response
    power = square(c) * sensors.z
    for d in of_frames:
        frames, frames_by_z, _ = sensors.of_frames
        power = power + square(d) * frames + 2.0 * _real_product(d * frames_by_z, c)
    return power


def _rest_of_error(response: Complex, sensors: TargetSpectra) -> Array:
    """Return the spectrum of its error less that of the estimate."""
    c, *of_frames = response
    shared = _real_product(sensors.by_z, c)
    for d in of_frames:
        shared = shared + _real_product(sensors.of_frames[2], d)
    return sensors.signal - 2.0 * shared


def _real_product(a: Complex, b: Complex) -> Array:
    """Return the real part of a b*."""
    return a.real * b.real + a.imag * b.imag


def has_exact_error(observer: Observer) -> bool:
    """Return whether an observer is linear and causal, takes every mode by itself and needs no training record."""
    return observer.linear and observer.causal and not observer.couples_modes and Training not in observer.prior


def exact_errors(
    observer: Observer, scenario: Scenario, *, spectra: Sequence[TrueSpectra] = ()
) -> list[dict[str, PeriodicError]]:
    """Compute the errors of an observer whose prior is that of the scenario, mode by mode.

    Parameters
    ----------
    observer : Observer
        Linear and causal, one mode apart from the others, without a training record.
    scenario : Scenario
        Of known spectra (`has_known_spectra`).
    spectra : sequence of TrueSpectra
        Mode by mode, what it meets; by default the true spectra of the scenario, which leave out aliasing.

    Returns
    -------
    list of dict
        Per mode: target -> error at every step of the cycle; TOTAL where it estimates both targets.

    Raises
    ------
    ValueError
        The observer is not of that kind, or the scenario has no such prior.
    """
    if not has_exact_error(observer):
        raise ValueError(
            f"{observer.id}: the exact error is that of an observer that is linear, causal and needs no training record, "
            "and takes every mode by itself"
        )
    settings, out = observer_settings(observer, scenario), []
    for mode, known in enumerate(spectra or [true_spectra(scenario, mode) for mode in range(len(scenario.modes))]):
        prior, ratio = prior_of(scenario, None, observer.parts(settings), modes=[mode]), known.ngs.ratio
        taps = impulse_responses(observer, prior, settings, scenario.dt, ratio, known.measurement.size, left=EXACT)
        if len(taps) > 1:
            taps[TOTAL] = np.sum([*taps.values()], axis=0)
        variances = {target: variance_of(of, target, known) for target, of in taps.items()}
        out.append({target: PeriodicError(np.repeat(x, ratio // x.size)) for target, x in variances.items()})
    return out


def variance_of(taps: Array, target: str, spectra: TrueSpectra) -> Array:
    """Return the variance of the error [um^2] at every place in the cycle, (ratio,); taps : of `impulse_responses`."""
    known, (fast, *of_frames) = spectra.without_lines, taps
    sensors = target_spectra(known, target)
    places = np.fft.rfft(taps, known.n).swapaxes(0, 1)
    out = [circle_mean(_estimate_power(at, sensors) + _rest_of_error(at, sensors)) for at in places]
    for frequency, variance in spectra.pure:
        turn = np.exp(-2j * np.pi * frequency * np.arange(taps.shape[-1]))
        seen = spectra.gain * turn[1] * (fast @ turn)
        for slow in of_frames:
            seen = seen + turn[1 : spectra.ngs.ratio + 1].mean() * (slow @ turn)
        out += variance * np.abs((target != TURBULENCE) - seen) ** 2
    return np.array(out)


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
            raise ValueError(f"no prediction: {UNRESOLVED}")
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

            def make(name: str = name, response: Complex | None = response) -> Prediction:
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

    def _response(self, observer: Observer, scenario: Scenario, mode: int, target: str, n: int) -> Complex:
        settings, ratio, name = observer_settings(observer, scenario), scenario.sensors.exposure_ratio, observer.id
        prior, length = self._prior(observer, scenario, mode), (name, self.left)

        def make() -> dict[str, Array]:
            first = self._lengths.get(length, SHORTEST)
            found = impulse_responses(observer, prior, settings, scenario.dt, ratio, n, first, self.left)
            self._lengths[length] = found[target].shape[-1]
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
