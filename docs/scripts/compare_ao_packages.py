"""Slopes and modes of the same phase screens as this package, OOPAO and SPECULA have them.

Both are references only: `pip install OOPAO==1.0.0 specula==1.1.0` into an environment of its own that sees this checkout,
then run this file there. It prints the tables of docs/validation.md.

A screen is a periodic sum of plane waves, so that its values at pixels of any size and its mean gradients over squares are
exact. All have the same pixels in the pupil. OOPAO takes finite differences between pixels and drops those at the pupil's
edge; SPECULA fits Zernike polynomials to the pixels. What remains between them and this package should therefore shrink with
the pixels, and does.
"""

from __future__ import annotations

import contextlib
import io
import logging
from dataclasses import dataclass
from importlib.metadata import version

import numpy as np

from wfsobs.atmosphere import von_karman_density
from wfsobs.sensors import zernike
from wfsobs.sensors.lenslets import Lenslets, reconstructor
from wfsobs.sensors.shack_hartmann import ARCSEC, ShackHartmann
from wfsobs.typing import Array

R0, L0 = 0.157, 25.0  # [m]
PERIOD = 32.0  # of a screen [m]
SCREENS = 20
DIAMETER, ACROSS = 8.0, 40
PIXELS = (160, 320, 640)  # across the pupil
ORDER = 6  # of the modes compared
FITTED = 8  # radial order that both fit to the slopes
CUT = 0.95 * np.pi * PIXELS[0] / DIAMETER  # no wave beyond [rad/m]: the coarsest pixels hold all of a screen


@dataclass(frozen=True)
class Screen:
    """Re sum a exp(i k . r), r from the centre of the pupil: a (n, n) [um] on the grid of FFT frequencies."""

    a: Array
    kx: Array
    ky: Array

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Screen:
        """A screen of von Karman turbulence, cut off at small waves."""
        n = round(PERIOD * PIXELS[0] / DIAMETER)
        k = 2.0 * np.pi * np.fft.fftfreq(n, PERIOD / n)
        kx, ky = k[None, :], k[:, None]
        k2 = kx**2 + ky**2
        density = np.where((k2 > 0) & (k2 < CUT**2), von_karman_density(k2, R0 ** (-5.0 / 3.0), L0), 0.0)
        noise = rng.standard_normal((2, n, n))
        return cls(np.sqrt(density) * (2.0 * np.pi / PERIOD) * (noise[0] + 1j * noise[1]), kx, ky)

    def values(self, pixels: int, weight: Array | float = 1.0) -> Array:
        """Re sum weight a exp(i k . r) at the centres of pixels over the pupil, (pixels, pixels)."""
        n, finer, pixel = len(self.a), pixels // PIXELS[0], DIAMETER / pixels
        first = (1 - pixels) / 2 * pixel
        shifted = self.a * weight * np.exp(1j * first * self.kx) * np.exp(1j * first * self.ky)
        big = np.zeros((n * finer, n * finer), complex)
        at = np.fft.fftfreq(n, 1.0 / n).astype(int)
        big[at[:, None], at[None, :]] = shifted
        return np.fft.ifft2(big, norm="forward").real[:pixels, :pixels]

    def slopes(self, lenslets: Lenslets) -> Array:
        """Mean gradients over the subapertures [um/m], exact."""
        h = lenslets.pitch / (2.0 * np.pi)
        cell = 1j * np.sinc(self.kx * h) * np.sinc(self.ky * h)
        return np.concatenate([lenslets.mean(self.values(lenslets.cells, cell * k)) for k in (self.kx, self.ky)])

    def modes(self, transforms: Array) -> Array:
        """What a linear sensor makes of it, given its transforms at all k (n_outputs, n, n)."""
        return np.tensordot(transforms, self.a, 2).real


def oopao(screens: list[Screen], lenslets: Lenslets) -> tuple[Array, Array]:
    """(slopes [um/m] of the valid subapertures, modes [um]) of OOPAO's geometric sensor."""
    from OOPAO.OPD_map import OPD_map
    from OOPAO.ShackHartmann import ShackHartmann as TheirSensor
    from OOPAO.Source import Source
    from OOPAO.Telescope import Telescope
    from OOPAO.Zernike import Zernike

    with contextlib.redirect_stdout(io.StringIO()):
        telescope = Telescope(resolution=lenslets.cells, diameter=DIAMETER, pupil=lenslets.lit)
        star = Source("R", 0.0)
        star**telescope
        sensor = TheirSensor(nSubap=ACROSS, telescope=telescope, lightRatio=lenslets.illumination, is_geometric=True)
        basis = Zernike(telescope, len(zernike.up_to_order(FITTED)))
        basis.computeZernike(telescope)

        def measured(opd_um: Array) -> Array:
            star**telescope * OPD_map(opd_um * 1e-6) * sensor
            return sensor.signal_2D.copy()

        unit = 1e6 * ARCSEC * sensor.pixel_scale  # of a signal [um/m]
        maps = np.array([measured(s.values(lenslets.cells)) for s in screens]) * unit
        assert np.array_equal(sensor.valid_subapertures, lenslets.valid)
        valid = np.tile(lenslets.valid, (2, 1))
        interaction = np.array([measured(z)[valid] for z in basis.modesFullRes.T]).T * unit  # .T: their x runs along rows
    return maps[:, valid], maps[:, valid] @ np.linalg.pinv(interaction).T


