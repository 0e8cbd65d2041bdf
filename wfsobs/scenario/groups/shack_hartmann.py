"""Settings of Shack-Hartmann sensors: their lenslets, and the spots behind them."""

from __future__ import annotations

from wfsobs.settings.group import Group
from wfsobs.settings.parameters import Real, Whole


class LensletArrays(Group):
    """Geometry of the Shack-Hartmann sensors and of their modal fit."""

    lgs_subapertures = Whole(
        40,
        bounds=(1, 100),
        softbounds=(2, 60),
        label="LGS subapertures",
        doc="Subapertures of an LGS sensor across the aperture.",
    )
    ngs_subapertures = Whole(
        40,
        bounds=(1, 100),
        softbounds=(2, 60),
        label="NGS subapertures",
        doc="Subapertures of the NGS sensor across the aperture, such as 40 or 2. Fewer than 3 measure the mean "
        "gradient instead of tip and tilt: an error of 166 nm where these have 529 nm.",
    )
    fitted_order = Whole(
        8,
        bounds=(1, 12),
        label="Fitted radial order",
        doc="Radial order up to which modes are fitted to the slopes; lower where a sensor has fewer subapertures "
        "across, or cannot resolve so many modes.",
    )
    illumination = Real(
        0.5,
        bounds=(0.01, 1.0),
        step=0.05,
        label="Minimum lit fraction",
        doc="Minimum lit fraction of a valid subaperture.",
    )
    obscuration = Real(
        0.0,
        bounds=(0.0, 0.5),
        step=0.01,
        label="Central obscuration",
        doc="Diameter of the central obscuration of the sensors over that of the aperture. The ideal projection and "
        "the truth use the whole disc.",
    )


class Spots(Group):
    """Light and detectors behind the lenslets, for noise from photons."""

    lgs_photons = Real(
        100.0,
        bounds=(0.1, 1e7),
        softbounds=(10.0, 1000.0),
        label="LGS photons",
        doc="Photons that a fully lit subaperture detects in an LGS frame [e-]; not given in the paper.",
    )
    ngs_photons = Real(
        100.0,
        bounds=(0.1, 1e7),
        softbounds=(10.0, 1000.0),
        label="NGS photons",
        doc="Photons that a fully lit subaperture detects in an NGS frame [e-]; not given in the paper.",
    )
    read_noise = Real(
        0.5, bounds=(0.0, 100.0), softbounds=(0.0, 10.0), step=0.1, label="Read noise", doc="Read noise of a pixel, rms [e-]."
    )
    lgs_fwhm = Real(
        1.2,
        bounds=(0.01, 100.0),
        softbounds=(0.5, 5.0),
        step=0.1,
        label="LGS spot size",
        doc="Full width at half maximum of an LGS spot, assumed round [arcsec].",
    )
    ngs_fwhm = Real(
        0.8,
        bounds=(0.01, 100.0),
        softbounds=(0.3, 3.0),
        step=0.1,
        label="NGS spot size",
        doc="Full width at half maximum of an NGS spot [arcsec].",
    )
    pixel_scale = Real(
        0.8,
        bounds=(0.01, 20.0),
        softbounds=(0.2, 2.0),
        step=0.1,
        label="Pixel scale",
        doc="Angle of a detector pixel on the sky [arcsec].",
    )
    pixels = Whole(
        6,
        bounds=(2, 64),
        softbounds=(2, 20),
        label="Pixels of a window",
        doc="Side of the window of the centre of gravity, in pixels.",
    )
