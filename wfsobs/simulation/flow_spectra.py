"""Temporal spectra of frozen flow seen by ideal sensors: the expectation of the signals of `frozen_flow`.

A layer of wind speed v turns the spatial frequency k_x along the wind into f = k_x v / 2 pi. With Phi the von Karman density and
M_i the transform of a functional (`plane_waves`), two of them have the one-sided cross spectrum

    S_ij(f) = (2 pi / v) 2 integral dk_y Phi(k) conj(M_i(k)) M_j(k),

times sinc^2(f T) for the mean over a step. Layers are independent and add. Aliasing is left out (`lenslet_spectra`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import helmert

from wfsobs.atmosphere.plane_waves import Footprint
from wfsobs.atmosphere.von_karman import CORE, TurbulenceLayer, fine_rule, nodes_across_wind, von_karman_density
from wfsobs.scenario import Scenario
from wfsobs.sensors.zernike import ZernikeProjection, tabulated_bessel_ratio
from wfsobs.signal.wiener import Complex
from wfsobs.simulation import layers as atmosphere
from wfsobs.simulation.guide_stars import lgs_weights
from wfsobs.typing import Array

LOWEST = 1e-3
"""Frequency below which spectra are flat, over that of the wind across the outer scale."""

RIPPLES = 24
"""Spectra have ripples of width speed / diameter; up to this many they are resolved, beyond only their mean."""


class FlowSpectra(NamedTuple):
    """One-sided spectra of one mode [um^2/Hz].

    Attributes
    ----------
    own, measurement, ngs : Array
        On the axis, of the mean of the LGS, and of the NGS.
    cross, ngs_cross, sensors_cross : Array
        Between the axis and the LGS, between the axis and the NGS, and between the NGS and the LGS.
    """

    own: Array
    measurement: Array
    cross: Complex
    ngs: Array
    ngs_cross: Complex
    sensors_cross: Complex


def flow_spectra(scenario: Scenario, mode: int, frequency: Array) -> FlowSpectra:
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
    FlowSpectra
        Six densities, (n,) each [um^2/Hz].
    """
    shared = spectra_between(scenario, mode, frequency, _stars_together)
    if len(shared.density) == 2:  # the NGS is on the axis
        own, measurement = shared.density
        return FlowSpectra(own, measurement, shared.pair(0, 1), own, own + 0j, shared.pair(0, 1))
    own, measurement, ngs = shared.density
    return FlowSpectra(own, measurement, shared.pair(0, 1), ngs, shared.pair(0, 2), shared.pair(2, 1))


