"""The spectrum of one mode of z: white noise, AR(2) turbulence, AR(2) resonances. Pure lines are in `lines`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit, logit

from wfsobs.ar2 import Ar2
from wfsobs.arrays import Array

STEP = 1e-4
"""Of the central differences, in the logarithm of a parameter."""

HIGHEST = 0.999
"""Damping of a process at most: at 1 its two poles are one."""


@dataclass(frozen=True)
class Spectrum:
    """noise : rms of the white noise [um]; turbulence : or None; resonances : of structure, any number."""

    noise: float
    dt: float
    turbulence: Ar2 | None = None
    resonances: tuple[Ar2, ...] = ()

    @property
    def processes(self) -> tuple[Ar2, ...]:
        """Turbulence, where there is any, and the resonances."""
        return (() if self.turbulence is None else (self.turbulence,)) + self.resonances

    def psd(self, f: Array) -> Array:
        """One-sided power spectral density [um^2/Hz] at f [Hz]."""
        return 2.0 * self.dt * self.noise**2 + sum((p.psd(f) for p in self.processes), np.zeros_like(f))

    @property
    def vector(self) -> Array:
        """log noise, then log omega, logit damping, log rms of every process, (1 + 3 processes,)."""
        return np.concatenate([[np.log(self.noise)], *map(_vector, self.processes)])

    def moved(self, vector: Array) -> Spectrum:
        """The spectrum with these numbers as its `vector`."""
        processes = tuple(_process(v, self.dt) for v in vector[1:].reshape(-1, 3))
        first = 0 if self.turbulence is None else 1
        return replace(self, noise=float(np.exp(vector[0])), turbulence=processes[0] if first else None,
                       resonances=processes[first:])

    def slopes(self, f: Array) -> Array:
        """Derivatives of the density by `vector`, (1 + 3 processes, len(f)) [um^2/Hz]."""
        rows = [np.full_like(f, 4.0 * self.dt * self.noise**2)]
        for p in self.processes:
            at = _vector(p)
            for i, step in enumerate((STEP * p.damping, STEP, STEP)):  # a resonance is as narrow as its damping
                move = step * np.eye(3)[i]
                rows.append((_process(at + move, self.dt).psd(f) - _process(at - move, self.dt).psd(f)) / (2.0 * step))
        return np.array(rows)


def _vector(p: Ar2) -> Array:
    return np.array([np.log(p.omega), logit(p.damping), np.log(p.rms)])


def _process(v: Array, dt: float) -> Ar2:
    return Ar2(float(np.exp(v[0])), float(np.clip(expit(v[1]), 1e-9, HIGHEST)), float(np.exp(v[2])), dt)
