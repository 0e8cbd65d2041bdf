"""Von Karman turbulence carried by the wind unchanged, layer by layer, without a phase screen.

The phase of a layer at time t, in the pupil plane, is a sum of plane waves that move with the wind,

    phi(r, t) = Re sum_k A(k) exp(i k . (r - v t)),    k_x > 0 along the wind.

A sensor's output is a fixed linear functional of the phase, given by its value for exp(i k . r), its transform M(k).
A whole time series is then one Fourier transform of

    a(k_x) = sum_ky A(k_x, k_y) M(k),    a(t) = Re sum_kx a(k_x) exp(-i k_x v t).

Sensors that share the waves share the turbulence, so their covariances are exact.

Integrals over spatial frequencies are by the trapezoidal rule in u(k) = asinh(k / q) / h + k / delta, q^2 the outer scale's k_0^2
and, where the rule is across the wind, k_x^2 besides. The first term follows the spectrum, analytic in u; the second keeps the
spacing below delta, which resolves the aperture and the way between beams.

The amplitudes of the waves are independent complex Gaussian numbers, so the signals of all sensors are sums over the waves, and
the covariances between them are those of the continuous spectrum as far as the sums are quadratures of the integrals. In the
layer's own frame, x along the wind, a wave of k_x oscillates with the frequency f = k_x v / 2 pi.

Along the wind: an FFT over a period P of more than twice the record and the passage of a beam gives f = j / P. The spectrum
is not smooth on that grid near f = 0, where most of the power is, so below TAPER / P a smooth window hands it over to
Gauss-Legendre nodes, panel by panel down to the outer scale, that are summed one by one (`frequency_grid`). Both together have
the right covariance at all lags of the record, the first step like the last, and none of the FFT's period.

Small waves that a Zernike mode averages away cause the aliasing of a Shack-Hartmann sensor. They are computed, with random
numbers of their own, where a sensor's `reach` includes them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.fft import irfft, next_fast_len
from scipy.special import erfc

from wfsobs.progress import QUIET, Watch
from wfsobs.typing import Array


@dataclass(frozen=True)
class Footprint:
    """Where a beam crosses a layer.

    Attributes
    ----------
    scale : float
        Beam diameter over aperture diameter, 1 - h / H for a star at height H, 1 for one at infinity.
    shift : tuple of float
        (x, y) of its centre on the layer [m], pupil frame.
    """

    scale: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Wave:
    """The random waves of one layer on a block of spatial frequencies.

    Attributes
    ----------
    kx : Array
        Along the wind, above 0, (Nx,) [rad/m].
    ky : Array
        Across the wind, ascending and symmetric about 0, (Ny,) [rad/m].
    angle : float
        Direction that the wind blows to, from the pupil's x axis to its y axis [rad].
    amplitude : Array
        Complex A of the sums above, quadrature weights included, (Ny, Nx) [um of wavefront].
    """

    kx: Array
    ky: Array
    angle: float
    amplitude: Array

    def through(self, footprint: Footprint) -> Array:
        """Return the amplitudes in a frame about the centre of the footprint, A exp(i k . shift), complex (Ny, Nx) [um]."""
        x, y = footprint.shift
        if x == 0.0 and y == 0.0:
            return self.amplitude
        c, s = np.cos(self.angle), np.sin(self.angle)
        along, across = c * x + s * y, c * y - s * x
        return self.amplitude * np.exp(1j * self.ky * across)[:, None] * np.exp(1j * self.kx * along)

    def in_pupil(self) -> tuple[Array, Array]:
        """Return (k_x, k_y) of the waves in the pupil frame, each (Ny, Nx) [rad/m]."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        kx, ky = self.kx[None, :], self.ky[:, None]
        return c * kx - s * ky, s * kx + c * ky


class Sensor(Protocol):
    """A linear wavefront sensor with its reconstruction."""

    @property
    def n_outputs(self) -> int:
        """Number of outputs, such as Zernike coefficients."""
        ...

    @property
    def reach(self) -> float:
        """Maximum spatial frequency on the pupil that the sensor needs [rad/m]; waves beyond may be left out."""
        ...

    def measure(self, wave: Wave, footprint: Footprint) -> Array:
        """Return the response to the waves, a(k_x) per output: complex (n_outputs, Nx) [um].

        A wave exp(i k . r) of the layer is exp(i s k . r) on the pupil, s the scale of the footprint, times the factor
        that `Wave.through` puts into the amplitudes.
        """
        ...


