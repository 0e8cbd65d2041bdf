"""The one array type: real numbers, in practice always float64; and masked numbers as such an array."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]
"""A numpy array of float64; shapes and units are in the docstrings."""


def fill_masked(values: ArrayLike) -> Array:
    """Return values, also a list of masked arrays, as an array: NaN where they are masked. Raises TypeError, ValueError."""
    if isinstance(values, (list, tuple)) and any(hasattr(x, "mask") for x in values):
        values = [fill_masked(x) for x in values]
    raw, mask = np.asarray(values), getattr(values, "mask", None)
    return np.where(mask, np.nan, raw) if isinstance(mask, np.ndarray) else raw
