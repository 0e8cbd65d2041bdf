"""Settings of the wavefront sensors, and the lenslets and number of modes that those of a Shack-Hartmann sensor resolve."""

from __future__ import annotations

from typing import ClassVar, Literal

import param

from wfsobs.sensors.lenslets import Lenslets, highest_order
from wfsobs.settings.group import Group, UsedWhen, section
from wfsobs.settings.values import Choice, Real, Reals, SettingError, Whole


class LensletArrays(Group):
    """Geometry of the Shack-Hartmann sensors and of their modal fit."""

    lgs_subapertures: Whole = Whole(
        40, (1, 100), "LGS subapertures", "Subapertures of an LGS sensor across the aperture.", softbounds=(2, 60)
    )
    ngs_subapertures: Whole = Whole(
        40,
        (1, 100),
        "NGS subapertures",
        "Subapertures of the NGS sensor across the aperture, such as 40 or 2. Fewer than 3 measure the mean "
        "gradient instead of tip and tilt: an error of 166 nm where these have 529 nm.",
        softbounds=(2, 60),
    )
    fitted_order: Whole = Whole(
        8,
        (1, 12),
        "Fitted radial order",
        "Radial order up to which modes are fitted to the slopes; lower where a sensor has fewer subapertures "
        "across, or cannot resolve so many modes.",
    )
    illumination: Real = Real(0.5, (0.01, 1.0), "Minimum lit fraction", "Minimum lit fraction of a valid subaperture.", step=0.05)
    obscuration: Real = Real(
        0.0,
        (0.0, 0.5),
        "Central obscuration",
        "Diameter of the central obscuration of the sensors over that of the aperture. The ideal projection and "
        "the truth use the whole disc.",
        step=0.01,
    )


class Spots(Group):
    """Light and detectors behind the lenslets, for noise from photons."""

    lgs_photons: Real = Real(
        100.0,
        (0.1, 1e7),
        "LGS photons",
        "Photons that a fully lit subaperture detects in an LGS frame [e-]; not given in the paper.",
        softbounds=(10.0, 1000.0),
    )
    ngs_photons: Real = Real(
        100.0,
        (0.1, 1e7),
        "NGS photons",
        "Photons that a fully lit subaperture detects in an NGS frame [e-]; not given in the paper.",
        softbounds=(10.0, 1000.0),
    )
    read_noise: Real = Real(0.5, (0.0, 100.0), "Read noise", "Read noise of a pixel, rms [e-].", softbounds=(0.0, 10.0), step=0.1)
    lgs_fwhm: Real = Real(
        1.2,
        (0.01, 100.0),
        "LGS spot size",
        "Full width at half maximum of an LGS spot, assumed round [arcsec].",
        softbounds=(0.5, 5.0),
        step=0.1,
    )
    ngs_fwhm: Real = Real(
        0.8,
        (0.01, 100.0),
        "NGS spot size",
        "Full width at half maximum of an NGS spot [arcsec].",
        softbounds=(0.3, 3.0),
        step=0.1,
    )
    pixel_scale: Real = Real(
        0.8, (0.01, 20.0), "Pixel scale", "Angle of a detector pixel on the sky [arcsec].", softbounds=(0.2, 2.0), step=0.1
    )
    pixels: Whole = Whole(
        6, (2, 64), "Pixels of a window", "Side of the window of the centre of gravity, in pixels.", softbounds=(2, 20)
    )


