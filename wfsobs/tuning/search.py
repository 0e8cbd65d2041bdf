"""A search for the least of a function that is costly and may fail: a Latin hypercube, then Nelder and Mead from its best."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize
from scipy.stats import qmc

from wfsobs.typing import Array

DESIGN = 3
"""One evaluation in so many goes to the hypercube."""
SIMPLEX = (0.15, 0.03)
"""Sizes of the first simplex, of one descent and of a second from where that ends."""
CLOSE, LEVEL = 2e-3, 1e-4
"""Where a descent ends: simplex of this size, values this near to each other (relative)."""


class NoEvaluationLeft(Exception):
    """No evaluation is left."""


def minimise(f: Callable[[Array], float], start: Array, evaluations: int, rng: np.random.Generator) -> None:
    """Ask f at points (d,) of the unit cube, `start` first, until it raises Spent or nothing is left to gain.

    f gives infinity where it fails; it keeps what it was asked.
    """
    try:
        points = [start, *qmc.LatinHypercube(len(start), seed=rng).random(evaluations // DESIGN)]
        values = [f(point) for point in points]
        for size in SIMPLEX:
            i = int(np.argmin(values))
            if not np.isfinite(values[i]):
                return
            found = minimize(
                f,
                points[i],
                method="Nelder-Mead",
                bounds=[(0.0, 1.0)] * len(start),
                options={"initial_simplex": _simplex(points[i], size), "xatol": CLOSE, "fatol": LEVEL * values[i]},
            )
            points.append(found.x)
            values.append(float(found.fun))
    except NoEvaluationLeft:
        return


def _simplex(point: Array, size: float) -> Array:
    """Return the point, and one beside it along every axis, on the side with more room."""
    return np.vstack([point, point + size * np.diag(np.where(point < 0.5, 1.0, -1.0))])
