"""Linear filters whose matrices repeat every few steps, run over a whole record without a loop per step.

    x[k+1] = F_j x[k] + G_j v[k],    e[k] = H_j x[k] + J_j v[k],    j = k mod cycle

A block of steps is one linear map of the state at its start and of its inputs ("lifting"), so a record
is a few matrix products over all blocks, and a loop over the states between them. Nothing is
diagonalised: near-defective matrices are as good as any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wfsobs.typing import Array

FilterStep = tuple[Array, Array, Array, Array]
"""(F, G, H, J) of one step: F (n, n), G (n, m), H (p, n), J (p, m)."""

BLOCK = 48
"""Approximate steps per block; the work per step grows with it, the number of blocks falls."""


@dataclass(frozen=True)
class PeriodicFilter:
    """Linear filter with a cycle of matrices.

    Attributes
    ----------
    steps : sequence of tuple
        One tuple (F, G, H, J) per step of the cycle.
    first : tuple or None
        Step 0, where it is not one of the cycle.
    """

    steps: Sequence[FilterStep]
    first: FilterStep | None = None

    def cycle_matrix(self) -> Array:
        """Return the product of the F over one cycle, (n, n); the filter is stable if its spectral radius is below 1."""
        out = np.eye(self.steps[0][0].shape[0])
        for F, *_ in self.steps:
            out = F @ out
        return out

    def run(self, v: Array, x0: Array | None = None, *, since: int = 0) -> Array:
        """Filter the inputs v.

        Parameters
        ----------
        v : Array
            Inputs, (n_steps, m).
        x0 : Array, optional
            State before the first of these inputs, (n,); zero by default.
        since : int
            First step whose outputs are wanted.

        Returns
        -------
        Array
            Outputs e, (n_steps - since, p).
        """
        if self.first is not None:
            F, G, H, J = self.first
            x, after = np.zeros(F.shape[1]) if x0 is None else x0, G @ v[0]
            later = PeriodicFilter(self.steps).run(v[1:], F @ x + after, since=max(since - 1, 0))
            return later if since > 0 else np.vstack([H @ x + J @ v[0], later])
        n_steps, cycle = len(v), len(self.steps)
        length = cycle * max(1, round(BLOCK / cycle))
        F, G, H, J = self.lift(length)
        inputs = np.zeros((-(-n_steps // length), G.shape[1]))  # of every block
        inputs.reshape(-1)[: v.size] = v.ravel()
        x, states = np.zeros(len(F)) if x0 is None else x0, np.empty((len(inputs), len(F)))
        for state, driven in zip(states, inputs @ G.T, strict=True):
            state[:] = x
            x = F @ x + driven
        left = since // length  # blocks without wanted outputs
        out = states[left:] @ H.T + inputs[left:] @ J.T
        return out.reshape(-1, len(H) // length)[since - left * length : n_steps - left * length]

    def lift(self, length: int) -> tuple[Array, Array, Array, Array]:
        """Return the map of one block: (F, G, H, J) with all the inputs and outputs of the block stacked."""
        F0, G0, H0, _ = self.steps[0]
        n, m, p = F0.shape[0], G0.shape[1], H0.shape[0]
        state, from_inputs = np.eye(n), np.zeros((n, length * m))
        H, J = np.zeros((length * p, n)), np.zeros((length * p, length * m))
        for i in range(length):
            Fi, Gi, Hi, Ji = self.steps[i % len(self.steps)]
            rows, columns = slice(i * p, (i + 1) * p), slice(i * m, (i + 1) * m)
            before = slice(i * m)
            H[rows] = Hi @ state
            J[rows, before] = Hi @ from_inputs[:, before]
            J[rows, columns] = Ji
            state, from_inputs[:, before] = Fi @ state, Fi @ from_inputs[:, before]
            from_inputs[:, columns] = Gi
        return state, from_inputs, H, J
