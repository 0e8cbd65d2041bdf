"""The one array type: real numbers, in practice always float64."""

from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]
"""A numpy array of float64; shapes and units are in the docstrings."""
