"""True spectra of a scenario, mode by mode, from its settings alone.

The width of lines determines how well they can be predicted. Damped ones have the width that they have in the record
(`turbulence`); undamped ones are predicted without error after long enough (`TrueSpectra.without_lines`). For the residual of
a controller they are taken `line_width` wide at half maximum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from math import ceil, log, log2, pi
from typing import NamedTuple

import numpy as np

from wfsobs.scenario import Scenario
from wfsobs.sensors import zernike
from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.signal.wiener import Complex, Whitener, advance_spectrum, error_spectrum, factorise, innovations_to_come
from wfsobs.simulation import layers as atmosphere
from wfsobs.simulation.disturbance import (
    damping_for_width,
    line_width,
    peak_rms,
    processes,
    pure_lines,
    table_variance,
    turbulence_process,
    vibration_power,
    widen_lines,
)
from wfsobs.simulation.flow_spectra import TurbulenceSpectra, flow_spectra
from wfsobs.simulation.sensing import is_blind, lgs_noise_rms, lgs_weights, low_frequency_process
from wfsobs.simulation.sensor_noise import noise_rms
from wfsobs.typing import Array

DECAYED = 2.5
"""Decay of correlations after half the DFT, as an exponent; a line that wraps around by then brings nothing new."""

SMOOTH = 12.5
"""The same for processes of a known width, whose correlations must not wrap around."""

NEGLIGIBLE = 3e-3
"""Over the variance of the least noise: that of a process times exp(-2 exponent), which is what wrapping puts into an error."""

MOST = 2**20
"""Maximum length of the DFT."""

UNRESOLVED = "the spectra of this scenario are not known or too narrow to resolve, or events change them"
"""Where `has_known_spectra` is false."""

NOTCH = 0.1
"""Mean square of a mode in waves across the wind, whose maximum is 1, below which its spectrum has a notch at 0 Hz."""


def n_frequencies(scenario: Scenario, mode: int = 0) -> int:
    """Return the length of the DFT of a mode, a power of two: its slowest correlation has decayed by half of it."""
    return min(wanted_frequencies(scenario, mode), MOST)


def wanted_frequencies(scenario: Scenario, mode: int = 0) -> int:
    """Return the same without the maximum."""
    slowest = max(one.exponent / one.rate for one in _correlations(scenario))
    if _is_of_aperture(scenario, mode):  # 2^16 and 2^18 differ by 6e-5 at most, on `higher-orders`
        slowest = min(slowest, DECAYED * 16.0 * scenario.telescope.diameter / _slowest_wind(scenario))
    return int(2 ** ceil(log2(2.0 * slowest / scenario.dt)))


class _Correlation(NamedTuple):
    """Of a disturbance: decay rate [1/s], exponent that half the DFT is to reach, and the least with which there is a bound."""

    rate: float
    exponent: float
    least: float = 0.0


def _correlations(scenario: Scenario) -> list[_Correlation]:
    """Return the correlations of the disturbances."""
    v, width, modes = scenario.vibration, pi * line_width(scenario), range(len(scenario.modes))
    noise = max(min(*(lgs_noise_rms(scenario, mode) for mode in modes), *noise_rms(scenario, "ngs")), FLOOR)

    def least(rms: float) -> float:
        return min(max(log(max(rms, FLOOR) / noise) - 0.5 * log(NEGLIGIBLE), DECAYED), SMOOTH)

    smooth = [turbulence_process(scenario, 0, scenario.dt)]
    if scenario.turbulence.source == "processes":
        smooth = [p for mode in modes for p in processes(scenario, mode, scenario.dt)]
    needs = [least(p.rms) if scenario.turbulence.source in ("ar2", "ar3", "processes") else 0.0 for p in smooth]
    found = [_Correlation(2.0, DECAYED)]
    found += [_Correlation(p.omega * p.damping, SMOOTH, need) for p, need in zip(smooth, needs, strict=True)]
    if v.source in ("psd", "measured"):
        found.append(_Correlation(width, DECAYED))
    elif v.source != "none":
        for p in v.peaks:
            rate = max(2.0 * pi * p.frequency * p.damping, width)
            need = least(max(peak_rms(p.rms, mode) for mode in modes)) if p.damping else 0.0  # undamped ones are known
            found.append(_Correlation(rate, min(max(DECAYED * rate / width, need), SMOOTH), need))
    if scenario.turbulence.source == "frozen-flow":
        found.append(_Correlation(_slowest_wind(scenario) / (8.0 * scenario.turbulence.outer_scale), DECAYED))
    elif scenario.turbulence.source == "psd":
        found.append(_Correlation(width, DECAYED))
    return found


def _slowest_wind(scenario: Scenario) -> float:
    return min(layer.speed for layer in atmosphere.layers(scenario))


def _is_of_aperture(scenario: Scenario, mode: int) -> bool:
    """Return whether a mode forgets what the wind carries out of the aperture: it sees little of the outer scale, and no line.

    The spectrum of one that waves across the wind do not excite falls to zero at 0 Hz, and it remembers longer.
    """
    it = scenario.modes[mode]
    if scenario.turbulence.source != "frozen-flow" or it.radial_order < 2 or _vibrates(scenario, mode):
        return False
    layers = atmosphere.layers(scenario)
    across = zernike.azimuthal(it.noll, np.array([1j * np.exp(1j * layer.angle) for layer in layers]))
    strength = np.array([layer.strength for layer in layers])
    return float(strength @ across**2) > NOTCH * float(strength.sum())


def _vibrates(scenario: Scenario, mode: int) -> bool:
    v = scenario.vibration
    if v.source in ("peaks", "ar2"):
        return any(peak_rms(peak.rms, mode) > 0 for peak in v.peaks)
    return bool(vibration_power(scenario, mode, scenario.n_steps).any())


FLOOR = 1e-6
"""Minimum noise of a measurement [um]."""


@dataclass(frozen=True)
class NgsSpectra:
    """Spectra of what the NGS sees in one mode, as `TrueSpectra`, at every fast step and without exposure and noise.

    Attributes
    ----------
    signal : Array
        Of the disturbance in the beam of the NGS.
    measurement_cross : Array
        Cross spectrum of it at step k and z[k + 1].
    cross : dict of str to Array
        Target -> cross spectrum of s[k] and it.
    noise : float
        Variance of the noise of a frame [um^2].
    ratio : int
        Fast steps in the exposure of a frame, and from frame to frame.
    """

    signal: Array
    measurement_cross: Complex | Array
    cross: dict[str, Complex | Array]
    noise: float
    ratio: int


class CausalEstimate(NamedTuple):
    """The best estimate of a target from z[k], z[k-1], ....

    cross   : spectrum of the target and z, the transform over n of E s[k] z[k-n]
    to_come : `wiener.innovations_to_come`
    error   : `wiener.error_spectrum`
    """

    cross: Complex
    to_come: Complex
    error: Array


@dataclass(frozen=True)
class TrueSpectra:
    """Spectra of one mode of a scenario, on the frequencies of `wiener`, all (n // 2 + 1,) [um^2 per sample].

    Attributes
    ----------
    measurement : Array
        S_z of the pseudo-open-loop LGS measurement, with noise.
    signal : dict of str to Array
        Target -> S_s.
    cross : dict of str to Array
        Target -> cross spectrum of s[k] and z[k + 1].
    ngs : NgsSpectra
        Those of the NGS.
    lines : Array or None
        Spectrum of the undamped lines of the vibration, `line_width` wide.
    gain : float
        Gain of the measurement for lines.
    pure : tuple
        (frequency [cycles per step], variance [um^2]) of each line.
    """

    measurement: Array
    signal: dict[str, Array]
    cross: dict[str, Complex | Array]
    ngs: NgsSpectra
    lines: Array | None = None
    gain: float = 1.0
    pure: tuple[tuple[float, float], ...] = ()

    @property
    def n(self) -> int:
        """Length of the DFT."""
        return 2 * (self.measurement.size - 1)

    @property
    def parts(self) -> list[str]:
        """Targets that are not zero throughout, one at least."""
        return [name for name, own in self.signal.items() if own.any()] or list(self.signal)[:1]

    @property
    def total(self) -> tuple[Array, Complex | Array]:
        """(signal, shared) of the whole disturbance; turbulence and vibration are independent."""
        return sum(self.signal.values(), np.zeros(1)), sum(self.cross.values(), np.zeros(1))

    @cached_property
    def whitener(self) -> Whitener:
        """Minimum-phase factor of the spectrum of z."""
        return factorise(self.measurement)

    @cached_property
    def without_lines(self) -> TrueSpectra:
        """The spectra once the undamped lines are known."""
        if self.lines is None:
            return self
        return TrueSpectra(
            self.measurement - self.gain**2 * self.lines,
            self.signal | {"vibration": self.signal["vibration"] - self.lines},
            self.cross | {"vibration": self.cross["vibration"] - self.gain * self.lines},
            replace(
                self.ngs,
                signal=self.ngs.signal - self.lines,
                measurement_cross=self.ngs.measurement_cross - self.gain * self.lines,
                cross=self.ngs.cross | {"vibration": self.ngs.cross["vibration"] - self.lines},
            ),
        )

    @cached_property
    def _estimates(self) -> dict[tuple[tuple[str, ...], int], CausalEstimate]:
        return {}

    def estimate(self, *targets: str, ahead: int = 0) -> CausalEstimate:
        """Return the best estimate of s[k + ahead], of a target or the sum of several; kept."""
        asked = targets, ahead
        if asked not in self._estimates:
            each = [self.estimate(name, ahead=ahead) for name in targets] if len(targets) > 1 else []
            cross = advance_spectrum(reduce(np.add, [self.cross[name] for name in targets]), 1 + ahead)
            to_come = reduce(np.add, [one.to_come for one in each]) if each else innovations_to_come(cross, self.whitener)
            own = reduce(np.add, [self.signal[name] for name in targets])
            self._estimates[asked] = CausalEstimate(cross, to_come, error_spectrum(own, cross, self.whitener, to_come))
        return self._estimates[asked]

    def line_covariance(self, n: int) -> Array:
        """Return the autocovariance of the undamped lines at the lags 0 to n - 1, (n,)."""
        lag = np.arange(n)
        return sum((variance * np.cos(2.0 * pi * f * lag) for f, variance in self.pure), np.zeros(n))


def true_spectra(scenario: Scenario, mode: int, air: TurbulenceSpectra | None = None) -> TrueSpectra:
    """Compute the spectra of one mode, from the settings alone.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    mode : int
        Index of the mode.
    air : TurbulenceSpectra, optional
        Its turbulence, where already computed, which has as many frequencies as the spectra are to have.

    Returns
    -------
    TrueSpectra
        Spectra.
    """
    air = air or turbulence_spectra(scenario, mode, n_frequencies(scenario, mode))
    n = 2 * (air.own.size - 1)
    vibration, gain = _vibration(scenario, mode, n), lgs_weights(scenario)[mode, :, mode].sum()
    lines = _pure_lines(scenario, mode, n)
    if lines is not None:
        vibration = vibration + lines
    return TrueSpectra(
        measurement=air.measurement + gain**2 * vibration + max(lgs_noise_rms(scenario, mode), FLOOR) ** 2,
        signal={"turbulence": air.own, "vibration": vibration},
        cross={"turbulence": air.cross, "vibration": gain * vibration},
        ngs=NgsSpectra(
            signal=air.ngs + vibration,
            measurement_cross=air.sensors_cross + gain * vibration,
            cross={"turbulence": air.ngs_cross, "vibration": vibration},
            noise=max(float(noise_rms(scenario, "ngs")[mode]), FLOOR) ** 2,
            ratio=scenario.sensors.exposure_ratio,
        ),
        lines=lines,
        gain=float(gain),
        pure=tuple((f * scenario.dt, variance) for f, variance in pure_lines(scenario, mode)),
    )


def lgs_turbulence_spectrum(scenario: Scenario, mode: int) -> Array:
    """Return the spectrum of the turbulence in the combined LGS, on the frequencies of `true_spectra`."""
    return turbulence_spectra(scenario, mode, n_frequencies(scenario, mode)).measurement


def has_known_spectra(scenario: Scenario) -> bool:
    """Return whether the spectra are known.

    They are not for frozen flow so slow that its low frequencies would not be resolved, nor for lines so narrow and strong, or
    turbulence so slow, that what wraps around would be more than the error, nor where events change them.
    """
    is_flow, modes = scenario.turbulence.source == "frozen-flow", range(len(scenario.modes))
    if scenario.events or (is_flow and max(wanted_frequencies(scenario, mode) for mode in modes) > 2 * MOST):
        return False
    return all(one.rate * scenario.dt * MOST >= 2.0 * one.least for one in _correlations(scenario))


def _vibration(scenario: Scenario, mode: int, n: int) -> Array:
    v, dt = scenario.vibration, scenario.dt
    if v.source == "ar2":
        out = np.zeros(n // 2 + 1)
        for peak in v.peaks:
            omega = 2.0 * pi * peak.frequency
            damping = damping_for_width(line_width(scenario), peak.frequency, peak.damping)
            out += density(Ar2(omega, damping, peak_rms(peak.rms, mode), dt), n)
        return out
    return 0.5 * n * vibration_power(scenario, mode, n)


def _pure_lines(scenario: Scenario, mode: int, n: int) -> Array | None:
    """Return the spectrum of the undamped lines; None where there is none."""
    power = np.zeros(n // 2 + 1)
    for frequency, variance in pure_lines(scenario, mode):
        power[min(round(frequency * n * scenario.dt), n // 2)] += variance
    return widen_lines(0.5 * n * power, line_width(scenario) * scenario.dt) if power.any() else None


# ---------------------------------------------------------------------- turbulence by its source


def turbulence_spectra(scenario: Scenario, mode: int, n: int) -> TurbulenceSpectra:
    """Return the spectra of the turbulence of one mode alone, for a DFT of `n` steps."""
    if scenario.turbulence.source == "frozen-flow":
        return per_sample(scenario, n, lambda frequency: flow_spectra(scenario, mode, frequency))
    if scenario.turbulence.source == "psd":
        return _through_lgs(scenario, mode, 0.5 * n * table_variance(scenario, mode, n))
    own = [density(p, n) for p in processes(scenario, mode, scenario.dt)]
    return _through_lgs(scenario, mode, sum(own, np.zeros(n // 2 + 1)))


def density(process: Ar2 | Ar3, n: int) -> Array:
    """Return the spectrum of an autoregressive process, per sample."""
    return process.psd(np.fft.rfftfreq(n, process.dt)) / (2.0 * process.dt)


def _through_lgs(scenario: Scenario, mode: int, own: Array) -> TurbulenceSpectra:
    """Return the spectra of turbulence that is common to all stars, each LGS with a slow error of its own."""
    weights = lgs_weights(scenario)[mode, :, mode]
    error = density(low_frequency_process(scenario, mode), 2 * (own.size - 1)) * np.sum(weights**2)
    gain = 0.0 if is_blind(scenario, mode) else weights.sum()
    return TurbulenceSpectra(own, gain**2 * own + error, gain * own, own, own, gain * own)


def notched_frequencies(n: int, dt: float) -> Array:
    """Return the frequencies of a DFT [Hz] at which spectra of frozen flow are taken.

    Along the wind they fall as f^2 to zero at 0 Hz, a notch that the DFT does not resolve: here it is a bin wide.
    """
    return np.hypot(np.fft.rfftfreq(n, dt), 1.0 / (n * dt))


def per_sample(scenario: Scenario, n: int, densities: Callable[[Array], TurbulenceSpectra]) -> TurbulenceSpectra:
    """Return the spectra of frozen flow for a DFT of `n` steps; densities : frequencies [Hz] -> spectra [um^2/Hz]."""
    found = densities(notched_frequencies(n, scenario.dt))
    scaled = {id(part): 0.5 / scenario.dt * part for part in found}  # on the axis the NGS shares its arrays with the truth
    return TurbulenceSpectra(*(scaled[id(part)] for part in found))
