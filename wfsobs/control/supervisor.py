"""A supervisor around a controller: an integrator takes over where the loop is worse than it should be, and gives it back.

In a closed loop the measurement y is what was not predicted, so that it is tested itself: its mean square over 16 frames, about a
running mean, against its own distribution, a gamma distribution of the mean and variance that were seen so far (with white y that
is chi squared of 16 degrees of freedom, with a line of slowly varying amplitude of two). Both controllers receive what the mirror
was sent, whoever asked for it: the controller's own state stays right while the integrator closes the loop.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammainccinv

from wfsobs.control.mirror import Mirror
from wfsobs.control.step import StepController
from wfsobs.observers.step import check_state
from wfsobs.observers.stepping import StateArrays, load_parts, save_parts
from wfsobs.typing import Array

WINDOW = 16
"""Frames over which the measurement is averaged."""

SLOW = 32
"""Frames of the running mean that is taken off first: the slow error of the LGS is not the loop's."""

MEMORY = 20_000
"""Frames over which its distribution is averaged."""

ANEW = 200
"""Frames that the distribution counts for when the other controller takes over."""

REFRESH = 50
"""Frames between two thresholds: the distribution changes slowly."""

STRICT = 0.5
"""Cap of the threshold after the first alarm over the threshold before: a controller that comes back is on trial."""

RELAX = 1.01
"""By how much that cap rises in `REFRESH` frames: slow growth does not become usual, a larger disturbance does."""

NGS_SHARE = 0.2
"""Share of each NGS frame in the running mean of what the LGS have more than it, which the integrator does not follow."""

REASONS = (
    "",
    "start",
    "a command is not finite",
    f"{WINDOW} frames exceed what the residual should be",
    "the mirror is at its limits most of the time",
    "the residual is worse than the integrator's",
)

CLIPPED = 0.5
"""Share of frames, over some 100, in which the mirror may be at a limit."""

BLEND = 0.9
"""By how much the step between both commands falls in each frame after the controller is back."""


@dataclass(frozen=True)
class Supervision:
    """When the integrator takes over, and for how long.

    Attributes
    ----------
    gain, leak : float
        Of the integrator.
    alarm : float
        Probability of an alarm in a frame without cause.
    worse : float
        Rms of the measurement over that of the integrator beyond which the controller is held for the worse one.
    calm : int
        Frames of the integrator at the start and after an alarm; twice as many after each further one, up to 64 times.
    """

    gain: float = 0.2
    leak: float = 1.0
    alarm: float = 1e-10
    worse: float = 1.5
    calm: int = 1000


class _Level(StateArrays):
    """The distribution of the mean square of the measurement over `WINDOW` frames, and whether it has been left.

    slow         : running mean of the measurement, (n_modes,) [um]
    squares      : of the last frames without it, (WINDOW, n_modes);  frames : their number so far
    weight       : frames that the distribution counts for
    mean, spread : its mean and mean square, (n_modes,);  limit : threshold, (n_modes,);  cap : which it may not exceed
    """

    state_names: tuple[str, ...] = ("slow", "squares", "frames", "weight", "mean", "spread", "limit", "cap")

    def __init__(self, n_modes: int, alarm: float):
        self._alarm = alarm
        self.slow, self.squares = np.zeros(n_modes), np.zeros((WINDOW, n_modes))
        self.frames = self.weight = 0
        self.mean, self.spread, self.limit = np.zeros(n_modes), np.zeros(n_modes), np.full(n_modes, np.inf)
        self.cap = self.limit
        self.mark_start()

    def exceeds(self, y: Array) -> bool:
        """Take a measurement, zero where it is missing, and return whether the level is excess."""
        self.slow += (y - self.slow) / SLOW
        self.squares[self.frames % WINDOW] = np.square(y - self.slow)
        self.frames += 1
        if self.frames < WINDOW:
            return False
        level = self.squares.mean(axis=0)
        usual = np.minimum(level, self.limit)  # an outburst does not make itself usual
        self.weight = min(self.weight + 1, MEMORY)
        self.mean += (usual - self.mean) / self.weight
        self.spread += (usual * usual - self.spread) / self.weight
        if self.frames % REFRESH == 0:
            self.cap = self.cap * (RELAX if self.weight < MEMORY else np.inf)
            if self.weight > 3 * ANEW:
                self.limit = np.minimum(self._limit(), self.cap)
        return bool((level > self.limit).any())

    def _limit(self) -> Array:
        variance = np.maximum(self.spread - self.mean**2, 0.0)
        # no fewer degrees of freedom than a line has, no more than white samples
        shape = np.clip(self.mean**2 / np.maximum(variance, 1e-300), 1.0, WINDOW / 2)
        return np.asarray(self.mean * gammainccinv(shape, self._alarm) / shape)

    def begin(self, limit: Array | float, cap: Array | float = np.inf) -> None:
        """Let what comes now count more than what was, with a threshold for the first 400 frames and a cap for longer."""
        cap = np.broadcast_to(cap, self.mean.shape)
        self.cap = np.where(cap > 0.0, cap, np.inf)  # measurements of zero alone say nothing of what is usual
        self.weight, self.limit = min(self.weight, ANEW), np.minimum(limit, self.cap)


