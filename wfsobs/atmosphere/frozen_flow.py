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

from wfsobs.atmosphere.frequency_grid import FrequencyGrid
from wfsobs.atmosphere.plane_waves import Footprint, Sensor, Wave
from wfsobs.atmosphere.von_karman import CORE, TurbulenceLayer, fine_rule, nodes_across_wind, von_karman_density
from wfsobs.progress import QUIET, Watch
from wfsobs.typing import Array

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
