"""An observer one frame at a time, as a real loop calls it.

`StepObserver` is what a loop holds. It checks what comes in, completes missing measurements as `wfsobs.observers.missing` does
over a record, unless its observer takes them as missing, and knows when an NGS frame is due; the rest is its `Estimator`, which
every observer makes in its own module.
After frame k `predict(0)` is row k of the observer's run over the record.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from math import inf, isfinite, isnan
from textwrap import shorten
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from wfsobs.observers.missing import Bridge
from wfsobs.observers.stepping import StateArrays, Stateful, load_parts, save_parts
from wfsobs.prior import Prior
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Estimates, Measurements, Sampling, by_name
from wfsobs.settings.values import error_line
from wfsobs.signal.gate import GateSettings, OutlierGate, frame_mean_of
from wfsobs.typing import Array, fill_masked
from wfsobs.units import unit_refusal


class StepError(ValueError):
    """Error: a step that cannot be taken, or an observer that has none; one line with the reason."""


class Naming:
    """Context that turns what an observer or a controller, perhaps of another package, raises into a StepError with its id."""

    def __init__(self, id: str):
        self._id = id

    def __enter__(self) -> None:
        """Do nothing."""

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        """Raise StepError."""
        if isinstance(error, Exception) and not isinstance(error, StepError):
            raise StepError(f"{self._id}: {error_line(error)}") from error


def take_state(new: StateArrays, old: StateArrays) -> None:
    """Go on from the state of another design. Raises StepError where that is of another kind, or has other shapes."""
    state = old.save() if type(old) is type(new) else {}
    if {name: x.shape for name, x in state.items()} != {name: x.shape for name, x in new.save().items()}:
        raise StepError("the designs have states of another kind, or of other shapes")
    new.load(state)


class Estimator(StateArrays, ABC):
    """What differs from observer to observer. Measurements come complete, or with NaN where it takes missing ones.

    Over a record it is driven frame by frame. One that is faster over all steps at once has a method `run` (measurements, watch)
    -> Estimates, equal to that; one that states standard deviations of targets together has `estimate` () -> estimates of the
    last frame, (n_targets, n_modes), and deviations of targets, TOTAL and NEXT_Z as far as it knows them.

    Attributes
    ----------
    horizon : float or None
        Frames ahead that it was trained for; None where it predicts any.
    needs_command : bool
        Whether `advance` needs u.
    """

    horizon: float | None = None
    needs_command: bool = False

    @abstractmethod
    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame: z (n_modes,) [um]; ngs (n_modes,) [um] where an NGS frame is due; u (n_modes,) [um]."""

    @abstractmethod
    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return (mean, sd) of the target so many frames ahead, (n_modes,) [um], good until the next call. Raises StepError."""

    def settle(self) -> None:
        """Do now what `advance` left for later; by default nothing."""

    def take_over(self, old: Any) -> None:
        """Go on from the state of another design of the same observer. Raises StepError."""
        take_state(self, old)


class HeldEstimate(Estimator):
    """An estimator that makes its estimate in `advance`, for one horizon.

    Parameters
    ----------
    n_modes : int
        Number of modes.
    horizon : float or None
        Frames ahead that it predicts; None where it holds its estimate for any.
    before : float
        The mean before the first one [um].
    """

    state_names: tuple[str, ...] = ("_mean",)

    def __init__(self, n_modes: int, horizon: float | None, before: float = np.nan):
        self.horizon = horizon
        self._mean, self._sd = np.full(n_modes, before), np.full(n_modes, np.nan)

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return mean and standard deviation of the last frame."""
        return self._mean, self._sd


MakeEstimator = Callable[[Prior, Any, Sampling, float], Estimator]
"""(prior, settings, sampling, horizon) -> estimator. Raises ValueError with the reason where there is none."""

EVERY = 200
"""Frames between two looks at whether to stop: the largest training set of a GPR takes 10 ms a frame."""


class RecordFrame(NamedTuple):
    """A frame of a record, as `StepObserver.update` takes it: NaN is missing, None is none."""

    z: Array
    ngs: Array | None
    u: Array
    stars: int | None
    each: Array | None


