"""The error of a fixed linear observer under the true spectra, computed, not measured on records.

The responses of the observer to one measurement of the LGS at every place in the cycle of an NGS frame, and to one frame, are the
coefficients h_p and g_p of its estimates p steps after a frame,

    s_hat[k] = sum_j h_p[j] z[k-j] + sum_j g_p[j] y[k-j].

With their transforms H_p and G_p, and y = x + v as in `slow_sensor`, the error s - s_hat has the variance

    mean(S_s + |H_p|^2 S_z - 2 Re(S_sz H_p*) + |G_p|^2 S_x - 2 Re((S_sx - H_p S_zx) G_p*)) + sum_j g_p[j]^2 E v^2,

what the frames leave of what the LGS leave (`linear_response`).

Undamped lines are in neither: each adds its variance times the square of what the observer leaves of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wfsobs.evaluation.bound_both import PeriodicError, exposure_response
from wfsobs.evaluation.linear_response import estimate_and_error, impulse_responses
from wfsobs.observers.base import Observer
from wfsobs.observers.estimates import TOTAL
from wfsobs.prior import Prior
from wfsobs.priors_from.scenario import observer_settings, prior_of
from wfsobs.scenario import Scenario
from wfsobs.settings import Group
from wfsobs.signal.wiener import Complex, advance_spectrum, circle_mean
from wfsobs.simulation.true_spectra import TrueSpectra, true_spectra
from wfsobs.typing import Array


def exact_errors(
    observer: Observer, scenario: Scenario, *, spectra: Sequence[TrueSpectra] = ()
) -> list[dict[str, PeriodicError]]:
    """Compute the errors of an observer that is told the scenario, mode by mode.

    Parameters
    ----------
    observer : Observer
        Linear and causal, one mode apart from the others, without a training record.
    scenario : Scenario
        Of known spectra (`has_known_spectra`).
    spectra : sequence of TrueSpectra
        Mode by mode, what it meets; by default the true spectra of the scenario, which leave out aliasing (`lenslet_spectra`).

    Returns
    -------
    list of dict
        Per mode: target -> error at every step of the cycle; TOTAL where it estimates both targets.

    Raises
    ------
    ValueError
        The observer is not of that kind, or the scenario has no such prior.
    """
    settings = observer_settings(observer, scenario)
    parts = observer.parts(settings)
    if not observer.linear or observer.couples_modes or not observer.causal or "training" in observer.needs:
        raise ValueError(
            f"{observer.id}: the exact error is that of an observer that is linear, causal and needs no training record, "
            "and takes every mode by itself"
        )
    met = spectra or [true_spectra(scenario, mode) for mode in range(len(scenario.modes))]
    return errors_under(observer, prior_of(scenario, None, parts), settings, scenario.dt, met)


def errors_under(
    observer: Observer, prior: Prior, settings: Group | None, dt: float, spectra: Sequence[TrueSpectra]
) -> list[dict[str, PeriodicError]]:
    """Compute the errors of an observer under these spectra, whatever it is told; dt [s]. Else as `exact_errors`."""
    ratio = spectra[0].ngs.ratio
    length = max(known.measurement.size for known in spectra) // ratio * ratio
    responses = impulse_responses(observer, prior, settings, dt, len(spectra), ratio, length)
    out = []
    for mode, known in enumerate(spectra):
        taps = {target: (fast[..., mode], slow[..., mode]) for target, (fast, slow) in responses.items()}
        if len(taps) > 1:
            fast, slow = zip(*taps.values(), strict=True)
            taps[TOTAL] = np.sum(fast, axis=0), np.sum(slow, axis=0)
        out.append({target: PeriodicError(variance_of(*pair, target, known)) for target, pair in taps.items()})
    return out


def variance_of(fast: Array, slow: Array, target: str, spectra: TrueSpectra) -> Array:
    """Return the variance of the error [um^2] at every place in the cycle, (ratio,); fast, slow : h_p, g_p (ratio, length)."""
    known, ratio = spectra.without_lines, spectra.ngs.ratio
    ngs, n = known.ngs, 2 * (known.measurement.size - 1)
    exposure = exposure_response(ratio, known.measurement.size)
    names = [target] if target in known.signal else list(known.signal)
    own = sum((known.signal[name] for name in names), np.zeros(1))
    by_z = advance_spectrum(sum((known.cross[name] for name in names), np.zeros(1)), 1)
    by_x = sum((ngs.cross[name] for name in names), np.zeros(1)) * exposure.conj()
    x, x_by_z = ngs.signal * np.abs(exposure) ** 2, advance_spectrum(ngs.measurement_cross * exposure, 1)
    out = np.empty(ratio)
    for phase in range(ratio):
        H, G = np.fft.rfft(fast[phase], n), np.fft.rfft(slow[phase], n)
        _, left = estimate_and_error(H, known.measurement, own, by_z)
        _, left = estimate_and_error(G, x, left, by_x - H * x_by_z.conj())
        of_lines = sum(
            variance * abs(_line_left(fast[phase], slow[phase], frequency, spectra.gain, ratio, target)) ** 2
            for frequency, variance in spectra.pure
        )
        out[phase] = circle_mean(left) + ngs.noise * np.sum(slow[phase] ** 2) + of_lines
    return out


def _line_left(fast: Array, slow: Array, frequency: float, gain: float, ratio: int, target: str) -> complex:
    """Return the error for a line of amplitude one; frequency [cycles per step]."""
    turn = np.exp(-2j * np.pi * frequency * np.arange(fast.size))
    exposure: Complex = np.exp(-2j * np.pi * frequency * np.arange(1, ratio + 1)).mean()
    is_part = 0.0 if target == "turbulence" else 1.0
    return complex(is_part - gain * turn[1] * (fast @ turn) - exposure * (slow @ turn))
