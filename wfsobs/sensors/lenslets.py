"""The lenslet array of a Shack-Hartmann sensor: the part of the pupil that each subaperture sees.

The pupil is cut into square cells, several to a subaperture, each lit or dark by its centre. A slope is the mean gradient
of the phase over the lit cells of its subaperture, so that one on the edge sees no phase from outside the pupil.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from wfsobs.typing import Array


@dataclass(frozen=True)
class Lenslets:
    """A square array of lenslets over a round aperture.

    Attributes
    ----------
    diameter : float
        Aperture diameter [m].
    across : int
        Subapertures along a side.
    illumination : float
        Minimum lit fraction of a valid subaperture.
    obscuration : float
        Diameter of the central obscuration over that of the aperture.
    cells : int
        Minimum number of cells across the aperture: 160 are 5 cm on 8 m.
    """

    diameter: float = 8.0
    across: int = 40
    illumination: float = 0.5
    obscuration: float = 0.0
    cells: int = 160

    @property
    def per_side(self) -> int:
        """Cells along a side of a subaperture: an even number."""
        return 2 * -(-self.cells // (2 * self.across))

    @property
    def pitch(self) -> float:
        """Side of a cell [m]."""
        return self.diameter / (self.across * self.per_side)

    @cached_property
    def centres(self) -> Array:
        """Coordinates of the cell centres along either axis, (n,) [m]."""
        n = self.across * self.per_side
        return (np.arange(n) - (n - 1) / 2) * self.pitch

    @cached_property
    def lit(self) -> Array:
        """Cells inside the pupil: bool (n, n), y along the rows."""
        r = np.hypot(self.centres[:, None], self.centres[None, :])
        return (r <= self.diameter / 2) & (r >= self.obscuration * self.diameter / 2)

    @cached_property
    def fraction(self) -> Array:
        """Lit fraction of every subaperture: (across, across), y along the rows."""
        return self._blocks(self.lit.astype(float)).mean(axis=(-3, -1))

    @cached_property
    def valid(self) -> Array:
        """Subapertures that are lit enough: bool (across, across)."""
        return self.fraction >= max(self.illumination, 1e-9)

    @property
    def count(self) -> int:
        """Number of valid subapertures."""
        return int(self.valid.sum())

    def mean(self, cells: Array) -> Array:
        """Average over the lit cells of the valid subapertures: (..., n, n) -> (..., count)."""
        sums = self._blocks(cells * self.lit).sum(axis=(-3, -1))
        return sums[..., self.valid] / (self.fraction[self.valid] * self.per_side**2)

    def spread(self, weights: Array) -> Array:
        """Apply the transpose of `mean`: weights of slopes (..., count) to weights of cells (..., n, n)."""
        shares = np.zeros((*weights.shape[:-1], *self.valid.shape))
        shares[..., self.valid] = weights / (self.fraction[self.valid] * self.per_side**2)
        return shares.repeat(self.per_side, axis=-2).repeat(self.per_side, axis=-1) * self.lit

    def slopes(self, phase: Callable[[Array, Array], Array]) -> Array:
        """Return the mean gradients [phase/m] of phase(x, y), x and y in [m]: (..., 2 count), those along x first.

        The mean of a derivative over a cell is the difference of the means over two of its edges, and these come from
        two Gauss points: exact for cubics.
        """
        edges = (np.arange(len(self.centres) + 1) - len(self.centres) / 2) * self.pitch
        offset = self.pitch / np.sqrt(12.0)
        below, above = self.centres - offset, self.centres + offset
        on_columns = phase(edges[None, :], below[:, None]) + phase(edges[None, :], above[:, None])
        on_rows = phase(below[None, :], edges[:, None]) + phase(above[None, :], edges[:, None])
        along_x, along_y = np.diff(on_columns, axis=-1) / (2 * self.pitch), np.diff(on_rows, axis=-2) / (2 * self.pitch)
        return np.concatenate([self.mean(along_x), self.mean(along_y)], axis=-1)

    def _blocks(self, cells: Array) -> Array:
        shape = (self.across, self.per_side, self.across, self.per_side)
        return cells.reshape(*cells.shape[:-2], *shape)
