"""Lines of a report, read as its script reads them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def read_levels(raw: bytes) -> NDArray[np.int64]:
    """Return the levels of a line, from differences folded at zero whose low bytes come before the high ones."""
    low, high = np.frombuffer(raw, dtype=np.uint8).astype(int).reshape(2, -1)
    change = low + 256 * high
    return np.cumsum(np.where(change % 2, -(change + 1) // 2, change // 2)) % 65_536
