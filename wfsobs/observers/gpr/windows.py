"""Sliding windows of a GPR: what they hold, and their squared-exponential covariances.

A point x_j is a window: the last `depth` samples up to step j of every channel. With G_ij = <x_i, x_j>,
delta_i = exp(-|x_i|^2 / 2 l^2) and s2 = sigma_SE^2, the kernel of the paper's eq. 13 is

    k(x_i, x_j) = s2 exp(-|x_i - x_j|^2 / 2 l^2) = M_ij + s2 delta_i delta_j,
    M_ij = s2 delta_i delta_j expm1(G_ij / l^2).

M is a covariance of its own (a sum of powers of G). With l far above the windows' norm, K is a huge constant
plus a small signal, cond(K + sigma_n^2 I) = 5e7 at the paper's numbers; M + sigma_n^2 I has 1e2 to 1e5, and the constant is
a rank-one border: with a = M^-1 f, b = M^-1 delta, kappa_i = M_ti (M now with sigma_n^2 on its diagonal),

    mean = kappa.a + (delta_t - kappa.b) (delta.a) / (1 / s2 + delta.b).

Inner products slide: G(i, j) = G(i-1, j-1) + s[i] s[j] - s[i-d] s[j-d], at a cost that depth does not enter.

Turbulence is a hundred times the vibration that a GPR is after, and in raw inputs the distance between windows is turbulence
nearly alone. A high-pass takes it out; standardising gives every channel the same weight. Both are causal: the high-pass starts
from rest at the first sample, and the means and deviations are those of the training record.

The modes of an observer are at work at the same time (`over_modes`).
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import numpy as np
import scipy
from numpy.lib.stride_tricks import as_strided, sliding_window_view
from scipy.linalg.blas import dsymv
from scipy.linalg.lapack import dpotrf, dpotrs

from wfsobs.observers.step import StepError
from wfsobs.observers.stepping import SampleHistory, StateArrays
from wfsobs.progress import Watch
from wfsobs.record import RecordError, Sampling, Signals, Training, pseudo_open_loop
from wfsobs.settings import Group, Real, Whole
from wfsobs.settings.group import UsedWhen
from wfsobs.settings.values import Choice
from wfsobs.typing import Array


@dataclass(frozen=True)
class SquaredExponential:
    """The kernel's numbers, all in [um]: signal_std sigma_SE, length_scale l, noise_std sigma_n."""

    signal_std: float
    length_scale: float
    noise_std: float

    @property
    def variance(self) -> float:
        """s2 = sigma_SE^2 [um^2]."""
        return self.signal_std**2

    def points(self, norm2: Array) -> Points:
        """Return the windows with these squared norms [l^2]."""
        return Points(norm2, np.exp(-0.5 * norm2), float(norm2.max(initial=0.0)))

    def split(self, G: Array, i: Points, j: Points) -> None:
        """Turn inner products G [l^2] of points i and j, which broadcast to its shape, into M (without the noise), in place.

        While |x|^2 < l^2 that is delta_i delta_j expm1(g). Beyond, where the factors could overflow, it is the same
        number as exp(max(g, 0) - (n_i + n_j) / 2) times (1 - exp(-|g|)) with the sign of g.
        """
        if max(i.largest, j.largest) < 1.0:
            np.expm1(G, out=G)
            G *= self.variance * i.delta
            G *= j.delta
            return
        exponent = np.maximum(G, 0.0) - 0.5 * (i.norm2 + j.norm2)
        np.copysign(np.expm1(-np.abs(G)), G, out=G)
        G *= self.variance * np.exp(np.minimum(exponent, 0.0))  # at most 0 but for rounding: |x_i - x_j|^2 >= 0

    def split_times(self, G: Array, i: Points, j: Points, w: Array) -> Array:
        """M w from inner products G (rows, columns) [l^2] of points i (rows,) and j (columns,); uses up G."""
        if max(i.largest, j.largest) < 1.0:  # the factors of `split`, taken out of the matrix
            return i.delta * (np.expm1(G, out=G) @ (self.variance * j.delta * w))
        self.split(G, i.select(lambda p: p[:, None]), j)
        return G @ w

    def own(self, points: Points) -> Array:
        """M of each point with itself [um^2], without the noise: s2 (1 - exp(-|x|^2 / l^2))."""
        return -self.variance * np.expm1(-points.norm2)


class Points(NamedTuple):
    """Windows by the numbers that the kernel needs beside inner products.

    |x|^2 [l^2] and delta, of equal shape, and an upper limit of |x|^2.
    """

    norm2: Array
    delta: Array
    largest: float

    def select(self, part: Callable[[Array], Array]) -> Points:
        """Return some of the points, or all of them in another shape."""
        return Points(part(self.norm2), part(self.delta), self.largest)


