"""What the windows of a GPR hold: which channels, and what is done to them first.

Turbulence is a hundred times the vibration that a GPR is after, and in raw inputs the distance between windows is turbulence
nearly alone. A high-pass takes it out; standardising gives every channel the same weight. Both are causal: the high-pass starts
from rest at the first sample, and the means and deviations are those of the training record.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.signal import butter, sosfilt, sosfilt_zi

from wfsobs.record import RecordError, Training, pseudo_open_loop
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.scenario.groups.observers import OfflineGpr, OnlineGpr

ORDER = 2
"""Of the high-pass."""


class Scale(NamedTuple):
    """Mean and standard deviation of every channel, (channels,) [um]."""

    mean: Array
    std: Array


def window_signals(
    settings: OfflineGpr | OnlineGpr, y: Array, u: Array, z: Array, mode: int, dt: float, scale: Scale | None = None
) -> Array:
    """The channels of a window, (n_steps, channels): u and y_lgs (paper, eq. 14), or z, as they are, high-passed or standardised.

    scale : for standardised ones, from `scale_of`
    """
    x = _channels(settings, y, u, z, mode)
    if settings.inputs_filter == "high-pass":
        sos = high_pass(settings.highpass, dt)
        return sosfilt(sos, x, axis=0, zi=at_rest(sos, x[0]))[0]
    if settings.inputs_filter == "standardised":
        assert scale is not None
        return (x - scale.mean) / scale.std
    return x


def scale_of(settings: OfflineGpr | OnlineGpr, training: Training | None, delay: int, mode: int) -> Scale | None:
    """What standardised inputs are divided by, from the training record; None for others. Raises RecordError without one."""
    if settings.inputs_filter != "standardised":
        return None
    if training is None:
        raise RecordError("standardised inputs need the training record, and the record has none")
    x = _channels(settings, training.y_lgs, training.u, pseudo_open_loop(training.y_lgs, training.u, delay), mode)
    std = x.std(axis=0)
    return Scale(x.mean(axis=0), np.where(std > 0, std, 1.0))


def high_pass(corner: float, dt: float) -> Array:
    """Second-order sections of the Butterworth high-pass with that corner [Hz]. Raises RecordError beyond half the rate."""
    if corner >= 0.5 / dt:
        raise RecordError(f"the high-pass of the inputs at {corner:g} Hz must lie below half the rate, {0.5 / dt:g} Hz")
    return butter(ORDER, corner, "highpass", fs=1.0 / dt, output="sos")


def at_rest(sos: Array, first: Array) -> Array:
    """States (sections, 2, channels) in which a constant input `first` (channels,) gives no output."""
    return sosfilt_zi(sos)[:, :, None] * first


def _channels(settings: OfflineGpr | OnlineGpr, y: Array, u: Array, z: Array, mode: int) -> Array:
    return z[:, [mode]] if settings.inputs == "z" else np.column_stack([u[:, mode], y[:, mode]])


class StreamingInputs:
    """`window_signals`, one sample at a time."""

    def __init__(self, settings: OfflineGpr | OnlineGpr, dt: float, scale: Scale | None = None):
        if settings.inputs_filter == "standardised" and scale is None:
            raise ValueError("standardised inputs need their scale")
        self._scale = scale
        self._sos = high_pass(settings.highpass, dt) if settings.inputs_filter == "high-pass" else None
        self._state: Array | None = None

    def step(self, sample: Array) -> Array:
        """The inputs (channels,) of this step's sample (channels,)."""
        if self._sos is not None:
            state = at_rest(self._sos, sample) if self._state is None else self._state
            out, self._state = sosfilt(self._sos, sample[None], axis=0, zi=state)
            return out[0]
        if self._scale is not None:
            return (sample - self._scale.mean) / self._scale.std
        return sample
