"""Linear filters of several modes, one frame at a time.

`wfsobs.signal.periodic` runs a filter over a record, this module the same filter in a loop. The modes are stacked, padded with
zeros to the longest state, so that a frame of all of them is one product:

    (x[k+1], e[k]) = [[F, G], [H, J]] (x[k], v[k]).

A Kalman filter is kept in the state after the measurement, which holds every prediction:

    x_hat[k] = (I - L C) A x_hat[k-1] + L z[k].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from wfsobs.signal.gains import SteadyState, steady_state
from wfsobs.signal.periodic import FilterStep, PeriodicFilter
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.typing import Array

Saved = dict[str, Array]
"""A state: name -> array, a copy."""


class Stateful(Protocol):
    """What has a state that can be saved, loaded and set back to the start."""

    def reset(self) -> None:
        """Set the state back to the start."""
        ...

    def save(self) -> Saved:
        """Return a copy of the state."""
        ...

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state of the same names and shapes."""
        ...


def save_parts(parts: Mapping[str, Stateful]) -> Saved:
    """Return the states of several parts as one, names with the part's in front."""
    return {f"{part}.{name}": x for part, one in parts.items() for name, x in one.save().items()}


def load_parts(parts: Mapping[str, Stateful], state: Mapping[str, Array]) -> None:
    """Load what `save_parts` gave."""
    for part, one in parts.items():
        one.load({name.removeprefix(f"{part}."): x for name, x in state.items() if name.startswith(f"{part}.")})


class StateArrays:
    """A state of the attributes that `state_names` lists: arrays, numbers, and parts with a state of their own, or None.

    `mark_start` ends the constructor: a reset goes back to what they are then.
    """

    state_names: tuple[str, ...] = ()

    def mark_start(self) -> None:
        """Keep the state as the one before the first step."""
        self._start = self.save()

    def reset(self) -> None:
        """Set the state back to the start."""
        self.load(self._start)

    def save(self) -> Saved:
        """Return a copy of the state."""
        out: Saved = {}
        for name in self.state_names:
            value, key = getattr(self, name), name.lstrip("_")
            if hasattr(value, "save"):
                out |= save_parts({key: value})
            elif value is not None:
                out[key] = np.array(value)
        return out

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state of the same names and shapes."""
        for name in self.state_names:
            value, key = getattr(self, name), name.lstrip("_")
            if hasattr(value, "load"):
                load_parts({key: value}, state)
            elif isinstance(value, np.ndarray):
                value[...] = state[key]
            elif value is not None:
                setattr(self, name, type(value)(state[key]))


class SampleHistory:
    """The last samples of several channels, in one piece: moved to the front at the end of a longer array.

    Parameters
    ----------
    n : int
        Channels.
    length : int
        Samples that are kept.
    """

    def __init__(self, n: int, length: int):
        self.length = length
        self._samples, self._end = np.zeros((n, length + max(length, 64))), length

    def push(self, x: Array) -> None:
        """Take a sample (n,)."""
        if self._end == self._samples.shape[1]:
            self._samples[:, : self.length] = self._samples[:, -self.length :]
            self._end = self.length
        self._samples[:, self._end] = x
        self._end += 1

    def last(self, length: int) -> Array:
        """Return the last samples, (n, length), the oldest first, zero where there was none: a view."""
        return self._samples[:, self._end - length : self._end]

    def reset(self) -> None:
        """Set the state back to zeros."""
        self._samples[...], self._end = 0.0, self.length

    def save(self) -> Saved:
        """Return a copy of the state."""
        return {"newest": self.last(self.length).copy()}

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state; of a longer or shorter history as much as there is room for."""
        n = min(self.length, state["newest"].shape[1])
        self.reset()
        self._samples[:, self.length - n : self.length] = state["newest"][:, state["newest"].shape[1] - n :]


class Gain(NamedTuple):
    """One step of a linear observer: measure with rows C (m, n) and filter gain L (n, m), then predict with A (n, n)."""

    A: Array
    C: Array
    L: Array

    def filter_step(self, outputs: Array) -> FilterStep:
        """Return (F, G, H, J) of the state x_pred[k]; the result is outputs (p, n) times x_hat[k]."""
        reduced = np.eye(len(self.A)) - self.L @ self.C
        return self.A @ reduced, self.A @ self.L, outputs @ reduced, outputs @ self.L


