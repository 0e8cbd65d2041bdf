"""Regression on a stream whose targets come late, as those of a prediction do.

The target of the window that ends at step j, what will be `late` steps on, is known only at step j + 1 + late. Until then
the window must not count; but leaving a point out of a Gaussian process is the same as giving it the target that makes its own
weight zero, so it can sit in its slot with that target, and the sliding of `SlidingRegression` goes on as it is.
"""

from __future__ import annotations

import numpy as np

from wfsobs.arrays import Array
from wfsobs.observers.gpr_stream import SlidingRegression
from wfsobs.observers.kernels import SquaredExponential


class LateRegression(SlidingRegression):
    """Regression on the windows before the newest m, `late` of the m being without a target still.

    Raises ValueError if no window would have one.
    """

    def __init__(self, depth: int, m: int, channels: int, kernel: SquaredExponential, late: int):
        if late >= m:
            raise ValueError(f"training size {m}: targets known {late} steps late need more")
        super().__init__(depth, m, channels, kernel)
        self.late = late

    def predict(self, sample: Array, last_target: float) -> float:
        """Take the sample of this step k and the target of window k - 1 - late; return the prediction.

        NaN until there are m windows before this one. `update` must follow before the next sample.
        """
        k = self.step + 1
        known = k - 1 - self.late
        if known >= self.depth - 1:
            self._weights[0] += last_target * self._column(known)
        super().predict(sample, 0.0)
        if not self.ready:
            return float("nan")
        waiting = [(k - 1 - i) % self.m for i in range(self.late)]
        a, b, _ = self._weights
        parts = np.vstack([a, *(self._column(slot) for slot in waiting)])  # of the known targets, of a 1 at each that waits
        delta = self._points.delta
        constants = parts @ delta / (1.0 / self.kernel.variance + b @ delta)
        weights = parts - np.outer(constants, b)
        targets = np.linalg.solve(weights[1:, waiting].T, -weights[0, waiting])
        mean = weights @ self._kappa + constants * self._newest.delta[0]
        return float(mean[0] + targets @ mean[1:])

    def _column(self, window: int) -> Array:
        """What a target of 1 of that window adds to the weights a."""
        s, N = window % self.m, self._N
        return np.concatenate([N[s, :s], N[s:, s]])