def frames_of(measurements: Measurements, watch: Watch = QUIET, steps: Iterable[int] | None = None) -> Iterator[RecordFrame]:
    """Yield the frames of a record, NGS frames where they are due; steps : those wanted, by default all. Raises Cancelled."""
    z, u, n, stars = measurements.z, measurements.u, measurements.ratio, measurements.lgs_stars
    z_ngs = measurements.z_ngs if n is not None and measurements.y_ngs is not None else None
    each = None if measurements.y_stars is None else measurements.z_stars
    for k in range(len(z)) if steps is None else steps:
        if k % EVERY == 0:
            watch.step(k / len(z))
        is_due = n is not None and k > 0 and k % n == 0
        yield RecordFrame(
            z[k],
            z_ngs[k] if z_ngs is not None and is_due else None,
            u[k],
            None if stars is None else int(stars[k]),
            None if each is None else each[k],
        )


def run_frames(estimator: Any, targets: Sequence[str], measurements: Measurements, watch: Watch) -> Estimates:
    """Run an estimator over a record frame by frame, for all modes at the same time.

    Filters that take the number of LGS, or every LGS by itself, are given these before the frame.
    """
    values, sd = [], []
    see_stars, see_each, estimate = (getattr(estimator, name, None) for name in ("see_stars", "see_each", "estimate"))
    for frame in frames_of(measurements, watch):
        if frame.stars is not None and see_stars is not None:
            see_stars(frame.stars)
        if frame.each is not None and see_each is not None:
            see_each(frame.each)
        estimator.advance(frame.z, frame.ngs, frame.u)
        pairs = [] if estimate else [estimator.predict(0.0, one) for one in targets]
        if any(not isinstance(pair, tuple) for pair in pairs):
            raise StepError("predict returns no tuple of mean and standard deviation")
        now, spread = estimate() if estimate else np.array(pairs).swapaxes(0, 1)
        values.append(now)
        sd.append(spread)
    if estimate:
        return Estimates(by_name(np.array(values)), by_name(np.array(sd)))
    found = [dict(zip(targets, np.array(x).swapaxes(0, 1), strict=True)) for x in (values, sd)]
    return Estimates(found[0], {target: x for target, x in found[1].items() if not np.isnan(x).all()})


