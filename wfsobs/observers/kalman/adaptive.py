"""Adaptive Kalman filters: the model is identified anew from the last seconds of the measurements, again and again.

They need no prior and follow changes: noise, turbulence and peaks of every window are identified (`kalman.window_model`), and the
steady-state filter of that model runs until the next. A new filter starts at rest at the beginning of its window, so that its
state has converged when its estimates begin. What does not move in a window, its mean, counts as turbulence.

`kf-adaptive` sees the LGS; its window has one length. `multirate-adaptive` sees both sensors: while the record is still, its
window grows from `adaptive.window` to `adaptive.longest`, so that close lines part and every number becomes more certain; the
peaks of the window before are tracked. Where the innovations are not as large as the model says, something has changed, and the
window is the shortest one again. The mean of a window is taken off either sensor; that of the NGS counts.

Missing measurements are missing: the filter in charge has the gains that it has near gaps, and a window is identified from the
samples that it has. Where they are too few the filter goes on until the next check; of both sensors, behind a long gap its model
stays, while the record is still, until a window as long as its own is there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from wfsobs.observers.base import TARGETS, TURBULENCE, Look, Observer, Tunable
from wfsobs.observers.kalman.filters import NGS
from wfsobs.observers.kalman.step import STEADY, KalmanEstimator, sensor_inputs
from wfsobs.observers.kalman.window_model import (
    ADAPTIVE,
    Adaptive,
    Lengths,
    WindowModel,
    identify_window,
    model_filter,
    pack_spectrum,
    sensor_samples,
    unpack_spectrum,
    window_lengths,
)
from wfsobs.observers.step import Estimator, StepError, run_frames
from wfsobs.observers.stepping import SampleHistory, Saved
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Estimates, Measurements, RecordError, Sampling, by_name
from wfsobs.typing import Array

STILL = 0.7, 1.4
"""Mean square of the innovations over what the model says, within which a record is still."""
TAIL = 200
"""Last steps of a window, in whole frames, that a new filter takes with their gaps; before them it takes what is expected in
these."""


def is_still(surprise: Array) -> bool:
    """Return whether squared innovations over their variances (n,) are as large as they should be; NaN where none is.

    Of fewer than half it is not told.
    """
    there = surprise[~np.isnan(surprise)]
    return 2 * there.size < surprise.size or bool(STILL[0] < there.mean() < STILL[1])


def with_hidden(sd: Array, hidden_rms: float) -> Array:
    """Return standard deviations of the targets and TOTAL, (..., 3) [um], with vibration that may be in no line of the model.

    hidden_rms : its rms [um]; it is taken for turbulence, so that it is not missing in both together
    """
    return np.hypot(sd, hidden_rms * np.array([1.0, 1.0, 0.0]))


class ModeWindow:
    """The filter in charge of one mode, and when the next model is due.

    Attributes
    ----------
    due, began, last_change : int
        Steps taken when the next identification is due, when the last one was, and before which the record was not still.
    model : WindowModel
        What was identified last.
    size : int
        Steps of the window of that model.
    means : Array
        Of the window, of LGS and NGS, (1 or 2,) [um]; NaN before the first.
    kalman : KalmanEstimator or None
        None before the first model, and where nothing moves.
    surprise : Array
        Squared innovations over their variances since the last check, NaN where z is missing, (interval,); of both sensors.
    """

    lengths: Lengths
    due: int
    began: int
    last_change: int
    size: int
    means: Array
    surprise: Array

    def __init__(self, lengths: Lengths):
        self.lengths, self.model = lengths, WindowModel()
        self.due, self.began, self.last_change, self.size = lengths.first + lengths.window, 0, 0, 0
        both = lengths.ratio is not None
        self.means, self.surprise = np.full(1 + both, np.nan), np.ones(lengths.interval * both)
        self.kalman: KalmanEstimator | None = None

    def advance(self, v: Array, count: int) -> None:
        """Take LGS and NGS (1 or 2,), the last of `count` steps."""
        assert self.kalman is not None
        moved, place = v - self.means, (count - self.began - 1) % self.lengths.interval
        if self.surprise.size:
            innovation = moved[0] - self._ahead @ self.kalman.bank.x[0]
            self.surprise[place] = innovation**2 / self._innovation_variance()
        self.kalman.advance(moved[:1], moved[1:], None)
        if self.surprise.size and place == self.lengths.interval - 1 and not is_still(self.surprise):
            self.last_change, self.due = count - self.lengths.interval, count

    def _innovation_variance(self) -> float:
        assert self.kalman is not None
        bank, one = self.kalman.bank, self.kalman.modes[0]
        near = bank.near[0]
        if near is None or near.is_last:
            return self._variance[bank.phase - 1]
        A, C, Q, R = one.cycle[bank.last_in_cycle]
        return C[0] @ (A @ near.posterior @ A.T + Q) @ C[0] + R[0, 0]

    def identify(self, v: Array, dt: float, settings: Adaptive) -> Array | None:
        """Identify a window v (n, 1 or 2) that ends now; return the part that was used, without gaps, or None without a model."""
        ratio = self.lengths.ratio
        least = self.size if ratio is not None and self.last_change < self.began else 0
        found = identify_window(v, dt, settings, self.model, self.lengths, least)
        if found is None:
            self.due += self.lengths.interval
            return None
        self.model, whole = found
        self.began, self.due, self.size = self.due, self.due + self.lengths.next_length(len(whole)), len(whole)
        if self.model.spectrum is None:
            return None
        self.means = np.array([x.mean() for x in sensor_samples(whole, ratio)])
        return whole

    def start(self, v: Array, whole: Array) -> None:
        """Take the filter of what was found through its window; v : with gaps; whole : its end or all of it, without."""
        kalman = self.put_in_charge()
        if kalman is None:
            return
        gains, frame = kalman.modes[0].gains, self.lengths.frame
        tail = v[len(v) - min(TAIL // frame * frame, len(whole) - frame) :]
        lost = bool(np.isnan(tail).any())
        since = len(whole) - 1 - lost * len(tail)
        (kalman.bank.x[0],) = gains.filter(np.eye(len(gains.steps[0].A))).run((whole - self.means)[: since + 1], since=since)
        for row in tail - self.means if lost else ():
            kalman.advance(row[:1], row[1:], None)

    def put_in_charge(self) -> KalmanEstimator | None:
        """Activate the filter of what was found: at rest, of both sensors after a whole frame."""
        one = self.model.filter
        self.kalman = None if one is None else KalmanEstimator([one])
        if one is not None and self.kalman is not None and self.surprise.size:
            self._ahead, self._variance = one.cycle[0][1][0] @ one.cycle[0][0], one.innovation_variances()
            self.kalman.bank.phase, self.kalman.bank.last = 1, self.lengths.frame
        return self.kalman

    def run(self, v: Array, dt: float, settings: Adaptive, tell: Callable[[float], None]) -> tuple[Array, Array]:
        """Run over the record of a mode without gaps, v (n, 1 or 2) [um]; `tell` receives the fraction done.

        Returns turbulence and vibration, (n, 2), and deviations of these and of both together, (n, 3) [um]; NaN until the first
        window is full.
        """
        n, interval = len(v), self.lengths.interval
        out, sd = np.full((n, 2), np.nan), np.full((n, 3), np.nan)
        while self.due <= n:
            tell(self.began / n)
            end = self.due
            start = self.lengths.window_start(end, self.last_change)
            if self.identify(v[start:end], dt, settings) is None:
                continue
            stop = min(self.due, n)
            here = slice(end - 1, stop)
            if self.model.filter is None:
                out[here] = self.means[-1], 0.0
                continue
            estimates, spread, surprise = self._run_block(v[start:stop], end - start)
            for check in range(end + interval, stop + 1, interval) if self.surprise.size else ():
                if not is_still(surprise[check - interval - end : check - end]):
                    self.last_change, self.due = check - interval, check
                    here = slice(end - 1, check)
                    break
            out[here], sd[here] = (x[: here.stop - here.start] for x in (estimates, spread))
        return out, sd

    def _run_block(self, v: Array, size: int) -> tuple[Array, Array, Array]:
        """Run the filter of what was found from the first step of v on; size : steps of its window, which come first.

        Returns estimates of the window's last step and the m behind it, (m + 1, 2), deviations of these and of both together,
        (m + 1, 3) [um], and squared innovations of those m over their variances, (m,).
        """
        one = self.model.filter
        assert one is not None
        A, C, _, _ = one.cycle[0]
        rows, moved = one.rows(TARGETS), v - self.means
        found = one.gains.filter(np.vstack([rows, C[0] @ A])).run(moved, since=size - 1)
        phase = np.arange(size - 1, len(v)) % len(one.cycle)
        surprise = (moved[size:, 0] - found[:-1, 2]) ** 2 / np.array(one.innovation_variances())[phase[1:]]
        sums = np.vstack([rows, rows.sum(axis=0)])
        sd = np.sqrt([np.maximum(np.sum((sums @ P) * sums, axis=1), 0.0) for P in one.posterior])
        return found[:, :2] + [self.means[-1], 0.0], with_hidden(sd, self.model.hidden_rms)[phase], surprise

    def predict(self, frames: float, target: str) -> tuple[float, float]:
        """Return mean and standard deviation of a target."""
        level = self.means[-1] if target == TURBULENCE else 0.0 * self.means[-1]
        if self.kalman is None:
            return level, np.nan
        (moving,), (spread,) = self.kalman.predict(frames, target)
        return moving + level, np.hypot(spread, self.model.hidden_rms)

    def estimate(self) -> tuple[Array, Array]:
        """Return the estimates (2,) of the last frame, and deviations of these and TOTAL, (3,) [um]."""
        level = self.means[-1] * np.array([1.0, 0.0])
        if self.kalman is None:
            return level, np.full(3, np.nan)
        values, sd = self.kalman.estimate()
        return values[:, 0] + level, with_hidden(sd[:3, 0], self.model.hidden_rms)

    def save(self, rows: int) -> Saved:
        """Return a copy of the state; rows : in the tables of spectra."""
        n, model = 4 * (rows + len(TARGETS)) + 2, self.model
        states, covariance, phases, near = np.zeros(n), np.zeros((n, n)), np.zeros(2, int), np.array(STEADY)
        if self.kalman is not None:
            one = self.kalman.bank.save()
            order, phases, near = one["x"].shape[1], one["phase"], one["near"][0]
            states[:order], covariance[:order, :order] = one["x"][0], one["covariance"][0]
        return {
            "times": np.array([self.due, self.began, self.last_change, self.size]),
            "spectra": np.array([pack_spectrum(one, rows) for one in (model.fit, model.spectrum, model.error)]),
            "noise": np.array([model.ngs, model.hidden_rms]),
            "means": self.means.copy(),
            "surprise": self.surprise.copy(),
            "states": states,
            "phases": phases,
            "near": near,
            "covariance": covariance,
        }

    def load(self, state: Mapping[str, Array], dt: float) -> None:
        """Take over a state."""
        self.due, self.began, self.last_change, self.size = (int(i) for i in state["times"])
        self.means, self.surprise = state["means"].copy(), state["surprise"].copy()
        steps = (dt, dt, dt * self.lengths.frame)
        fit, spectrum, error = (unpack_spectrum(table, step) for table, step in zip(state["spectra"], steps, strict=True))
        ngs, hidden_rms = state["noise"].tolist()
        filter_ = None if spectrum is None else model_filter(spectrum, error, ngs, self.lengths.ratio)
        self.model: WindowModel = WindowModel(fit, spectrum, filter_, hidden_rms, error, ngs)
        kalman = self.put_in_charge()
        if kalman is not None:
            n = kalman.bank.x.shape[1]
            own = {"near": state["near"][None], "covariance": state["covariance"][None, :n, :n], "phase": state["phases"]}
            kalman.bank.load({"x": state["states"][None, :n], **own})


class AdaptiveEstimator(Estimator):
    """The adaptive filter of one sensor, or of both where the sampling has NGS frames that it uses.

    It identifies in `advance`, each mode when its window is due. Over a record without gaps it runs a filter over all steps to
    the next identification at once.

    Parameters
    ----------
    settings : Adaptive
        Of its windows.
    sampling : Sampling
        Of the loop; its ratio is None for the LGS alone.
    """

    settings: Adaptive
    sampling: Sampling
    lengths: Lengths
    count: int

    state_names: tuple[str, ...] = ("_samples", "count")

    def __init__(self, settings: Adaptive, sampling: Sampling):
        self.settings, self.sampling = settings, sampling
        self.lengths = window_lengths(settings, sampling.dt, sampling.ratio, sampling.delay)
        self.lengths.check(settings, sampling.dt)
        self._n_sensors = 1 if sampling.ratio is None else 2
        self.count, self._samples = 0, SampleHistory(sampling.n_modes * self._n_sensors, self.lengths.longest)
        self.windows: list[ModeWindow] = [ModeWindow(self.lengths) for _ in range(sampling.n_modes)]
        self._outputs: dict[tuple[float, str], Array] = {}
        self.mark_start()

    def run(self, measurements: Measurements, watch: Watch) -> Estimates:
        """Run over a record. Raises RecordError for one that is shorter than a window."""
        m, needed = self.sampling.n_modes, self.lengths.first + self.lengths.window
        if measurements.n_steps < needed:
            window = f"adaptive.window = {self.settings.window:g} s"
            raise RecordError(f"the record has {measurements.n_steps} steps; {window} needs {needed}")
        v = sensor_inputs(measurements, self.lengths.ratio)
        if np.isnan(v).any():
            return run_frames(self, TARGETS, measurements, watch)
        columns = []
        for mode, window in enumerate(self.windows):  # one after the other: steps as short as these leave a second thread no room
            tell = watch.part(mode / m, 1.0 / m).step
            columns.append(window.run(np.ascontiguousarray(v[:, :, mode]), measurements.dt, self.settings, tell))
        return Estimates(*(by_name(np.stack(found, axis=-1)) for found in zip(*columns, strict=True)))

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        row = z[:, None] if self._n_sensors == 1 else np.column_stack([z, np.zeros(len(z)) if ngs is None else ngs])
        self._samples.push(row.ravel())
        self.count += 1
        for mode, (v, window) in enumerate(zip(row, self.windows, strict=True)):
            if window.kalman is not None:
                window.advance(v, self.count)
            if self.count == window.due:
                size = self.count - self.lengths.window_start(self.count, window.last_change)
                seen = self._samples.last(size)[self._n_sensors * mode : self._n_sensors * (mode + 1)].T
                whole = window.identify(seen, self.sampling.dt, self.settings)
                if whole is not None:
                    window.start(seen, whole)

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return mean and standard deviation; NaN before the first full window."""
        out = self._outputs.setdefault((frames, target), np.empty((2, len(self.windows))))
        for mode, window in enumerate(self.windows):
            out[:, mode] = window.predict(frames, target)
        return out[0], out[1]

    def estimate(self) -> tuple[Array, Array]:
        """Return the estimates of the last frame, (2, n_modes), and deviations of these and of both together, (3, n_modes)."""
        values, sd = zip(*(window.estimate() for window in self.windows), strict=True)
        return np.stack(values, axis=1), np.stack(sd, axis=1)

    def save(self) -> Saved:
        """Return a copy of the state: the samples, what was found in them, and the states of the filters."""
        saved = [window.save(self._n_sensors * self.settings.peak_count + 2) for window in self.windows]
        return super().save() | {name: np.array([one[name] for one in saved]) for name in saved[0]}

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        super().load(state)
        for mode, window in enumerate(self.windows):
            window.load({name: x[mode] for name, x in state.items() if np.ndim(x)}, self.sampling.dt)

    def take_over(self, old: Any) -> None:
        """Go on from another design with the same windows and as many peaks. Raises StepError."""
        kinds = [(e.lengths.window if e.lengths.ratio is None else e.lengths, e.settings.peak_count) for e in (self, old)]
        if kinds[0] != kinds[1]:
            raise StepError("the designs have other windows or another maximum number of peaks")
        self.load(old.save())


