"""From the settings of a Shack-Hartmann sensor to its lenslets and the number of modes that they resolve."""

from __future__ import annotations

from typing import Literal

from wfsobs.scenario.groups.sensors import LensletArrays
from wfsobs.sensors.lenslets import Lenslets
from wfsobs.sensors.reconstructor import highest_order
from wfsobs.settings.errors import SettingError

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