def specula(screens: list[Screen], pixels: int) -> Array:
    """Zernike coefficients [um] by SPECULA's modal analysis, (screens, modes), but for their signs."""
    import specula as package

    logging.getLogger("specula").setLevel(logging.ERROR)
    package.init(-1, precision=0)
    from specula.data_objects.electric_field import ElectricField
    from specula.processing_objects.modal_analysis import ModalAnalysis

    analysis = ModalAnalysis(
        type_str="zernike", npixels=pixels, obsratio=0.0, diaratio=1.0, nmodes=len(zernike.up_to_order(ORDER))
    )
    field = ElectricField(pixels, pixels, DIAMETER / pixels)
    analysis.inputs["in_ef"].set(field)
    out = []
    for step, screen in enumerate(screens, 1):
        field.phaseInNm[:] = 1e3 * screen.values(pixels)
        field.generation_time = step
        analysis.check_ready(step)
        analysis.trigger()
        analysis.post_trigger()
        out.append(1e-3 * np.array(analysis.out_modes.value))
    return np.array(out)


def rms(x: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(x**2)))


def main() -> None:
    """Print the tables."""
    screens = [Screen.draw(stream) for stream in np.random.default_rng(1).spawn(SCREENS)]
    nolls = zernike.up_to_order(ORDER)
    kx, ky = np.broadcast_arrays(screens[0].kx, screens[0].ky)
    transforms = np.array([zernike.transform(j, DIAMETER / 2.0 * kx, DIAMETER / 2.0 * ky) for j in nolls])
    ideal = np.array([s.modes(transforms) for s in screens])
    print(
        f"{SCREENS} screens, {len(nolls)} modes; numpy {np.__version__}, OOPAO {version('OOPAO')}, SPECULA {version('specula')}"
    )
    rows = []
    for pixels in PIXELS:
        lenslets = Lenslets(DIAMETER, ACROSS, cells=pixels)
        slopes = np.array([s.slopes(lenslets) for s in screens])
        modes = slopes @ reconstructor(lenslets, FITTED)[: len(nolls)].T
        if pixels == PIXELS[0]:
            transforms = ShackHartmann(lenslets, nolls, FITTED).transform(kx, ky)
            direct = np.array([s.modes(transforms) for s in screens])
            print(
                f"this package, by transform and by slopes: {1e3 * rms(direct - modes):.2g} nm apart; sensor less Zernike "
                f"coefficients {1e3 * rms((modes - ideal)[:, :2]):.2f} nm in tip and tilt, {1e3 * rms(modes - ideal):.2f} nm "
                f"in all, of {1e3 * rms(ideal[:, :2]):.0f} and {1e3 * rms(ideal):.0f} nm"
            )
        their_slopes, their_modes = oopao(screens, lenslets)
        analysed = specula(screens, pixels)
        inner = np.tile(lenslets.fraction[lenslets.valid] == 1.0, 2)
        off = their_modes[:, : len(nolls)] - modes
        apart = analysed * np.sign(np.sum(analysed * ideal, axis=0)) - ideal  # an orthonormal basis has no signs
        rows.append(
            f"| {pixels} | {rms((their_slopes - slopes)[:, inner]) / rms(slopes[:, inner]):.2%} "
            f"| {rms(their_slopes - slopes) / rms(slopes):.2%} | {1e3 * rms(off[:, :2]):.2f} nm "
            f"| {1e3 * rms(off):.2f} nm | {1e3 * rms(apart[:, :2]):.2f} nm | {1e3 * rms(apart):.2f} nm |"
        )
    print("| Pixels across | OOPAO: slopes, inner | slopes, all | tip and tilt | all modes | SPECULA: tip and tilt | all modes |")
    print("|---|---|---|---|---|---|---|", *rows, sep="\n")


if __name__ == "__main__":
    main()