@dataclass(frozen=True)
class GainCycle:
    """A linear observer whose gains repeat, after a step 0 of its own where there is one."""

    steps: Sequence[Gain]
    first: Gain | None = None

    def filter(self, outputs: Array) -> PeriodicFilter:
        """Return the filter of the steps that repeat, with these outputs (p, n) of x_hat[k]."""
        return PeriodicFilter([step.filter_step(outputs) for step in self.steps])

    def recursion(self, outputs: Array) -> PeriodicFilter:
        """Return the filter with these outputs (p, n) of x_hat[k]."""
        return replace(self.filter(outputs), first=self.first and self.first.filter_step(outputs))

    def estimator(self) -> PeriodicFilter:
        """Return the recursion of x_hat, which is its state after a step; it has no outputs of its own."""
        n, m = self.steps[0].L.shape
        nothing = np.zeros((0, n)), np.zeros((0, m))
        maps = [
            ((np.eye(n) - step.L @ step.C) @ before.A, step.L, *nothing)
            for step, before in zip(self.steps, [self.steps[-1], *self.steps[:-1]], strict=True)
        ]
        first = None if self.first is None else (np.zeros((n, n)), self.first.L, *nothing)
        return PeriodicFilter(maps, first)


def steady_gains(model: DisturbanceModel, noise: float) -> tuple[GainCycle, SteadyState]:
    """Return the gains of the steady-state filter of z (1 input), and its covariances; noise [um]. Raises RiccatiError."""
    steady = steady_state(model.A, model.C, model.Q, np.array(noise**2))
    return GainCycle([Gain(model.A, np.atleast_2d(model.C), steady.L)]), steady


class FilterBank:
    """Filters of several modes, one step at a time; all have as many inputs, outputs and steps in their cycle.

    Attributes
    ----------
    x : Array
        State after the last step, (n_modes, n) [as in the filters, zeros behind the shorter ones].
    v : Array
        Inputs of the next step, (n_modes, m).
    phase : int
        Which of the maps comes next.
    last : int
        Which of the maps came last.
    """

    phase: int
    last: int
    x: Array
    v: Array

    def __init__(self, modes: Sequence[PeriodicFilter]):
        first = modes[0].first is not None
        cycles = [[*([] if mode.first is None else [mode.first]), *mode.steps] for mode in modes]
        n = max(steps[0][0].shape[0] for steps in cycles)
        p, m = cycles[0][0][3].shape
        self.maps: list[Array] = [np.zeros((len(modes), n + p, n + m)) for _ in cycles[0]]
        for j, stacked in enumerate(self.maps):
            for one, (F, G, H, J) in zip(stacked, (steps[j] for steps in cycles), strict=True):
                size = len(F)
                one[:size, :size], one[:size, n:], one[n:, :size], one[n:, n:] = F, G, H, J
        self._after = [*range(1, len(self.maps)), int(first)]
        self._in, self._out = np.zeros((len(modes), n + m)), np.zeros((len(modes), n + p))
        self._link(n)
        self.phase = self.last = 0

    def _link(self, n: int) -> None:
        """Make the parts of inputs and outputs, which share their memory."""
        self.x, self.v = self._in[:, :n], self._in[:, n:]
        self._next, self._e = self._out[:, :n], self._out[:, n:]
        self._in3, self._out3 = self._in[:, :, None], self._out[:, :, None]

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Link the parts again, which a copy and another process receive apart."""
        self.__dict__.update(state)
        self._link(self.x.shape[1])

    def step(self, v: Array) -> Array:
        """Take the inputs v (n_modes, m) of a step; return its outputs (n_modes, p), valid until the next."""
        self.v[...] = v
        return self.advance()

    def advance(self) -> Array:
        """Do as `step` with the inputs that have been written to `v`."""
        np.matmul(self.maps[self.phase], self._in3, out=self._out3)
        self.x[...] = self._next
        self.last, self.phase = self.phase, self._after[self.phase]
        return self._e

    def reset(self) -> None:
        """Set the state back to rest."""
        self.x[...] = 0.0
        self.phase = self.last = 0

    def save(self) -> Saved:
        """Return a copy of the state."""
        return {"x": self.x.copy(), "phase": np.array([self.phase, self.last])}

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        self.x[...] = state["x"]
        self.phase, self.last = (int(i) for i in state["phase"])
