"""An observer behind the interface of a modal predictor: fit on a history, then a frame in, a prediction out."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.step import StepController
from wfsobs.identification import identify
from wfsobs.identification.result import Identification
from wfsobs.observers import OBSERVERS
from wfsobs.observers.step import StepObserver
from wfsobs.prior import Training
from wfsobs.priors_from.telemetry import told_by
from wfsobs.record import Record, Sampling
from wfsobs.scenario import Scenario
from wfsobs.stepping import design
from wfsobs.streams.shared_image import StreamError
from wfsobs.streams.wiring import STUCK, GoingBack, NgsStream, NgsWiring
from wfsobs.typing import Array


@dataclass(frozen=True)
class SecondSensorOptions:
    """What a loop's configuration says of its second sensor.

    stream : name of the stream of its slopes
    matrix : file of the matrix (.npy) from its slopes to the modes of the loop, (modes, slopes)
    ratio  : frames of the loop per frame of the sensor
    wfc    : name of the stream of commands
    lag    : frames of the loop between the end of an exposure and its slopes, below `ratio`
    """

    stream: str
    matrix: str
    ratio: int
    wfc: str = "wfc"
    lag: int = 0


class SlopeStream:
    """A stream of slopes, read as residual modes. Raises StreamError where there is none, or no matrix for it."""

    path: str
    n: int
    first: int

    def __init__(self, path: str, matrix: Array):
        self.path, self._matrix = path, matrix
        self._stream = open_stream(path)
        self.n, self.first = len(matrix), self.count
        if int(np.prod(self._stream.shape)) != matrix.shape[1]:
            raise StreamError(f"{path}: {int(np.prod(self._stream.shape))} slopes, the matrix takes {matrix.shape[1]}")

    @property
    def count(self) -> int:
        """Frames that have been written."""
        return int(self._stream.count)

    @property
    def write_time(self) -> int:
        """When the last frame was written [ns]."""
        return round(1e9 * self._stream.write_time)

    @property
    def is_current(self) -> bool:
        """Whether no other stream has taken its name."""
        try:
            return open_stream(self.path).instance_id == self._stream.instance_id
        except StreamError:
            return False

    def read(self, patience: float = 0.0) -> tuple[int, Array] | None:
        """Return the counter and the modes of the last frame, (n,)."""
        frame = self._stream.read_publication()
        return int(frame.count), self._matrix @ np.asarray(frame.payload, dtype=float).ravel()

    def reopen(self) -> SlopeStream:
        """Return the stream that has its name now."""
        return SlopeStream(self.path, self._matrix)


class SecondSensor:
    """The frames of the second sensor, less what the mirror did in them.

    Parameters
    ----------
    options : SecondSensorOptions
        Streams, ratio and matrix.
    elements : Array
        Modes of the loop that are wanted.
    unit : float
        Micrometres per unit of the modes.
    delay : int
        Frames from a command to the first measurement that sees it.
    rate : float
        Frames per second of the loop [Hz].
    say : callable
        Receives one line about whatever happens.

    Raises
    ------
    StreamError
        A stream or the matrix cannot be read, or a number is out of range.
    """

    def __init__(
        self, options: SecondSensorOptions, elements: Array, unit: float, delay: int, rate: float, say: Callable[[str], None]
    ):
        if options.ratio < 1 or not 0 <= options.lag < options.ratio:
            raise StreamError(f"ngs: ratio = {options.ratio}, lag = {options.lag}: take 1 or more, and less than that")
        slopes = SlopeStream(options.stream, read_matrix(options.matrix))
        self._commands, self._elements, self._unit, self._delay = open_stream(options.wfc), elements, unit, delay
        self._history: deque[Array] = deque(maxlen=delay + 2 * options.ratio)
        self._count = 0
        self.ratio: int = options.ratio
        stuck = max(STUCK, 3 * options.ratio / rate)
        wiring = NgsWiring(tuple(map(int, elements)), unit, options.ratio, options.lag, stuck)
        self._frames = NgsStream(slopes, wiring, say)

    def look(self) -> tuple[int, Array] | None:
        """Return what is new: how many frames ago its place was, and the pseudo-open-loop modes [um]; once a frame."""
        self._count += 1
        command = np.asarray(self._commands.read_publication().payload, dtype=float).ravel()
        self._history.append(self._unit * command[self._elements])  # the command of the frame before
        found = self._frames.look(self._count)
        if found is None or len(self._history) < (self._history.maxlen or 0):
            return None
        late, residual = found
        newest = len(self._history) - self._delay - late
        exposure = [self._history[k] for k in range(newest - self.ratio + 1, newest + 1)]
        return late, residual - np.mean(exposure, axis=0)

    @property
    def age(self) -> int | None:
        """Frames of the loop since the last one that a frame of the sensor belongs to, 0 to ratio - 1; None where not known."""
        return None if self._frames.phase is None else (self._count - self._frames.phase) % self.ratio


def open_stream(name: str) -> Any:
    """Open a stream of pyRTC. Raises StreamError where there is none."""
    import pyshmem  # pyright: ignore[reportMissingImports]

    try:
        return pyshmem.open(name)
    except OSError as error:
        raise StreamError(f"{name}: no stream: {error}") from None


def read_matrix(file: str) -> Array:
    """Return a matrix of a .npy file, (modes, slopes). Raises StreamError."""
    try:
        matrix = np.load(Path(file), allow_pickle=False)
    except (OSError, ValueError) as error:
        raise StreamError(f"{file}: no matrix: {error}") from None
    if matrix.ndim != 2 or not np.isfinite(matrix).all():
        raise StreamError(f"{file}: takes a matrix of finite numbers, (modes, slopes), not the shape {matrix.shape}")
    return matrix.astype(float)


class CommandAhead:
    """Predicts `delay` frames after the last measurement, by the controller of a loop with that delay.

    Parameters
    ----------
    controller : StepController
        Designed for a mirror with this delay and without limits.
    """

    targets: tuple[str, ...] = ("disturbance",)

    def __init__(self, controller: StepController):
        self._controller, self._command = controller, np.zeros(controller.sampling.n_modes)

    @property
    def frame(self) -> int:
        """Frames that it has taken."""
        return self._controller.frame

    @property
    def sampling(self) -> Sampling:
        """That of the controller."""
        return self._controller.sampling

    def update(self, z: Array, ngs: Array | None = None) -> None:
        """Take pseudo-open-loop measurements, (n_modes,) [um]. Raises StepError."""
        self._command[:] = self._controller.update_open_loop(z, ngs)

    def predict(self, frames: float = 0.0, target: str = "disturbance") -> tuple[Array, Array]:
        """Return mean and standard deviation, which it does not know, (n_modes,) [um] each."""
        return -self._command, np.full(len(self._command), np.nan)

    def reset(self) -> None:
        """Go back to before the first frame."""
        self._controller.reset()
        self._command[:] = 0.0

    def state_dict(self) -> dict[str, Array]:
        """Return a copy of the state."""
        return {"ahead.command": self._command.copy()} | self._controller.state_dict()

    def load_state_dict(self, state: Mapping[str, Array]) -> None:
        """Go on from a state of `state_dict`. Raises StepError where it is that of another design."""
        rest = dict(state)
        self._command[:] = rest.pop("ahead.command")
        self._controller.load_state_dict(rest)


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

    num_modes: int
    horizon: int

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

        With a prior from a file, which a second sensor needs, the history is not used: the observer goes on. Raises
        PredictorError, and RecordError where it is too short.
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
        self.fitted: bool = True
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
        return CommandAhead(controller)
