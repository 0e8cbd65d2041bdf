"""Missing samples of one mode: what a spectrum expects in their place, and how much of every bin is lost with them.

A filled record is no measurement: it has no noise in its gaps. With C the covariance of the complete record (circulant, of
eigenvalues S), the filled record is the conditional mean of the complete one given what was measured; the expected periodogram
of the complete one is that of the filled one plus V(f), the spectrum of what is not known. V is that of fills of records drawn
from S and given the same gaps: any gaps, single or in bursts. Fitting S to I + V and filling anew is the EM algorithm (Dempster,
Laird and Rubin, J. R. Stat. Soc. B 39, 1, 1977), whose end is the maximum of Whittle's likelihood of the samples that there are.
"""

from __future__ import annotations

from itertools import pairwise
from math import ceil, log

import numpy as np
from scipy.fft import irfft, rfft
from scipy.sparse.linalg import LinearOperator, cg

from wfsobs.spectral.periodogram import periodogram
from wfsobs.typing import Array

DRAWS = 2
"""Records drawn for V. Its scale is known: the shares of all bins add up to the share of samples that are measured."""
BANDS = 40
"""Over which V is smoothed. It is flat where S is white or far above noise, hence a resonance makes no step in it."""
CLOSE, MOST = 1e-4, 300
"""Error of a filled sample at which conjugate gradients stop, over the rms of the noise, about; and their steps at most."""
LEAST = 1e-3
"""Share of a bin that is taken for measured at least."""


class Missing:
    """gone (n,) : which samples are missing; dt [s]; rng : for the records drawn."""

    def __init__(self, gone: Array, dt: float, rng: np.random.Generator):
        self.gone, self.dt, self.n = gone, dt, len(gone)
        self.any = bool(gone.any())
        self.noise = rng.standard_normal((DRAWS, self.n)) if self.any else np.zeros((0, self.n))

    def rounds(self, left: float) -> int:
        """Of filling and fitting, until `left` of the error of the first is left; 1 where nothing is missing."""
        return max(1, ceil(log(left) / log(self.gone.mean()))) if self.any else 1

    def interpolated(self, z: Array) -> Array:
        """z (n,) with straight lines through the gaps, for a first guess."""
        k = np.arange(self.n)
        return np.interp(k, k[~self.gone], z[~self.gone]) if self.any else z

    def filled(self, z: Array, S: Array) -> Array:
        """z (n,) with what the density S (bins,) expects in the place of missing samples, given all others."""
        weight = self._everywhere(S)
        weight = weight.min() / weight

        def weighted(x: Array) -> Array:
            return irfft(weight * rfft(x), self.n)

        def within(x: Array) -> Array:
            whole = np.zeros(self.n)
            whole[self.gone] = x
            return weighted(whole)[self.gone]

        start = self.interpolated(z)
        out, count = start.copy(), int(self.gone.sum())
        rest = -weighted(start)[self.gone]
        size = CLOSE * np.sqrt(count * S.min() / (2.0 * self.dt))
        move, _ = cg(LinearOperator((count, count), matvec=within, dtype=float), rest, rtol=0.0, atol=size, maxiter=MOST)
        out[self.gone] += move
        return out

    def unknown(self, S: Array) -> Array:
        """What the fills of records drawn from the density S leave unknown, (DRAWS, n): missing samples less their fill."""
        root = np.sqrt(self._everywhere(S) / (2.0 * self.dt))
        drawn = irfft(root * rfft(self.noise), self.n)
        return np.array([x - self.filled(x, S) for x in drawn])

    def measured(self, S: Array, unknown: Array) -> Array:
        """Share 1 - V / S of every bin that is measured, (bins,): for white noise the share of samples that are."""
        V = np.mean([periodogram(e, self.dt) for e in unknown], axis=0)
        j = np.arange(1.0, len(V) + 1.0)
        edges = np.unique(np.concatenate([[0], np.geomspace(1, len(V), BANDS).astype(int)]))
        centre, level = (np.array([x[a:b].mean() for a, b in pairwise(edges)]) for x in (np.log(j), V))
        V = np.exp(np.interp(np.log(j), centre, np.log(np.maximum(level, np.finfo(float).tiny))))
        return np.maximum(1.0 - V / S * self.gone.mean() / np.mean(V / S), LEAST)

    def _everywhere(self, S: Array) -> Array:
        """At the frequencies of rfft, from zero on."""
        return np.concatenate([S[:1], S, S[-1:]])[: self.n // 2 + 1]
