"""The model with one vibration peak and the bands of the vibration: whole, or as much of them as somebody needs.

Numbers that are not for whoever asked are NaN, so that a change of them is none to it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan
from typing import NamedTuple, Self

from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.statespace import DisturbanceModel, disturbance_model


@dataclass(frozen=True)
class Model:
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


@dataclass(frozen=True)
class LgsModel(Model):
    """That for a filter of the LGS alone: the noise of NGS frames is NaN."""

    def __post_init__(self) -> None:
        _forget(self, "ngs_noise")


@dataclass(frozen=True)
class NgsModel(Model):
    """That for a filter of NGS frames alone: the noise of the LGS is NaN."""

    def __post_init__(self) -> None:
        _forget(self, "lgs_noise")


@dataclass(frozen=True)
class NoiselessModel(Model):
    """The two processes alone: both noises are NaN."""

    def __post_init__(self) -> None:
        _forget(self, "lgs_noise", "ngs_noise")


class Noise(NamedTuple):
    """The noise of a `Model` alone: rms of the white noise of the LGS together in a step, and of an NGS frame [um]."""

    lgs_noise: float
    ngs_noise: float


@dataclass(frozen=True)
class Bands:
    """Where the vibration of every mode is: the Butterworth bank of the paper (section 2.3).

    frequencies : centres [Hz]; bandwidth_offline, bandwidth_online : widths on open-loop and closed-loop data [Hz]
    order       : of each band-pass
    """

    frequencies: tuple[float, ...]
    bandwidth_offline: float
    bandwidth_online: float
    order: int


@dataclass(frozen=True)
class OfflineBands(Bands):
    """Those on open-loop data alone: the other width is NaN."""

    def __post_init__(self) -> None:
        _forget(self, "bandwidth_online")


@dataclass(frozen=True)
class OnlineBands(Bands):
    """Those on closed-loop data alone: the other width is NaN."""

    def __post_init__(self) -> None:
        _forget(self, "bandwidth_offline")


def _forget(part: Model | Bands, *names: str) -> None:
    """Make numbers of a part NaN."""
    for name in names:
        object.__setattr__(part, name, nan)