def adapt(z: Array, dt: float, settings: Adaptive, tell: Callable[[float], None]) -> tuple[Array, Array]:
    """Run the adaptive filter of the LGS over z (n,) of one mode, as `ModeWindow.run`."""
    return ModeWindow(window_lengths(settings, dt)).run(z[:, None], dt, settings, tell)


def kf_adaptive(_prior: Prior, settings: Adaptive, sampling: Sampling, _horizon: float) -> AdaptiveEstimator:
    """Return the adaptive filter of the LGS. Raises RecordError for a window of too few samples."""
    return AdaptiveEstimator(settings, sampling._replace(ratio=None))


def multirate_adaptive(_prior: Prior, settings: Adaptive, sampling: Sampling, _horizon: float) -> AdaptiveEstimator:
    """Return the adaptive filter of both sensors. Raises RecordError for a window of too few samples."""
    return AdaptiveEstimator(settings, sampling)


def kf_seconds(settings: Adaptive, n_steps: int, n_modes: int, dt: float) -> float:
    """3.5 ms + 0.9 us per sample for every window, one mode after the other [s]."""
    windows = max((n_steps - round(settings.window / dt)) // max(round(settings.interval / dt), 1), 0)
    return n_modes * windows * (3.5e-3 + 0.9e-6 * settings.window / dt)


def multirate_seconds(settings: Adaptive, n_steps: int, n_modes: int, dt: float) -> float:
    """9 ms + 1 us per sample for every window, one mode after the other; windows grow [s]."""
    lengths, out = window_lengths(settings, dt, 1, 0), 0.0
    end = lengths.window
    while end <= n_steps:
        window = min(end, lengths.longest)
        out += 9e-3 + 1e-6 * window
        end += lengths.next_length(window)
    return n_modes * out


def identification_settings(_prior: Prior, settings: Adaptive) -> tuple[float, ...]:
    """Return what identifications of windows depend on."""
    return settings.window, settings.interval, settings.peak_count, settings.lowest


def _growing_settings(prior: Prior, settings: Adaptive) -> tuple[float, ...]:
    return *identification_settings(prior, settings), settings.longest


KF_ADAPTIVE = Observer(
    "kf-adaptive",
    "Adaptive KF",
    TARGETS,
    help="Kalman filter that identifies noise, turbulence and peaks in the last 4 s, twice a second; not in the paper",
    settings=ADAPTIVE,
    takes_missing=True,
    tunable=Tunable(("adaptive.window",), ("adaptive.interval",)),  # a shorter interval costs time, which no error shows
    weight=50.0,
    seconds=kf_seconds,
    look=Look("Adaptive KF", "#522C0A", "#F4C173", (20, 2), width=1.8),
    step=kf_adaptive,
    counts=identification_settings,
)

MULTIRATE_ADAPTIVE = Observer(
    "multirate-adaptive",
    "Adaptive multi-rate KF",
    TARGETS,
    help="Kalman filter on both sensors that identifies noise, turbulence, peaks and LGS error as it runs; not in the paper",
    settings=ADAPTIVE,
    needs=NGS,
    takes_missing=True,
    sensors=("lgs", "ngs"),
    tunable=Tunable(("adaptive.window",), ("adaptive.longest", "adaptive.interval")),
    weight=50.0,
    seconds=multirate_seconds,
    look=Look("Adaptive multi-rate", "#591677", "#F3C1F7", (20, 2, 3, 2), width=1.8),
    step=multirate_adaptive,
    counts=_growing_settings,
)
