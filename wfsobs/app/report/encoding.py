"""Arrays in the file of a report: each once, in 16 bits a point."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wfsobs.app.report.grid import Floats


class Pool:
    """Arrays in the file, each once however many states share it."""

    def __init__(self) -> None:
        self.number: dict[bytes, int] = {}

    def add(self, content: bytes) -> int:
        """Add the bytes of an array; return its number."""
        return self.number.setdefault(content, len(self.number))

    def all(self) -> list[bytes]:
        """Every array, in order."""
        return list(self.number)


LEVELS = 65_534
"""Steps between the lowest and the highest point of a line; one number more stands for none."""


def encode(line: Sequence[float] | Floats, pool: Pool, logarithmic: bool = False) -> list[float]:
    """Write a line in 16 bits a point: [number in the pool, lowest, step]; of its decimal logarithm if asked for."""
    x = np.asarray(line, dtype=np.float64)
    if logarithmic:
        x = np.log10(np.where(x > 0, x, np.nan))
    known = np.isfinite(x)
    low, high = (float(x[known].min()), float(x[known].max())) if known.any() else (0.0, 0.0)
    step = (high - low) / LEVELS or 1.0
    levels = np.full(x.size, LEVELS + 1, dtype="<u2")
    levels[known] = np.round((x[known] - low) / step).astype("<u2")
    return [pool.add(levels.tobytes()), low, step]
