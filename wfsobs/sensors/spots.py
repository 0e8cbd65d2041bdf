"""Noise of a Shack-Hartmann sensor's spots, and of their centre of gravity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wfsobs.typing import Array

ARCSEC = np.pi / 180.0 / 3600.0
"""One arcsecond [rad]."""


@dataclass(frozen=True)
class SpotModel:
    """The spots of a sensor and their detector. Spots are round: the elongation of a laser's spot is not modelled.

    Attributes
    ----------
    photons : float
        Detected per frame by a fully lit subaperture [e-].
    read_noise : float
        Rms per pixel and frame [e-].
    fwhm : float
        Full width at half maximum of a spot [arcsec].
    pixel_scale : float
        Angle of a pixel [arcsec].
    pixels : int
        Side of the window of the centre of gravity.
    """

    photons: float
    read_noise: float
    fwhm: float
    pixel_scale: float
    pixels: int

    def slope_variance(self, lit: Array) -> Array:
        """Return the variance of a slope [um^2/m^2] of subapertures with the lit fraction `lit`.

        For a Gaussian spot in photon noise, and read noise on every pixel of the window (G. Rousset in F. Roddier (ed.),
        "Adaptive optics in astronomy", 1999; S. Thomas et al., Mon. Not. R. Astron. Soc. 371, 323, 2006):

            fwhm^2 / (8 ln 2 photons) + pixel_scale^2 (read_noise / photons)^2 N^2 (N^2 - 1) / 12,

        where N^2 (N^2 - 1) / 12 is the sum of the squares of the pixels' positions along an axis.
        """
        photons = self.photons * lit
        photon_noise = self.fwhm**2 / (8.0 * np.log(2.0) * photons)
        places = self.pixels**2 * (self.pixels**2 - 1) / 12.0
        read_noise = (self.pixel_scale * self.read_noise / photons) ** 2 * places
        return (photon_noise + read_noise) * (1e6 * ARCSEC) ** 2
