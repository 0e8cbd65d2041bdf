"""An observer one frame at a time, as a real loop calls it.

`StepObserver` is what a loop holds. It checks what comes in, completes missing measurements as `wfsobs.observers.missing` does
over a record, unless its observer takes them as missing, and knows when an NGS frame is due; the rest is its `Estimator`, which
every observer makes in its own module.
After frame k `predict(0)` is row k of the observer's run over the record.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from wfsobs.observers.missing import Bridge
from wfsobs.observers.step_checks import (
    StepError,
    check_each,
    check_frame,
    check_ngs,
    check_request,
    check_stars,
    check_state,
    only_target,
)
from wfsobs.signal.stepping import Stateful, load_parts, save_parts
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.prior import Prior
    from wfsobs.record import Sampling


class Estimator(Stateful, Protocol):
    """What differs from observer to observer. Measurements come complete, or with NaN where it takes missing ones.

    Attributes
    ----------
    horizon : float or None
        Frames ahead that it was trained for; None where it predicts any.
    needs_command : bool
        Whether `advance` needs u.
    """

    @property
    def horizon(self) -> float | None: ...  # noqa: D102

    @property
    def needs_command(self) -> bool: ...  # noqa: D102

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame: z (n_modes,) [um]; ngs (n_modes,) [um] where an NGS frame is due; u (n_modes,) [um]."""
        ...

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return (mean, sd) of the target so many frames ahead, (n_modes,) [um], good until the next call. Raises StepError."""
        ...

    def settle(self) -> None:
        """Do now what `advance` left for later."""
        ...

    def take_over(self, old: Any) -> None:
        """Go on from the state of another design of the same observer. Raises StepError."""
        ...


MakeEstimator = Callable[["Prior", Any, "Sampling", float], Estimator]
"""(prior, settings, sampling, horizon) -> estimator. Raises ValueError with the reason where there is none."""


class StepObserver:
    """An observer of several modes, one frame at a time; made by `wfsobs.design`.

    Attributes
    ----------
    id : str
        Of the observer.
    targets : tuple of str
        What it estimates.
    sampling : Sampling
        Modes, step, NGS ratio and delay that it was designed for.
    frame : int
        Frames that it has taken.
    """

    def __init__(
        self,
        id: str,
        targets: tuple[str, ...],
        estimator: Estimator,
        sampling: Sampling,
        needs_ngs: bool,
        bridges: tuple[Bridge, Bridge] | None,
    ):
        self.id, self.targets, self.sampling, self.estimator = id, targets, sampling, estimator
        self.frame, self._ratio, self._needs_ngs = 0, sampling.ratio or 0, needs_ngs
        self._lgs, self._ngs = bridges or (None, None)
        if not needs_ngs:
            self._ngs = None
        found = {id: estimator, "lgs": self._lgs, "ngs": self._ngs}
        self._parts: dict[str, Stateful] = {name: part for name, part in found.items() if part is not None}
        self._allowed_requests: set[tuple[float, str]] = set()
        self._nothing = np.full(sampling.n_modes, np.nan)
        self._each_shape: tuple[int, int] | None = getattr(estimator, "each_shape", None)
        self._see_stars: Callable[[int | None], None] | None = getattr(estimator, "see_stars", None)

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
        z, is_whole = self._check(z, "z")
        check_stars(self.id, stars)
        due = self._needs_ngs and self.frame > 0 and self.frame % self._ratio == 0
        slow = check_ngs(self.id, ngs, due, self.sampling.n_modes, self._ratio, self.frame) if self._needs_ngs else None
        if self.estimator.needs_command:
            if u is None:
                raise StepError(f"{self.id}: its windows hold commands: update(z, u=...) takes that of the frame, too")
            u, _ = self._check(u, "u")
        else:
            u = None
        if self._each_shape is not None:
            self.estimator.see_each(check_each(self.id, each, self._each_shape, self.frame))  # type: ignore[attr-defined]
        if self._lgs is not None:
            z = self._lgs.complete(z, is_whole)
        if slow is not None and self._ngs is not None:
            slow = self._ngs.complete(slow)
        if self._see_stars is not None:
            self._see_stars(stars)
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
            (n_modes,) [um]. NaN where there is none.

        Raises
        ------
        StepError
            Another target, or frames that the observer does not predict.
        """
        if target is None:
            target = only_target(self.id, self.targets)
        if (frames, target) not in self._allowed_requests:
            check_request(self.id, frames, target, self.targets, self.estimator.horizon)
            self._allowed_requests.add((frames, target))
        mean, sd = self.estimator.predict(frames, target) if self.frame else (self._nothing, self._nothing)
        if out is None:
            return mean.copy(), sd.copy()
        out[0][...], out[1][...] = mean, sd
        return out

    def settle(self) -> None:
        """Do what does not need to be done before the estimate is out; the next `update` does it otherwise.

        An observer that learns from every frame learns here: call it once the command has been sent.
        """
        self.estimator.settle()

    def reset(self) -> None:
        """Go back to before the first frame."""
        self.frame = 0
        for part in self._parts.values():
            part.reset()

    def state_dict(self) -> dict[str, Array]:
        """Return a copy of the state: name -> array, plain numbers that `numpy.savez` can keep."""
        return {"frame": np.array(self.frame), **save_parts(self._parts)}

    def load_state_dict(self, state: Mapping[str, ArrayLike]) -> None:
        """Go on from a state of `state_dict`. Raises StepError where it is that of another design."""
        given = check_state(self.id, state, self.state_dict())
        self.frame = int(given["frame"])
        load_parts(self._parts, given)

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
        for new, was in ((self._lgs, old._lgs), (self._ngs, old._ngs)):
            if new is not None and was is not None:
                new.take_over(was)
        self.frame = old.frame

    def _check(self, x: ArrayLike, name: str) -> tuple[Array, bool]:
        return check_frame(self.id, x, name, self.sampling.n_modes, self.frame)
