"""Estimates of least variance where some of several alike inputs are missing, from the states of those that are there.

Every input goes through the same filters. The states are kept for combinations of the inputs, the rows of an invertible matrix;
those of any input are combinations of them. What is there is taken as the mean of its inputs and orthonormal differences: by
themselves they are so alike that their covariance is near to singular.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import block_diag, helmert

from wfsobs.signal.joint_states import LeastVariance, in_two_threads
from wfsobs.typing import Array

SETS = 16
"""Sets of inputs whose factors are kept; others are made anew."""

Present = tuple[bool, ...]
"""Which inputs are there."""


class Selection(NamedTuple):
    """What is taken of all states.

    states : combinations of all states, (n, n_states), in every phase
    least  : estimates that are linear in them, in every phase
    """

    states: Sequence[Array]
    least: Sequence[LeastVariance]


class PresentInputs:
    """Estimates of least variance from the states of the inputs that are there, and of others that always are.

    Parameters
    ----------
    covariances : sequence of Array
        Of all states in every phase, (n_states, n_states) [um^2]: of the first combination of the inputs, of the second, ..., and
        of the others.
    basis : Array
        Weights of the inputs in their combinations, (n_inputs, n_inputs).
    n_fast : int
        States of the inputs. Of these alone are the estimates of one more phase, the last.
    """

    def __init__(self, covariances: Sequence[Array], basis: Array, n_fast: int):
        self._covariances, self._to_each, self._n_fast = covariances, np.linalg.inv(basis), n_fast
        self.selection: Final = lru_cache(SETS)(self._select)

    def estimate(self, targets: Sequence[tuple[Array, Array]], present: Present) -> tuple[Array, Array]:
        """Return weights of all states and standard deviations, (n_phases, n_targets, n_states) and (n_phases, n_targets).

        targets : covariances of targets and states, and variances of the targets, of every phase or the first of them
        """
        weights, sd = [], []
        for (cross, variance), states, least in zip(targets, *self.selection(present), strict=False):
            of_states = cross @ states.T
            found = least.weights(of_states) if least.size else of_states
            weights.append(found @ states)
            sd.append(np.sqrt(np.maximum(variance - np.sum(found * of_states, axis=1), 0.0)))
        return np.array(weights), np.array(sd)

    def _select(self, present: Present) -> Selection:
        there, n, last = np.flatnonzero(present), self._n_fast, self._covariances[-1]
        if there.size == len(present):
            whole = np.eye(len(last))
            found = in_two_threads(LeastVariance, (*self._covariances, last[:n, :n]))
            return Selection([whole] * len(self._covariances) + [whole[:n]], found)
        mean = np.full((1, there.size), 1.0 / max(there.size, 1))
        among = np.vstack([mean, helmert(there.size)]) @ self._to_each[there] if there.size else np.empty((0, len(present)))
        fast = np.kron(among, np.eye(n // len(present)))
        both = block_diag(fast, np.eye(len(self._covariances[0]) - n))
        alone = both[: len(fast)]
        of_phases = [both @ one @ both.T for one in self._covariances] + [alone @ last @ alone.T]
        return Selection([both] * len(self._covariances) + [alone], in_two_threads(LeastVariance, of_phases))
