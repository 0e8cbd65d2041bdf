"""Temporal frequencies of a layer of frozen flow, and the signals of amplitudes on them: see `frozen_flow`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len
from scipy.special import erfc

from wfsobs.atmosphere.von_karman import FIELD, TurbulenceLayer
from wfsobs.typing import Array

TAPER = 16
"""Multiples of 1 / P below which single nodes replace the FFT."""
STEEPNESS = 7.0
"""Steepness of the window between the two; erfc(STEEPNESS / 2) = 7e-7 is cut off."""
PANEL_NODES = 20
"""Gauss-Legendre nodes of a panel: the phase of a wave turns by less than 8 pi over it."""

END = 700.0
"""Maximum k_x D / 2 of the waves: 370 times the knee of tip; less than 1e-11 of its variance lies beyond."""


@dataclass(frozen=True)
class FrequencyGrid:
    """Temporal frequencies of a layer: single nodes first, then multiples of 1 / P.

    Attributes
    ----------
    f, weight : Array
        Frequencies and quadrature weights, (n,) [Hz].
    n_low : int
        Number of single nodes.
    n_fft : int
        Steps of a period P.
    dt : float
        Time step [s].
    """

    f: Array
    weight: Array
    n_low: int
    n_fft: int
    dt: float

    @classmethod
    def of(cls, layer: TurbulenceLayer, outer_scale: float, diameter: float, n_steps: int, dt: float) -> FrequencyGrid:
        """Return the grid for a record of `n_steps`."""
        n_fft = fft_length(layer, diameter, n_steps, dt)
        period = n_fft * dt
        top = TAPER / period
        nodes, weights = np.polynomial.legendre.leggauss(PANEL_NODES)
        panels = max(int(np.ceil(np.log2(top / (0.5 * layer.speed / outer_scale)))), 0)
        edges = np.concatenate([[0.0], top * 0.5 ** np.arange(panels, -1, -1)])
        half, middle = 0.5 * np.diff(edges)[:, None], 0.5 * (edges[1:] + edges[:-1])[:, None]
        f_low, w_low = (middle + half * nodes).ravel(), (half * weights).ravel()
        last = int(np.ceil(END / (np.pi * diameter) * layer.speed * period))
        f_high = np.arange(1, max(last, TAPER) + 1) / period
        w_high = np.full(f_high.size, 1.0 / period)
        f, share = np.concatenate([f_low, f_high]), np.concatenate([fade_out(f_low / top), 1.0 - fade_out(f_high / top)])
        return cls(f, np.concatenate([w_low, w_high]) * share, f_low.size, n_fft, dt)

    def signal(self, amplitude: Array, n_steps: int) -> Array:
        """Return Re sum_f a(f) exp(-2 pi i f t) at the steps, (n_outputs, n_steps), for complex a (n_outputs, n)."""
        j = np.arange(1, self.f.size - self.n_low + 1) % self.n_fft
        beyond = j > self.n_fft // 2  # aliases: exp(-2 pi i j t) = exp(2 pi i (n_fft - j) t) at the steps
        at = np.where(beyond, self.n_fft - j, j)
        out = np.empty((len(amplitude), n_steps))
        for row, a in zip(out, amplitude, strict=True):
            high = np.where(beyond, a[self.n_low :], a[self.n_low :].conj())
            bins = np.zeros(self.n_fft // 2 + 1, complex)
            if at.size <= self.n_fft // 2:
                bins[at] = high
            else:
                np.add.at(bins, at, high)
            bins[0] = 2.0 * bins[0].real
            if self.n_fft % 2 == 0:
                bins[-1] = 2.0 * bins[-1].real
            row[:] = irfft(bins, self.n_fft)[:n_steps] * (0.5 * self.n_fft)
        return out + sum_waves(self.f[: self.n_low], amplitude[:, : self.n_low], n_steps, self.dt)


def fft_length(layer: TurbulenceLayer, diameter: float, n_steps: int, dt: float) -> int:
    """Return the length of the FFT: twice the record and the time in which the layer moves past all beams."""
    across = (diameter + FIELD * layer.height) / layer.speed
    return next_fast_len(int(np.ceil(2.0 * (n_steps + across / dt))), real=True)


def fade_out(x: Array) -> Array:
    """Return a smooth window from 1 at x = 0 to 0 at x = 1."""
    return np.where(x < 1.0, 0.5 * erfc(STEEPNESS * (x - 0.5)), 0.0)


def sum_waves(f: Array, a: Array, n_steps: int, dt: float) -> Array:
    """Return Re sum a exp(-2 pi i f t) at t = 0, dt, ..., (n_outputs, n_steps), by blocks of time."""
    block = 512
    angle = -2.0 * np.pi * np.outer(f, np.arange(block) * dt)
    cosine, sine = np.cos(angle), np.sin(angle)
    starts = np.exp(-2j * np.pi * np.outer(f, np.arange(0, n_steps, block) * dt))
    out = np.empty((len(a), starts.shape[1], block))
    for i, start in enumerate(starts.T):
        turned = a * start
        out[:, i] = turned.real @ cosine - turned.imag @ sine
    return out.reshape(len(a), -1)[:, :n_steps]