MAX_CONDITION = 1e13
"""Condition number of M + sigma_n^2 I beyond which a prediction has no correct digits left to show."""


class ConditionError(ValueError):
    """Kernel numbers that double precision cannot serve; one line saying which and what would help."""


def check_condition(S: Array, kernel: SquaredExponential) -> None:
    """Raise ConditionError if M + sigma_n^2 I is too ill conditioned; S (m, m) column-major, its lower triangle.

    Trace over sigma_n^2 bounds the condition number, which settles all but extreme numbers; for those, power iterations
    on S and on its inverse find it.
    """
    if np.trace(S) <= MAX_CONDITION * kernel.noise_std**2:
        return
    condition = np.inf
    factor, info = dpotrf(S, lower=1)
    if info == 0:
        condition = _largest_eigenvalue(lambda x: dsymv(1.0, S, x, lower=1), len(S))
        condition *= _largest_eigenvalue(lambda x: dpotrs(factor, x, lower=1)[0], len(S))
    if not condition <= MAX_CONDITION:
        raise ConditionError(
            f"the covariance has condition {condition:.1e}, above {MAX_CONDITION:.0e}: raise noise_std "
            f"({kernel.noise_std:g}) or length_scale ({kernel.length_scale:g}), or lower signal_std ({kernel.signal_std:g})"
        )


def _largest_eigenvalue(apply: Callable[[Array], Array], n: int) -> float:
    """Of a symmetric positive matrix, by power iteration from a start that no symmetry makes orthogonal to it."""
    x = 1.0 + 0.5 * np.sin(1.0 + np.arange(n) ** 2)
    largest = 0.0
    for _ in range(30):
        x = apply(x / np.linalg.norm(x))
        largest = float(np.linalg.norm(x))
    return largest


