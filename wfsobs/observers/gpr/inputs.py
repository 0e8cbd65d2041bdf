"""What the windows of a GPR hold: which channels, and what is done to them first.

Turbulence is a hundred times the vibration that a GPR is after, and in raw inputs the distance between windows is turbulence
nearly alone. A high-pass takes it out; standardising gives every channel the same weight. Both are causal: the high-pass starts
from rest at the first sample, and the means and deviations are those of the training record.

The modes of an observer are at work at the same time (`over_modes`).
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import numpy as np
import param
from scipy.signal import butter, sosfilt, sosfilt_zi

from wfsobs.observers.step import StepError
from wfsobs.observers.stepping import SampleHistory, StateArrays
from wfsobs.progress import Watch
from wfsobs.record import Measurements, RecordError, Sampling, Training, pseudo_open_loop
from wfsobs.settings import Group, Real, Whole
from wfsobs.settings.group import UsedWhen
from wfsobs.typing import Array


class Gpr(Group):
    """What both GPR share; the numbers are those of Table 4."""

    used_when: ClassVar[UsedWhen] = MappingProxyType({"highpass": ("inputs_filter", ("high-pass",))})

    inputs: param.Selector[str] = param.Selector(
        default="u-y",
        objects=["u-y", "z"],
        label="Inputs",
        doc="Contents of a window: commands and LGS measurements (paper, eq. 14) or pseudo-open-loop measurements z.",
    )
    inputs_filter: param.Selector[str] = param.Selector(
        default="raw",
        objects=["raw", "high-pass", "standardised"],
        label="Filter of the inputs",
        doc="Processing of the inputs. raw: none (paper); high-pass: without turbulence below the corner; "
        "standardised: each channel over its standard deviation in the training record, so that l has no unit.",
    )
    highpass: Real = Real(
        10.0,
        bounds=(0.1, 1000.0),
        softbounds=(1.0, 30.0),
        step=0.5,
        label="High-pass corner",
        doc="Corner of the inputs' high-pass, a second-order Butterworth filter [Hz]; not in the paper.",
    )
    training_size: Whole = Whole(
        1000, bounds=(2, 2048), label="Training size m", doc="Number of training windows (paper, Table 4)."
    )
    depth: Whole = Whole(407, bounds=(1, 2000), label="Depth d", doc="Samples in a window (paper, Table 4).")
    signal_std: Real = Real(
        10.0,
        bounds=(1e-3, 1e4),
        softbounds=(0.1, 100.0),
        label="Output scale σ_SE",
        doc="Output scale sigma_SE of the squared-exponential kernel [um] (paper, eq. 13 and Table 4).",
    )
    length_scale: Real = Real(
        300.0,
        bounds=(0.1, 1e5),
        softbounds=(1.0, 1000.0),
        label="Length scale l",
        doc="Length scale l of the squared-exponential kernel [um] (paper, eq. 13 and Table 4). Far above the norm of "
        "the windows the kernel is linear: ridge regression with weight (sigma_n l / sigma_SE)^2.",
    )
    noise_std: Real = Real(
        0.13,
        bounds=(1e-4, 10.0),
        softbounds=(0.01, 1.0),
        label="Noise σ_awgn",
        doc="Noise sigma_awgn on the diagonal of the covariance [um] (paper, Table 4).",
    )


ORDER = 2
"""Of the high-pass."""


class Scale(NamedTuple):
    """Mean and standard deviation of every channel, (channels,) [um]."""

    mean: Array
    std: Array


def window_signals(settings: Gpr, y: Array, u: Array, z: Array, mode: int, dt: float, scale: Scale | None = None) -> Array:
    """Return the channels of a window, (n_steps, channels): u and y_lgs (paper, eq. 14), or z; raw, high-passed or standardised.

    scale : for standardised ones, from `scale_of`
    """
    x = _channels(settings, y, u, z, mode)
    return StreamingInputs(settings, dt, scale, x.shape[1]).run(x)


def scale_of(settings: Gpr, training: Training | None, delay: int, mode: int) -> Scale | None:
    """Return the scale of standardised inputs, from the training record; None for others. Raises RecordError without one."""
    if settings.inputs_filter != "standardised":
        return None
    if training is None:
        raise RecordError("standardised inputs need training data, and the record has none")
    x = _channels(settings, training.y_lgs, training.u, pseudo_open_loop(training.y_lgs, training.u, delay), mode)
    std = x.std(axis=0)
    return Scale(x.mean(axis=0), np.where(std > 0, std, 1.0))


def scales_of(settings: Gpr, training: Training | None, sampling: Sampling) -> list[Scale]:
    """Return the scales of standardised inputs of every mode; none for others. Raises RecordError."""
    found = (scale_of(settings, training, sampling.delay, mode) for mode in range(sampling.n_modes))
    return [scale for scale in found if scale is not None]


def training_signals(settings: Gpr, training: Training, mode: int, dt: float, delay: int) -> Array:
    """Return the channels of a window in the training record, (n_steps, channels)."""
    z = pseudo_open_loop(training.y_lgs, training.u, delay)
    return window_signals(settings, training.y_lgs, training.u, z, mode, dt, scale_of(settings, training, delay, mode))


def high_pass(corner: float, dt: float) -> Array:
    """Second-order sections of the Butterworth high-pass with that corner [Hz]. Raises RecordError beyond half the rate."""
    if corner >= 0.5 / dt:
        raise RecordError(f"the high-pass of the inputs at {corner:g} Hz must lie below half the rate, {0.5 / dt:g} Hz")
    return butter(ORDER, corner, "highpass", fs=1.0 / dt, output="sos")


def at_rest(sos: Array, first: Array) -> Array:
    """States (sections, 2, channels) in which a constant input `first` (channels,) gives no output."""
    return sosfilt_zi(sos)[:, :, None] * first


def _channels(settings: Gpr, y: Array, u: Array, z: Array, mode: int) -> Array:
    return z[:, [mode]] if settings.inputs == "z" else np.column_stack([u[:, mode], y[:, mode]])


class StreamingInputs(StateArrays):
    """What is done to the samples of so many channels, as many at a time as there are."""

    state_names: tuple[str, ...] = ("_filter", "_is_started")

    def __init__(self, settings: Gpr, dt: float, scale: Scale | None, channels: int):
        if settings.inputs_filter == "standardised" and scale is None:
            raise ValueError("standardised inputs need their scale")
        self._scale, self._is_started = scale, False
        self._sos = high_pass(settings.highpass, dt) if settings.inputs_filter == "high-pass" else None
        self._filter = None if self._sos is None else np.zeros((len(self._sos), 2, channels))
        self.mark_start()

    def run(self, samples: Array) -> Array:
        """Return the inputs of the next samples, both (n, channels)."""
        if self._sos is not None and self._filter is not None:
            start = self._filter if self._is_started else at_rest(self._sos, samples[0])
            out, self._filter[...] = sosfilt(self._sos, samples, axis=0, zi=start)
            self._is_started = True
            return out
        return samples if self._scale is None else (samples - self._scale.mean) / self._scale.std


class Windows(StateArrays):
    """The channels of all modes, sample by sample, and the last of them.

    Parameters
    ----------
    settings : Gpr or None
        Which channels a window has and what is done to them; None for z as it is.
    sampling : Sampling
        Of the loop.
    depth : int
        Samples in a window.
    scales : sequence of Scale
        Of standardised inputs, one per mode; empty for others.
    """

    depth: int

    state_names: tuple[str, ...] = ("_samples", "_commands", "_held_value", "count", "_inputs")

    def __init__(self, settings: Gpr | None, sampling: Sampling, depth: int, scales: Sequence[Scale] = ()):
        self._of_record = settings, sampling.dt, tuple(scales)
        self.needs_command: bool = settings is not None and settings.inputs == "u-y"
        self.depth, self.count = depth, 0
        n = sampling.n_modes * (2 if self.needs_command else 1)
        self._inputs = None
        if settings is not None and settings.inputs_filter != "raw":
            scale = Scale(*(np.concatenate(part) for part in zip(*scales, strict=True))) if scales else None
            self._inputs = StreamingInputs(settings, sampling.dt, scale, n)
        self._samples = SampleHistory(n, depth)
        self._commands = np.zeros((sampling.delay, sampling.n_modes))  # newest first
        self._held_value = np.zeros(sampling.n_modes)
        self._sample = np.zeros(n)
        self.mark_start()

    @property
    def is_full(self) -> bool:
        """Whether the window is full."""
        return self.count >= self.depth

    def channels(self, measurements: Measurements, mode: int) -> Array:
        """Return the channels of a mode over a record, (n_steps, channels)."""
        settings, dt, scales = self._of_record
        if settings is None:
            return measurements.z[:, [mode]]
        scale = scales[mode] if scales else None
        return window_signals(settings, measurements.y_lgs, measurements.u, measurements.z, mode, dt, scale)

    def push(self, z: Array, u: Array | None) -> Array:
        """Take z and, where windows hold commands, u (n_modes,) [um]; return the frame's channels (n_modes * channels,)."""
        sample = self._sample
        if self.needs_command:
            assert u is not None
            held, past = self._held_value, self._commands
            np.copyto(held, u, where=~np.isnan(u))
            sample[::2] = held
            sample[1::2] = z + past[-1]
            past[1:] = past[:-1].copy()
            past[0] = held
        else:
            sample[...] = z
        out = sample if self._inputs is None else self._inputs.run(sample[None])[0]
        self._samples.push(out)
        self.count += 1
        return out

    @property
    def window(self) -> Array:
        """The newest window, (n_modes * channels, depth), the oldest sample first; a view."""
        return self._samples.last(self.depth)

    def take_over(self, old: Windows) -> None:
        """Go on from other windows of the same channels; of longer ones, or of shorter ones that are then not full."""
        state, own = old.save(), self.save()
        if state.keys() != own.keys() or len(state["samples.newest"]) != len(own["samples.newest"]):
            raise StepError("the designs have windows of other channels")
        self.load(state)
        if self.depth > old.depth:
            self.count: int = min(old.count, old.depth)


def tunable(group: str) -> tuple[str, ...]:
    """Return the settings of a group of a GPR that are tuned only if they are named."""
    return tuple(f"{group}.{name}" for name in ("signal_std", "training_size", "highpass"))


CORES = 2
"""Processors of the machine that computing times were measured on (`wfsobs.cost`)."""

AT_ONCE = max(os.cpu_count() or 1, 2)
"""Modes at work at the same time: more would only need more memory."""


def turns(n_modes: int) -> int:
    """How many modes that machine does one after the other, where modes run side by side."""
    return -(-n_modes // CORES)


def over_modes(n_modes: int, work: Callable[[int, Watch], Array], watch: Watch) -> Array:
    """Columns work(mode, watch) of every mode, as many at a time as there are processors, (n_steps, n_modes).

    If one fails, or the wait for them is interrupted, the others are told to stop by the watch they were given.
    """
    stop = threading.Event()
    told = replace(watch, is_cancelled=lambda: stop.is_set() or watch.is_cancelled())
    with ThreadPoolExecutor(min(n_modes, AT_ONCE)) as pool:
        try:
            return np.column_stack(list(pool.map(lambda mode: work(mode, told), range(n_modes))))
        except BaseException:
            stop.set()
            raise
