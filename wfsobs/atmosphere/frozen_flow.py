"""Von Karman turbulence carried by the wind unchanged, layer by layer, without a phase screen.

A layer is a sum of plane waves with independent complex Gaussian amplitudes (see `plane_waves`), so the signals of all sensors
are sums over its waves, and the covariances between them are those of the continuous spectrum as far as the sums are quadratures
of the integrals. In the layer's own frame, x along the wind, a wave of k_x oscillates with the frequency f = k_x v / 2 pi.

Along the wind: an FFT over a period P of more than twice the record and the passage of a beam gives f = j / P. The spectrum
is not smooth on that grid near f = 0, where most of the power is, so below TAPER / P a smooth window hands it over to
Gauss-Legendre nodes, panel by panel down to the outer scale, that are summed one by one (`frequency_grid`). Both together have
the right covariance at all lags of the record, the first step like the last, and none of the FFT's period.

Across the wind: the rule of `von_karman`.

Small waves that a Zernike mode averages away cause the aliasing of a Shack-Hartmann sensor. They are computed, with random
numbers of their own, where a sensor's `reach` includes them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len
from scipy.special import erfc

from wfsobs.atmosphere.plane_waves import Footprint, Sensor, Wave
from wfsobs.atmosphere.von_karman import CORE, FIELD, TurbulenceLayer, fine_rule, nodes_across_wind, von_karman_density
from wfsobs.progress import QUIET, Watch
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


FAR = 32.0
"""k_x D / 2 beyond which the rule across the wind is coarse: less than 2e-3 of the variance of order 6, 1e-6 of tip."""
NARROWEST = 0.5
"""Minimum scale of a beam that gets more waves, over the aperture: a layer halfway up to a guide star."""
COLUMNS = 512
"""Maximum number of columns k_x of a block: 512 by 60 waves are half a megabyte."""


@dataclass(frozen=True)
class View:
    """A sensor and where its beam crosses each layer.

    Attributes
    ----------
    sensor : Sensor
        The sensor.
    footprints : tuple of Footprint
        One per layer.
    """

    sensor: Sensor
    footprints: tuple[Footprint, ...]


def frozen_flow(
    layers: Sequence[TurbulenceLayer],
    outer_scale: float,
    diameter: float,
    views: Sequence[View],
    n_steps: int,
    dt: float,
    rng: np.random.Generator,
    watch: Watch = QUIET,
) -> list[Array]:
    """Simulate the signals of several sensors behind the same layers of frozen flow.

    Every layer has a random stream of its own. Identical views (sensor and footprints) are computed once.

    Parameters
    ----------
    layers : sequence of Layer
        Layers along the line of sight.
    outer_scale : float
        L0 [m].
    diameter : float
        Aperture diameter [m].
    views : sequence of View
        Sensors and their beams.
    n_steps : int
        Number of steps.
    dt : float
        Time step [s]; every sample is the mean over its step.
    rng : numpy.random.Generator
        Source of all random numbers.
    watch : Watch
        Asked between blocks whether to stop.

    Returns
    -------
    list of Array
        Signal of each view, (n_steps, n_outputs) [um].

    Raises
    ------
    Cancelled
        `watch` asks to stop.
    """
    signals = [np.zeros((view.sensor.n_outputs, n_steps)) for view in views]
    for number, (layer, stream) in enumerate(zip(layers, rng.spawn(len(layers)), strict=True)):
        watch.check()
        if layer.strength == 0.0:
            continue
        seen: dict[tuple[int, Footprint], list[int]] = {}
        for i, view in enumerate(views):
            seen.setdefault((id(view.sensor), view.footprints[number]), []).append(i)
        beams = [(views[which[0]].sensor, footprint) for (_, footprint), which in seen.items()]
        made = layer_signals(layer, outer_scale, diameter, beams, n_steps, dt, stream, watch)
        for values, which in zip(made, seen.values(), strict=True):
            for i in which:
                signals[i] += values
    return [np.ascontiguousarray(x.T) for x in signals]


def layer_signals(
    layer: TurbulenceLayer,
    outer_scale: float,
    diameter: float,
    beams: Sequence[tuple[Sensor, Footprint]],
    n_steps: int,
    dt: float,
    rng: np.random.Generator,
    watch: Watch = QUIET,
) -> list[Array]:
    """Simulate the signal of each beam through one layer, [(n_outputs, n_steps) um]."""
    grid = FrequencyGrid.of(layer, outer_scale, diameter, n_steps, dt)
    amplitudes = [np.zeros((sensor.n_outputs, grid.f.size), complex) for sensor, _ in beams]
    reaches = [sensor.reach / max(footprint.scale, NARROWEST) for sensor, footprint in beams]
    for part, wave in waves(grid, layer, outer_scale, diameter, rng, max(reaches)):
        watch.check()
        exposure = np.sinc(grid.f[part] * dt)
        least = wave.ky[wave.ky.size // 2]
        for (sensor, footprint), reach, amplitude in zip(beams, reaches, amplitudes, strict=True):
            if least <= max(reach, CORE / (0.5 * diameter)):
                amplitude[:, part] += sensor.measure(wave, footprint) * exposure
    return [grid.signal(amplitude, n_steps) for amplitude in amplitudes]


def waves(
    grid: FrequencyGrid, layer: TurbulenceLayer, outer_scale: float, diameter: float, rng: np.random.Generator, reach: float = 0.0
) -> Iterator[tuple[slice, Wave]]:
    """Yield (columns of the grid, their waves), block by block: the core, then beside, ahead of and far from it.

    reach : spatial frequency [rad/m] up to which waves are finely resolved at least
    """
    streams: dict[str, np.random.Generator] = dict(zip(("core", "far", "beside", "ahead"), rng.spawn(4), strict=True))
    kx = 2.0 * np.pi * grid.f / layer.speed
    k0 = 2.0 * np.pi / outer_scale
    core, front = CORE / (0.5 * diameter), FAR / (0.5 * diameter)

    def made(part: slice, zone: str, ky: Array, weight: Array) -> tuple[slice, Wave]:
        noise = streams[zone].standard_normal((2, ky.size, kx[part].size))
        density = von_karman_density(kx[part] ** 2 + ky[:, None] ** 2, layer.strength, outer_scale)
        cell = weight[:, None] * (grid.weight[part] * (2.0 * np.pi / layer.speed))
        # phi = Re sum over half the plane: E |A|^2 = 4 density cell, and standard_normal has twice the unit variance
        return part, Wave(kx[part], ky, layer.angle, np.sqrt(2.0 * density * cell) * (noise[0] + 1j * noise[1]))

    for part in blocks(kx, grid.n_low, (front, max(front, reach))):
        first, last = kx[part][0], kx[part][-1]
        q = np.hypot(k0, 0.0 if part.start == 0 else first)
        delta, h = fine_rule(layer.height, diameter)
        if first >= max(front, reach):
            yield made(part, "far", *nodes_across_wind(q, 4.0 * last, np.inf, 0.25))
        elif first >= front:
            yield made(part, "ahead", *nodes_across_wind(q, max(core, reach), delta, h))
        else:
            inner = nodes_across_wind(q, core, delta, h)
            yield made(part, "core", *inner)
            if reach > core:
                n = inner[0].size // 2
                wider = nodes_across_wind(q, reach, delta, h)
                yield made(part, "beside", *(np.concatenate([x[: x.size // 2 - n], x[x.size // 2 + n :]]) for x in wider))


def blocks(kx: Array, n_low: int, borders: tuple[float, ...]) -> Iterator[slice]:
    """Yield the single nodes, then columns whose k_x at most doubles and does not cross a border."""
    yield slice(0, n_low)
    start = n_low
    while start < kx.size:
        end = min([2.0 * kx[start], *(border for border in borders if border > kx[start])])
        stop = min(max(int(np.searchsorted(kx[n_low:], end)) + n_low, start + 1), start + COLUMNS, kx.size)
        yield slice(start, stop)
        start = stop