def star_flow_spectra(scenario: Scenario, mode: int, frequency: Array) -> Complex:
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
    Array
        One-sided cross spectra [um^2/Hz] of the signal on the axis, that of the NGS, the mean of the LGS and their orthonormal
        differences (`star_basis`), (2 + n_lgs, 2 + n_lgs, n).
    """
    shared = spectra_between(scenario, mode, frequency, _stars_apart)
    signals = range(len(shared.density))
    out = np.array([[shared.pair(i, j) if i < j else np.empty_like(shared.pair(0, 0)) for j in signals] for i in signals])
    for i in signals:
        out[i, i] = shared.density[i]
        out[i, :i] = out[:i, i].conj()
    return out


def star_basis(stars: int) -> Array:
    """Return the weights of the stars in their mean and in orthonormal differences, (n_stars, n_stars)."""
    differences: Array = helmert(stars)
    return np.vstack([np.full(stars, 1.0 / stars), differences])


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
        real, imaginary = (np.interp(self.at, self.nodes, part) for part in (share.real, share.imag))
        return np.sqrt(self.density[i] * self.density[j]) * (real + 1j * imaginary)


def spectra_between(scenario: Scenario, mode: int | None, frequency: Array, sight: Sight, reach: float = 0.0) -> SpectraBetween:
    """Return the spectra [um^2/Hz] of what a sight gives of one mode, or of all (None), at frequencies from 0 on [Hz].

    reach : spatial frequency up to which the sight takes waves that the modes do not have [rad/m]
    """
    f, total = _at_nodes(scenario, mode, float(frequency[-1]), sight, reach)
    exposure = np.sinc(f * scenario.dt) ** 2
    at, nodes = np.log(np.maximum(frequency, f[0])), np.log(f)
    density = [np.exp(np.interp(at, nodes, np.log(np.maximum((row[i] * exposure).real, 1e-300)))) for i, row in enumerate(total)]
    return SpectraBetween(density, nodes, at, total)


@lru_cache(maxsize=32)
def _at_nodes(scenario: Scenario, mode: int | None, highest: float, sight: Sight, reach: float) -> tuple[Array, Complex]:
    """Return the nodes in frequency, and the spectra of all layers there, which take a second where there are many."""
    found = atmosphere.layers(scenario)
    f = _frequencies(scenario, min(layer.speed for layer in found), highest, reach)
    total = np.sum([_layer(scenario, mode, layer, f, sight, reach) for layer in found], axis=0)
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


def _layer(scenario: Scenario, mode: int | None, layer: TurbulenceLayer, f: Array, sight: Sight, reach: float) -> Complex:
    """Return the spectra of one layer between the signals, (n_signals, n_signals, n)."""
    kx = 2.0 * np.pi * f / layer.speed
    front = max(CORE / (0.5 * scenario.telescope.diameter), reach)
    return np.concatenate([_block(scenario, mode, layer, kx[part], front, sight) for part in _blocks(kx, front)], axis=-1)


def _blocks(kx: Array, front: float) -> Iterator[slice]:
    """Yield ranges of frequencies that share their nodes across the wind."""
    start = 0
    while start < kx.size:
        end = front if kx[start] < front else 1.5 * kx[start]
        stop = max(int(np.searchsorted(kx, end)), start + 1)
        yield slice(start, stop)
        start = stop


def _block(scenario: Scenario, mode: int | None, layer: TurbulenceLayer, kx: Array, front: float, sight: Sight) -> Complex:
    diameter, q0 = scenario.telescope.diameter, 2.0 * np.pi / scenario.turbulence.outer_scale
    if kx[0] < front:
        ky, weight = nodes_across_wind(q0, front, *fine_rule(layer.height, diameter))
    else:
        ky, weight = nodes_across_wind(float(np.hypot(q0, kx[0])), 4.0 * kx[-1], np.inf, 0.25)
    density = (
        (4.0 * np.pi / layer.speed)
        * weight[:, None]
        * von_karman_density(kx**2 + ky[:, None] ** 2, layer.strength, scenario.turbulence.outer_scale)
    )
    c, s = np.cos(layer.angle), np.sin(layer.angle)
    signals = np.asarray(sight(scenario, mode, layer, c * kx - s * ky[:, None], s * kx + c * ky[:, None]))
    by_kx = np.moveaxis(signals, 2, 0)
    return np.moveaxis((by_kx.conj() * density.T[:, None]) @ by_kx.swapaxes(1, 2), 0, 2)


Sight = Callable[[Scenario, Any, TurbulenceLayer, Array, Array], Sequence[Complex]]
"""(scenario, mode, layer, k_x, k_y) -> transforms of the signals."""

ModeInBeam = Callable[[Scenario, int, Array, Array, Footprint], Complex]
"""(scenario, mode, k_x, k_y, footprint) -> transform of the mode in that beam."""


def _stars_together(scenario: Scenario, mode: int, layer: TurbulenceLayer, x: Array, y: Array) -> list[Complex]:
    """Return those of axis, combined LGS and, off the axis, NGS."""
    signals = [ideal_mode(scenario, mode, x, y, Footprint()), of_stars(scenario, mode, layer, x, y, ideal_mode)]
    if atmosphere.natural_star(scenario) != atmosphere.on_axis():
        signals.append(ideal_mode(scenario, mode, x, y, footprint_on(scenario, atmosphere.natural_star(scenario), layer)))
    return signals


def of_stars(scenario: Scenario, mode: int, layer: TurbulenceLayer, x: Array, y: Array, star_mode: ModeInBeam) -> Complex:
    """Return the transform of the combined LGS; star_mode : of a mode of each of them."""
    combined = np.zeros(np.shape(x), dtype=np.complex128)
    for star, gains in zip(atmosphere.laser_stars(scenario), lgs_weights(scenario)[mode], strict=True):
        footprint = footprint_on(scenario, star, layer)
        for other, gain in enumerate(gains):
            blind = scenario.sensors.tip_tilt_indetermination and scenario.modes[other].radial_order == 1
            if gain != 0.0 and not blind:
                combined = combined + gain * star_mode(scenario, other, x, y, footprint)
    return combined


def _stars_apart(scenario: Scenario, mode: int, layer: TurbulenceLayer, x: Array, y: Array) -> list[Complex]:
    """Return those of axis, NGS, mean of the LGS and their differences."""
    stars = (atmosphere.natural_star(scenario), *atmosphere.laser_stars(scenario))
    ngs, *lgs = (ideal_mode(scenario, mode, x, y, footprint_on(scenario, star, layer)) for star in stars)
    return [ideal_mode(scenario, mode, x, y, Footprint()), ngs, *np.tensordot(star_basis(len(lgs)), lgs, axes=1)]


def ideal_mode(scenario: Scenario, mode: int, x: Array, y: Array, footprint: Footprint) -> Complex:
    """Return the transform of a mode in a beam, at k_x and k_y in the pupil frame [rad/m]."""
    sensor = ZernikeProjection(scenario.telescope.diameter, (scenario.modes[mode].noll,))
    return sensor.transform(x, y, footprint, tabulated_bessel_ratio)[0]


def footprint_on(scenario: Scenario, star: atmosphere.Star, layer: TurbulenceLayer) -> Footprint:
    """Return where the beam of a star crosses a layer."""
    return atmosphere.view(atmosphere.ideal_sensor(scenario), star, (layer,)).footprints[0]
