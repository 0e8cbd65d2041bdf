"""The Zernike modes in the columns of an array."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

from wfsobs.sensors.zernike import mode_name, noll, up_to_order

HIGHEST_ORDER = 6


class Mode(NamedTuple):
    """One Zernike mode: name, Noll index, radial order n(i) of the paper's eq. 1d."""

    name: str
    noll: int
    radial_order: int


@cache
def modes_up_to(order: int) -> tuple[Mode, ...]:
    """Return all modes up to a radial order, without piston, in Noll's order.

    >>> [mode.name for mode in modes_up_to(2)]
    ['tip', 'tilt', 'defocus', 'oblique astigmatism', 'vertical astigmatism']
    """
    return tuple(Mode(mode_name(j), j, noll(j)[0]) for j in up_to_order(order))


def order_of(n_modes: int) -> int | None:
    """Return the smallest radial order that has so many modes, None where there is none.

    >>> order_of(2), order_of(5), order_of(28)
    (1, 2, None)
    """
    return next((order for order in range(1, HIGHEST_ORDER + 1) if len(modes_up_to(order)) >= n_modes), None)


TIP_TILT = modes_up_to(1)
MODE_NAMES = tuple(mode.name for mode in modes_up_to(HIGHEST_ORDER))
"""Of the columns of an array of any width."""
