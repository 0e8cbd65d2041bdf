"""The Zernike modes that columns of an array stand for."""

from __future__ import annotations

from typing import NamedTuple


class Mode(NamedTuple):
    """One Zernike mode: name, Noll index, radial order n(i) of the paper's eq. 1d."""

    name: str
    noll: int
    radial_order: int


TIP_TILT = (Mode("tip", 2, 1), Mode("tilt", 3, 1))
