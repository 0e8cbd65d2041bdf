"""Linear filters whose matrices repeat every few steps, run over a whole record without a loop per step.

    x[k+1] = F_j x[k] + G_j v[k],    e[k] = H_j x[k] + J_j v[k],    j = k mod cycle

A block of steps is one linear map of the state at its start and of its inputs ("lifting"), so a record
is a few matrix products over all blocks, and the block states are the same kind of recursion with one
step per block. Nothing is diagonalised: near-defective matrices are as good as any other.
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
class Recursion:
    """A linear filter as steps (F, G, H, J) that repeat, after a step 0 of its own where there is one."""

    steps: Sequence[FilterStep]
    first: FilterStep | None = None

    @property
    def cycle(self) -> PeriodicFilter:
        """The steps that repeat."""
        return PeriodicFilter(self.steps)

    def run(self, v: Array) -> Array:
        """Return the outputs at every step of a record v (n_steps, m) from rest, (n_steps, p)."""
        if self.first is None:
            return self.cycle.run(v[:, :, None])[:, :, 0]
        _, G, _, J = self.first
        return np.vstack([J @ v[0], self.cycle.run(v[1:, :, None], (G @ v[0])[:, None])[:, :, 0]])


@dataclass(frozen=True)
class PeriodicFilter:
    """Linear filter with a cycle of matrices.

    Attributes
    ----------
    steps : sequence of tuple
        One tuple (F, G, H, J) per step of the cycle.
    """

    steps: Sequence[FilterStep]

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
            Inputs, (n_steps, m, n_columns); every column is a signal of its own.
        x0 : Array, optional
            Initial state, (n, n_columns); zero by default.
        since : int
            First step whose outputs are wanted.

        Returns
        -------
        Array
            Outputs e, (n_steps - since, p, n_columns).
        """
        n_steps, m, columns = v.shape
        cycle = len(self.steps)
        length = cycle * max(1, round(BLOCK / cycle))
        blocks = -(-n_steps // length)
        padded = np.zeros((blocks * length, m, columns))
        padded[:n_steps] = v
        # (inputs of a block, all blocks and columns)
        inputs = padded.reshape(blocks, length * m, columns).transpose(1, 0, 2).reshape(length * m, -1)
        F, G, H, J = self.lift(length)
        n = F.shape[0]
        start = np.zeros((n, columns)) if x0 is None else x0
        states = _block_states(F, (G @ inputs).reshape(n, blocks, columns), start)
        p, left = H.shape[0] // length, since // length  # blocks without wanted outputs
        out = H @ states[:, left:].reshape(n, -1) + J @ inputs[:, left * columns :]
        steps = out.reshape(length, p, blocks - left, columns).transpose(2, 0, 1, 3).reshape(-1, p, columns)
        return steps[since - left * length : n_steps - left * length]

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


def _block_states(F: Array, drive: Array, start: Array) -> Array:
    """Return the state at the start of each block: x_0 = start, x_b+1 = F x_b + driven_b.

    `drive` is (n, blocks, columns). The same method again: blocks of blocks, then one short loop over their starts.
    """
    n, blocks, columns = drive.shape
    length = max(1, int(np.sqrt(blocks)))
    groups = -(-blocks // length)
    padded = np.zeros((n, groups * length, columns))
    padded[:, :blocks] = drive
    padded = padded.reshape(n, groups, length, columns).transpose(2, 0, 1, 3).reshape(length, n, -1)
    local = np.zeros((length + 1, n, groups * columns))  # states of every group started from zero
    powers = [np.eye(n)]
    for i in range(length):
        local[i + 1] = F @ local[i] + padded[i]
        powers.append(F @ powers[-1])
    ends = local[length].reshape(n, groups, columns)
    starts = np.empty((n, groups, columns))
    x = start
    for g in range(groups):
        starts[:, g] = x
        x = powers[length] @ x + ends[:, g]
    out = local[:length] + (np.vstack(powers[:length]) @ starts.reshape(n, -1)).reshape(length, n, -1)
    return out.reshape(length, n, groups, columns).transpose(1, 2, 0, 3).reshape(n, -1, columns)[:, :blocks]