def squared_norms(signals: Array, depth: int) -> Array:
    """|x_j|^2 of the window ending at every step, samples before the start being zero, (n,); signals (n, channels).

    A window is the end of one block of `depth` samples and the start of the next, so that sums from the blocks' borders
    outwards are all it takes and nothing is ever subtracted.
    """
    n = signals.shape[0]
    blocks = np.zeros((-(-n // depth) + 1, depth))
    blocks.reshape(-1)[depth : depth + n] = np.square(signals).sum(axis=1)
    out = np.cumsum(blocks, axis=1)
    out[1:, :-1] += np.cumsum(blocks[:-1, :0:-1], axis=1)[:, ::-1]
    return out.ravel()[depth : depth + n]


TILE = 64
"""Rows worked on at a time, few enough to stay in the cache."""


def restart_interval(depth: int) -> int:
    """Return the steps after which sliding inner products restart from direct ones: the samples of a window.

    Rounding never grows beyond that of a direct product, and the cost stays independent of depth.
    """
    return max(16, depth)


def sliding_products(a: Array, b: Array, depth: int, i0: int, j0: int, rows: int, offsets: int, triangle: bool = False) -> Array:
    """Inner products of windows of `a` with windows of `b` along diagonals, shape (rows, offsets).

    out[r, c] = <window of a ending at i0 + r, window of b ending at j0 + r + c>; a, b (n, channels), samples
    outside the records are zero. Every so many rows are direct dot products, the others slide from them.
    triangle: leave out what has r + c >= rows, but for the last few rows.
    """
    out = np.zeros((rows, offsets))
    interval = restart_interval(depth)
    span = rows + offsets - 1
    ones = [_cut(x, i0 - depth, depth + rows) for x in a.T]  # samples i0 - depth ... i0 + rows - 1 of each channel
    others = [_cut(x, j0 - depth, depth + span) for x in b.T]
    # What row r has more than the one above: what comes into the window less what goes out, a product of 2 x channels numbers.
    factors = np.stack([one[depth:] for one in ones] + [-one[:rows] for one in ones], axis=1)[:, None]
    samples = np.stack([other[depth:] for other in others] + [other[:span] for other in others])
    pieces = sliding_window_view(samples, offsets, axis=1).transpose(1, 0, 2)  # [r, :, c] = samples[:, r + c]
    for top in range(0, rows, TILE):
        bottom, wide = min(top + TILE, rows), min(offsets, rows - top) if triangle else offsets
        np.matmul(factors[top:bottom], pieces[top:bottom, :, :wide], out=out[top:bottom, None, :wide])
        for r in range(top, bottom):
            if r % interval:
                out[r, :wide] += out[r - 1, :wide]
            else:
                out[r, :wide] = sum(
                    np.correlate(other[r + 1 : r + depth + wide], one[r + 1 : r + depth + 1], "valid")
                    for one, other in zip(ones, others, strict=True)
                )
    return out


def _cut(x: Array, start: int, length: int) -> Array:
    """x[start : start + length] with zeros outside the record."""
    out = np.zeros(length)
    low, high = max(start, 0), min(start + length, x.size)
    if high > low:
        out[low - start : high - start] = x[low:high]
    return out


def band(signals: Array, depth: int, kernel: SquaredExponential, first: int, rows: int, reach: int) -> tuple[Array, Points]:
    """M + sigma_n^2 I of the windows ending at first ... first + rows - 1, by lag, and those windows.

    Returns (V, points): V (rows, reach + 1) with V[r, lag] = entry of windows first + r and first + r + lag, as far as
    that one is among the rows; points (rows,).
    """
    signals = signals / kernel.length_scale
    V = sliding_products(signals, signals, depth, first, first, rows, reach + 1, triangle=True)
    samples = np.column_stack([_cut(channel, first - depth + 1, depth - 1 + rows + reach) for channel in signals.T])
    points = kernel.points(squared_norms(samples, depth)[depth - 1 :])
    later = points.select(lambda p: sliding_window_view(p, reach + 1)[:rows])
    for top in range(0, rows, TILE):
        part, wide = slice(top, min(top + TILE, rows)), min(reach + 1, rows - top)
        here = points.select(lambda p, part=part: p[part, None])
        kernel.split(V[part, :wide], here, later.select(lambda p, part=part, wide=wide: p[part, :wide]))
    V[:, 0] += kernel.noise_std**2
    return V, points.select(lambda p: p[:rows])


def square_from_band(V: Array, start: int, n: int) -> Array:
    """Return a view of V as the symmetric matrix of points start ... start + n - 1, column-major, read-only.

    Its lower triangle is valid down to V's largest lag; the rest is meaningless.
    """
    row, item = V.strides
    return as_strided(V[start:], (n, n), (item, row - item), writeable=False)


class Gpr(Group):
    """What both GPR share; the numbers are those of Table 4."""

    used_when: ClassVar[UsedWhen] = MappingProxyType({"highpass": ("inputs_filter", ("high-pass",))})

    inputs: Choice = Choice(
        ["u-y", "z"],
        label="Inputs",
        doc="Contents of a window: commands and LGS measurements (paper, eq. 14) or pseudo-open-loop measurements z.",
    )
    inputs_filter: Choice = Choice(
        ["raw", "high-pass", "standardised"],
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


def kernel_of(settings: Gpr) -> SquaredExponential:
    """Return the kernel with the numbers of the settings."""
    return SquaredExponential(settings.signal_std, settings.length_scale, settings.noise_std)


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


def high_pass(corner: float, dt: float) -> Array:
    """Second-order sections of the Butterworth high-pass with that corner [Hz]. Raises RecordError beyond half the rate."""
    if corner >= 0.5 / dt:
        raise RecordError(f"the high-pass of the inputs at {corner:g} Hz must lie below half the rate, {0.5 / dt:g} Hz")
    return scipy.signal.butter(ORDER, corner, "highpass", fs=1.0 / dt, output="sos")


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
            if not self._is_started:
                self._filter[...] = scipy.signal.sosfilt_zi(self._sos)[:, :, None] * samples[0]  # no output at rest
                self._is_started = True
            out, self._filter[...] = scipy.signal.sosfilt(self._sos, samples, axis=0, zi=self._filter)
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
    training : Training, optional
        What the scales of standardised inputs are of.

    Raises
    ------
    RecordError
        Standardised inputs without training data.
    """

    depth: int

    state_names: tuple[str, ...] = ("_samples", "_commands", "_held_value", "count", "_inputs")

    def __init__(self, settings: Gpr | None, sampling: Sampling, depth: int, training: Training | None = None):
        found = [scale_of(settings, training, sampling.delay, mode) for mode in range(sampling.n_modes)] if settings else []
        scales = [scale for scale in found if scale is not None]
        self._of_record = settings, sampling, scales
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

    def channels(self, of: Signals | Training, mode: int) -> Array:
        """Return the channels of a mode over a record or training data, (n_steps, channels)."""
        settings, sampling, scales = self._of_record
        z = pseudo_open_loop(of.y_lgs, of.u, sampling.delay)
        if settings is None:
            return z[:, [mode]]
        return window_signals(settings, of.y_lgs, of.u, z, mode, sampling.dt, scales[mode] if scales else None)

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