class StepBase:
    """What observers and controllers share, one frame at a time: checks, gates, the bridging of gaps, and the state.

    Attributes
    ----------
    id : str
        Of the observer or controller.
    sampling : Sampling
        Modes, step, NGS ratio and delay that it was designed for.
    uses_ngs : bool
        Whether it takes NGS frames.
    bridges : tuple of Bridge or None
        What completes LGS measurements and NGS frames; None where it takes missing ones as missing.
    frame : int
        Frames that it has taken.
    """

    id: str
    sampling: Sampling
    uses_ngs: bool
    bridges: tuple[Bridge, Bridge] | None
    frame: int

    def __init__(
        self,
        id: str,
        sampling: Sampling,
        uses_ngs: bool,
        bridges: tuple[Bridge, Bridge] | None,
        gate: GateSettings | None,
        each_shape: tuple[int, int] | None = None,
    ):
        self.id, self.sampling, self.uses_ngs, self.bridges, self.frame = id, sampling, uses_ngs, bridges, 0
        self._naming: Naming = Naming(id)
        self._ratio = sampling.ratio or 0
        self._lgs, self._ngs = bridges or (None, None)
        if not uses_ngs:
            self._ngs = None
        n, (stars, modes) = sampling.n_modes, each_shape or (0, 0)
        sizes = {"gate_lgs": n, "gate_ngs": n * uses_ngs, "gate_each": stars * modes}
        self._gates = {name: OutlierGate(size, gate) for name, size in sizes.items() if size} if gate else {}
        self._lgs_history = np.zeros((self._ratio if "gate_ngs" in self._gates else 0, sampling.n_modes))  # newest last
        known = {"lgs": self._lgs, "ngs": self._ngs, **self._gates}
        self._parts: dict[str, Stateful] = {name: part for name, part in known.items() if part is not None}
        self._arrays: dict[str, Array] = {"lgs_history": self._lgs_history} if self._lgs_history.size else {}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.id}, frames {self.frame}, modes {self.sampling.n_modes})"

    def __copy__(self) -> Self:
        return deepcopy(self)  # the state of a copy is its own

    def reset(self) -> None:
        """Go back to before the first frame, a mirror at rest."""
        self.frame = 0
        for x in self._arrays.values():
            x[...] = 0.0
        for part in self._parts.values():
            part.reset()

    def state_dict(self) -> dict[str, Array]:
        """Return a copy of the state: name -> array, plain numbers that `numpy.savez` can keep."""
        own = {name: x.copy() for name, x in self._arrays.items()}
        return {"frame": np.array(self.frame), **own, **save_parts(self._parts)}

    def load_state_dict(self, state: Mapping[str, ArrayLike]) -> None:
        """Go on from a state of `state_dict`. Raises StepError where it is that of another design."""
        given = check_state(self.id, state, self.state_dict())
        self.frame = int(given["frame"])
        for name, x in self._arrays.items():
            x[...] = given[name]
        load_parts(self._parts, given)

    def _check(self, x: ArrayLike, ngs: ArrayLike | None, stars: int | None, name: str) -> tuple[Array, bool, Array | None]:
        """Return an LGS measurement, whether it has no NaN, and an NGS frame that is due. Raises StepError."""
        x, is_whole = self._check_frame(x, name)
        if stars is not None and (not isinstance(stars, (int, np.integer)) or stars < 0):
            raise StepError(f"{self.id}: stars takes a whole number, 0 or more, not {shorten(repr(stars), 60)}")
        return x, is_whole, self._check_ngs(ngs) if self.uses_ngs else None

    def _check_frame(self, x: ArrayLike, name: str, ago: int = 0) -> tuple[Array, bool]:
        """Return one number per mode as an array, and whether it has no NaN, which is missing. Raises StepError.

        ago : frames since that of x
        """
        if type(x) is not np.ndarray or x.dtype != float:
            x = as_numbers(self.id, x, name)
        shape = (self.sampling.n_modes,)
        if x.shape != shape:
            raise StepError(f"{self.id}: {name} takes the shape {shape}, one number per mode, not {x.shape}")
        is_whole = all(map(isfinite, x.tolist()))  # faster than numpy for few, and no square overflows
        if not is_whole and np.isinf(x).any():
            raise StepError(f"{self.id}: {name} is infinite in frame {self.frame - ago}; NaN stands for a missing number")
        return x, is_whole

    def _check_ngs(self, ngs: ArrayLike | None) -> Array | None:
        """Return an NGS frame that is due, NaN where it is missing, and None where none is due. Raises StepError."""
        n = self._ratio
        if self.frame > 0 and self.frame % n == 0:
            return np.full(self.sampling.n_modes, np.nan) if ngs is None else self._check_frame(ngs, "ngs")[0]
        if ngs is not None and not np.isnan(as_numbers(self.id, ngs, "ngs")).all():
            raise StepError(f"{self.id}: an NGS frame in frame {self.frame}: one is due in every {n}th, {n}, {2 * n}, ...")
        return None

    def _pass_gate(self, name: str, z: Array) -> Array:
        """Return an LGS measurement of any shape [um] with outliers missing, or clipped; those without earlier commands pass."""
        if name not in self._gates or self.frame < self.sampling.delay:
            return z
        return self._gates[name].check(z.ravel()).reshape(z.shape)

    def _complete_lgs(self, z: Array, is_whole: bool) -> Array:
        """Pass the gate and the bridge of LGS measurements."""
        if self._gates:
            z = self._pass_gate("gate_lgs", z)
            is_whole = is_whole and not np.isnan(z).any()
        if self._lgs_history.size:
            self._lgs_history[:-1], self._lgs_history[-1] = self._lgs_history[1:], z
        return z if self._lgs is None else self._lgs.complete(z, is_whole)

    def _complete_ngs(self, z: Array) -> Array:
        """Pass the gate and the bridge of NGS frames."""
        if self._lgs_history.size and self.frame >= self.sampling.delay + self._ratio - 1:
            z = self._gates["gate_ngs"].check_beside(z, frame_mean_of(self._lgs_history))
        return z if self._ngs is None else self._ngs.complete(z)

    def _take_over(self, old: StepBase) -> None:
        """Go on with the bridges, gates and arrays of another design."""
        for new, was in ((self._lgs, old._lgs), (self._ngs, old._ngs)):
            if new is not None and was is not None:
                new.take_over(was)
        for name in self._gates.keys() & old._gates.keys():
            self._gates[name].load(old._gates[name].save())
        for name, x in self._arrays.items():
            x[...] = old._arrays[name]
        self.frame = old.frame


