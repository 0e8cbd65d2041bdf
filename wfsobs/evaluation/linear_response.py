"""Responses of linear observers to single measurements, and the spectra of errors that follow from them.

With H the response of an observer from a measurement z to its estimate of s, the error has the spectrum

    S_e = S_s + |H|^2 S_z - 2 Re(S_sz H*),

whatever the model that the observer is built on.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from wfsobs.observers.base import Observer
from wfsobs.prior import Prior
from wfsobs.progress import QUIET
from wfsobs.record import Measurements
from wfsobs.signal.wiener import Complex
from wfsobs.typing import Array

SETTLED = 1e-6
"""What may be left at the end of a response, over its maximum."""

SHORTEST = 2**11
"""Steps of the first look at a response; each next one is twice as long."""

START = 1000
"""Steps before the response to both sensors: windows are full and gains are those that repeat."""


def estimate_and_error(H: Complex, measurement: Array, signal: Array, cross: Complex | Array) -> tuple[Array, Array]:
    """Return the spectra of an estimate and of its error.

    Parameters
    ----------
    H : Array
        Response from the measurement to the estimate, (n,).
    measurement, signal, cross : Array
        S_z, S_s and S_sz, (n,). Of a second measurement: S_s is the error that the first one leaves, S_sz the cross spectrum of
        that error and the second.

    Returns
    -------
    tuple of Array
        |H|^2 S_z and S_e, (n,).
    """
    power = (H.real**2 + H.imag**2) * measurement
    return power, signal + power - 2.0 * (np.real(cross) * H.real + np.imag(cross) * H.imag)


def impulse_response(
    observer: Observer, prior: Prior, settings: Any, dt: float, most: int, first: int = SHORTEST, left: float = SETTLED
) -> dict[str, Array]:
    """Compute the estimates of a linear observer of the LGS from a single sample of one, in one mode.

    Parameters
    ----------
    observer : Observer
        The observer.
    prior, settings : Prior, Group or None
        What it is given, of one mode.
    dt : float
        Time step [s].
    most : int
        Maximum number of steps.
    first : int
        Steps of the first try, twice as many in each next, until the response has settled.
    left : float
        What may be left at the end of a response, over its maximum.

    Returns
    -------
    dict of str to Array
        Target -> response, (n_steps,).
    """
    steps = min(first, most)
    while True:
        impulse = np.zeros((steps, 1))
        impulse[0] = 1.0
        found = record_estimates(observer, Measurements(impulse, np.zeros_like(impulse), dt), prior, settings)
        taps = {target: values[:, 0] for target, values in found.items()}
        if steps == most or all(has_settled(h, left) for h in taps.values()):
            return taps
        steps = min(2 * steps, most)


def has_settled(h: Array, left: float = SETTLED) -> bool:
    """Return whether no more is left at the end of a response, over its maximum."""
    return float(np.abs(h[-h.size // 8 :]).max()) <= left * float(np.abs(h).max())


def impulse_responses(
    observer: Observer, prior: Prior, settings: Any, dt: float, n_modes: int, ratio: int, length: int
) -> dict[str, tuple[Array, Array]]:
    """Compute the responses of a linear observer of both sensors at every place p in the cycle of an NGS frame.

    They are the coefficients of its estimates p steps after a frame, sum_j h_p[j] z[k-j] + sum_j g_p[j] y[k-j].

    Parameters
    ----------
    observer : Observer
        The observer.
    prior, settings : Prior, Group or None
        What it is given; all modes respond at once, each to itself.
    dt : float
        Time step [s].
    n_modes, ratio, length : int
        Number of modes, steps of a cycle, steps of a response.

    Returns
    -------
    dict of str to tuple of Array
        Target -> h_p and g_p, (ratio, length, n_modes) each.
    """
    start = -(-START // ratio) * ratio
    n_steps = start + length + ratio
    frames = np.full((n_steps, n_modes), np.nan)
    frames[ratio::ratio] = 0.0
    rest = np.zeros((n_steps, n_modes))

    def respond(z: Array, ngs: Array) -> dict[str, Array]:
        return record_estimates(observer, Measurements(z, rest, dt, y_ngs=ngs, ratio=ratio), prior, settings)

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


def record_estimates(observer: Observer, measurements: Measurements, prior: Prior, settings: Any) -> dict[str, Array]:
    """Return an observer's estimates of a record, zero where there is none."""
    found = observer.estimate(measurements, prior, settings, QUIET)
    return {target: np.nan_to_num(values) for target, values in found.items()}
