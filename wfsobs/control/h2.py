"""H2 control from the spectra, robust to a plant that is not the assumed one: a finite impulse response from z to the command.

A law u = -Q z is in itself the parametrisation of all stabilising controllers by a stable Q (Youla). With Q of finite length the
mean square of the residual is quadratic in its taps, and what limits it is convex:

    |1 - P Q| <= PEAK                      no disturbance is amplified by more
    |P Q| W <= ROBUST / caution,           W = max |P' / P - 1| over errors of delay, gain and rotation

The second, below 1, keeps the loop stable for every such plant P' (small gain; a rotation by theta turns the two modes of a pair
of azimuthal order m by exp(+-i m theta), and m = 1 is borne). It rolls the command off where the delay is felt most. After
P. Dinis et al. 2024 (arXiv:2410.05123), who design by the frequency response of a plant that was measured. The limits act by
multipliers at each frequency, which grow in proportion to what is exceeded (iterative reweighting, as C. Lawson's).
"""

from __future__ import annotations

from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
from scipy.linalg import toeplitz

from wfsobs.control.mirror import Law, Mirror, Plant
from wfsobs.observers.stepping import Gain, GainCycle
from wfsobs.prior import Prior, Spectra
from wfsobs.typing import Array

TAPS = 64
"""Length of Q."""

PEAK = 2.0
"""Largest amplification of a disturbance."""

ROBUST = 0.8
"""Part of what small gain allows that a law of caution 1 takes."""

DELAY, GAIN, ROTATION = 0.5, 0.2, 10.0
"""Errors of the plant that are borne, either way: delay [frames], gain, rotation [deg]."""

FREQUENCIES = np.unique(np.concatenate([np.geomspace(1e-3, pi, 60), np.linspace(0.02, pi, 140)]))
"""Frequencies of the limits [rad per step]."""

ROUNDS = 300
"""Of the multipliers; after a third of them the taps change by less than 1e-6."""


def h2_fir(prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    """Return the law of one mode of least residual within the limits, by the spectra in the prior; `control.caution` counts."""
    q = taps_of(prior.spectra[mode], plant.mirror, settings.control.caution)
    gains = GainCycle([Gain(np.eye(q.size, k=-1), np.zeros((1, q.size)), np.eye(q.size)[:, :1])])  # the state is the last z
    return Law(gains.filter(-q[None]), gains=gains, row=-q)


def taps_of(spectra: Spectra, mirror: Mirror, caution: float) -> Array:
    """Return the taps of Q (TAPS,), of commands over measurements; spectra : on equidistant frequencies up to half the rate."""
    n = spectra.measurement.size
    P = mirror.response(pi * np.arange(n) / (n - 1))
    power = np.fft.irfft(np.abs(P) ** 2 * spectra.measurement)[:TAPS]
    target = np.fft.irfft(spectra.cross * np.conj(P))[:TAPS]
    response, lags = mirror.response(FREQUENCIES), np.arange(TAPS)
    E = response[:, None] * np.exp(-1j * FREQUENCIES[:, None] * lags)
    of_limits = np.abs(response) ** 2 * np.cos(lags[:, None] * FREQUENCIES)  # E* w E is Toeplitz, its first column of_limits w
    most = ROBUST / caution / uncertainty(mirror, FREQUENCIES)
    scale = power[0]
    power[0] += 1e-12 * scale
    peak, roll_off = np.full((2, FREQUENCIES.size), 1e-9 * scale)
    q = np.zeros(TAPS)
    for _ in range(ROUNDS):
        q = np.linalg.solve(toeplitz(power + of_limits @ (peak + roll_off)), target + E.real.T @ peak)
        T = E @ q
        peak = np.maximum(peak * (np.abs(1.0 - T) / PEAK) ** 1.5, 1e-14 * scale)
        roll_off = np.maximum(roll_off * (np.abs(T) / most) ** 1.5, 1e-14 * scale)
    return q


def uncertainty(mirror: Mirror, omega: Array) -> Array:
    """Return W at omega [rad per step], the same shape (n,)."""
    lags = np.linspace(max(-DELAY, 1.0 - mirror.delay), DELAY, 5)
    turned = [replace(mirror, delay=mirror.delay + lag).response(omega) / mirror.response(omega) for lag in lags]
    angles = np.exp(1j * np.radians([-ROTATION, 0.0, ROTATION]))
    factors = np.multiply.outer([1.0 - GAIN, 1.0, 1.0 + GAIN], angles).ravel()
    return np.abs(np.multiply.outer(factors, np.array(turned)) - 1.0).max(axis=(0, 1))
