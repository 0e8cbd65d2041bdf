"""Slopes and modes of the same phase screens as this package, OOPAO and SPECULA have them.

Both are references only: `pip install OOPAO==1.0.0 specula==1.1.0` into an environment of its own that sees this checkout,
then run this file there. It prints the tables of docs/validation.md.

A screen is a periodic sum of plane waves, so that its values at pixels of any size and its mean gradients over squares are
exact. OOPAO takes finite differences between pixels and drops those at the pupil's edge; SPECULA fits Zernike polynomials to
the pixels in the pupil. What remains between them and this package should therefore shrink with the pixels, and does.
"""

from __future__ import annotations

import contextlib
import io
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np

from wfsobs import zernike
from wfsobs.arrays import Array
from wfsobs.frozen_flow import spectrum
from wfsobs.lenslets import Lenslets
from wfsobs.shack_hartmann import ShackHartmann
from wfsobs.spots import ARCSEC

R0, L0 = 0.157, 25.0  # [m]
PERIOD = 32.0  # of a screen [m]
SCREENS = 20
LENSLETS = Lenslets(diameter=8.0, across=40)
ORDER = 6  # of the modes compared
FITTED = 8  # radial order that both fit to the slopes
CUT = 0.95 * np.pi / LENSLETS.pitch  # no wave beyond [rad/m]: the coarsest pixels hold all of a screen


@dataclass(frozen=True)
class Screen:
    """Re sum a exp(i k . r), r from the centre of the pupil: a (n, n) [um] on the grid of FFT frequencies."""

    a: Array
    kx: Array
    ky: Array

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Screen:
        """A screen of von Karman turbulence, cut off at small waves."""
        n = round(PERIOD / LENSLETS.pitch)
        k = 2.0 * np.pi * np.fft.fftfreq(n, PERIOD / n)
        kx, ky = k[None, :], k[:, None]
        k2 = kx**2 + ky**2
        density = np.where((k2 > 0) & (k2 < CUT**2), spectrum(k2, R0 ** (-5.0 / 3.0), L0), 0.0)
        noise = rng.standard_normal((2, n, n))
        return cls(np.sqrt(density) * (2.0 * np.pi / PERIOD) * (noise[0] + 1j * noise[1]), kx, ky)

    def values(self, weight: Array | float = 1.0, per_cell: int = 1) -> Array:
        """Re sum weight a exp(i k . r) at the centres of pixels over the pupil, `per_cell` to a side of a cell."""
        n, pixel = len(self.a), LENSLETS.pitch / per_cell
        across = len(LENSLETS.centres) * per_cell
        first = (1 - across) / 2 * pixel
        shifted = self.a * weight * np.exp(1j * first * self.kx) * np.exp(1j * first * self.ky)
        big = np.zeros((n * per_cell, n * per_cell), complex)
        at = np.fft.fftfreq(n, 1.0 / n).astype(int)
        big[at[:, None], at[None, :]] = shifted
        return np.fft.ifft2(big, norm="forward").real[:across, :across]

    def slopes(self) -> Array:
        """Mean gradients over the subapertures [um/m], exact."""
        h = LENSLETS.pitch / (2.0 * np.pi)
        cell = 1j * np.sinc(self.kx * h) * np.sinc(self.ky * h)
        return np.concatenate([LENSLETS.mean(self.values(cell * k)) for k in (self.kx, self.ky)])

    def modes(self, transforms: Array) -> Array:
        """What a linear sensor makes of it, given its transforms at all k (n_outputs, n, n)."""
        return np.tensordot(transforms, self.a, 2).real


