"""Temporal spectra of frozen flow seen by ideal sensors: the expectation of the signals of `frozen_flow`.

A layer of wind speed v turns the spatial frequency k_x along the wind into f = k_x v / 2 pi. With Phi the von Karman density and
M_i the transform of a functional, two of them have the one-sided cross spectrum

    S_ij(f) = (2 pi / v) 2 integral dk_y Phi(k) conj(M_i(k)) M_j(k),

times sinc^2(f T) for the mean over a step. Layers are independent and add. Aliasing is left out (`mode_spectra` has it).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag

from wfsobs.atmosphere import CORE, Footprint, TurbulenceLayer, fine_rule, nodes_across_wind, von_karman_density
from wfsobs.scenario import Scenario
from wfsobs.sensors import zernike
from wfsobs.signal.wiener import Complex
from wfsobs.simulation import layers as atmosphere
from wfsobs.simulation.sensing import MEAN, is_blind, lgs_weights, stars_differ
from wfsobs.typing import Array

LOWEST = 1e-3
"""Frequency below which spectra are flat, over that of the wind across the outer scale."""

RIPPLES = 24
"""Spectra have ripples of width speed / diameter, and up to this many are exact to 0.1 %. Beyond, 30 Hz for 10 m/s on 8 m, they
go through single samples: a factor of 1.5 to 2 off at a frequency, up to 35 % in the mean over an octave (tip and tilt)."""


@dataclass(frozen=True)
class SpectraBetween:
    """Densities of signals, (n,) each, and how they are shared at the nodes, interpolated at log frequencies `at`."""

    density: list[Array]
    nodes: Array
    at: Array
    total: Complex

    def pair(self, i: int, j: int) -> Complex:
        """Interpolate only the share of the geometric mean: it is smooth, and never above one."""
        share = self.total[i, j] / np.sqrt(np.maximum((self.total[i, i] * self.total[j, j]).real, 1e-300))
        out = np.asarray(np.interp(self.at, self.nodes, share), dtype=np.complex128)
        out *= self._roots[i]
        out *= self._roots[j]
        return out

    @cached_property
    def _roots(self) -> list[Array]:
        return [np.sqrt(one) for one in self.density]

    def matrix(self, signals: Sequence[int]) -> Complex:
        """Return the cross spectra of some signals, Hermitian, (n_signals, n_signals, n)."""
        out = np.empty((len(signals), len(signals), self.at.size), dtype=np.complex128)
        for a, i in enumerate(signals):
            out[a, a] = self.density[i]
            for b, j in enumerate(signals[a + 1 :], a + 1):
                out[a, b] = self.pair(i, j)
                np.conjugate(out[a, b], out=out[b, a])
        return out


def spectra_between(
    scenario: Scenario, mode: int | None, frequency: Array, sight: Sight, reach: float = 0.0, weights: Array | None = None
) -> SpectraBetween:
    """Return the spectra [um^2/Hz] of what a sight gives of one mode, or of all (None), at frequencies from 0 on [Hz].

    reach : spatial frequency up to which the sight takes waves that the modes do not have [rad/m]
    weights : of what the sight gives in the signals, (n_signals, n_sights); by default that itself
    """
    f, total = _at_nodes(_Air(scenario), mode, float(frequency[-1]), sight, reach)
    if weights is not None:
        total = np.einsum("ai,ijf,bj->abf", weights, total, weights, optimize=True)
    exposure = np.sinc(f * scenario.dt) ** 2
    at, nodes = np.log(np.maximum(frequency, f[0])), np.log(f)
    density = [np.exp(np.interp(at, nodes, np.log(np.maximum((row[i] * exposure).real, 1e-300)))) for i, row in enumerate(total)]
    return SpectraBetween(density, nodes, at, total)


class _Air:
    """A scenario, equal to any other of the same turbulence, sensors and vibration: no other setting changes these spectra."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        groups = scenario.telescope, scenario.turbulence, scenario.sensors, scenario.vibration
        self._settings = scenario.n_steps, *(group.to_dict() for group in groups)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Air) and self._settings == other._settings

    def __hash__(self) -> int:
        return hash(repr(self._settings))


