"""Regression on a stream whose targets come late, as those of a prediction do.

The target of the window that ends at step j, what will be `late` steps on, is known only at step j + 1 + late. Until then
the window must not count; but leaving a point out of a Gaussian process is the same as giving it the target that makes its own
weight zero, so it can sit in its slot with that target, and the sliding of `SlidingRegression` goes on as it is.
"""

from __future__ import annotations

import numpy as np

from wfsobs.observers.gpr.kernels import SquaredExponential
from wfsobs.observers.gpr.sliding_regression import SlidingRegression
from wfsobs.typing import Array


class LateRegression(SlidingRegression):
    """Regression on the windows before the newest m, `late` of the m being without a target still.

    Raises ValueError if no window would have one.
    """

    def __init__(self, depth: int, m: int, channels: int, kernel: SquaredExponential, late: int):
        if late >= m:
            raise ValueError(f"training size {m}: must be above the delay of the targets, {late} steps")
        super().__init__(depth, m, channels, kernel)
        self.late = late

    def predict(self, sample: Array, last_target: float) -> float:
        """Take the sample of this step k and the target of window k - 1 - late; return the prediction.

        NaN until there are m windows before this one. `update` must follow before the next sample.
        """
        self.step += 1
        self._last_target = 0.0  # none for the newest window; `_learn` brings them in when they come
        self._learn(last_target)
        self._slide(sample)
        self._covariances()
        if not self.ready:
            return float("nan")
        waiting = [(self.step - 1 - i) % self.m for i in range(self.late)]
        # weights a of the known targets, and of a 1 at each window that waits, the newest first
        parts = self._weights[: 2 * self.late + 1 : 2]
        if self.late > 1:
            parts = np.vstack([parts, *(self._column(slot) for slot in waiting[1:])])
        b, both = self._weights[1], np.array([self._kappa, self._points.delta])
        (along, _), over = both @ b, parts @ both.T
        constants = over[:, 1] / (1.0 / self.kernel.variance + both[1] @ b)
        mean = over[:, 0] + constants * (self._newest.delta[0] - along)
        own = parts[:, waiting] - np.outer(constants, b[waiting])  # weights of the windows that wait: to become zero
        targets = np.linalg.solve(own[1:].T, -own[0]) if self.late > 1 else -own[0] / own[1:].ravel()
        return float(mean[0] + targets @ mean[1:])

    def _learn(self, target: float) -> None:
        """Bring in the target of the newest window that has one."""
        window = self.step - 1 - self.late
        if window >= self.depth - 1:
            self._weights[0] += target * self._column(window % self.m)

    def _column(self, s: int) -> Array:
        """Return the effect of a target of 1 in slot s on the weights a."""
        return np.concatenate([self._N[s, :s], self._N[s:, s]])
