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

    def __init__(self, depth: int, m: int, channels: int, kernel: SquaredExponential, late: int, n_modes: int = 1):
        if late >= m:
            raise ValueError(f"training size {m}: must be above the delay of the targets, {late} steps")
        super().__init__(depth, m, channels, kernel, n_modes)
        self.late = late

    def predict(self, samples: Array, last_targets: Array) -> Array:
        """Take the samples (n_modes, channels) of this step k and the targets (n_modes,) of the windows k - 1 - late.

        Returns the predictions, (n_modes,), NaN until there are m windows before this one. `update` must follow before the
        next sample.
        """
        self.step += 1
        self._last_target = np.zeros(len(samples))  # none for the newest window; `_learn` brings them in when they come
        self._learn(last_targets)
        self._slide(samples)
        self._covariances()
        if not self.ready:
            return np.full(len(samples), np.nan)
        waiting = [(self.step - 1 - i) % self.m for i in range(self.late)]
        columns = (
            np.stack([self._column(slot) for slot in waiting[1:]], axis=1)
            if self.late > 1
            else np.empty((len(samples), 0, self.m))
        )
        return np.array([self._mean(mode, waiting, columns[mode]) for mode in range(len(samples))])

    def _mean(self, mode: int, waiting: list[int], columns: Array) -> float:
        """Prediction of a mode; columns : of N at the windows that wait but the newest, (late - 1, m)."""
        # weights a of the known targets, and of a 1 at each window that waits, the newest first
        parts = np.vstack([self._weights[mode, : 2 * self.late + 1 : 2], columns])
        b, both = self._weights[mode, 1], np.array([self._kappa[mode], self._points.delta[mode]])
        (along, _), over = both @ b, parts @ both.T
        constants = over[:, 1] / (1.0 / self.kernel.variance + both[1] @ b)
        mean = over[:, 0] + constants * (self._newest.delta[mode, 0] - along)
        own = parts[:, waiting] - np.outer(constants, b[waiting])  # weights of the windows that wait: to become zero
        targets = np.linalg.solve(own[1:].T, -own[0]) if self.late > 1 else -own[0] / own[1:].ravel()
        return float(mean[0] + targets @ mean[1:])

    def _learn(self, targets: Array) -> None:
        """Bring in the targets of the newest windows that have them."""
        window = self.step - 1 - self.late
        if window >= self.depth - 1:
            self._weights[:, 0] += np.asarray(targets)[:, None] * self._column(window % self.m)
