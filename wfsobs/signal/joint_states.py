"""States of several linear filters together, and the estimate of least variance that is linear in them.

A filter x[k] = F x[k-1] + G z[k] of one input has the response X(omega) = (I - F exp(-i omega))^-1 G. With the cross powers
S_ij of the inputs, the states of filters i and j have the covariance

    E x_i x_j' = Re sum X_i S_ij X_j^H,

and with C the covariance of all states and b that of a target and the states, the estimate b' C^-1 x of the target leaves the
variance E s^2 - b' C^-1 b: no other that is linear in the states leaves less.

Estimates of least variance where some of several alike inputs are missing, from the states of those that are there.

Every input goes through the same filters. The states are kept for combinations of the inputs, the rows of an invertible matrix;
those of any input are combinations of them. What is there is taken as the mean of its inputs and orthonormal differences: by
themselves they are so alike that their covariance is near to singular.

What one disturbance and white noise bring into the states of a filter of every step and of a filter of frames.

A frame is the mean of the measurements of n steps, with noise of its own. With the disturbance's state d, the fast filter f, the
sum a of the exposure so far and the filter s of the frames, (d[k+1], f[k], a[k], s[k]) is a linear process whose matrices repeat
every n steps; its covariance is that of a Lyapunov equation of one cycle.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_solve, helmert, schur

from wfsobs.signal.gains import lyapunov
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.signal.wiener import Complex, in_two_threads
from wfsobs.typing import Array

RIDGE = 1e-10
"""Added to the covariance of the states, over that: rounding must not make it indefinite."""


class StateFilter(NamedTuple):
    """A filter x[k] = F x[k-1] + G z[k]: F (n, n), G (n,)."""

    F: Array
    G: Array

    def response(self, omega: Array) -> Complex:
        """Return X(omega), (n, len(omega)); omega in rad per step. By back substitution in the Schur form of F."""
        T, Z = schur(self.F, output="complex")
        late, out = np.exp(-1j * omega), np.zeros((len(T), omega.size), dtype=np.complex128)
        into = Z.conj().T @ self.G
        for i in reversed(range(len(T))):
            out[i] = (into[i] + late * (T[i, i + 1 :] @ out[i + 1 :])) / (1.0 - late * T[i, i])
        return Z @ out


def responses(filters: Sequence[StateFilter], common: StateFilter, omega: Array) -> list[Complex]:
    """Return the responses of filters whose last states are those of one that all have in common."""
    of_common, n = common.response(omega), common.G.size
    return [np.vstack([StateFilter(one.F[:-n, :-n], one.G[:-n]).response(omega), of_common]) for one in filters]


def running_means(spans: Sequence[float], turns: Sequence[float] = (0.0,)) -> StateFilter:
    """Return means of the past with the weights exp(-age / span), 0 for the newest measurement alone.

    Parameters
    ----------
    spans : sequence of float
        Times of the means [steps].
    turns : sequence of float
        Angles [rad] by which the weights turn within a span: a turn b gives the two means of weights cos and sin(b age / span).

    Returns
    -------
    StateFilter
        All of them, one after the other.
    """
    blocks, into = [], []
    for span in spans:
        for turn in turns if span > 0.0 else (0.0,):
            decay = np.exp(-1.0 / span) if span > 0.0 else 0.0
            angle = turn / max(span, 1.0)
            c, s = decay * np.cos(angle), decay * np.sin(angle)
            blocks.append(np.array([[c, -s], [s, c]] if turn else [[c]]))
            into += [1.0 - decay, 0.0][: len(blocks[-1])]
    return StateFilter(block_diag(*blocks), np.array(into))


def shared_covariance(powers: Complex, responses: Sequence[Complex]) -> Array:
    """Return the covariance of the states of all filters, of inputs of these cross powers (m, m, n_nodes)."""
    starts = np.cumsum([0, *(len(one) for one in responses)])
    at = [slice(*ends) for ends in pairwise(starts)]
    out = np.empty((starts[-1], starts[-1]))

    def fill(i: int) -> None:
        for j in range(i, len(responses)):
            found = real_product(responses[i] * powers[i, j], responses[j])
            out[at[j], at[i]], out[at[i], at[j]] = found.T, found

    in_two_threads(fill, range(len(responses)))
    return 0.5 * (out + out.T)


def real_product(a: Complex, b: Complex) -> Array:
    """Return the real part of a b^H, by half of the products."""
    real, other = (np.ascontiguousarray(each).view(np.float64) for each in (a, b))
    return real @ other.T


class LeastVariance:
    """Estimates of least variance that are linear in states of this covariance, (n, n) [um^2]; size : n."""

    size: int

    def __init__(self, covariance: Array):
        variance, self.size = np.diag(covariance), len(covariance)
        self._scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
        correlation = covariance / np.outer(self._scale, self._scale)
        correlation[np.diag_indices_from(correlation)] += RIDGE
        self._factor = np.linalg.cholesky(correlation)

    def weights(self, cross: Array) -> Array:
        """Return the weights of the states, for targets of these covariances with them, both (n_targets, n)."""
        return np.asarray(cho_solve((self._factor, True), (cross / self._scale).T)).T / self._scale


SETS = 16
"""Sets of inputs whose factors are kept; others are made anew."""

Present = tuple[bool, ...]
"""Which inputs are there."""


Selection = tuple[Sequence[Array], Sequence[LeastVariance]]
"""Combinations of all states, (n, n_states), in every phase; and estimates that are linear in them, in every phase."""


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
            return [whole] * len(self._covariances) + [whole[:n]], found
        mean = np.full((1, there.size), 1.0 / max(there.size, 1))
        among = np.vstack([mean, helmert(there.size)]) @ self._to_each[there] if there.size else np.empty((0, len(present)))
        fast = np.kron(among, np.eye(n // len(present)))
        both = block_diag(fast, np.eye(len(self._covariances[0]) - n))
        alone = both[: len(fast)]
        of_phases = [both @ one @ both.T for one in self._covariances] + [alone @ last @ alone.T]
        return [both] * len(self._covariances) + [alone], in_two_threads(LeastVariance, of_phases)


class FrameShare(NamedTuple):
    """What the disturbance of one mode alone, and noise, bring into the states of both filters: covariances [um^2].

    states      : of the states, (n, n)
    disturbance : of the disturbance's state and those, (n_disturbance, n)
    exposure    : of what the running frame has seen so far and those, (n,)
    """

    states: Array
    disturbance: Array
    exposure: Array


def frame_shares(
    fast: StateFilter,
    frames: StateFilter,
    ratio: int,
    model: DisturbanceModel,
    noise: float,
    frame_noise: float,
    gain: float = 1.0,
    *,
    age: int = 0,
) -> list[FrameShare]:
    """Return the shares in the states of both filters, the fast one first, in `ratio` steps one after the other.

    Parameters
    ----------
    fast, frames : StateFilter
        Of every step, and of every frame.
    ratio : int
        Steps per frame.
    model : DisturbanceModel
        The disturbance.
    noise, frame_noise : float
        White noise in a step and in a frame [um].
    gain : float
        Of the fast filter's measurement for the disturbance.
    age : int
        Steps between the last frame that was read and the first of these steps, a multiple of `ratio`.

    Returns
    -------
    list of FrameShare
        Covariances, `age`, `age` + 1, ... steps after the last frame.
    """
    n, m, p = len(model.A), len(fast.F), len(frames.F)
    of_fast, at_sum, of_frames = slice(n, n + m), n + m, slice(n + m + 1, n + m + 1 + p)
    step = block_diag(model.A, fast.F, np.eye(1 + p))
    step[of_fast, :n], step[at_sum, :n] = np.outer(fast.G, gain * model.C), np.ravel(model.C) / ratio
    read = np.eye(len(step))  # at the end of an exposure
    read[of_frames, of_frames], read[of_frames, at_sum], read[at_sum, at_sum] = frames.F, frames.G, 0.0
    drive = block_diag(model.Q, noise**2 * np.outer(fast.G, fast.G), np.zeros((1 + p, 1 + p)))
    frame = (read @ step, read @ drive @ read.T)
    frame[1][of_frames, of_frames] += frame_noise**2 * np.outer(frames.G, frames.G)
    between = [(step, drive)] * (ratio - 1)
    F, W = np.eye(len(step)), np.zeros_like(step)
    for one, more in (*between, frame):
        F, W = one @ F, one @ W @ one.T + more
    S, kept, out = lyapunov(F, W), np.r_[of_fast, of_frames], list[FrameShare]()  # S: in a step with a frame
    anew = step @ np.diag(np.arange(len(step)) != at_sum)  # after the end of an exposure that was not read
    unread = [(step if i % ratio else anew, drive) for i in range(age + ratio - 1)]
    for one, more in unread if age else (*between, frame):
        cross = S[:n] @ one.T
        S = one @ S @ one.T + more
        out.append(FrameShare(S[np.ix_(kept, kept)], cross[:, kept], S[at_sum, kept]))
    return out[-ratio:] if age else [out[-1], *out[:-1]]


def frame_mean_response(ratio: int, omega: Array) -> Complex:
    """Return the response of a frame to the measurements of every step, in the last of these, (len(omega),)."""
    return np.exp(-1j * np.outer(np.arange(ratio), omega)).mean(axis=0)
