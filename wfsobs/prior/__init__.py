"""Priors: what observers and controllers receive beside measurements.

Parts of a prior, of one mode or of all, are numbers, without a reference to their source. They are made from a scenario
(`wfsobs.priors_from.scenario`), or from telemetry (`IdentifiedMode.prior`). Of a model that an observer needs only in part, the
rest is NaN, so that a change of it changes nothing for that observer.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import nan, pi
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np

from wfsobs.record import Training as Training
from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.signal.gains import ONE, SensorMean
from wfsobs.signal.statespace import DisturbanceModel, disturbance_model
from wfsobs.signal.wiener import Complex
from wfsobs.typing import Array


class _Share:
    """A part of a prior of which a kind may have a share alone: the rest is NaN."""

    unknown: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        for name in self.unknown:
            object.__setattr__(self, name, nan)


@dataclass(frozen=True)
class Model(_Share):
    """The model of one mode with one vibration peak (paper, eq. 1, 2 and 7).

    turbulence, vibration : the processes, sampled at the fast step unless moved by `at`
    lgs_noise, ngs_noise  : rms of the white noise of the LGS together in a step, and of an NGS frame [um]
    """

    turbulence: Ar2
    vibration: Ar2
    lgs_noise: float
    ngs_noise: float

    def at(self, dt: float) -> Self:
        """Return the same processes sampled every `dt` [s]."""
        return replace(self, turbulence=self.turbulence.at(dt), vibration=self.vibration.at(dt))

    def disturbance(self) -> DisturbanceModel:
        """Return the state-space model of the two processes."""
        return disturbance_model([self.turbulence], [self.vibration])


class LgsModel(Model):
    """That for a filter of the LGS alone: the noise of NGS frames is NaN."""

    unknown = ("ngs_noise",)


class NgsModel(Model):
    """That for a filter of NGS frames alone: the noise of the LGS is NaN."""

    unknown = ("lgs_noise",)


class NoiselessModel(Model):
    """The two processes alone: both noises are NaN."""

    unknown = ("lgs_noise", "ngs_noise")


class Noise(NamedTuple):
    """The noise of a `Model` alone: rms of the white noise of the LGS together in a step, and of an NGS frame [um]."""

    lgs_noise: float
    ngs_noise: float


@dataclass(frozen=True)
class Bands(_Share):
    """Where the vibration of every mode is: the Butterworth bank of the paper (section 2.3).

    frequencies : centres [Hz]; bandwidth_offline, bandwidth_online : widths on open-loop and closed-loop data [Hz]
    order       : of each band-pass
    """

    frequencies: tuple[float, ...]
    bandwidth_offline: float
    bandwidth_online: float
    order: int


class OfflineBands(Bands):
    """Those on open-loop data alone: the other width is NaN."""

    unknown = ("bandwidth_online",)


class OnlineBands(Bands):
    """Those on closed-loop data alone: the other width is NaN."""

    unknown = ("bandwidth_offline",)


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
class Asterism:
    """Turbulence of all modes as the target, every LGS and the NGS have it, without noise.

    Spectra stand for sums: E t_i[k] m_j[k-n] is the real part of the sum over nodes of cross[i, j] exp(i omega n). Beams are the
    mean of the LGS, their orthonormal differences, and the NGS.

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


class Flow(FlowOfBoth):
    """That without an NGS, as of frames of every step."""


PriorSource = Literal["true", "identified", "given"]
"""Where lines and spectra of a prior come from."""
TRUE: PriorSource = "true"
"""From the settings that the record was simulated from."""
IDENTIFIED: PriorSource = "identified"
"""From an identification."""
GIVEN: PriorSource = "given"
"""From settings, on a record that was not simulated from them."""

Part = type[Model | Noise | LgsError | LgsStars | Lines | Beams | Flow | FlowOfBoth | Asterism | Bands | Spectra | Training]
"""A kind of thing that an observer or a controller can ask for."""

_WORDS: dict[Part, tuple[str, ...]] = {
    Model: ("model",),
    LgsModel: ("model",),
    NgsModel: ("model",),
    NoiselessModel: ("model",),
    Noise: ("model",),
    LgsError: ("model",),
    LgsStars: (),
    Lines: ("model", "{source} peaks"),
    Beams: ("model",),
    Flow: ("model",),
    FlowOfBoth: ("model",),
    Asterism: ("model",),
    Bands: ("bands",),
    OfflineBands: ("bands",),
    OnlineBands: ("bands",),
    Spectra: ("{source} spectra",),
    Training: ("training data",),
}
"""Part -> what it is called in the column "Prior knowledge", by the source of the prior."""
PARTS: tuple[Part, ...] = tuple(_WORDS)
"""Every part of a prior."""


def words_for(parts: Iterable[Part], *, source: PriorSource = TRUE) -> tuple[str, ...]:
    """Return what parts of a prior are called in the column "Prior knowledge", each word once.

    >>> words_for((Model, Lines), source=IDENTIFIED)
    ('model', 'identified peaks')
    """
    return tuple(dict.fromkeys(word.format(source=source) for part in parts for word in _WORDS[part]))


def ask_nothing(_settings: Any) -> tuple[Part, ...]:
    """Return the parts that are needed for some settings alone: none."""
    return ()


def asks_for(part: Part, parts: Iterable[Part]) -> bool:
    """Return whether a part is among others, whole or as much of it as somebody needs.

    >>> asks_for(Model, (Lines, LgsModel)), asks_for(LgsModel, (Model,))
    (True, False)
    """
    return any(issubclass(one, part) for one in parts)


@dataclass(frozen=True)
class Prior:
    """The parts that an observer or a controller asked for, empty or None where it did not.

    model, noise, lgs_error, stars, lines, beams, spectra : one per mode
    flow, asterism, bands : of all modes; asterism of every LGS, or of all of them together
    training : a record to learn from
    """

    model: tuple[Model, ...] = ()
    lgs_error: tuple[LgsError, ...] = ()
    stars: tuple[LgsStars, ...] = ()
    lines: tuple[Lines, ...] = ()
    beams: tuple[Beams, ...] = ()
    flow: Flow | None = None
    asterism: Asterism | None = None
    bands: Bands | None = None
    spectra: tuple[Spectra, ...] = ()
    training: Training | None = None
    noise: tuple[Noise, ...] = ()

    def noise_of(self, mode: int) -> Noise | Model:
        """Return what tells the noise of one mode: the noise alone, or the model; NaN where neither was asked for."""
        told = self.noise or self.model
        return told[mode] if told else Noise(nan, nan)
