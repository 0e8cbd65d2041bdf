"""What the settings of a Shack-Hartmann sensor amount to: its lenslets, and how many modes they tell apart."""

from __future__ import annotations

from typing import Literal

from wfsobs.scenario.groups.shack_hartmann import LensletArrays
from wfsobs.sensors.lenslets import Lenslets
from wfsobs.sensors.reconstructor import highest_order
from wfsobs.settings.group import SettingError

Kind = Literal["lgs", "ngs"]


def fit(settings: LensletArrays, kind: Kind, diameter: float, wanted: int) -> tuple[Lenslets, int]:
    """The lenslets on an LGS or on the NGS behind an aperture [m], and the radial order fitted to their slopes.
    Raises SettingError where that is less than the order wanted."""
    across = settings.lgs_subapertures if kind == "lgs" else settings.ngs_subapertures
    lenslets = Lenslets(diameter, across, settings.illumination, settings.obscuration)
    name = f"sensors.lenslets.{kind}_subapertures = {across}"
    try:
        order = highest_order(lenslets, settings.fitted_order)
    except ValueError as error:
        raise SettingError(f"{name}: {error}") from None
    if order < wanted:
        raise SettingError(
            f"{name}: with sensors.lenslets.fitted_order = {settings.fitted_order} these fit modes up to radial "
            f"order {order}, fewer than telescope.radial_order = {wanted}"
        )
    return lenslets, order
