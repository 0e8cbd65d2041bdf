"""What two sensors of a record differ by: the noise of the NGS, and what the LGS alone see.

With x the mean of phi over a frame, the NGS gives x + v, and the mean of z over the same steps x + e + w / sqrt(n). Their
difference holds the slow error e of the LGS and both noises, but no vibration. Its spectrum is fitted as that of a mode without
peaks. e is taken for independent of phi.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import hypot, nan, sqrt

import numpy as np

from wfsobs.identification.one_mode import SETTLED, OneMode
from wfsobs.identification.process import IdentifiedProcess, Number, read_process, scale_number, with_reliable_std
from wfsobs.record import Record, hold_last, pseudo_open_loop
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.spectral.missing import find_outlying
from wfsobs.spectral.periodogram import fast_length
from wfsobs.typing import Array

FEWEST, SHARE = 200, 0.5
"""Minimum NGS frames, and minimum share of them that is measured."""
LEAST = 0.1
"""Minimum share of the NGS in the noise of the difference."""
LEFT = 0.01
"""Minimum share of the variance of z's turbulence that is not the error of the LGS."""


@dataclass(frozen=True)
class SensorDifference:
    """What the sensors of one mode differ by.

    Attributes
    ----------
    noise : Number
        Rms of the noise of an NGS frame [um].
    error : IdentifiedProcess or None
        Slow error of the combined LGS.
    process : Ar2 or None
        The same, as an observer receives it.
    outlying : int
        Frames far from what those around them predict, taken for missing.
    """

    noise: Number
    error: IdentifiedProcess | None = None
    process: Ar2 | None = None
    outlying: int = 0


def sensor_differences(record: Record) -> Array | None:
    """Return the mean of z over each NGS frame minus the frame, (frames, n_modes) [um]; None without enough frames.

    NaN where a sample is missing.
    """
    if record.y_ngs is None or record.ratio is None:
        return None
    ratio, u = record.ratio, hold_last(record.u)
    z = pseudo_open_loop(record.y_lgs, u, record.delay)
    first = ratio * -(-(record.delay + ratio) // ratio)  # what the mirror did before the record is not known
    frames = replace(record, u=u).z_ngs[first::ratio]
    whole = fast_length(len(frames))
    if whole < FEWEST:
        return None
    start = first - ratio + 1
    out = z[start : start + whole * ratio].reshape(whole, ratio, -1).mean(axis=1) - frames[:whole]
    return out if (np.isfinite(out).mean(axis=0) >= SHARE).all() else None


def read_difference(difference: Array, dt: float, ratio: int, lgs_noise: Number) -> SensorDifference:
    """Identify one mode.

    Parameters
    ----------
    difference : Array
        Of the sensors, (frames,) [um]; NaN is a missing one.
    dt, ratio : float, int
        Time step of z [s], and steps of a frame.
    lgs_noise : Number
        Rms of the noise of z [um].

    Returns
    -------
    SensorDifference
        The numbers.
    """
    outlying = find_outlying(difference)
    mode = OneMode(np.where(outlying, np.nan, difference), dt * ratio)
    for _ in range(mode.missing.rounds(SETTLED)):
        mode.refit()
    std, spectrum = mode.errors(), mode.spectrum
    whole, of_lgs = spectrum.noise**2, lgs_noise.value**2 / ratio
    rms = sqrt(max(whole - of_lgs, LEAST * whole))
    noise = with_reliable_std(Number(rms, hypot(whole * float(std[0]), lgs_noise.value * lgs_noise.std / ratio) / rms))
    if not isinstance(slow := spectrum.turbulence, Ar2):
        return SensorDifference(noise, outlying=int(outlying.sum()))
    return SensorDifference(noise, read_process(slow, std[spectrum.starts[0] :]), slow.at(dt), int(outlying.sum()))


def without_error(turbulence: tuple[Ar2 | Ar3, ...], error: Ar2 | None) -> tuple[Ar2 | Ar3, ...]:
    """Return the processes of z's turbulence, the first without the variance of the LGS error."""
    if error is None or not turbulence:
        return turbulence
    first, *others = turbulence
    return replace(first, rms=sqrt(max(first.rms**2 - error.rms**2, LEFT * first.rms**2))), *others


def error_of_a_star(difference: SensorDifference, stars: int) -> Number:
    """Return the rms of the slow error of one of so many LGS [um], 0 where none was found."""
    return Number(0.0, nan) if difference.error is None else scale_number(difference.error.rms, sqrt(stars))
