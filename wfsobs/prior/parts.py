"""Parts of a prior, of one mode or of all: numbers, without a reference to their source.

Made from a scenario (`wfsobs.priors_from.scenario`), or from telemetry (`IdentifiedMode.prior`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi
from typing import NamedTuple, Self

import numpy as np

from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.signal.gap_gains import ONE, SensorMean
from wfsobs.signal.statespace import DisturbanceModel, disturbance_model
from wfsobs.signal.wiener import Complex
from wfsobs.typing import Array


class LgsError(NamedTuple):
    """The slow error of the LGS together in one mode, as a process at the fast step."""

    process: Ar2


@dataclass(frozen=True)
class LgsStars:
    """The LGS together in one mode where some of them are out: the first 1, 2, ... of them.

    noise : rms of the white noise over that of all, by how many there are
    slow  : one process less, at the fast step: the first s have the slow error of all, and of these processes that of s and those
        behind it, all independent. For the mean over equal stars that is exact (Helmert contrasts).
    """

    noise: tuple[float, ...]
    slow: tuple[Ar2, ...] = ()

    def sensor_mean(self, has_slow_error: bool) -> SensorMean:
        """Return them as a measurement; has_slow_error: to a filter that models the slow error of all."""
        found = [(i, p) for i, p in enumerate(self.slow) if p.rms > 0] if has_slow_error else []
        if not found:
            return ONE._replace(noise=np.array(self.noise), C=np.zeros((len(self.noise), 0)))
        model, behind = disturbance_model([process for _, process in found], ()), np.repeat([i for i, _ in found], 2)
        return SensorMean(np.array(self.noise), model.A, model.Q, (behind >= np.arange(len(self.noise))[:, None]) * model.C)


class Line(NamedTuple):
    """A vibration peak: natural frequency [Hz], damping (0 for a pure line), rms [um]."""

    frequency: float
    damping: float
    rms: float


@dataclass(frozen=True)
class Lines:
    """The model of one mode with the whole vibration.

    noise      : rms of the white noise of its measurement [um]
    turbulence : processes whose sum the turbulence is, sampled every `dt` [s]; a coloured background is one of them, as
        measurements alone cannot tell the two apart
    lines      : the peaks of the vibration
    continuum  : processes whose sum is the part of the vibration that is no peak
    """

    noise: float
    dt: float
    turbulence: tuple[Ar2 | Ar3, ...] = ()
    lines: tuple[Line, ...] = ()
    continuum: tuple[Ar2, ...] = ()

    def disturbance(self, line_width: float) -> DisturbanceModel:
        """Return the state-space model, with `line_width` the minimum line width (FWHM) [Hz]."""
        return disturbance_model(self.turbulence, self.vibration(line_width))

    def vibration(self, line_width: float) -> list[Ar2]:
        """Return the processes of the vibration: one per line, then the continuum."""
        least = pi * line_width  # as xi w
        peaks = []
        for frequency, damping, rms in self.lines:
            omega = 2.0 * pi * frequency
            peaks.append(Ar2(omega, min(max(damping, least / omega), 1.0), rms, self.dt))
        return [*peaks, *self.continuum]


@dataclass(frozen=True)
class Beams:
    """Turbulence of one mode as the target has it and as the LGS together see it: independent processes at the fast step.

    common : in both;  gain : of the LGS for them
    target, lgs : in one alone
    line_gain   : of the LGS for the vibration
    """

    common: tuple[Ar2 | Ar3, ...]
    target: tuple[Ar2 | Ar3, ...] = ()
    lgs: tuple[Ar2 | Ar3, ...] = ()
    gain: float = 1.0
    line_gain: float = 1.0


@dataclass(frozen=True)
class Spectra:
    """The spectra of one mode at frequencies that are evenly spaced from 0 to half the rate, (n,) [um^2 per sample].

    disturbance : of phi_dist;  measurement : of z, noise and all
    cross       : between phi_dist[k] and z[k + 1], complex where the sensor sees other turbulence
    """

    disturbance: Array
    measurement: Array
    cross: Complex | Array


@dataclass(frozen=True)
class Flow:
    """Turbulence of all modes together, as the target has it and as the LGS together see it, without noise.

    Spectra stand for sums: E t_i[k] m_j[k-n] is the real part of the sum over nodes of cross[i, j] exp(i omega n).

    omega       : nodes [rad per step], (n,)
    own         : powers of the target, (n_modes, n) [um^2]
    measurement : cross powers between modes of the LGS, (n_modes, n_modes, n) [um^2]
    cross       : those of the target and the LGS, (n_modes, n_modes, n) [um^2]
    line_gain   : of the LGS for the vibration, (n_modes,)
    """

    omega: Array
    own: Array
    measurement: Complex
    cross: Complex
    line_gain: Array

    def first(self, n: int) -> Flow:
        """Return that of the first n modes."""
        return Flow(self.omega, self.own[:n], self.measurement[:n, :n], self.cross[:n, :n], self.line_gain[:n])


@dataclass(frozen=True)
class Asterism:
    """Turbulence of all modes as the target, every LGS and the NGS have it, without noise; sums as in `Flow`.

    Beams are the mean of the LGS, their orthonormal differences, and the NGS.

    omega       : nodes [rad per step], (n,)
    own         : powers of the target, (n_modes, n) [um^2]
    measurement : cross powers between modes of the beams, (n_beams, n_modes, n_beams, n_modes, n) [um^2]
    cross       : those of the target and the beams, (n_modes, n_beams, n_modes, n) [um^2]
    basis       : weights of the LGS in their mean and in the differences, (n_lgs, n_lgs)
    noise       : rms of the white noise of one LGS in a step, (n_modes,) [um]
    ngs_noise   : that of an NGS frame, (n_modes,) [um]
    combination : weight of mode k of each LGS in mode i of z, (n_modes, n_lgs, n_modes)
    line_gain   : of the mean of the LGS for the vibration, (n_modes,)
    ratio       : steps per NGS frame
    """

    omega: Array
    own: Array
    measurement: Complex
    cross: Complex
    basis: Array
    noise: Array
    ngs_noise: Array
    combination: Array
    line_gain: Array
    ratio: int

    def first(self, n: int) -> Self:
        """Return that of the first n modes."""
        return replace(
            self,
            own=self.own[:n],
            measurement=self.measurement[:, :n, :, :n],
            cross=self.cross[:n, :, :n],
            noise=self.noise[:n],
            ngs_noise=self.ngs_noise[:n],
            combination=self.combination[:n, :, :n],
            line_gain=self.line_gain[:n],
        )


class FlowOfBoth(Asterism):
    """As an asterism, with what is made of all LGS together in the place of one star."""