class StepObserver(StepBase):
    """An observer of several modes, one frame at a time; made by `wfsobs.design`.

    Attributes
    ----------
    targets : tuple of str
        What it estimates.
    estimator : Estimator
        What differs from observer to observer.
    """

    frame: int
    targets: tuple[str, ...]
    estimator: Estimator

    def __init__(
        self,
        id: str,
        targets: tuple[str, ...],
        estimator: Estimator,
        sampling: Sampling,
        needs_ngs: bool,
        bridges: tuple[Bridge, Bridge] | None,
        gate: GateSettings | None = None,
    ):
        self.targets, self.estimator = targets, estimator
        self._each_shape: tuple[int, int] | None = getattr(estimator, "each_shape", None)
        super().__init__(id, sampling, needs_ngs, bridges, gate, self._each_shape)
        self._parts[id] = estimator
        self._allowed_requests: set[tuple[float, str]] = set()
        self._nothing = np.full(sampling.n_modes, np.nan)
        self._see_stars: Callable[[int | None], None] | None = getattr(estimator, "see_stars", None)
        self._see_each: Callable[[Array], None] | None = getattr(estimator, "see_each", None)

    def update(
        self,
        z: ArrayLike,
        ngs: ArrayLike | None = None,
        u: ArrayLike | None = None,
        *,
        stars: int | None = None,
        each: ArrayLike | None = None,
    ) -> None:
        """Take the measurements of a frame.

        Parameters
        ----------
        z : array_like
            Pseudo-open-loop LGS measurement z[k] = y_lgs[k] - u[k-delay] of every mode, (n_modes,) [um]; NaN is missing.
        ngs : array_like, optional
            Pseudo-open-loop NGS measurement, (n_modes,) [um], in the frames that have one: k = n, 2n, ... for the ratio n. One
            that is due and missing or NaN is predicted.
        u : array_like, optional
            Command u[k], (n_modes,) [um]; for observers alone whose windows hold commands.
        stars : int, optional
            LGS that z is the mean over; by default all. A filter that is told them has the noise of those that are there.
        each : array_like, optional
            Every LGS by itself, as z, (n_lgs, n_modes) [um], NaN where one is out; for observers alone that take them apart.

        Raises
        ------
        StepError
            A wrong shape, an infinite number, an NGS frame that is not due, no command, or no LGS apart, where that is needed.
            The frame is then not taken.
        """
        z, is_whole, slow = self._check(z, ngs, stars, "z")
        if self.estimator.needs_command:
            if u is None:
                raise StepError(f"{self.id}: its windows hold commands: update(z, u=...) takes that of the frame, too")
            u, _ = self._check_frame(u, "u")
        else:
            u = None
        if self._each_shape is not None and self._see_each is not None:
            self._see_each(self._pass_gate("gate_each", self._check_each(each, self._each_shape)))
        z = self._complete_lgs(z, is_whole)
        slow = None if slow is None else self._complete_ngs(slow)
        if self._see_stars is not None:
            self._see_stars(stars)
        with self._naming:
            self.estimator.advance(z, slow, u)
        self.frame += 1

    def predict(
        self, frames: float = 0, target: str | None = None, *, out: tuple[Array, Array] | None = None
    ) -> tuple[Array, Array]:
        """Predict a target.

        Parameters
        ----------
        frames : float
            Frames ahead of the last one, 0 or more; with a fraction where the observer has a model in continuous time.
        target : str, optional
            "turbulence" or "vibration"; can be left out where the observer estimates one.
        out : (Array, Array), optional
            Arrays that mean and sd are written to, (n_modes,) each, for a loop that allocates nothing; by default new ones.

        Returns
        -------
        mean, sd : Array
            Prediction, and its standard deviation by the observer's own model once that is in its steady state, each
            (n_modes,) [um]. NaN where there is none; no deviation where the last measurement was filled.

        Raises
        ------
        StepError
            Another target, or frames that the observer does not predict.
        """
        if target is None:
            if len(self.targets) != 1:
                raise StepError(f"{self.id}: predict takes a target: {' or '.join(self.targets)}")
            target = self.targets[0]
        if (frames, target) not in self._allowed_requests:
            self._check_request(frames, target)
            self._allowed_requests.add((frames, target))
        with self._naming:
            mean, sd = self.estimator.predict(frames, target) if self.frame else (self._nothing, self._nothing)
            if mean.shape != self._nothing.shape:
                raise ValueError(f"predict takes the shape {self._nothing.shape}, one number per mode, not {mean.shape}")
        if self._lgs is not None and self._lgs.is_missing.any():
            sd = np.where(self._lgs.is_missing, np.nan, sd)
        if out is None:
            return mean.copy(), sd.copy()
        out[0][...], out[1][...] = mean, sd
        return out

    def _check_each(self, each: ArrayLike | None, shape: tuple[int, int]) -> Array:
        """Return the measurement of every LGS by itself as an array, NaN where one is out. Raises StepError."""
        x = None if each is None else as_numbers(self.id, each, "each")
        if x is None or x.shape != shape:
            raise StepError(f"{self.id}: takes every LGS by itself: update(z, each=...) of the shape {shape}, (n_lgs, n_modes)")
        if np.isinf(x).any():
            raise StepError(f"{self.id}: each is infinite in frame {self.frame}; NaN stands for a star that is out")
        return x

    def _check_request(self, frames: float, target: str) -> None:
        """Raise StepError for a prediction that the observer does not make."""
        if target not in self.targets:
            raise StepError(f"{self.id}: target {target!r}: it estimates {' and '.join(self.targets)}")
        if not isinstance(frames, (int, float, np.number)) or not 0 <= frames < inf:
            raise StepError(f"{self.id}: frames = {frames!r}: takes 0 or more")
        horizon = self.estimator.horizon
        if horizon is not None and frames != horizon:
            raise StepError(
                f"{self.id}: designed for {horizon:g} frames ahead; design it with horizon = {frames:g} for predict({frames:g})"
            )

    def settle(self) -> None:
        """Do what does not need to be done before the estimate is out; the next `update` does it otherwise.

        An observer that learns from every frame learns here: call it once the command has been sent.
        """
        with self._naming:
            self.estimator.settle()

    def take_over(self, old: StepObserver) -> None:
        """Go on where another design of the same observer is: the estimates continue without a start of their own.

        Parameters
        ----------
        old : StepObserver
            Of the same observer and sampling, with another prior or other settings.

        Raises
        ------
        StepError
            Another observer or sampling, or a state that cannot be carried over.
        """
        if old.id != self.id or old.sampling != self.sampling:
            raise StepError(f"{self.id}: takes over from a design of the same observer and sampling, not from {old.id}")
        self.estimator.take_over(old.estimator)
        self._take_over(old)


