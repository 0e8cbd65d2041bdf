"""The plant of a closed loop as it is, where it is not the mirror that a controller is designed for (`control.mirror`).

A command v[k] is lost or arrives, is rounded to the actuator's step, goes through hysteresis and the matrix of the modes, and
switches the mirror delay - 1 + late frames after the start of step k. From there on each change of it, frame by frame and mode
by mode, is followed by the step response of a second-order system, as the mean over a frame:

    phi_corr[k + m] = sum of changes * mean over [m, m + 1) of 1 - Re(a exp(pole (t - switch))),   t > switch

so that delays, their jitter and the resonance are one formula, exact between the frames too. Hysteresis is a Prandtl-Ishlinskii
operator, a weighted sum of plays of evenly spaced widths (K. Kuhnen, European Journal of Control 9, 2003).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, pi
from typing import Any

import numpy as np
import scipy

from wfsobs.control.step import StepController, push_row
from wfsobs.control.supervisor import SupervisedController
from wfsobs.observers.step import frames_of
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Measurements, hold_last
from wfsobs.signal.wiener import Complex
from wfsobs.typing import Array

PLAYS = (np.arange(10) + 0.5) / 10.0
"""Half widths of the plays of a hysteresis, over its range; their weights are equal."""

FAR = 1e3
"""Commands [um] at which a loop is taken for unstable."""


@dataclass(frozen=True)
class TruePlant:
    """What the plant is; times in frames.

    Attributes
    ----------
    matrix : Array
        Correction of each mode by the command of each, (n_modes, n_modes).
    delay, jitter : float
        Of a command, at least 1; and its largest deviation, which is uniform.
    resonance, damping : float
        Natural frequency of the mirror [rad per frame], 0 for none, and its damping ratio.
    loss : float
        Share of the commands that do not arrive.
    quantum : float
        Step of the actuator [um]; 0 is none.
    hysteresis, hysteresis_range : float
        Width of the loop over its height, and the commands either way that it is of [um].
    gain_drift, gain_rms, gain_time : float
        Gain of the LGS measurements less 1: its change per frame; deviation and correlation time of a random part.
    start : int
        Frame from which it is so; before, it is the plant that the controllers are designed for.
    """

    matrix: Array
    delay: float = 2.0
    jitter: float = 0.0
    resonance: float = 0.0
    damping: float = 0.3
    loss: float = 0.0
    quantum: float = 0.0
    hysteresis: float = 0.0
    hysteresis_range: float = 1.0
    gain_drift: float = 0.0
    gain_rms: float = 0.0
    gain_time: float = 1000.0
    start: int = 0

    @property
    def is_linear(self) -> bool:
        """Whether it is linear, with the same statistics at every step: delays may be random and commands lost."""
        return not (self.quantum or self.hysteresis or self.gain_drift or self.gain_rms)

    @property
    def time_invariant(self) -> bool:
        """Whether it is linear and the same at every step."""
        return self.is_linear and not (self.jitter or self.loss or self.start)

    @property
    def pole(self) -> complex:
        """Pole of the mirror [1/frame]."""
        return self.resonance * complex(-self.damping, np.sqrt(1.0 - self.damping**2))

    @property
    def group_delay(self) -> float:
        """Group delay at low frequency [frames], including that of the mirror, 2 damping / resonance."""
        return self.delay + (2.0 * self.damping / self.resonance if self.resonance else 0.0)

    @property
    def size(self) -> int:
        """Frames that a switch of the mirror may be ahead."""
        return int(self.delay - 1.0 + self.jitter) + 1

    def step_means(self, late: float = 0.0) -> tuple[Array, complex]:
        """(means of the step response of a command over its next `size` frames, what swings on after them).

        The mean of the n-th frame after them is 1 + Re(swing exp(pole n) (exp(pole) - 1) / pole).
        """
        switch = self.delay - 1.0 + late
        after = np.maximum(np.arange(self.size + 1) - switch, 0.0)
        means = np.diff(after)
        if not self.resonance:
            return means, 0j
        pole = self.pole
        swing = (-1.0 - 1j * pole.real / pole.imag) * np.exp(pole * after)
        return means + np.diff(swing / pole).real, complex(swing[-1])

    def frame_response(self, n: int) -> Array:
        """Impulse response of the measurements over n frames, (n,), without the matrix and jitter; its first lag is one frame."""
        means, swing = self.step_means()
        turn = np.exp(self.pole * np.arange(n + 1)) / self.pole if self.resonance else np.zeros(n + 1)
        return np.diff(np.append(means, 1.0 + (swing * np.diff(turn)).real)[:n], prepend=0.0)

    def response(self, omega: Array) -> Complex:
        """Response of a measurement to a command, at omega [rad per step], the matrix aside; without jitter. Same shape."""
        means, swing = self.step_means()
        back: Complex = np.exp(-1j * omega)
        out: Any = np.polynomial.polynomial.polyval(back, means)
        left = np.zeros_like(back)
        if self.resonance:
            one, turn = swing * (np.exp(self.pole) - 1.0) / self.pole, np.exp(self.pole)
            left = 0.5 * (one / (1.0 - turn * back) + np.conj(one) / (1.0 - np.conj(turn) * back))
        return back * ((1.0 - back) * (out + back**self.size * left) + back**self.size)

    def sensor_gain(self, n: int, rng: np.random.Generator) -> Array:
        """Gain of the LGS measurements of n frames from `start` on, (n,)."""
        keeps = np.exp(-1.0 / self.gain_time)
        noise = rng.standard_normal(n) * np.append(1.0, np.full(n - 1, np.sqrt(1.0 - keeps**2)))
        return 1.0 + self.gain_drift * np.arange(n) + self.gain_rms * scipy.signal.lfilter([1.0], [1.0, -keeps], noise)


class ActingPlant:
    """A plant frame by frame, from rest; with columns after the modes, as many plants side by side."""

    def __init__(self, plant: TruePlant, *columns: int):
        self.plant = plant
        shape = (len(plant.matrix), *columns)
        self.position: Array = np.zeros(shape)  # of the mirror, once all has arrived, as its swing
        self.swing: Complex = np.zeros(shape, dtype=complex)
        self.ahead: Array = np.zeros((plant.size, *shape))  # phi_corr of the frames to come, by the commands so far
        self._plays = np.zeros((len(PLAYS), *shape))
        self._turn = np.exp(plant.pole) if plant.resonance else 0j
        self._mean = (self._turn - 1.0) / plant.pole if plant.resonance else 0j
        self._on_time = plant.step_means()

    def go_on(self, old: ActingPlant) -> None:
        """Go on from where another mirror is; where its delay is another, from where that will come to rest."""
        self.position = old.position
        self.ahead[:] = old.position
        if old.ahead.shape == self.ahead.shape:
            self.ahead[:], self.swing = old.ahead, old.swing
        self._plays = old._plays

    def take(self, v: Array, late: float = 0.0, is_lost: bool = False) -> Array:
        """Take a command (n_modes, ...) [um] and return phi_corr of its frame, the same shape."""
        p = self.plant
        if not is_lost:
            if p.quantum:
                v = p.quantum * np.round(v / p.quantum)
            if p.hysteresis:
                width = p.hysteresis_range * PLAYS.reshape(-1, *(1,) * v.ndim)
                self._plays = np.clip(self._plays, v - width, v + width)
                weight = p.hysteresis / np.minimum(PLAYS, 1.0 - PLAYS).sum()
                v = v * (1.0 - weight * (1.0 - PLAYS).sum()) + weight * self._plays.sum(axis=0)
            position = p.matrix @ v
            change, (means, swing) = position - self.position, p.step_means(late) if late else self._on_time
            self.ahead += means.reshape(-1, *(1,) * change.ndim) * change
            self.swing += swing * change
            self.position = position
        out = self.ahead[0].copy()
        self.ahead[:-1] = self.ahead[1:].copy()
        self.ahead[-1] = self.position + (self.swing * self._mean).real
        self.swing = self.swing * self._turn
        return out


class ActingLoop:
    """A controller and the plant that it acts on, one frame at a time, both from rest.

    Parameters
    ----------
    controller : StepController or SupervisedController
        Before its first frame.
    plant : TruePlant
        As it is.
    ratio : int, optional
        LGS frames in a frame of the NGS.
    """

    def __init__(self, controller: StepController | SupervisedController, plant: TruePlant, ratio: int | None = None):
        self.controller: StepController | SupervisedController = controller
        self.acting: ActingPlant = ActingPlant(plant)
        self.has_diverged: bool = False
        self._corrections = np.zeros((ratio or 1, len(plant.matrix)))  # newest first

    @property
    def correction(self) -> Array:
        """What the mirror does in the last frame, phi_corr, (n_modes,) [um]."""
        return self._corrections[0]

    def take(
        self,
        z: Array,
        ngs: Array | None,
        *,
        gain: float = 1.0,
        late: float = 0.0,
        is_lost: bool = False,
        stars: int | None = None,
    ) -> Array:
        """Take the measurements of the disturbance alone, and return the command, both (n_modes,) [um].

        gain : of the LGS measurement;  late, is_lost : of the command [frames];  stars : in the LGS measurement, None for all.
        A command beyond FAR does not reach the plant.
        """
        slow = None if ngs is None else ngs + self._corrections.mean(axis=0)
        u = self.controller.update(gain * (z + self.correction), slow, stars=stars)
        self.has_diverged = not np.abs(u).max() < FAR
        if not self.has_diverged:
            push_row(self._corrections, self.acting.take(u, late, is_lost))
        return u

    def change(self, plant: TruePlant) -> None:
        """Act on another plant, from where the mirror is."""
        old, self.acting = self.acting, ActingPlant(plant)
        self.acting.go_on(old)

    def go_on(self, old: ActingLoop) -> None:
        """Go on with the mirror where that of another loop is."""
        self.acting.go_on(old.acting)
        self._corrections[...] = old._corrections


def drive(
    controller: StepController | SupervisedController,
    measurements: Measurements,
    plant: TruePlant,
    rng: np.random.Generator,
    watch: Watch = QUIET,
) -> tuple[Array, Array]:
    """(commands, what the mirror made of them), both (n_steps, n_modes) [um], of a loop on pseudo-open-loop measurements.

    It ends where a command is beyond FAR: later rows are infinite. Raises Cancelled.
    """
    measurements = replace(measurements, u=hold_last(measurements.u))
    z, start = measurements.z, plant.start
    known = controller.mirror if isinstance(controller, SupervisedController) else controller.plant.mirror
    loop = ActingLoop(controller, TruePlant(np.eye(z.shape[1]), known.delay) if start else plant, measurements.ratio)
    gain = np.append(np.ones(start), plant.sensor_gain(len(z), rng))
    late, lost = plant.jitter * rng.uniform(-1.0, 1.0, len(z)), rng.uniform(size=len(z)) < plant.loss
    late[:start], lost[:start] = 0.0, False
    u, correction = np.full_like(z, inf), np.full_like(z, inf)
    for k, frame in enumerate(frames_of(measurements, watch)):
        if k == start > 0:
            loop.change(plant)
        is_lost = bool(lost[k])
        u[k] = loop.take(frame.z, frame.ngs, gain=gain[k], late=float(late[k]), is_lost=is_lost, stars=frame.stars)
        if loop.has_diverged:
            break
        correction[k] = loop.correction
    return u, correction


def true_matrix(orders: list[tuple[int, int]], gain_error: list[float], rotation: float, coupling: float) -> Array:
    """Matrix of the modes of these (radial order, azimuthal frequency), below 0 for a sine (`zernike.noll`).

    Gains first, then coupling within each pair of one order, then rotation [deg], which turns a pair by its frequency.
    """
    n = len(orders)
    gain = 1.0 + np.append(gain_error, np.zeros(n))[:n]
    out = np.diag(gain)
    for i, (order, azimuthal) in enumerate(orders):
        if azimuthal > 0 and (order, -azimuthal) in orders:
            pair = [i, orders.index((order, -azimuthal))]
            turn = azimuthal * rotation * pi / 180.0
            cross = np.array([[1.0, coupling], [coupling, 1.0]])
            turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            out[np.ix_(pair, pair)] = turned @ cross @ np.diag(gain[pair])
    return out