@lru_cache(maxsize=32)
def _at_nodes(air: _Air, mode: int | None, highest: float, sight: Sight, reach: float) -> tuple[Array, Complex]:
    """Return the nodes in frequency, and the spectra of all layers there, which take a while where there are many."""
    scenario = air.scenario
    found = atmosphere.layers(scenario)
    f = _frequencies(scenario, min(layer.speed for layer in found), highest, reach)
    front = max(CORE / (0.5 * scenario.telescope.diameter), reach)

    def through(layer: TurbulenceLayer) -> Complex:
        kx = 2.0 * np.pi * f / layer.speed
        return np.concatenate([_block(scenario, mode, layer, kx[part], front, sight) for part in _blocks(kx, front)], axis=-1)

    total = np.sum([through(layer) for layer in found], axis=0)
    f.flags.writeable = total.flags.writeable = False
    return f, total


def _frequencies(scenario: Scenario, speed: float, highest: float, reach: float) -> Array:
    """Return the nodes in frequency: by ratio, then by the ripple width of the slowest layer, then by ratio again."""
    ripple = speed / scenario.telescope.diameter
    ripples = max(RIPPLES, int(reach * scenario.telescope.diameter / (2.0 * np.pi)))
    lowest = min(LOWEST * speed / scenario.turbulence.outer_scale, 0.01 * ripple)
    f = np.concatenate(
        [
            np.geomspace(lowest, ripple / 40, 32, endpoint=False),
            ripple / 40 * np.arange(1, 160),
            ripple / 12 * np.arange(48, 12 * ripples),
            np.geomspace(ripples * ripple, max(highest, 2 * ripples * ripple), 48),
        ]
    )
    return f[: int(np.searchsorted(f, highest)) + 1]


def _blocks(kx: Array, front: float) -> Iterator[slice]:
    """Yield ranges of frequencies that share their nodes across the wind."""
    start = 0
    while start < kx.size:
        end = front if kx[start] < front else 1.5 * kx[start]
        stop = max(int(np.searchsorted(kx, end)), start + 1)
        yield slice(start, stop)
        start = stop