class SupervisedController(StateArrays):
    """A controller with an integrator that takes over where the loop is worse than it should be.

    The integrator closes the loop first, which tells what it leaves; the controller listens. The integrator takes over where
    the measurement exceeds what it should be over 16 frames, where it is worse than the integrator's in the long run (LGS alone),
    where the mirror is at a limit half of the time, or where a command is not finite. It starts from the commands that
    were sent, without a bump; on the way back the difference of both commands dies away in some 20 frames.

    Parameters
    ----------
    controller : StepController
        Made by `wfsobs.design`.
    supervision : Supervision, optional
        When and for how long the integrator takes over.

    Attributes
    ----------
    alarms : list of tuple
        (frame, reason) of every time that it took over.
    """

    state_names: tuple[str, ...] = (
        "_level",
        "_command",
        "_offset",
        "_usual",
        "_bound",
        "_why",
        "_left",
        "_calm",
        "_limit_share",
        "_since",
        "_exposure",
        "_slow_error",
    )

    def __init__(self, controller: StepController, supervision: Supervision = Supervision()):
        n, mirror = controller.sampling.n_modes, controller.plant.mirror
        self.controller: StepController = controller
        self.supervision: Supervision = supervision
        self.mirror: Mirror = mirror
        self.alarms: list[tuple[int, str]] = []
        self._level = _Level(n, supervision.alarm)
        self._command, self._offset = np.zeros(n), np.zeros(n)
        self._usual = np.full(n, np.inf)  # mean square of the measurement under the integrator
        self._bound = np.full(n, np.inf)  # cap of the threshold of the controller, when it lost the loop
        self._why = REASONS.index("start")
        self._left, self._calm = supervision.calm, supervision.calm  # frames of the integrator: still, and at the next alarm
        self._limit_share, self._since = 0.0, 0  # share of frames at a limit; frame of the last change of hands
        self._exposure = np.zeros(n)  # sum of the measurements since the last NGS frame
        self._slow_error = np.zeros(n)  # of the LGS
        self.mark_start()

    def __copy__(self) -> Self:
        return deepcopy(self)  # the state of a copy is its own

    @property
    def reason(self) -> str:
        """Why the integrator closes the loop; "" while the controller does."""
        return REASONS[self._why]

    @property
    def id(self) -> str:
        """Id of the controller."""
        return self.controller.id

    @property
    def frame(self) -> int:
        """Frames so far."""
        return self.controller.frame

    def update(self, y: ArrayLike, ngs: ArrayLike | None = None, *, stars: int | None = None) -> Array:
        """Take the measurements of a frame and return the command, as `StepController.update`; an infinite number is missing."""
        seen = np.asarray(y, dtype=float)
        seen = np.where(np.isfinite(seen), seen, np.nan)
        slow = None if ngs is None else np.where(np.isfinite(ngs), ngs, np.nan)
        command = self.controller.update(seen, slow, stars=stars)
        is_missing, plan = np.isnan(seen), self.supervision
        error = np.where(is_missing, 0.0, seen)
        excess = not is_missing.any() and self._level.exceeds(error)  # a dropout is no small residual
        self._follow_ngs(seen, slow)
        wanted = plan.leak * self._command - plan.gain * np.where(is_missing, 0.0, seen - self._slow_error)
        safe = self.mirror.clip_commands(wanted, self._command)
        if self._why:
            self._wait(command, safe, excess)
        elif fault := self._fault(command, excess):
            self._fall_back(fault)
        u = safe
        if not self._why:
            self._offset *= BLEND
            u = self.mirror.clip_commands(command + self._offset, self._command)
            is_clipped = (np.abs(u) >= self.mirror.stroke) | (np.abs(u - self._command) >= self.mirror.slew)
            self._limit_share += (bool(is_clipped.any()) - self._limit_share) / 100.0
        self.amend(u)
        return u

    def amend(self, command: ArrayLike) -> None:
        """Replace the command of the last frame by that which the mirror was sent, (n_modes,) [um]. Raises StepError."""
        self.controller.amend(command)
        self._command = np.array(command, dtype=float)

    def _follow_ngs(self, y: Array, ngs: Array | None) -> None:
        """Learn what the LGS have more than an NGS frame over its exposure, where none of it is missing."""
        ratio = self.controller.sampling.ratio
        if not (ratio and self.controller.uses_ngs):
            return
        self._exposure += y
        if (self.frame - 1) % ratio == 0:
            if ngs is not None:
                error = self._exposure / ratio - ngs - self._slow_error
                self._slow_error += NGS_SHARE * np.where(np.isnan(error), 0.0, error)
            self._exposure = np.zeros_like(y)

    def _fault(self, command: Array, excess: bool) -> int:
        """Return why the controller may not go on, an index of `REASONS`; 0 where it may."""
        if not np.isfinite(command).all():
            return 2
        if excess:
            return 3
        if self._limit_share > CLIPPED:
            return 4
        # with an NGS the slow error of the LGS, which an integrator on y follows, rightly stays in y
        is_long = self.frame - self._since > 5 * ANEW and not self.controller.uses_ngs
        return 5 if is_long and (self._level.mean > self.supervision.worse**2 * self._usual).any() else 0

    def _fall_back(self, why: int) -> None:
        self.alarms.append((self.frame - 1, REASONS[why]))
        most = 64 * self.supervision.calm
        self._left = self._calm = self.supervision.calm if self.frame - self._since > most else min(2 * self._calm, most)
        inherited = self.frame - self._since <= 2 * ANEW  # it may be the disturbance that is larger: ever more is allowed
        self._bound = self._level.limit * (self.supervision.worse if inherited else STRICT)
        self._why, self._limit_share, self._since = why, 0.0, self.frame
        self._level.begin(np.inf)

    def _wait(self, command: Array, safe: Array, excess: bool) -> None:
        """Let the integrator go on until all has been well for a while, then give the loop back."""
        self._left = max(self._left - 1, WINDOW if excess else 0)
        if not self._left and np.isfinite(command).all():
            cap = self._bound * RELAX ** (min(self.frame - self._since, MEMORY) / REFRESH)
            self._usual, self._why, self._since = self._level.mean.copy(), 0, self.frame
            self._offset = (safe - command) / BLEND
            self._level.begin(self.supervision.worse**2 * self._level.limit, cap)

    def take_over(self, old: SupervisedController) -> None:
        """Go on where another design of the same controller is supervised. Raises StepError."""
        self.controller.take_over(old.controller)
        self.load(old.save())
        self.alarms = old.alarms

    def reset(self) -> None:
        """Go back to before the first frame, the mirror at rest."""
        super().reset()
        self.controller.reset()
        self.alarms = []

    def state_dict(self) -> dict[str, Array]:
        """Return a copy of the state: name -> array; past alarms are no part of it."""
        return {**self.controller.state_dict(), **save_parts({"supervisor": self})}

    def load_state_dict(self, state: Mapping[str, ArrayLike]) -> None:
        """Go on from a state of `state_dict`. Raises StepError where it is that of another design."""
        given = check_state(self.id, state, self.state_dict())
        load_parts({"supervisor": self}, given)
        self.controller.load_state_dict({name: given[name] for name in self.controller.state_dict()})