def oopao(screens: list[Screen], per_cell: int) -> tuple[Array, Array]:
    """(slopes [um/m] of the subapertures valid here and there, NaN elsewhere; modes [um]) of OOPAO's geometric sensor."""
    from OOPAO.OPD_map import OPD_map
    from OOPAO.ShackHartmann import ShackHartmann as TheirSensor
    from OOPAO.Source import Source
    from OOPAO.Telescope import Telescope
    from OOPAO.Zernike import Zernike

    lit = LENSLETS.lit.repeat(per_cell, axis=0).repeat(per_cell, axis=1)
    with contextlib.redirect_stdout(io.StringIO()):
        telescope = Telescope(resolution=len(lit), diameter=LENSLETS.diameter, pupil=lit)
        star = Source("R", 0.0)
        star**telescope
        sensor = TheirSensor(nSubap=LENSLETS.across, telescope=telescope, lightRatio=LENSLETS.illumination, is_geometric=True)
        basis = Zernike(telescope, len(zernike.up_to_order(FITTED)))
        basis.computeZernike(telescope)

        def measured(opd_um: Array) -> Array:
            star**telescope * OPD_map(opd_um * 1e-6) * sensor
            return sensor.signal_2D.copy()

        unit = 1e6 * ARCSEC * sensor.pixel_scale  # of a signal [um/m]
        maps = np.array([measured(s.values(per_cell=per_cell)) for s in screens]) * unit
        valid = np.tile(sensor.valid_subapertures, (2, 1))
        interaction = np.array([measured(z)[valid] for z in np.moveaxis(basis.modesFullRes, 2, 0)]).T * unit
    modes = maps[:, valid] @ np.linalg.pinv(interaction).T
    both = np.where(valid, maps, np.nan).reshape(len(screens), 2, LENSLETS.across, LENSLETS.across)
    return both[:, :, LENSLETS.valid].reshape(len(screens), -1), modes


def specula(screens: list[Screen], per_cell: int) -> Array:
    """Zernike coefficients [um] by SPECULA's modal analysis, (screens, modes)."""
    import specula as package

    package.init(-1, precision=0)
    from specula.data_objects.electric_field import ElectricField
    from specula.processing_objects.modal_analysis import ModalAnalysis

    pixels = len(LENSLETS.centres) * per_cell
    analysis = ModalAnalysis(type_str="zernike", npixels=pixels, obsratio=0.0, diaratio=1.0,
                             nmodes=len(zernike.up_to_order(ORDER)))
    field = ElectricField(pixels, pixels, LENSLETS.diameter / pixels)
    analysis.inputs["in_ef"].set(field)
    out = []
    for step, screen in enumerate(screens, 1):
        field.phaseInNm[:] = 1e3 * screen.values(per_cell=per_cell)
        field.generation_time = step
        analysis.check_ready(step)
        analysis.trigger()
        analysis.post_trigger()
        out.append(1e-3 * np.array(analysis.out_modes.value))
    return np.array(out)


def rms(x: Array) -> float:
    """Root mean square of what is not NaN."""
    return float(np.sqrt(np.nanmean(x**2)))


def main() -> None:
    """Print the tables."""
    screens = [Screen.draw(stream) for stream in np.random.default_rng(1).spawn(SCREENS)]
    nolls = zernike.up_to_order(ORDER)
    kx, ky = np.broadcast_arrays(screens[0].kx, screens[0].ky)
    sensor = ShackHartmann(LENSLETS, nolls, FITTED)
    slopes = np.array([s.slopes() for s in screens])
    transforms = sensor.transform(kx, ky)
    modes = np.array([s.modes(transforms) for s in screens])
    radius = LENSLETS.diameter / 2.0
    ideal_transforms = np.array([zernike.transform(j, radius * kx, radius * ky) for j in nolls])
    ideal = np.array([s.modes(ideal_transforms) for s in screens])
    print(f"{SCREENS} screens, {len(nolls)} modes; numpy {np.__version__}, OOPAO {version('OOPAO')}, "
          f"SPECULA {version('specula')}")
    print(f"modes: transform against reconstructed slopes {1e3 * rms(modes - slopes @ sensor.reconstructor.T):.2g} nm; "
          f"sensor against Zernike coefficients {1e3 * rms(modes - ideal):.2f} nm of {1e3 * rms(ideal):.1f}")
    inner = np.tile(LENSLETS.fraction[LENSLETS.valid] == 1.0, 2)
    print("| Pixels across | OOPAO: slopes, inner | slopes, all | tip and tilt | all modes | SPECULA: tip and tilt | all modes |")
    print("|---|---|---|---|---|---|---|")
    for per_cell in (1, 2, 4):
        their_slopes, their_modes = oopao(screens, per_cell)
        analysed = specula(screens, per_cell)
        difference = their_slopes - slopes
        off = their_modes[:, : len(nolls)] - modes
        apart = analysed - ideal
        print(f"| {len(LENSLETS.centres) * per_cell} | {rms(difference[:, inner]) / rms(slopes[:, inner]):.2%} "
              f"| {rms(difference) / rms(slopes):.2%} | {1e3 * rms(off[:, :2]):.2f} nm | {1e3 * rms(off):.2f} nm "
              f"| {1e3 * rms(apart[:, :2]):.2f} nm | {1e3 * rms(apart):.2f} nm |")


if __name__ == "__main__":
    main()