SEEING_WAVELENGTH = 0.5
"""Wavelength of r0 [um]."""
CORE = 64.0
"""k D / 2 up to which waves are finely resolved across the wind; less than 1e-4 of the variance of radial order 6 lies beyond."""
FIELD = 1e-3
"""Shifts between beams that the spacing across the wind resolves [m per m of height, 3.4 arcmin]."""


@dataclass(frozen=True)
class TurbulenceLayer:
    """One layer along the line of sight.

    Attributes
    ----------
    strength : float
        r0^(-5/3) of the layer alone, r0 at 500 nm [m^(-5/3)].
    height : float
        Distance along the line of sight [m].
    speed : float
        Wind speed [m/s].
    angle : float
        Direction that the wind blows to, from the pupil's x axis to its y axis [rad].
    """

    strength: float
    height: float
    speed: float
    angle: float


def von_karman_density(k2: Array, strength: float, outer_scale: float) -> Array:
    """Return the von Karman density of the wavefront; its integral over the plane d^2k is the variance.

    0.0229 r0^(-5/3) (f^2 + L0^-2)^(-11/6) rad^2 m^2 with k = 2 pi f (Noll 1976, eq. 21, with an outer scale).

    Parameters
    ----------
    k2 : Array
        Squared angular spatial frequency [rad^2/m^2].
    strength : float
        r0^(-5/3), r0 at 500 nm [m^(-5/3)].
    outer_scale : float
        L0 [m].

    Returns
    -------
    Array
        Density [um^2 m^2].
    """
    in_angular = 0.0229 * strength * (2.0 * np.pi) ** (11.0 / 3.0 - 2.0)
    return in_angular * (k2 + (2.0 * np.pi / outer_scale) ** 2) ** (-11.0 / 6.0) * (SEEING_WAVELENGTH / (2.0 * np.pi)) ** 2


def fine_rule(height: float, diameter: float) -> tuple[float, float]:
    """Return (delta, h) of the fine rule across the wind."""
    return np.pi / (diameter + FIELD * height), 0.5


def nodes_across_wind(q: float, end: float, delta: float, h: float) -> tuple[Array, Array]:
    """Return nodes k_y, symmetric about 0, and weights [rad/m] of the rule above, out to about `end`."""

    def u(k: Array) -> Array:
        return np.arcsinh(k / q) / h + k / delta

    n = int(np.ceil(float(u(np.array(end)))))
    wanted = np.arange(n) + 0.5
    table = q * np.sinh(np.linspace(0.0, np.arcsinh(end / q) + 1.0, 8 * n + 2))
    k = np.interp(wanted, u(table), table)
    for _ in range(3):
        k -= (u(k) - wanted) * _spacing(k, q, delta, h)
    weight = _spacing(k, q, delta, h)
    return np.concatenate([-k[::-1], k]), np.concatenate([weight[::-1], weight])


def _spacing(k: Array, q: float, delta: float, h: float) -> Array:
    return 1.0 / (1.0 / (h * np.hypot(k, q)) + 1.0 / delta)


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
        grid = FrequencyGrid.of(layer, outer_scale, diameter, n_steps, dt)
        amplitudes = [np.zeros((sensor.n_outputs, grid.f.size), complex) for sensor, _ in beams]
        reaches = [sensor.reach / max(footprint.scale, NARROWEST) for sensor, footprint in beams]
        for part, wave in waves(grid, layer, outer_scale, diameter, stream, max(reaches)):
            watch.check()
            exposure = np.sinc(grid.f[part] * dt)
            least = wave.ky[wave.ky.size // 2]
            for (sensor, footprint), reach, amplitude in zip(beams, reaches, amplitudes, strict=True):
                if least <= max(reach, CORE / (0.5 * diameter)):
                    amplitude[:, part] += sensor.measure(wave, footprint) * exposure
        for amplitude, which in zip(amplitudes, seen.values(), strict=True):
            values = grid.signal(amplitude, n_steps)
            for i in which:
                signals[i] += values
    return [np.ascontiguousarray(x.T) for x in signals]


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
