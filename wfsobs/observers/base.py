"""The type of an observer: a name, targets, needs and a function.

phi_hat[k], its estimate of the target at step k, may use y[0..k] and u[0..k-1], nothing later. It receives measurements,
the prior that it asked for and its own settings: the truth is out of reach.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from wfsobs.observers.missing import LINE_WIDTH, bridges, fill_missing
from wfsobs.observers.step import Estimator, MakeEstimator, StepError, StepObserver, run_frames
from wfsobs.prior import PARTS, TRUE, Part, Prior, PriorSource, ask_nothing, words_for
from wfsobs.progress import QUIET, Watch
from wfsobs.record import SENSORS, Estimates, Measurements, Record, Sampling, hold_last
from wfsobs.record import TARGETS as TARGETS
from wfsobs.record import TURBULENCE as TURBULENCE
from wfsobs.record import VIBRATION as VIBRATION
from wfsobs.registry import check_tuple, check_weight
from wfsobs.settings import Group, Section
from wfsobs.signal.gate import GateSettings
from wfsobs.typing import Array

SLOW = 50.0
"""Weight of an observer for which no other waits: those that learn during the run."""

NOTHING, SPECTRA, MODEL, LINES, BANDS, TRAINING = "none", "true spectra", "model", "true peaks", "bands", "training data"
"""What an observer or a controller may have to be given beside measurements: the spectra of turbulence, vibration and noise;
a model with numbers, of one vibration peak; every line of the vibration; where the vibration is; a record to learn from."""


class Tunable(NamedTuple):
    """Dotted paths of the settings that are tuned by default, and of others that can be."""

    usual: tuple[str, ...] = ()
    others: tuple[str, ...] = ()


NOT_TUNED = Tunable()


@dataclass(frozen=True)
class Look:
    """Line of an observer or a controller in figures.

    Attributes
    ----------
    label : str
        Name in legends, where the full one is too long; empty for the full one.
    light, dark : str
        Colour of CSS in light and dark mode, such as #rrggbb or a name.
    dash : tuple of int
        Pattern, empty for solid [px].
    width : float
        Line width [px].
    """

    label: str = ""
    light: str = "#555577"
    dark: str = "#BBBBDD"
    dash: tuple[int, ...] = ()
    width: float = 1.4

    def colour(self, dark: bool) -> str:
        """Return the colour for the mode."""
        return self.dark if dark else self.light


COLOUR = re.compile(r"#([0-9A-Fa-f]{3,4}|[0-9A-Fa-f]{6}|[0-9A-Fa-f]{8})|rgba?\([0-9., ]+\)|[A-Za-z]+")


def check_look(look: object) -> None:
    """Raise ValueError where there is no look, or one without colours."""
    if not isinstance(look, Look):
        raise ValueError(f"look = {look!r}: takes a Look")
    for name, colour in (("light", look.light), ("dark", look.dark)):
        if not COLOUR.fullmatch(str(colour)):
            raise ValueError(f"look.{name} = {colour!r}: takes a colour of CSS, such as #rrggbb or a name")


_WORDS = {
    "y_ngs": "NGS measurements",
    "ratio": "NGS measurements",
    "y_stars": "measurements of every LGS",
    "open_loop_y": "measurements with the mirror at rest",
    "training": "training data",
}
"""Field that a record may not have -> what is in it."""

PLAIN = Look(dash=(4, 2))
"""Default look."""


@dataclass(frozen=True)
class Observer:
    """An observer in the registry.

    Attributes
    ----------
    id, label : str
        For tables and files, and for people.
    targets : tuple of str
        What it estimates, of "turbulence" and "vibration".
    run : callable or None
        (measurements, prior, settings, watch) -> {target: (n_steps, n_modes) [um]}, NaN without an estimate; no measurement is
        missing, unless it takes that.
        `Estimates` where it has a standard deviation. None for one that is its estimator of `step`, driven over the record.
    help : str
        One line of description.
    prior : tuple
        What it needs beside measurements, see `wfsobs.prior`.
    settings : Section or str or None
        Its own group of settings, or the name of a group of every scenario.
    needs : tuple of str
        Fields of the record without which it cannot run.
    asks : callable
        Settings -> further needs for these.
    causal : bool
        False only for a reference that uses later samples.
    linear : bool
        Whether estimates are a linear function of the measurements, with prior and settings fixed; a constant may be added.
    couples_modes : bool
        Whether the estimate of a mode uses the measurements of others.
    takes_missing : bool
        Whether it takes missing measurements as missing, as NaN; by default they are filled by the model of its prior.
    sensors : tuple of str
        Whose measurements it uses, of "lgs" and "ngs".
    tunable : Tunable
        Settings that can be tuned.
    weight : float
        Computing time relative to a Kalman filter, for progress and to run fast ones first.
    seconds : callable or None
        (settings, n_steps, n_modes, dt [s]) -> estimated time [s]; None for one as fast as a Kalman filter.
    look : Look
        Line in figures.
    step : callable or None
        (prior, settings, sampling, horizon) -> its estimator, one frame at a time (`wfsobs.observers.step`); None without one.
    counts : callable or None
        (prior, settings) -> what of its settings its estimates depend on, as plain values; None for all that have an effect.
    """

    id: str
    label: str
    targets: tuple[str, ...]
    run: Callable[[Measurements, Prior, Any, Watch], dict[str, Array]] | None = None
    _: KW_ONLY
    help: str = ""
    prior: tuple[Part, ...] = ()
    settings: Section | str | None = None
    needs: tuple[str, ...] = ()
    asks: Callable[[Any], tuple[Part, ...]] = ask_nothing
    causal: bool = True
    linear: bool = False
    couples_modes: bool = False
    takes_missing: bool = False
    sensors: tuple[str, ...] = ("lgs",)
    tunable: Tunable = NOT_TUNED
    weight: float = 1.0
    seconds: Callable[[Any, int, int, float], float] | None = None
    look: Look = PLAIN
    step: MakeEstimator | None = None
    counts: Callable[[Prior, Any], Any] | None = None

    def check_fields(self) -> None:
        """Raise ValueError, one line, where a field has a value that it does not take."""
        check_tuple("targets", self.targets, TARGETS)
        check_tuple("needs", self.needs, (field.name for field in fields(Record)))
        check_tuple("sensors", self.sensors, SENSORS)
        check_tuple("prior", self.prior, PARTS)
        if not self.targets:
            raise ValueError(f"targets = (): takes one at least, of {', '.join(TARGETS)}")
        if self.run is None and self.step is None:
            raise ValueError("has neither a run nor a step")
        for name in ("run", "step", "seconds", "counts", "asks"):
            of = getattr(self, name)
            if not callable(of) and (of is not None or name == "asks"):
                raise ValueError(f"{name} = {of!r}: takes a function")
        if not isinstance(self.help, str):
            raise ValueError(f"help = {self.help!r}: takes a text")
        check_weight(self.weight)
        check_look(self.look)

    def parts(self, settings: Any) -> tuple[Part, ...]:
        """Return what it needs beside measurements for these settings."""
        return (*self.prior, *self.asks(settings))

    def measurements(self, record: Record) -> Measurements:
        """Return copies of what it receives of a record: the measurements of its sensors, and what it needs besides."""
        sensors = (*self.sensors, "ngs") if "y_ngs" in self.needs else self.sensors
        return record.measurements("open_loop_y" in self.needs, sensors=sensors)

    def missing(self, record: Record) -> tuple[str, ...]:
        """Return what a record does not have of what is needed, in words."""
        return tuple(dict.fromkeys(_WORDS.get(name, name) for name in self.needs if getattr(record, name) is None))

    def estimate(
        self, measurements: Measurements, prior: Prior, settings: Group | None = None, watch: Watch = QUIET
    ) -> Estimates:
        """Run the observer on measurements; missing ones are filled by the model of its prior, unless it takes them as missing.

        Parameters
        ----------
        measurements : Measurements
            Signals of a record.
        prior : Prior
            What it needs beside measurements.
        settings : Group, optional
            Its own settings.
        watch : Watch
            Receives the progress, and is asked at every block of work whether to stop.

        Returns
        -------
        Estimates
            Target -> estimate, (n_steps, n_modes) [um]; NaN where there is none. With `sd`, their standard deviations; NaN where
            a measurement has been filled.

        Raises
        ------
        ValueError
            There is no estimate; one line with the reason.
        Cancelled
            `watch` asks to stop.
        """
        if self.takes_missing:
            given = replace(measurements, u=hold_last(measurements.u))
        else:
            given = fill_missing(measurements, prior, getattr(settings, "line_width", LINE_WIDTH))
        found = self.run(given, prior, settings, watch) if self.run else run_design(self, given, prior, settings, watch)
        out = check_estimates(found, self.targets, measurements.y_lgs.shape)
        if not self.takes_missing and (filled := np.isnan(measurements.y_lgs)).any():
            out.sd = {of: np.where(filled, np.nan, sd) for of, sd in out.sd.items()}
        return out

    def design(
        self,
        prior: Prior,
        settings: Group | None,
        sampling: Sampling,
        horizon: float = 0.0,
        gate: GateSettings | None = None,
    ) -> StepObserver:
        """Return the observer one frame at a time; missing measurements are taken as in `estimate`.

        Parameters
        ----------
        prior : Prior
            What it needs beside measurements.
        settings : Group or None
            Its own settings.
        sampling : Sampling
            Modes, step, NGS ratio and delay of the loop.
        horizon : float
            Frames ahead that predictions are wanted for.
        gate : GateSettings, optional
            How it is kept from outliers; by default not at all.

        Returns
        -------
        StepObserver
            Before its first frame.

        Raises
        ------
        ValueError
            There is none; one line with the reason.
        """
        needs_ngs = "y_ngs" in self.needs
        if needs_ngs and sampling.ratio is None:
            raise StepError(f"{self.id}: needs NGS frames: a sampling with their ratio")
        width = getattr(settings, "line_width", LINE_WIDTH)
        beside = None if self.takes_missing else bridges(prior, sampling.n_modes, sampling.dt, sampling.ratio, width)
        estimator = self.estimator(prior, settings, sampling, horizon)
        return StepObserver(self.id, self.targets, estimator, sampling, needs_ngs, beside, gate)

    def estimator(self, prior: Prior, settings: Any, sampling: Sampling, horizon: float) -> Estimator:
        """Return its estimator, as `step` makes it. Raises StepError where there is none."""
        if self.step is None:
            why = "has no step interface" if self.causal else "looks ahead: it cannot run frame by frame"
            raise StepError(f"{self.id}: {why}")
        made = self.step(prior, settings, sampling, horizon)
        if not isinstance(made, Estimator):
            raise StepError(f"{self.id}: step returns no Estimator, but {type(made).__name__}")
        return made

    @property
    def group(self) -> str | None:
        """Name of its group of settings in a scenario, or None."""
        return self.settings.name if isinstance(self.settings, Section) else self.settings

    @property
    def slow(self) -> bool:
        """Whether it takes so long that no other waits for it."""
        return self.weight >= SLOW

    def needs_text(self, *, source: PriorSource = TRUE) -> str:
        """Return what it has to be told beside measurements, for people; source : where its prior comes from."""
        return ", ".join(words_for(self.prior, source=source)) or NOTHING


LARGEST = np.float64(1e100)
"""Largest number of an estimate [um]: sums of squares of larger ones may overflow."""


def check_estimates(estimates: object, targets: tuple[str, ...], shape: tuple[int, ...]) -> Estimates:
    """Return what an observer found, arrays of this shape, (n_steps, n_modes). Raises ValueError."""
    if not isinstance(estimates, Mapping):
        raise ValueError(f"returns {type(estimates).__name__}, not a dictionary of arrays")
    if missing := [target for target in targets if target not in estimates]:
        raise ValueError(f"returns no {', '.join(missing)}")
    out = estimates if isinstance(estimates, Estimates) else Estimates(estimates)
    for name, values in [*((target, out[target]) for target in targets), *((f"sd of {of}", x) for of, x in out.sd.items())]:
        if not isinstance(values, np.ndarray) or values.shape != shape:
            kind = getattr(values, "shape", type(values).__name__)
            raise ValueError(f"{name} takes an array of the shape {shape}, (n_steps, n_modes), not {kind}")
        if values.dtype.kind not in "fiu" or np.isinf(values).any():
            kind = "infinite ones" if values.dtype.kind == "f" else values.dtype.name
            raise ValueError(f"{name} takes real numbers, NaN where there is none, not {kind}")
        if isinstance(values, np.ma.MaskedArray):
            raise ValueError(f"{name} takes NaN where there is no number, not a mask")
        if (np.abs(values) > LARGEST).any():
            raise ValueError(f"{name} takes numbers up to {LARGEST:g}, not {np.nanmax(np.abs(values)):g}")
        if name not in targets and (values < 0).any():
            raise ValueError(f"{name} takes numbers from 0, not negative ones")
    return out


def run_design(observer: Observer, measurements: Measurements, prior: Prior, settings: Any, watch: Watch) -> Estimates:
    """Run the estimator of an observer over a record: all steps at once where it can, else frame by frame."""
    estimator = observer.estimator(prior, settings, measurements.sampling, 0.0)
    run = getattr(estimator, "run", None)
    found = run(measurements, watch) if run else run_frames(estimator, observer.targets, measurements, watch)
    if observer.targets == TARGETS:
        return found
    return Estimates(*({target: x[target] for target in observer.targets if target in x} for x in (found, found.sd)))
