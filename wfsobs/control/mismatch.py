"""Linear loops whose plant is not the one that their laws are designed for: residual, stability and margins by theory.

A law takes the mirror that it knows, P0, off its measurement. Of another one, P, it finds z + (P - P0) u in the place of z, so
that with u = -K z the loop is closed by the difference alone,

    u = -Q z,    Q = (1 + K (P - P0))^-1 K,    residual = disturbance - P Q z,

and since K, P and P0 are stable it is stable if and only if det(1 + K (P - P0)) does not go around 0 while the frequency goes
from 0 to half the rate (Nyquist). The two modes of a pair are coupled by P. A law that repeats itself every c steps mixes the c
frequencies that differ by multiples of the rate over c (`images`), between which it is a matrix K as well.

Stability in the mean square of a loop whose step differs at random, independently, from one to the next.

The covariance S of the state goes from step to step by E[A S A'], and the loop is stable where no S grows (O. Costa, M. Fragoso,
R. Marques, Discrete-Time Markov Jump Linear Systems, 2005). Steps differ only in what the mirror makes of a change of its
commands, a few rows V of the state: A = E[A] + U V with U random, so that

    E[A S A'] = E[A] S E[A]' + W(V S V'),    W(M) = E[U M U'],

and a rate of growth is one at which the covariance of those rows, a matrix of as many rows, comes back as it was by W and the
sum of all that follows from it: no eigenvalue of the n^2 numbers of S is looked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import pi
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from wfsobs.control.margins import Margins, Response, frequencies, margins
from wfsobs.control.mirror import Law, Mirror
from wfsobs.control.true_plant import ActingPlant, TruePlant
from wfsobs.signal.periodic import FilterStep, PeriodicFilter
from wfsobs.signal.wiener import Complex
from wfsobs.typing import Array

SAME = 1e-12
"""Relative size below which draws do not differ."""

MIDDLE = 1e-10
"""Least relative distance of the rate of growth from that of the mean step."""

DOUBLINGS = 60
"""Of the number of cycles whose contributions are added up."""


def mean_square_radius(weights: Sequence[float], draws: Sequence[Sequence[Array]]) -> float:
    """Growth of the covariance of the state over a cycle, at most; below 1 the loop is stable in the mean square.

    Parameters
    ----------
    weights : sequence of float
        Probabilities of the draws.
    draws : sequence of sequence of Array
        Steps of a cycle in each draw, (n, n), independent of each other.

    Returns
    -------
    float
        Spectral radius of E[A x A] over a cycle.
    """
    steps, w = np.array(draws), np.array(weights)
    mean = np.tensordot(w, steps, 1)
    phases, n = mean.shape[:2]
    rows, spread = [], []
    for off in np.moveaxis(steps - mean, 1, 0):
        size, V = np.linalg.svd((np.sqrt(w)[:, None, None] * off).reshape(-1, n), full_matrices=False)[1:]
        V = V[size > SAME * np.abs(mean).max()]
        rows.append(V)
        spread.append(np.sqrt(w)[:, None, None] * (off @ V.T))
    least = float(np.abs(np.linalg.eigvals(_cycle(mean, 0))).max()) ** 2
    if not any(len(V) for V in rows):
        return least

    def excess(log_rate: float) -> float:
        scale = np.exp(-0.5 * log_rate / phases)
        returned = _carry_around(scale * mean, rows, [scale * U for U in spread])
        return float(np.log(np.abs(np.linalg.eigvals(returned)).max() + 1e-300))

    low = np.log(max(least, 1e-12)) + MIDDLE
    if excess(low) <= 0.0:
        return least
    high = low + 0.1
    while excess(high) > 0.0:
        high += 1.0
    return float(np.exp(brentq(excess, low, high, xtol=1e-12)))


def _cycle(mean: Array, first: int) -> Array:
    """Return the product of the steps of a cycle that begins with this one."""
    out = np.eye(mean.shape[1])
    for phase in range(first, first + len(mean)):
        out = mean[phase % len(mean)] @ out
    return out


def _carry_around(mean: Array, rows: Sequence[Array], spread: Sequence[Array]) -> Array:
    """Return what comes back, in all phases, of a covariance of the rows in each: a square matrix of all their numbers."""
    starts = np.cumsum([0, *(len(V) ** 2 for V in rows)])
    out = np.zeros((starts[-1], starts[-1]))
    for phase, (V, U) in enumerate(zip(rows, spread, strict=True)):
        unit = np.eye(len(V) ** 2).reshape(-1, len(V), len(V))
        S = np.einsum("dia,eab,djb->eij", U, unit, U)
        power = _cycle(mean, phase + 1)
        for _ in range(DOUBLINGS):
            S = S + power @ S @ power.T
            power = power @ power
            if np.abs(power).max() < SAME**2:
                break
        for later in range(phase + 1, phase + 1 + len(mean)):
            at = later % len(mean)
            seen = rows[at] @ S @ rows[at].T
            out[starts[at] : starts[at + 1], starts[phase] : starts[phase + 1]] = seen.reshape(len(unit), -1).T
            S = mean[at] @ S @ mean[at].T
    return out


DENSE = 1600
"""Even and logarithmic points of a frequency grid, each."""

COARSE, COARSE_CYCLE, NEAR = 480, 120, 9
"""The same for many plants, of a law that is the same at every step and of one that has a cycle, whose frequencies are as many
times closer; points on either side of each pole. Residuals differ by 0.4 % at most, by 5 % where a loop is nearly unstable.
"""

TURN = 2.0
"""Change of the phase of the determinant from point to point beyond which eigenvalues decide on stability [rad]."""


@dataclass(frozen=True)
class SensorSpectra:
    """What the measurements of one mode hold, evenly spaced from 0 to half the rate, (n,) [um^2 per sample].

    disturbance, measurement : of phi_dist, and of z;  cross : between phi_dist[k] and z[k + 1]
    ngs : (of the signal s of the NGS, between s[k] and z[k + 1], between phi_dist[k] and s[k]), each (n,) or (1,)
    ngs_noise : variance of a frame [um^2]
    """

    disturbance: Array
    measurement: Array
    cross: Complex | Array
    ngs: tuple[Array, Complex | Array, Complex | Array] = (np.zeros(1), np.zeros(1), np.zeros(1))
    ngs_noise: float = 0.0


def pairs(matrix: Array) -> Iterator[list[int]]:
    """Yield the modes of a plant alone or, where they are coupled, in pairs."""
    for i, row in enumerate(matrix):
        coupled = np.flatnonzero((row != 0.0) | (matrix[:, i] != 0.0))
        columns = sorted({i, *coupled.tolist()})
        if columns[0] == i:
            yield columns


@dataclass(frozen=True)
class Loops:
    """The loops of some modes at the frequencies omega (n,) [rad per step] and their images.

    K (modes, n, c, c) : from z to -u;  ngs (modes, n, c) : from an NGS frame to -u
    """

    nominal: Mirror
    omega: Array
    K: Complex
    ngs: Complex

    @property
    def images(self) -> Array:
        """The frequencies and their images, (n, c)."""
        c = self.K.shape[-1]
        return self.omega[:, None] + 2.0 * pi * np.arange(c) / c

    @property
    def exposure(self) -> Complex:
        """Mean of the c steps before a frame, of a signal of frequency omega, (n, c)."""
        return np.mean([np.exp(-1j * i * self.images) for i in range(1, self.K.shape[-1] + 1)], axis=0)

    def solve(self, response: Complex, matrix: Array) -> tuple[Complex, Complex]:
        """Return (determinant (..., n), Q (..., n, modes c, modes c + modes)) of plants: u = -Q (z, NGS frames).

        response (..., n, c) : of the mirror at the images;  matrix (..., modes, modes)
        """
        b, n, c, _ = self.K.shape
        seen = response[..., None, None, :] * matrix[..., None, :, :, None]
        seen = seen - np.eye(b)[:, :, None] * self.nominal.response(self.images)[:, None, None, :]
        both = self.K + self.ngs[..., None] * (self.exposure * np.exp(1j * self.images))[:, None, :]
        X = np.einsum("inml,...nijl->...nimjl", both, seen).reshape(*seen.shape[:-3], b * c, b * c) + np.eye(b * c)
        R = np.zeros((n, b, c, b * c + b), dtype=complex)
        for i in range(b):
            R[:, i, :, i * c : (i + 1) * c], R[:, i, :, b * c + i] = self.K[i], self.ngs[i]
        R = R.reshape(n, b * c, -1)
        if b * c == 1:
            return X[..., 0, 0], R / X
        if b * c == 2:
            determinant = X[..., 0, 0] * X[..., 1, 1] - X[..., 0, 1] * X[..., 1, 0]
            inverse = np.stack([X[..., 1, 1], -X[..., 0, 1], -X[..., 1, 0], X[..., 0, 0]], -1) / determinant[..., None]
            return determinant, np.einsum("...ij,...jk->...ik", inverse.reshape(X.shape), R)
        return np.linalg.det(X), np.linalg.solve(X, np.broadcast_to(R, (*X.shape[:-1], R.shape[-1])))

    def stable(self, determinant: Complex) -> tuple[Array, Array]:
        """Return whether loops of these determinants (..., n) are stable, and whether the frequencies tell, both (...)."""
        turns = np.angle(determinant[..., 1:] / determinant[..., :-1])
        return np.abs(turns.sum(axis=-1)) < 0.5 * pi, np.abs(turns).max(axis=-1) < TURN

    def residual(self, Q: Complex, response: Complex, matrix: Array, weights: Sequence[Weights]) -> Array:
        """Mean square of the residual of every mode, (..., modes) [um^2]; weights : one per mode."""
        b, _, c, _ = self.K.shape
        Q = Q.reshape(*Q.shape[:-2], b, c, -1)
        T = response[..., None, :, None] * np.einsum("...ij,...njmq->...nimq", matrix, Q)  # (..., n, modes, c, inputs)
        by_lgs, by_ngs = T[..., : b * c].reshape(*T.shape[:-1], b, c), T[..., b * c :]
        step = np.exp(1j * self.images)
        out = np.zeros((*T.shape[:-4], b))
        for i in range(b):
            for j, w in enumerate(weights):
                lgs, slow = by_lgs[..., i, :, j, :], by_ngs[..., i, :, j]  # (..., n, c, c), (..., n, c)
                density = w.measurement * (np.abs(lgs) ** 2).sum(axis=-2)
                if i == j:
                    density = density + w.disturbance - 2.0 * (np.einsum("...mm->...m", lgs) * np.conj(w.cross)).real
                power = (np.abs(slow) ** 2).sum(axis=-1)
                density = density + power[..., None] * (np.abs(self.exposure) ** 2 * w.signal + w.ngs_noise[..., None])
                mixed = np.einsum("...ml,...m->...l", lgs, np.conj(slow))
                density = density + 2.0 * (mixed * np.conj(step * self.exposure * w.to_next)).real
                if i == j:
                    density = density - 2.0 * (slow * step * self.exposure * np.conj(w.to_truth)).real
                out[..., i] += density.sum(axis=(-1, -2))
        return out


class Weights(NamedTuple):
    """`SensorSpectra` as sums over the frequencies of loops and their images, (..., n, c); all else is straight between these.

    signal, to_next, to_truth : `ngs` of these spectra
    """

    disturbance: Array
    measurement: Array
    cross: Complex
    signal: Array
    to_next: Complex
    to_truth: Complex
    ngs_noise: Array


def loops(laws: Sequence[Law], nominal: Mirror, is_coarse: bool = False) -> Loops:
    """Return the loops of the laws of modes that one plant couples, on frequencies that are close where they change."""
    c = len(laws[0].cycle.steps)
    density = (COARSE_CYCLE if c > 1 else COARSE, NEAR) if is_coarse else (DENSE, 24)
    grid = np.unique(np.concatenate([frequencies(law.poles, *density) for law in laws])) / c
    return loops_at(laws, nominal, grid)


def loops_at(laws: Sequence[Law], nominal: Mirror, omega: Array) -> Loops:
    """Return the loops at these frequencies [rad per step]."""
    K, ngs = zip(*(_images_of(law, omega) for law in laws), strict=True)
    return Loops(nominal, omega, np.array(K), np.array(ngs))


def _images_of(law: Law, omega: Array) -> tuple[Complex, Complex]:
    """(K (n, c, c), K of NGS frames (n, c)) of a law."""
    c, inputs = len(law.cycle.steps), law.cycle.steps[0][1].shape[1]
    if c == 1 and inputs == 1:
        return law.response(omega)[:, None, None], np.zeros((omega.size, 1), dtype=complex)
    F, G, H, J = PeriodicFilter(_steps(law)).lift(c)
    turn = np.exp(1j * (omega[:, None] + 2.0 * pi * np.arange(c) / c)[:, None, :] * np.arange(c)[:, None])  # (n, step, image)
    out = np.empty((omega.size, c, c * inputs), dtype=complex)
    for start in range(0, omega.size, 64):
        part = slice(start, start + 64)
        inside = np.exp(1j * c * omega[part])[:, None, None] * np.eye(len(F)) - F
        out[part] = H @ np.linalg.solve(inside, np.broadcast_to(G.astype(complex), (len(inside), *G.shape))) + J
    out = -np.conj(turn).swapaxes(1, 2) @ out / c
    ngs = out[:, :, 1] if inputs > 1 else np.zeros((omega.size, c))
    return np.asarray(out[:, :, ::inputs] @ turn, dtype=complex), np.asarray(ngs, dtype=complex)


def _steps(law: Law) -> Sequence[FilterStep]:
    """Return the steps of a cycle, the one with the NGS frame first."""
    steps = law.cycle.steps
    return steps if law.cycle.first is None else [steps[-1], *steps[:-1]]


def weigh(spectra: SensorSpectra, of: Loops) -> Weights:
    """Return the spectra of a mode as sums over the frequencies of loops."""
    n, c, grid = spectra.measurement.size, of.K.shape[-1], of.omega
    omega = pi * np.arange(n) / (n - 1)
    image = np.rint(omega * c / (2.0 * pi)).astype(int)
    offset = omega - 2.0 * pi * image / c
    turned = offset < 0.0  # the conjugate has a frequency of the grid
    image, offset = np.where(turned, -image, image) % c, np.abs(offset)
    right = np.clip(np.searchsorted(grid, offset), 1, grid.size - 1)
    share = np.clip((offset - grid[right - 1]) / (grid[right] - grid[right - 1]), 0.0, 1.0)
    each = np.full(n, 1.0 / (n - 1))
    each[[0, -1]] *= 0.5

    def total(x: Array) -> Array:
        x = each * x
        counts = sum(np.bincount((right - 1 + s) * c + image, x * w, grid.size * c) for s, w in ((0, 1.0 - share), (1, share)))
        return np.asarray(counts).reshape(-1, c)

    def both(x: Complex | Array) -> Complex:
        real, imaginary = np.broadcast_to(np.real(x), n), np.broadcast_to(np.imag(x), n)
        return np.asarray(total(real) + 1j * total(np.where(turned, -imaginary, imaginary)), dtype=complex)

    signal, to_next, to_truth = map(both, spectra.ngs)
    even = np.convolve(np.diff(grid), [0.5, 0.5]) / (grid[-1] - grid[0])
    return Weights(
        total(spectra.disturbance),
        total(spectra.measurement),
        both(spectra.cross),
        signal.real,
        to_next,
        to_truth,
        spectra.ngs_noise * even / c,
    )


def stack_weights(weights: Sequence[Weights]) -> Weights:
    """Return the weights of a mode in several plants as one, with the plants first."""
    return Weights(*map(np.array, zip(*weights, strict=True)))


def one_loop(laws: Sequence[Law], nominal: Mirror, plant: TruePlant, columns: Sequence[int], mode: int) -> Response:
    """Return T = L / (1 + L), L the loop gain of one of some coupled modes, opened at its command, the others closed.

    laws : of the coupled modes, time-invariant;  columns : of the plant that these are;  mode : place among them
    """
    matrix = plant.matrix[np.ix_(columns, columns)]

    def response_of_one(omega: Array) -> Complex:
        response = plant.response(omega)
        _, Q = loops_at(laws, nominal, omega).solve(response[:, None], matrix)
        return response * (Q[:, mode, : len(laws)] @ matrix[:, mode])

    return response_of_one


def margins_of(T: Response, laws: Sequence[Law], dt: float) -> Margins:
    """Margins of a stable loop of T, which changes as fast as the poles of the laws have it."""
    return margins(T, np.unique(np.concatenate([frequencies(law.poles, DENSE) for law in laws])), dt)


# ---------------------------------------------------------------------- the state from step to step


def step_matrices(
    laws: Sequence[Law], nominal: Mirror, plant: TruePlant, late: float = 0.0, is_lost: bool = False
) -> list[Array]:
    """Matrices of the state of coupled loops without disturbance from step to step of a cycle, of law, plant and model of it.

    plant : linear, of the modes of these laws;  late [frames], is_lost : what happens to the commands
    """
    b, c = len(laws), len(laws[0].cycle.steps)
    steps, taps, slow = [_steps(law) for law in laws], nominal.taps[1:], laws[0].cycle.steps[0][1].shape[1] > 1
    orders = [len(law.cycle.steps[0][0]) for law in laws]
    sizes = [*orders, b * taps.size, b, b, b, b, b * plant.size, b * (c - 1) * slow]
    n = sum(sizes)
    out = []
    for phase in range(c):
        *x, u, seen, position, real, imag, ahead, before = np.split(np.eye(n), np.cumsum(sizes)[:-1])
        u, before = u.reshape(-1, b, n), before.reshape(-1, b, n)
        wrong = seen - np.tensordot(taps, u, 1)
        frame = (wrong + before.sum(axis=0)) / c if phase == 0 and slow else np.zeros_like(wrong)
        command = np.empty_like(wrong)
        for i, of_mode in enumerate(steps):
            F, G, H, J = of_mode[phase]
            v = np.array([wrong[i], frame[i]])[: G.shape[1]]
            command[i], x[i] = (H @ x[i] + J @ v)[0], F @ x[i] + G @ v
        acting = ActingPlant(plant, n)
        acting.position, acting.swing, acting.ahead = position, real + 1j * imag, ahead.reshape(-1, b, n)
        seen = acting.take(command, late, is_lost)
        u = np.concatenate([command[None], u[:-1]])
        before = np.concatenate([wrong[None], before[:-1]]) if len(before) else before
        state = [*x, u, seen, acting.position, acting.swing.real, acting.swing.imag, acting.ahead, before]
        out.append(np.concatenate([part.reshape(-1, n) for part in state]))
    return out


def radius(laws: Sequence[Law], nominal: Mirror, plant: TruePlant) -> float:
    """Spectral radius of coupled loops over a cycle; below 1 they are stable, in the mean square where delays are random."""
    if not (plant.jitter or plant.loss):
        return float(np.abs(np.linalg.eigvals(_cycle(np.array(step_matrices(laws, nominal, plant)), 0))).max())
    draws = draws_of(plant)
    steps = [step_matrices(laws, nominal, plant, late, lost) for _, late, lost in draws]
    return mean_square_radius([weight for weight, *_ in draws], steps)


def draws_of(plant: TruePlant) -> list[tuple[float, float, bool]]:
    """(weight, late, lost) whose mean is the expectation: Gauss points between the delays at which a frame begins."""
    points, weights = np.polynomial.legendre.leggauss(8 if plant.resonance else 2)  # exact for straight lines
    edges = np.arange(plant.size + 1) - (plant.delay - 1.0)
    edges = np.unique(np.clip(np.append(edges, [-plant.jitter, plant.jitter]), -plant.jitter, plant.jitter))
    out = [(plant.loss, 0.0, True)] if plant.loss else []
    arrive = 1.0 - plant.loss
    if edges.size == 1:
        return [*out, (arrive, 0.0, False)]
    for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        part = 0.5 * (high - low)
        late = 0.5 * (low + high) + part * points
        out += [
            (arrive * w * part / (2.0 * plant.jitter), x, False) for w, x in zip(weights.tolist(), late.tolist(), strict=True)
        ]
    return out