def _block(scenario: Scenario, mode: int | None, layer: TurbulenceLayer, kx: Array, front: float, sight: Sight) -> Complex:
    """Return the spectra of one layer between the signals, (n_signals, n_signals, n)."""
    diameter, outer_scale = scenario.telescope.diameter, scenario.turbulence.outer_scale
    q0 = 2.0 * np.pi / outer_scale
    if kx[0] < front:
        ky, weight = nodes_across_wind(q0, front, *fine_rule(layer.height, diameter))
    else:
        ky, weight = nodes_across_wind(float(np.hypot(q0, kx[0])), 4.0 * kx[-1], np.inf, 0.25)
    above = von_karman_density(kx**2 + ky[ky.size // 2 :, None] ** 2, layer.strength, outer_scale)
    above *= (4.0 * np.pi / layer.speed) * weight[ky.size // 2 :, None]
    waves = PlaneWaves(kx, ky, layer.angle)
    signals = sight(scenario, mode, layer, waves)
    if isinstance(signals, ModesInBeams):
        return signals.spectra(waves, above)
    by_kx = np.moveaxis(np.asarray(signals), 2, 0)
    between: Complex = np.matmul(by_kx.conj() * _mirror(above).T[:, None], by_kx.swapaxes(1, 2))
    return np.moveaxis(between, 0, 2)


def _mirror(above: Array, below: Array | None = None) -> Array:
    """Return what is on either side of the wind, from its halves; below : the same as above unless given."""
    return np.concatenate([(above if below is None else below)[::-1], above])


class PlaneWaves:
    """Waves of a block, `kx` along and `ky` across the wind, (n_kx,) and (n_ky, 1) [rad/m]; the latter symmetric about 0."""

    kx: Array
    ky: Array
    c: float
    s: float
    above: Array

    def __init__(self, kx: Array, ky: Array, angle: float) -> None:
        self.kx, self.ky, self.c, self.s = kx, ky[:, None], np.cos(angle), np.sin(angle)
        self.above = self.ky[ky.size // 2 :]
        self._length = np.hypot(kx, self.above)
        self._radial: dict[tuple[int, float], Array] = {}
        self._azimuthal: dict[int, tuple[Array, Array]] = {}

    @property
    def x(self) -> Array:
        """Along x of the pupil, (n_ky, n_kx) [rad/m]."""
        return self.c * self.kx - self.s * self.ky

    @property
    def y(self) -> Array:
        """Along y of the pupil, (n_ky, n_kx) [rad/m]."""
        return self.s * self.kx + self.c * self.ky

    def mode(self, diameter: float, noll: int, footprint: Footprint) -> Complex:
        """Return the transform of a Zernike mode in a beam."""
        radial, angular = self.radial(diameter, noll, footprint.scale), self.azimuthal(noll)
        return (zernike.amplitude(noll) * self.turn(footprint)) * _mirror(*(radial * each for each in angular))

    def radial(self, diameter: float, noll: int, scale: float) -> Array:
        """Return the radial factor of a mode in a beam of this scale, of the waves with ky above 0."""
        order, radius = zernike.noll(noll)[0] + 1, 0.5 * diameter * scale
        if (order, radius) not in self._radial:
            self._radial[order, radius] = zernike.tabulated_bessel_ratio(order, radius * self._length)
        return self._radial[order, radius]

    def azimuthal(self, noll: int) -> tuple[Array, Array]:
        """Return the angular factor of a mode, of the waves with ky above 0 and of those below, from 0 on."""
        if noll not in self._azimuthal:
            along, angle = (self.kx + 1j * self.above) / self._length, self.c + 1j * self.s
            above, below = (zernike.azimuthal(noll, each * angle) for each in (along, along.conj()))
            self._azimuthal[noll] = above, below
        return self._azimuthal[noll]

    def in_wind(self, footprint: Footprint) -> tuple[float, float]:
        """Return the shift of a footprint along and across the wind [m]."""
        x, y = footprint.shift
        return self.c * x + self.s * y, self.c * y - self.s * x

    def turn(self, footprint: Footprint) -> Complex:
        """Return exp(i k . shift)."""
        along, across = self.in_wind(footprint)
        return np.exp(1j * self.kx * along) * np.exp(1j * self.ky * across)


@dataclass(frozen=True)
class ModesInBeams:
    """Signals each of which is a mode in a beam: (noll, footprint) of each; diameter : that of the aperture [m].

    Beams of one scale differ in their shifts, which are a factor along the wind times one across it: the sum over the waves
    across is a product of matrices for all pairs of signals of the same modes and scales, of its even and of its odd part.
    """

    diameter: float
    signals: Sequence[tuple[int, Footprint]]

    def spectra(self, waves: PlaneWaves, density: Array) -> Complex:
        """Return the sums over the waves across the wind between all signals, (n_signals, n_signals, n_kx).

        density : of the waves with ky above 0, (n_ky // 2, n_kx)
        """
        once = list(dict.fromkeys(self.signals))  # an NGS on the axis sees what is there
        shifts = np.array([waves.in_wind(footprint) for _, footprint in once])
        pairs: dict[tuple[tuple[int, float], tuple[int, float]], list[tuple[int, int]]] = {}
        for i, (noll, one) in enumerate(once):
            for j, (other_noll, other) in enumerate(once):
                first, second = (noll, one.scale), (other_noll, other.scale)
                if first < second or (first == second and i <= j):
                    pairs.setdefault((first, second), []).append((i, j))
        out = np.empty((len(shifts), len(shifts), waves.kx.size), dtype=np.complex128)
        for (first, second), among in pairs.items():
            radial = density * waves.radial(self.diameter, *first) * waves.radial(self.diameter, *second)
            sides = zip(waves.azimuthal(first[0]), waves.azimuthal(second[0]), strict=True)
            above, below = (one * other for one, other in sides)
            factor = zernike.amplitude(first[0]).conjugate() * zernike.amplitude(second[0])
            i, j = np.array(among).T
            along, across = (shifts[j] - shifts[i]).T
            turn = np.outer(across, waves.above)
            between = np.cos(turn) @ (radial * (above + below)) + 1j * (np.sin(turn) @ (radial * (above - below)))
            out[i, j] = factor * between * np.exp(1j * np.outer(along, waves.kx))
            out[j, i] = out[i, j].conj()
        places = [once.index(signal) for signal in self.signals]
        return out[np.ix_(places, places)]


Sight = Callable[[Scenario, Any, TurbulenceLayer, PlaneWaves], Sequence[Complex] | ModesInBeams]
"""(scenario, mode, layer, waves) -> transforms of the signals."""


# ---------------------------------------------------------------------- of one mode, as sensors see it


class TurbulenceSpectra(NamedTuple):
    """Spectra of the turbulence in one mode, one-sided [um^2/Hz], or per sample, with the errors of the combined LGS.

    Attributes
    ----------
    own, measurement, ngs : Array
        On the axis, of the mean of the LGS, and of the NGS.
    cross, ngs_cross, sensors_cross : Array
        Between the axis and the LGS, between the axis and the NGS, and between the NGS and the LGS.
    """

    own: Array
    measurement: Array
    cross: Complex | Array
    ngs: Array
    ngs_cross: Complex | Array
    sensors_cross: Complex | Array


def flow_spectra(scenario: Scenario, mode: int, frequency: Array) -> TurbulenceSpectra:
    """Compute the spectra of one mode of frozen flow.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    mode : int
        Index of the mode.
    frequency : Array
        Frequencies from 0 on, (n,) [Hz].

    Returns
    -------
    TurbulenceSpectra
        Six densities, (n,) each [um^2/Hz].
    """
    if scenario.sensors.lgs_combination == MEAN and stars_differ(scenario, mode):
        shared = _stars_apart(scenario, mode, frequency, 1)
    else:
        shared = spectra_between(scenario, mode, frequency, _stars_together)
    own, ngs, measurement = shared.density
    cross = shared.pair(0, 2)
    if atmosphere.natural_star(scenario) == atmosphere.on_axis():
        return TurbulenceSpectra(own, measurement, cross, own, own + 0j, cross)
    return TurbulenceSpectra(own, measurement, cross, ngs, shared.pair(0, 1), shared.pair(1, 2))


def star_flow_spectra(scenario: Scenario, mode: int, frequency: Array) -> SpectraBetween:
    """Compute the spectra of one mode of frozen flow, every LGS apart.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    mode : int
        Index of the mode.
    frequency : Array
        Frequencies from 0 on, (n,) [Hz].

    Returns
    -------
    SpectraBetween
        One-sided cross spectra [um^2/Hz] of the signal on the axis, that of the NGS, the mean of the LGS and their orthonormal
        differences (`star_basis`).
    """
    return _stars_apart(scenario, mode, frequency, scenario.sensors.lgs_count)


def _stars_apart(scenario: Scenario, mode: int, frequency: Array, count: int) -> SpectraBetween:
    """Return those of the axis, the NGS, and the first `count` of `star_basis`, from spectra between beams that are kept."""
    weights = block_diag(np.eye(2), star_basis(scenario.sensors.lgs_count)[:count])
    return spectra_between(scenario, mode, frequency, _beams, weights=weights)


def star_basis(stars: int) -> Array:
    """Return the weights of the stars in their mean and in orthonormal differences, (n_stars, n_stars).

    The differences are the harmonics on the circle of the stars, which have little in common.
    """
    angle = 2.0 * np.pi * np.outer(np.arange(1, stars // 2 + 1), np.arange(stars)) / stars
    waves = np.stack([np.cos(angle), np.sin(angle)], axis=1).reshape(-1, stars)[: stars - 1]
    differences = waves / np.linalg.norm(waves, axis=1, keepdims=True)
    return np.vstack([np.full(stars, 1.0 / stars), differences])


ModeInBeam = Callable[[Scenario, int, PlaneWaves, Footprint], Complex]
"""(scenario, mode, waves, footprint) -> transform of the mode in that beam."""


def _stars_together(scenario: Scenario, mode: int, layer: TurbulenceLayer, waves: PlaneWaves) -> list[Complex]:
    """Return those of axis, NGS and combined LGS."""
    footprints = (Footprint(), atmosphere.footprint(atmosphere.natural_star(scenario), layer))
    natural = [ideal_mode(scenario, mode, waves, footprint) for footprint in footprints]
    return [*natural, of_stars(scenario, mode, layer, waves, ideal_mode)]


def _beams(scenario: Scenario, mode: int, layer: TurbulenceLayer, _waves: PlaneWaves) -> ModesInBeams:
    """Return those of axis, NGS and every LGS."""
    stars = (atmosphere.on_axis(), atmosphere.natural_star(scenario), *atmosphere.laser_stars(scenario))
    noll = scenario.modes[mode].noll
    return ModesInBeams(scenario.telescope.diameter, [(noll, atmosphere.footprint(star, layer)) for star in stars])


def of_stars(scenario: Scenario, mode: int, layer: TurbulenceLayer, waves: PlaneWaves, star_mode: ModeInBeam) -> Complex:
    """Return the transform of the combined LGS; star_mode : of a mode of each of them."""
    combined = np.zeros(waves.x.shape, dtype=np.complex128)
    for star, gains in zip(atmosphere.laser_stars(scenario), lgs_weights(scenario)[mode], strict=True):
        footprint = atmosphere.footprint(star, layer)
        for other, gain in enumerate(gains):
            if gain != 0.0 and not is_blind(scenario, other):
                combined += gain * star_mode(scenario, other, waves, footprint)
    return combined


def ideal_mode(scenario: Scenario, mode: int, waves: PlaneWaves, footprint: Footprint) -> Complex:
    """Return the transform of a mode in a beam."""
    return waves.mode(scenario.telescope.diameter, scenario.modes[mode].noll, footprint)