KNOWN = frozenset({"beside", "commands", "covariance", "frames", "held_value", "last", "mirror", "sent", "states", "x"})
"""Parts of a state that hold finite numbers; others may have NaN where nothing is known yet."""


def as_numbers(id: str, x: ArrayLike, name: str) -> Array:
    """Return real numbers as float64. Raises StepError for anything else."""
    is_plain = type(x) is np.ndarray  # which has neither unit nor mask: nearly all that comes in a loop
    if not is_plain and (why := unit_refusal(x)):
        raise StepError(f"{id}: {name} {why}")
    try:
        raw = np.asarray(x) if is_plain else fill_masked(x)
        if raw.dtype.kind in "biufO":
            return raw.astype(float)
    except (TypeError, ValueError):
        raise StepError(f"{id}: {name} takes real numbers, not {shorten(repr(x), 60)}") from None
    raise StepError(f"{id}: {name} takes real numbers, not {'text' if raw.dtype.kind in 'SU' else raw.dtype}")


def check_state(id: str, state: Mapping[str, ArrayLike], own: Mapping[str, Array]) -> dict[str, Array]:
    """Return a state as arrays. Raises StepError where it is that of another design, or has no numbers where there are some."""
    if not isinstance(state, Mapping):
        raise StepError(f"{id}: load_state_dict: takes what state_dict returns, not a {type(state).__name__}")
    given = {name: as_numbers(id, x, f"load_state_dict: {name}") for name, x in state.items()}
    for name in sorted(own.keys() | given.keys()):
        if name not in given or name not in own or given[name].shape != own[name].shape:
            shape = "no such state" if name not in own else f"takes the shape {own[name].shape}"
            raise StepError(f"{id}: load_state_dict: the state is that of another design: {name}: {shape}")
        is_count = own[name].dtype.kind in "biu"
        if (is_count or name.rpartition(".")[2] in KNOWN) and not np.isfinite(given[name]).all():
            raise StepError(f"{id}: load_state_dict: {name} is NaN or infinite")
        if is_count and (given[name] % 1).any():
            raise StepError(f"{id}: load_state_dict: {name} takes whole numbers")
        given[name] = given[name].astype(own[name].dtype)
    if given["frame"] < 0:
        raise StepError(f"{id}: load_state_dict: frame = {given['frame']:g}: takes 0 or more")
    return given


def whole_frames(frames: float, what: str) -> int:
    """Return frames as a whole number. Raises StepError."""
    if isnan(frames) or frames < 0 or frames != int(frames):
        raise StepError(f"{what}: takes a whole number of frames ahead, 0 or more, not {frames:g}")
    return int(frames)
