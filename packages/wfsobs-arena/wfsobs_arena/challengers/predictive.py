"""Predictive control by recursive least squares: what commands are to act against is predicted at once.

Without the commands the loop measures z, and the mirror of weights a[j] acts on z[k+1], ..., z[k+n] by a[1] u[k], ..., a[n] u[k].
The command that leaves least is the prediction of their weighed mean,

    u[k] = -W h[k],    W h[k] ~ a[1] z[k+1] + ... + a[n] z[k+n],    h[k] = (z[k], z[k-1], ..., z[k-L+1]),

with the W of least squares over all that is known by step k, the past forgotten exponentially: for the paper's delay of two
frames, z two steps ahead. Predictive control by empirical orthogonal functions (Guyon and Males 2017, arXiv:1707.00570) and,
without its penalty on commands, data-driven predictive control (Haffert et al. 2021, JATIS 7, 029001) are this with a batch. It
is told nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from wfsobs.control.base import Controller, Settings
from wfsobs.control.mirror import Mirror, Plant
from wfsobs.control.step import StepLaw, push_row
from wfsobs.observers.step import StepError
from wfsobs.observers.stepping import Saved
from wfsobs.prior import Prior
from wfsobs.record import Sampling
from wfsobs.typing import Array
from wfsobs_arena.challengers.base import Challenger
from wfsobs_arena.challengers.rls import MEMORY, ORDER, Rls

PENALTY = 1e-6
"""Of the squares of the weights at the start [um^2]."""


class PredictiveLaw(StepLaw):
    """The law of all modes, learnt one frame at a time.

    Parameters
    ----------
    mirror : Mirror
        Whose weights make the output of the regression.
    dt : float
        Step [s].
    n_modes : int
        Number of modes.
    """

    def __init__(self, mirror: Mirror, dt: float, n_modes: int):
        self._taps = mirror.taps[1:]
        self._new = lambda: Rls(ORDER * n_modes, n_modes, float(np.exp(-dt / MEMORY)), PENALTY)
        self.fit, self._recent = self._new(), np.zeros((ORDER + len(self._taps), n_modes))  # newest first

    def see_stars(self, count: int | None) -> None:
        """Take no notice: it learns from the mean as it is."""

    def command(self, z: Array, ngs: Array | None, forward: Array) -> Array:
        """Learn from the newest z (n_modes,), the one before where it is missing, and return the command (n_modes,) [um]."""
        lag = len(self._taps)
        push_row(self._recent, np.where(np.isnan(z), self._recent[0], z))
        self.fit.learn(self._recent[lag:].ravel(), self._taps[::-1] @ self._recent[:lag])
        return forward - self._recent[:ORDER].ravel() @ self.fit.W

    def tell(self, command: Array, forward: Array) -> None:
        """Take no notice: z holds none of the commands."""

    def amend(self, difference: Array) -> None:
        """Take no notice, as of what is told."""

    def take_over(self, old: Any) -> None:
        """Go on from what another law has learnt."""
        if not isinstance(old, PredictiveLaw) or old._recent.shape != self._recent.shape:
            raise StepError("the laws are of another kind")
        self.load(old.save())

    def reset(self) -> None:
        """Forget all."""
        self.fit, self._recent[...] = self._new(), 0.0

    def save(self) -> Saved:
        """Return a copy of the state."""
        return {"P": self.fit.P.copy(), "W": self.fit.W.copy(), "recent": self._recent.copy()}

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        self.fit.P[...], self.fit.W[...], self._recent[...] = state["P"], state["W"], state["recent"]


def predictive_law(_prior: Prior, plant: Plant, _settings: Settings, sampling: Sampling) -> StepLaw:
    """Return the law before its first frame."""
    return PredictiveLaw(plant.mirror, plant.dt, sampling.n_modes)


PREDICTIVE_RLS = Challenger(
    Controller(
        "predictive-rls",
        "Predictive control, least squares",
        help="minus what recursive least squares on 20 measurements of all modes predicts",
        step_law=predictive_law,
    ),
    ("closed-loop",),
    "Guyon and Males 2017, arXiv:1707.00570; Haffert et al. 2021, JATIS 7, 029001",
)
