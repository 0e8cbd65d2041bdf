"""The error of a fixed linear observer under the true spectra, computed, not measured on records.

The responses of the observer to one measurement of the LGS at every place in the cycle of an NGS frame, and to one frame, are the
coefficients h_p and g_p of its estimates p steps after a frame,

    s_hat[k] = sum_j h_p[j] z[k-j] + sum_j g_p[j] y[k-j].

With their transforms H_p and G_p, and y = x + v as in `slow_sensor`, the error s - s_hat has the variance

    mean(S_s + |H_p|^2 S_z + |G_p|^2 S_x + 2 Re(H_p* G_p S_xz - H_p* S_sz - G_p* S_sx)) + sum_j g_p[j]^2 E v^2.

Undamped lines are in neither: each adds its variance times the square of what the observer leaves of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wfsobs.evaluation.bound import TOTAL
from wfsobs.evaluation.bound_both import PeriodicError, exposure_response
from wfsobs.observers.base import Observer
from wfsobs.prior import Prior
from wfsobs.priors_from.scenario import observer_settings, prior_of
from wfsobs.progress import QUIET
from wfsobs.record import Measurements
from wfsobs.scenario import Scenario
from wfsobs.settings import Group
from wfsobs.signal.wiener import Complex, advance_spectrum, circle_mean
from wfsobs.simulation.true_spectra import TrueSpectra, true_spectra
from wfsobs.typing import Array

SETTLED = 1000
"""Steps before the response: windows are full and gains are those that repeat."""


def exact_errors(observer: Observer, scenario: Scenario) -> list[dict[str, PeriodicError]]:
    """Compute the errors of an observer that is told the scenario, mode by mode.

    Parameters
    ----------
    observer : Observer
        Linear and causal, one mode apart from the others, without a training record.
    scenario : Scenario
        Of known spectra (`has_known_spectra`).

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
    parts = (*observer.prior, *observer.asks(settings))
    if not observer.linear or not observer.causal or "training" in observer.needs:
        raise ValueError(
            f"{observer.id}: the exact error is that of an observer that is linear, causal and needs no training record"
        )
    spectra = [true_spectra(scenario, mode) for mode in range(len(scenario.modes))]
    return errors_under(observer, prior_of(scenario, None, parts), settings, scenario.dt, spectra)


def errors_under(
    observer: Observer, prior: Prior, settings: Group | None, dt: float, spectra: Sequence[TrueSpectra]
) -> list[dict[str, PeriodicError]]:
    """Compute the errors of an observer under these spectra, whatever it is told; dt [s]. Else as `exact_errors`."""
    ratio = spectra[0].ngs.ratio
    length = spectra[0].measurement.size // ratio * ratio
    responses = impulse_responses(observer, prior, settings, dt, len(spectra), ratio, length)
    out = []
    for mode, known in enumerate(spectra):
        taps = {target: (fast[..., mode], slow[..., mode]) for target, (fast, slow) in responses.items()}
        if len(taps) > 1:
            fast, slow = zip(*taps.values(), strict=True)
            taps[TOTAL] = np.sum(fast, axis=0), np.sum(slow, axis=0)
        out.append({target: PeriodicError(_variance(*pair, target, known)) for target, pair in taps.items()})
    return out


def impulse_responses(
    observer: Observer, prior: Prior, settings: Group | None, dt: float, n_modes: int, ratio: int, length: int
) -> dict[str, tuple[Array, Array]]:
    """Return target -> h_p and g_p, (ratio, length, n_modes) each; all modes respond at once, each to itself."""
    start = -(-SETTLED // ratio) * ratio
    n_steps = start + length + ratio
    frames = np.full((n_steps, n_modes), np.nan)
    frames[ratio::ratio] = 0.0
    rest = np.zeros((n_steps, n_modes))

    def respond(z: Array, ngs: Array) -> dict[str, Array]:
        given = Measurements(z, rest, dt, y_ngs=ngs, ratio=ratio)
        return {name: np.nan_to_num(values) for name, values in observer.estimate(given, prior, settings, QUIET).items()}

    silence = respond(rest, frames)
    out = {name: (np.zeros((ratio, length, n_modes)), np.zeros((ratio, length, n_modes))) for name in silence}
    for at in range(start, start + ratio + 1):
        is_frame = at == start + ratio
        pulse = (frames if is_frame else rest).copy()
        first = start if is_frame else at
        pulse[first] = 1.0
        for name, values in respond(*((rest, pulse) if is_frame else (pulse, frames))).items():
            response = (values - silence[name])[first : first + length]
            for late in range(ratio):  # steps after the measurement
                out[name][int(is_frame)][(first + late) % ratio, late::ratio] = response[late::ratio]
    return out


def _variance(fast: Array, slow: Array, target: str, spectra: TrueSpectra) -> Array:
    """Return the variance of the error at every place in the cycle, (ratio,); fast, slow : h_p, g_p (ratio, length)."""
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
        left = own + np.abs(H) ** 2 * known.measurement + np.abs(G) ** 2 * x
        left += 2.0 * (H.conj() * (G * x_by_z - by_z) - G.conj() * by_x).real
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