class Sensors(Group):
    """Wavefront sensors: a natural guide star (NGS) and laser guide stars (LGS)."""

    used_when: ClassVar[UsedWhen] = {
        "lgs_noise": ("noise_from", ("nm",)),
        "lgs_noise_per_mode": ("noise_from", ("nm",)),
        "ngs_noise": ("noise_from", ("nm",)),
        "spots": ("noise_from", ("photons",)),
        "gate_level": ("gate", ("reject", "clip")),
    }

    lgs_rate: Real = Real(
        1000.0, (10.0, 100_000.0), "LGS rate 1/T", "Frame rate of the LGS sensors and of the loop [Hz] (paper, Table 3: 1000 Hz)."
    )
    exposure_ratio: Whole = Whole(
        5,
        (1, 100),
        "Exposure ratio n",
        "NGS exposure over LGS exposure, n = T_NGS / T_LGS (paper: 5 ms over 1 ms).",
        softbounds=(1, 20),
    )
    lgs_count: Whole = Whole(2, (1, 16), "Number of LGS", "Number of laser guide stars (paper: 2).")
    lgs_combination: Choice = Choice(
        ["mean", "minimum-variance"],
        "LGS combined by",
        "Guide-star combination. mean: the mean over the LGS (paper); minimum-variance: the linear combination of "
        "all their modes that is nearest to the disturbance on the axis, from the covariances of the model.",
    )
    kind: Choice = Choice(
        ["shack-hartmann", "zernike"],
        "Kind",
        "Sensor of frozen flow. shack-hartmann: modes fitted to slopes; zernike: the modes themselves. Turbulence "
        "from other sources is measured without a sensor model.",
    )
    noise_from: Choice = Choice(
        ["nm", "photons"],
        "Noise from",
        "nm: white noise of the rms below in every mode; photons: photon and read noise of the slopes of the "
        "Shack-Hartmann sensors, correlated between modes.",
    )
    lgs_noise: Real = Real(
        0.02,
        (0.0, 10.0),
        "LGS noise",
        "White measurement noise of each LGS and mode, rms [um], for noise from nm; not given in the paper.",
        softbounds=(0.0, 0.2),
        step=0.001,
    )
    lgs_noise_per_mode: Reals = Reals(
        [],
        (0.0, 1e4),
        (0, 64),
        "LGS noise per mode",
        "Noise of each LGS per mode, rms [um], where modes differ; modes beyond the list have the noise above.",
    )
    ngs_noise: Real = Real(
        0.01,
        (0.0, 10.0),
        "NGS noise",
        "White measurement noise of an NGS frame and mode, rms [um], for noise from nm; not given in the paper.",
        softbounds=(0.0, 0.2),
        step=0.001,
    )
    lgs_low_frequency_rms: Real = Real(
        0.049,
        (0.0, 10.0),
        "LGS low-frequency error",
        "Slow error of each LGS in tip and tilt, rms [um], independent between LGS. It stands for cone effect and "
        "uplink turbulence where turbulence is not frozen flow. 0.049 um is the cone effect of one layer at 8 km "
        "and a guide star at 90 km.",
        softbounds=(0.0, 0.2),
        step=0.005,
    )
    lgs_altitude: Real = Real(
        90_000.0,
        (1000.0, 1e6),
        "LGS altitude H",
        "Height of the laser guide stars above the telescope [m], for frozen flow: a beam is narrower by 1 - h / H "
        "in a layer at height h.",
        softbounds=(80_000.0, 100_000.0),
        step=1000.0,
    )
    lgs_radius: Real = Real(
        0.0,
        (0.0, 120.0),
        "LGS asterism, radius",
        "Angle between each LGS and the axis [arcsec], for frozen flow; 0 is on the axis.",
        softbounds=(0.0, 70.0),
        step=0.5,
    )
    lgs_angle: Real = Real(
        0.0,
        (-360.0, 360.0),
        "LGS asterism, first at",
        "Direction of the first LGS from the axis of tip to that of tilt [deg]; the others are evenly spaced.",
        softbounds=(-180.0, 180.0),
        step=5.0,
    )
    ngs_direction: Reals = Reals(
        [0.0, 0.0],
        (-120.0, 120.0),
        (2, 2),
        "NGS direction",
        "Direction of the NGS along the axes of tip and tilt [arcsec], for frozen flow; the truth is on the axis.",
    )
    gate: Choice = Choice(
        ["reject", "clip", "off"],
        "Outliers",
        "Measurements of a loaded record or a stream that their own past excludes. reject: they are missing; clip: they "
        "are taken at the level below; off: they are taken as they are. A simulation has none.",
    )
    gate_level: Real = Real(
        3.6,
        (2.5, 100.0),
        "Outliers beyond",
        "Deviation of a measurement from its prediction beyond which it is an outlier where 1 % are, in standard deviations; "
        "up to 1.4 times this where fewer are.",
        softbounds=(3.0, 10.0),
        step=0.1,
    )
    tip_tilt_indetermination: param.Boolean[bool] = param.Boolean(
        False,
        label="Tip-tilt indetermination",
        doc="The LGS cannot see turbulent tip and tilt, as in reality; off in the paper, whose simulator does not model it.",
    )
    lenslets: LensletArrays = section(
        LensletArrays, "Shack-Hartmann", "Lenslets of the Shack-Hartmann sensors, and the fit to their slopes."
    )
    spots: Spots = section(Spots, "Spots", "Light and detectors of the Shack-Hartmann sensors, for noise from photons.")


Kind = Literal["lgs", "ngs"]


def fit_lenslets(settings: LensletArrays, kind: Kind, diameter: float, min_order: int) -> tuple[Lenslets, int]:
    """Return the lenslets on an LGS or on the NGS, and the radial order fitted to their slopes.

    Parameters
    ----------
    settings : LensletArrays
        Settings of the sensors.
    kind : {"lgs", "ngs"}
        Which sensor.
    diameter : float
        Aperture diameter [m].
    min_order : int
        Minimum radial order.

    Returns
    -------
    lenslets : Lenslets
        Geometry.
    order : int
        Radial order of the fit.

    Raises
    ------
    SettingError
        The slopes determine fewer orders than `min_order`.
    """
    across = settings.lgs_subapertures if kind == "lgs" else settings.ngs_subapertures
    lenslets = Lenslets(diameter, across, settings.illumination, settings.obscuration)
    name = f"sensors.lenslets.{kind}_subapertures = {across}"
    try:
        order = highest_order(lenslets, settings.fitted_order)
    except ValueError as error:
        raise SettingError(f"{name}: {error}") from None
    if order < min_order:
        raise SettingError(
            f"{name}: with sensors.lenslets.fitted_order = {settings.fitted_order} these fit modes up to radial "
            f"order {order}, fewer than telescope.radial_order = {min_order}"
        )
    return lenslets, order
