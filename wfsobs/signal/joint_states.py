"""States of several linear filters together, and the estimate of least variance that is linear in them.

A filter x[k] = F x[k-1] + G z[k] of one input has the response X(omega) = (I - F exp(-i omega))^-1 G. With the cross powers
S_ij of the inputs, the states of filters i and j have the covariance

    E x_i x_j' = Re sum X_i S_ij X_j^H,

and with C the covariance of all states and b that of a target and the states, the estimate b' C^-1 x of the target leaves the
variance E s^2 - b' C^-1 b: no other that is linear in the states leaves less.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.linalg import block_diag, cho_solve, schur

from wfsobs.signal.filter_covariance import lyapunov
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.signal.wiener import Complex
from wfsobs.typing import Array

RIDGE = 1e-10
"""Added to the covariance of the states, over that: rounding must not make it indefinite."""


Item = TypeVar("Item")
Found = TypeVar("Found")


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


def in_two_threads(function: Callable[[Item], Found], items: Iterable[Item]) -> list[Found]:
    """Return what a function makes of every item: products and factors of matrices leave the interpreter to others."""
    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(function, items))


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


class OwnShare(NamedTuple):
    """What the disturbance of one mode alone, and noise, bring into the states: covariances [um^2].

    states      : of the states, (n, n)
    disturbance : of the disturbance's state and the filter's, (n_disturbance, n)
    """

    states: Array
    disturbance: Array


def own_share(one: StateFilter, model: DisturbanceModel, gain: float, noise: float) -> OwnShare:
    """Return the share of a disturbance that is measured with a gain, and of white noise [um]."""
    n, m = len(model.A), len(one.F)
    into = np.outer(one.G, gain * model.C)
    F = np.block([[model.A, np.zeros((n, m))], [into, one.F]])  # of the disturbance at k + 1, the filter at k
    S = lyapunov(F, block_diag(model.Q, noise**2 * np.outer(one.G, one.G)))
    return OwnShare(S[n:, n:], S[:n, n:] @ one.F.T + S[:n, :n] @ into.T)


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
