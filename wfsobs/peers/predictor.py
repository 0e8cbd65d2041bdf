"""An observer behind the interface of a modal predictor: fit on a history, then a frame in, a prediction out."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.identification import identify
from wfsobs.identification.result import Identification
from wfsobs.observers import OBSERVERS
from wfsobs.observers.step import StepObserver
from wfsobs.peers.command import CommandAhead
from wfsobs.peers.second_sensor import SecondSensor, SecondSensorOptions
from wfsobs.prior import Training
from wfsobs.priors_from.identification import told_by
from wfsobs.record import Record, Sampling
from wfsobs.scenario import Scenario
from wfsobs.stepping import design
from wfsobs.streams.going_back import GoingBack
from wfsobs.typing import Array

SIZE = 0.5
"""Rms that the history of the modes is scaled to before it is identified [um]: the filters' settings are in micrometres."""


class PredictorError(ValueError):
    """Error: a predictor that cannot be made or fitted; one line with the reason."""


class LoopPredictor:
    """Predicts the disturbance of modes some frames ahead; the interface that pyRTC asks of a predictor.

    Parameters
    ----------
    num_modes : int
        Modes of the loop.
    horizon : int
        Frames from the last measurement to the one that is predicted, 1 or more.
    observer : str
        Id of an observer that needs no training data, or of a controller; those of two sensors with `ngs`.
    rate : float
        Frames per second of the loop [Hz].
    modes : sequence of int, optional
        Modes that the observer predicts, by default all; of the others the last measurement is the prediction.
    prior : str, optional
        The file of `wfsobs identify --out`; by default `fit` identifies the history that it is given.
    scale : float
        Micrometres per unit of the modes, for a prior from a file.
    settings : mapping, optional
        Settings of the observer by dotted name, such as {"gpr_online.inputs": "z"}.
    ngs : mapping, optional
        The second sensor: see `SecondSensorOptions`. It takes a prior from a file, and a horizon that is the delay of the loop.

    Raises
    ------
    PredictorError
        A number is out of range, or the observer cannot run here.
    SettingError
        The file or a setting is refused.
    """

    def __init__(
        self,
        num_modes: int,
        horizon: int = 2,
        *,
        observer: str = "kf-multi",
        rate: float = 1000.0,
        modes: Sequence[int] | None = None,
        prior: str | None = None,
        scale: float = 1.0,
        settings: Mapping[str, Any] | None = None,
        ngs: Mapping[str, Any] | None = None,
    ):
        chosen = list(range(num_modes)) if modes is None else [int(mode) for mode in modes]
        if num_modes < 1 or not chosen or len(set(chosen)) != len(chosen) or not 0 <= min(chosen) <= max(chosen) < num_modes:
            raise PredictorError(f"modes = {chosen}: takes different whole numbers from 0 to {num_modes - 1}")
        if horizon < 1 or not 0 < rate < np.inf or not 0 < scale < np.inf:
            raise PredictorError(f"horizon = {horizon}, rate = {rate}, scale = {scale}: take 1 or more, and numbers above 0")
        self.num_modes, self.horizon, self.fitted = num_modes, horizon, False
        self._id, self._rate, self._modes, self._scale = observer, float(rate), np.array(chosen), float(scale)
        self._settings = Scenario().replace({**(settings or {}), "sensors.lgs_rate": self._rate})
        self._check_observer(ngs is not None)
        self._second = None if ngs is None else self._open_second(ngs, prior)
        self._observer: StepObserver | CommandAhead | None = None
        self._frames: GoingBack | None = None
        self._last = np.zeros(num_modes)
        if prior is not None:
            from wfsobs.scenario import configfile  # needs a writer of TOML, which the core is installed without

            self._put_in(self._design(configfile.load_scenario(prior)))
            self.fitted = True

    def fit(self, pol_history: ArrayLike) -> LoopPredictor:
        """Identify a history of pseudo-open-loop modes, (n, num_modes) in units of the loop, and design the observer.

        With a prior from a file the history is not used. Raises PredictorError, and RecordError where it is too short.
        """
        history = np.asarray(pol_history, dtype=float)
        if history.ndim == 1:
            history = history[:, None]
        if history.ndim != 2 or history.shape[1] != self.num_modes:
            raise PredictorError(f"fit: takes the shape (frames, {self.num_modes}), not {history.shape}")
        if self._observer is None or not self._is_told:
            z = history[:, self._modes]
            known = z[np.isfinite(z)]
            size = float(known.std()) if known.size else 0.0
            if size == 0:
                raise PredictorError("fit: the history is constant or not finite")
            self._scale, self._is_told = SIZE / size, False
            record = Record(self._scale * z, np.zeros_like(z), 1.0 / self._rate)
            self._put_in(self._design(identify(record), record))
        for row in history:
            self._take(row, None)
        self.fitted = True
        return self

    def update(self, pol: ArrayLike) -> None:
        """Take a pseudo-open-loop measurement of all modes, (num_modes,); NaN is missing. Raises StepError."""
        self._take(pol, None if self._second is None else self._second.look())

    def _take(self, pol: ArrayLike, ngs: tuple[int, Array] | None) -> None:
        given = np.asarray(pol, dtype=float).reshape(self.num_modes)
        np.copyto(self._last, given, where=np.isfinite(given))
        if self._observer is None or self._frames is None:
            return
        if self._second is not None and (age := self._second.age) is not None:
            self._frames.align(age)
        late, slow = ngs or (0, None)
        self._frames.update(self._scale * given[self._modes], slow, late)
        self._frames.keep()

    def predict(self) -> Array:
        """Return the modes `horizon` frames after the last measurement, (num_modes,)."""
        out = self._last.copy()
        if self._observer is not None and self._observer.frame:
            parts = [self._observer.predict(self.horizon - 1, target)[0] for target in self._observer.targets]
            out[self._modes] = np.sum(parts, axis=0) / self._scale
        return out

    def reset(self) -> None:
        """Go back to before the first frame, and keep the design."""
        self._last[:] = 0.0
        if self._observer is not None and self._frames is not None:
            self._observer.reset()
            self._frames.forget()

    def _check_observer(self, has_ngs: bool) -> None:
        if self._id not in OBSERVERS and self._id not in CONTROLLERS:
            raise PredictorError(f"observer {self._id!r}: no such observer; there are {', '.join(OBSERVERS)}")
        needs_ngs = CONTROLLERS[self._id].ngs if self._id in CONTROLLERS else "y_ngs" in OBSERVERS[self._id].needs
        if needs_ngs != has_ngs:
            raise PredictorError(
                f"{self._id}: takes {'no' if has_ngs else 'a'} second sensor, ngs: {{stream: ..., ratio: ..., matrix: ...}}"
            )
        if self._id in CONTROLLERS:
            return
        declared = OBSERVERS[self._id]
        if "y_stars" in declared.needs:
            raise PredictorError(f"{self._id}: takes every LGS by itself, which a predictor is not given")
        if Training in declared.prior or len(declared.targets) < 2:
            raise PredictorError(
                f"{self._id}: takes an observer of turbulence and vibration without training data, or a controller"
            )

    def _put_in(self, observer: StepObserver | CommandAhead) -> None:
        self._observer, self._frames = observer, GoingBack(observer)

    def _open_second(self, ngs: Mapping[str, Any], prior: str | None) -> SecondSensor:
        if prior is None:
            raise PredictorError("ngs: a second sensor takes a prior: the file of wfsobs identify --out, of a record of both")
        try:
            options = SecondSensorOptions(**ngs)
            say = logging.getLogger(__name__).warning
            return SecondSensor(options, self._modes, self._scale, self.horizon, self._rate, say)
        except TypeError as error:
            raise PredictorError(f"ngs: {error}") from None

    def _design(self, source: Scenario | Identification, history: Record | None = None) -> StepObserver | CommandAhead:
        self._is_told = isinstance(source, Scenario)
        own = {"sensors.lgs_rate": self._rate, "control.delay": float(self.horizon)}
        scenario = told_by(source, self._settings).replace(own)
        prior = scenario if self._is_told else source
        sampling = Sampling(len(self._modes), 1.0 / self._rate, None if self._second is None else self._second.ratio)
        if self._id in OBSERVERS:
            return design(self._id, prior, scenario=scenario, sampling=sampling, horizon=self.horizon - 1)
        controller = design(self._id, prior, scenario=scenario, sampling=sampling, train=history)
        return CommandAhead(controller, sampling.n_modes, self.horizon)
