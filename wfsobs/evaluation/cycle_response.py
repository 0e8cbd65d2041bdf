"""Spectra of what observers of NGS frames do, whose responses repeat with the frames.

With the responses H_p and G_p, p steps after a frame, of `exact_errors`, a wave exp(i w k) of z becomes n waves of the estimate,

    H_p(w) exp(i w k) = sum_l c_l(w) exp(i (w + 2 pi l / n) k),    c_l(w) = mean over p of H_p(w) exp(-2 pi i l p / n),

and one of the frames likewise. At w + 2 pi l / n the error has, on average over the cycle, |1 at l = 0, -c_l, -d_l|^2 in the
spectral matrix of s, z and y at w. (Bittanti and Colaneri, Periodic Systems, 2009, chapter 6, have these transfer functions.)
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from wfsobs.evaluation.bound_both import exposure_response
from wfsobs.evaluation.linear_response import SETTLED, SHORTEST, START, has_settled, record_estimates
from wfsobs.observers.base import Observer
from wfsobs.prior import Prior
from wfsobs.record import Measurements
from wfsobs.settings import Group
from wfsobs.signal.wiener import Complex, advance_spectrum
from wfsobs.simulation.true_spectra import TrueSpectra
from wfsobs.typing import Array


class CycleTaps(NamedTuple):
    """Coefficients of an estimate p steps after a frame; fast, slow : h_p of z and g_p of the frames, (ratio, length)."""

    fast: Array
    slow: Array


class BothSensors(NamedTuple):
    """Spectra of a target and of what is measured, all (n // 2 + 1,) [um^2 per sample].

    signal, z, frames : of s, z and the NGS with the noise of a frame;  by_z, by_frames : cross spectra of s with these
    frames_by_z       : cross spectrum of the NGS with z
    """

    signal: Array
    z: Array
    frames: Array
    by_z: Complex
    by_frames: Complex
    frames_by_z: Complex


def both_sensors(spectra: TrueSpectra, target: str) -> BothSensors:
    """Return the spectra of a target and of both sensors."""
    ngs, exposure = spectra.ngs, exposure_response(spectra.ngs.ratio, spectra.measurement.size)
    return BothSensors(
        spectra.signal[target],
        spectra.measurement,
        ngs.signal * np.abs(exposure) ** 2 + ngs.noise,
        advance_spectrum(spectra.cross[target], 1),
        ngs.cross[target] * exposure.conj(),
        advance_spectrum(ngs.measurement_cross * exposure, 1),
    )


def cycle_taps(
    observer: Observer,
    prior: Prior,
    settings: Group | None,
    dt: float,
    ratio: int,
    most: int,
    first: int = SHORTEST,
    left: float = SETTLED,
) -> dict[str, CycleTaps]:
    """Compute the coefficients of a linear observer's estimates, in one mode, from one record of impulses one after the other.

    Parameters
    ----------
    observer : Observer
        The observer.
    prior, settings : Prior, Group or None
        What it is given, of one mode.
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
    dict of str to CycleTaps
        Target -> coefficients.
    """
    start, longest = -(-START // ratio) * ratio, most // ratio * ratio
    length = min(-(-first // ratio) * ratio, longest)
    while True:
        at = [start + i * (length + ratio) + i % ratio for i in range(ratio + 1)]  # the last in a frame
        z = np.zeros((start + (ratio + 1) * (length + ratio), 1))
        frames = np.full_like(z, np.nan)
        frames[ratio::ratio] = 0.0
        z[at[:-1]] = frames[at[-1]] = 1.0
        found = record_estimates(observer, Measurements(z, np.zeros_like(z), dt, y_ngs=frames, ratio=ratio), prior, settings)
        segments = {target: _segments(values[:, 0], at, length, ratio) for target, values in found.items()}
        if length == longest or all(has_settled(h, left) for parts in segments.values() for h in parts):
            return {target: _taps(parts, ratio) for target, parts in segments.items()}
        length = min(2 * length, longest)


def _segments(values: Array, at: list[int], length: int, ratio: int) -> list[Array]:
    """Return what follows each impulse, without what the estimates are of nothing."""
    rest = values[at[0] - ratio : at[0]]  # as it was over the cycle before the first impulse
    late = np.arange(length) - at[0]
    return [values[i : i + length] - rest[(late + i) % ratio] for i in at]


def _taps(segments: list[Array], ratio: int) -> CycleTaps:
    """Sort what follows an impulse by the place in the cycle where it is estimated."""
    fast, slow = np.zeros((2, ratio, segments[0].size))
    for i, response in enumerate(segments):
        for late in range(ratio):
            (fast if i < ratio else slow)[(i + late) % ratio, late::ratio] = response[late::ratio]
    return CycleTaps(fast, slow)


def cycle_spectra(taps: CycleTaps, sensors: BothSensors) -> tuple[Array, Array]:
    """Return the spectra of an estimate and of its error on average over the cycle, (n // 2 + 1,).

    What moves to a frequency between those of the DFT is at the nearest one.
    """
    ratio, n = taps.fast.shape[0], 2 * (sensors.z.size - 1)
    places = np.exp(-2j * np.pi * np.outer(np.arange(ratio), np.arange(ratio)) / ratio) / ratio
    fast, slow = (places @ np.fft.rfft(h, n) for h in taps)
    out = np.zeros((2, 2 * n))
    for wave, (c, d) in enumerate(zip(fast, slow, strict=True)):
        shift = round(wave * n / ratio)
        power = _power(c) * sensors.z + _power(d) * sensors.frames + 2.0 * _real_product(d * sensors.frames_by_z, c)
        parts = np.stack([power, power])
        if wave == 0:
            parts[1] += sensors.signal - 2.0 * (_real_product(sensors.by_z, c) + _real_product(sensors.by_frames, d))
        parts[:, [0, -1]] *= 0.5  # these are their own at negative frequencies
        out[:, shift : shift + parts.shape[1]] += parts
    circle = out[:, :n] + out[:, n:]
    signal, error = (circle + np.roll(circle[:, ::-1], 1, axis=1))[:, : n // 2 + 1]
    return signal, error


def _power(c: Complex) -> Array:
    return c.real**2 + c.imag**2


def _real_product(a: Complex, b: Complex) -> Array:
    """Return the real part of a b*."""
    return a.real * b.real + a.imag * b.imag
