"""Butterworth bank: a sum of narrow band-passes that isolates vibration (paper, section 2.3)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import butter, sosfilt

from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.typing import Array


def bandpass_bank(frequencies: Sequence[float], bandwidth: float, order: int, dt: float) -> list[Array]:
    """Design one digital Butterworth band-pass per centre frequency.

    Parameters
    ----------
    frequencies : sequence of float
        Centres [Hz].
    bandwidth : float
        Full width [Hz]: the edges are centre +- bandwidth / 2.
    order : int
        Order of each filter.
    dt : float
        Time step [s].

    Returns
    -------
    list of Array
        Second-order sections, one array per centre.
    """
    return [_bandpass(f - bandwidth / 2.0, f + bandwidth / 2.0, order, dt).copy() for f in frequencies]


@lru_cache(maxsize=64)  # a run asks several times for the same ones
def _bandpass(low: float, high: float, order: int, dt: float) -> Array:
    return butter(order, [low, high], "bandpass", fs=1.0 / dt, output="sos")


def filter_causal(bank: Sequence[Array], x: Array) -> Array:
    """Return the sum of the band-passes of x (n, n_modes) along the steps, from rest; same shape."""
    out = np.zeros_like(x)
    for sos in bank:
        out += sosfilt(sos, x, axis=0)
    return out


def filter_zero_phase(bank: Sequence[Array], x: Array) -> Array:
    """Return the sum of the band-passes, each run forward and then backward in time, so without delay; same shape.

    Not causal: for references and training targets only.
    """
    out = np.zeros_like(x)
    for sos in bank:
        out += sosfilt(sos, sosfilt(sos, x, axis=0)[::-1], axis=0)[::-1]
    return out


def bank_recursion(bank: Sequence[Array]) -> PeriodicFilter:
    """Return `filter_causal` of one signal as a recursion."""
    systems = [sos2ss(sos) for sos in bank]
    A = block_diag(*(A for A, *_ in systems))
    b, c = (np.concatenate([system[i] for system in systems]) for i in (1, 2))
    return PeriodicFilter([(A, b[:, None], c[None], np.array([[sum(d for *_, d in systems)]]))])


def sos2ss(sos: Array) -> tuple[Array, Array, Array, float]:
    """Return the state space (A, b, c, d) of second-order sections in series, each in transposed direct form II."""
    A, b, c, d = np.zeros((0, 0)), np.zeros(0), np.zeros(0), 1.0
    for b0, b1, b2, _, a1, a2 in sos:
        Ai = np.array([[-a1, 1.0], [-a2, 0.0]])
        bi = np.array([b1 - a1 * b0, b2 - a2 * b0])
        A = np.block([[A, np.zeros((len(A), 2))], [np.outer(bi, c), Ai]])
        b, c, d = np.concatenate([b, bi * d]), np.concatenate([b0 * c, [1.0, 0.0]]), b0 * d
    return A, b, c, d
