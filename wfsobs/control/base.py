"""What a controller is: a name, a linear law, perhaps a prediction of the vibration beside it, and what they are made from.

Like an observer it receives measurements, what it asked to be told and settings of its own, and besides the plant. The truth is
out of reach. An integrator with a prediction of the vibration must not correct the vibration twice. Its measurement is therefore
freed of what is left of it,

    y_int[k] = y[k] - (f[k] - vib_hat[k-1]),

f the causal Butterworth bank on z, which at step k estimates phi_vib[k-1], and vib_hat[k-1] what was commanded against it. In
pseudo-open-loop terms the integrator works on z - f, and u[k] = u_int[k] - vib_hat[k+1].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from wfsobs.control.laws import limited_integrator
from wfsobs.control.mirror import Law, Mirror, Plant
from wfsobs.control.step import MakeStepLaw, StepController, StepLaw, StepPredict, VibrationAhead, step_law, take_missing
from wfsobs.observers.base import NOT_TUNED, NOTHING, PLAIN, Look, Tunable, check_look
from wfsobs.observers.baselines import online_reference
from wfsobs.observers.missing import LINE_WIDTH, bridges, fill_missing
from wfsobs.observers.step import StepError, frames_of
from wfsobs.prior import PARTS, TRUE, Bands, Part, Prior, PriorSource, ask_nothing, asks_for, words_for
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Measurements, RecordError, Sampling, hold_last
from wfsobs.registry import check_tuple, check_weight
from wfsobs.settings import Section
from wfsobs.signal.gate import GateSettings
from wfsobs.typing import Array

Settings = SimpleNamespace
"""A controller's own groups of settings, by name."""

MakeLaw = Callable[[Prior, int, Plant, Any], Law]
"""(prior, mode, plant, settings) -> law. Raises ValueError saying why there is none."""

Predict = Callable[[Measurements, Prior, Plant, Any, Watch], Array]
"""(measurements without gaps, prior, plant, settings, watch) -> vibration while u[k] acts, (n_steps, n_modes) [um], NaN where it
is not known yet."""


@dataclass(frozen=True)
class Controller:
    """A controller in the registry: a linear law, one with a prediction of the vibration, or none.

    Attributes
    ----------
    id, label : str
        For tables and files, and for people.
    law : callable or None
        Law of one mode, designed before there is a record; with a prediction, of the rest.
    predict : callable or None
        Prediction of the vibration.
    help : str
        One line of description.
    prior : tuple
        What it needs beside measurements, see `wfsobs.prior`; a prediction needs Bands.
    settings : tuple
        Its groups of settings, its own or names of groups of every scenario.
    asks : callable
        Settings -> further needs for these.
    ngs : bool
        Whether it uses NGS frames.
    weight : float
        Computing time relative to a linear law.
    seconds : callable or None
        (settings, n_steps, n_modes) -> maximum time [s]; None for one as fast as a linear law.
    look : Look
        Line in figures.
    step_predict : callable or None
        (prior, plant, settings, sampling) -> its prediction, one frame at a time; None without one.
    counts : callable or None
        Settings -> what of them its commands depend on beside its laws, as plain values; None for none where it is
        linear, else for all that have an effect.
    tunable : Tunable
        Settings that its laws can be tuned by on an uncertain plant.
    step_law : callable or None
        In place of `law`: laws of all modes, frame by frame, that change as they run.
    learns : callable or None
        (settings, sampling) -> steps before its own laws close the loop; None for one that does from the start.

    Raises
    ------
    ValueError
        It predicts without bands in its prior.
    """

    id: str
    label: str
    law: MakeLaw | None = None
    _: KW_ONLY
    predict: Predict | None = None
    help: str = ""
    prior: tuple[Part, ...] = ()
    settings: tuple[Section | str, ...] = ()
    asks: Callable[[Any], tuple[Part, ...]] = ask_nothing
    ngs: bool = False
    weight: float = 1.0
    seconds: Callable[[Any, int, int], float] | None = None
    look: Look = PLAIN
    step_predict: StepPredict | None = None
    counts: Callable[[Any], Any] | None = None
    tunable: Tunable = NOT_TUNED
    step_law: MakeStepLaw | None = None
    learns: Callable[[Any, Sampling], int] | None = None

    def __post_init__(self) -> None:
        if self.predict is not None and not asks_for(Bands, self.prior):
            raise ValueError(f"controller {self.id!r}: with a prediction it needs Bands in its prior")

    def check_fields(self) -> None:
        """Raise ValueError, one line, where a field has a value that it does not take."""
        check_tuple("prior", self.prior, PARTS)
        check_weight(self.weight)
        check_look(self.look)

    @property
    def is_linear(self) -> bool:
        """Whether it has a linear law alone."""
        return self.law is not None and self.predict is None

    @property
    def is_idle(self) -> bool:
        """Whether it commands nothing."""
        return self.law is None and self.step_law is None

    @property
    def is_quick(self) -> bool:
        """Whether it is linear, or idle."""
        return self.predict is None and self.step_law is None

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of its groups of settings in a scenario."""
        return tuple(own.name if isinstance(own, Section) else own for own in self.settings)

    def parts(self, settings: Settings) -> tuple[Part, ...]:
        """Return what it needs beside measurements for these settings."""
        return tuple(dict.fromkeys((*self.asks(settings), *self.prior)))

    def needs_text(self, settings: Settings, *, source: PriorSource = TRUE) -> str:
        """Return what it needs beside measurements, for people; source : where its prior comes from."""
        return ", ".join(words_for(self.parts(settings), source=source)) or NOTHING

    def laws(self, prior: Prior, plant: Plant, settings: Settings, n_modes: int) -> tuple[Law, ...]:
        """One law per mode, none for control by nothing. Raises ValueError saying why there is none."""
        return () if self.law is None else tuple(self.law_of(prior, mode, plant, settings) for mode in range(n_modes))

    def law_of(self, prior: Prior, mode: int, plant: Plant, settings: Settings) -> Law:
        """Return the law of one mode. Raises ValueError saying why there is none."""
        law = None if self.law is None else self.law(prior, mode, plant, settings)
        if not isinstance(law, Law):
            raise ValueError(f"law takes a wfsobs.control.mirror.Law, not a {type(law).__name__}")
        return law

    def design(
        self, prior: Prior, plant: Plant, settings: Settings, sampling: Sampling, gate: GateSettings | None = None
    ) -> StepController:
        """Return the controller one frame at a time; missing samples are taken as in `commands`.

        Parameters
        ----------
        prior : Prior
            What it needs beside measurements.
        plant : Plant
            Mirror, step and NGS ratio.
        settings : Settings
            Its own groups of settings.
        sampling : Sampling
            Number of modes; its delay is that of the training record.
        gate : GateSettings, optional
            How it is kept from outliers; by default not at all.

        Returns
        -------
        StepController
            Before its first frame, the mirror at rest.

        Raises
        ------
        ValueError
            There is none; one line with the reason.
        """
        return self.assemble(self.laws(prior, plant, settings, sampling.n_modes), prior, plant, settings, sampling, gate)

    def assemble(
        self,
        laws: Sequence[Law],
        prior: Prior,
        plant: Plant,
        settings: Settings,
        sampling: Sampling,
        gate: GateSettings | None = None,
    ) -> StepController:
        """Return `design` with laws that are already made from the same. Raises StepError."""
        if self.predict is not None and self.step_predict is None:
            raise StepError(f"{self.id}: has no step interface")
        if self.ngs and sampling.ratio is None:
            raise StepError(f"{self.id}: needs NGS frames: a sampling with their ratio")
        if not all(law.stable for law in laws):
            raise StepError(f"{self.id}: a pole of the closed loop is not within the unit circle")
        ahead, beside = None, None
        if self.step_predict is not None:
            assert prior.bands is not None
            ahead = VibrationAhead(self.step_predict(prior, plant, settings, sampling), prior.bands, sampling)
        if not self._takes_missing(laws):
            beside = bridges(prior, sampling.n_modes, sampling.dt, sampling.ratio, _line_width(settings))
        own = self._step_law(laws, prior, plant, settings, sampling)
        return StepController(self.id, plant, sampling, own, ahead, self.ngs, beside, gate)

    def _step_law(
        self, laws: Sequence[Law], prior: Prior, plant: Plant, settings: Settings, sampling: Sampling
    ) -> StepLaw | None:
        return self.step_law(prior, plant, settings, sampling) if self.step_law else step_law(laws, plant.mirror)

    def commands(
        self,
        laws: Sequence[Law],
        measurements: Measurements,
        prior: Prior,
        plant: Plant,
        settings: Settings,
        watch: Watch = QUIET,
    ) -> tuple[Array, Array]:
        """(commands that the mirror takes [um], whether a limit changed them), both (n_steps, n_modes).

        laws : of `laws`, from the same prior, plant and settings. Missing samples are none to the Kalman filters of LQG; others
        have them bridged by what they are told. Raises ValueError, Cancelled.
        """
        if self.ngs and measurements.y_ngs is None:
            raise RecordError("the record has no NGS measurement")
        if self._takes_missing(laws):
            measurements = replace(measurements, u=hold_last(measurements.u))
        else:
            measurements = fill_missing(measurements, prior, _line_width(settings))
        z, n = measurements.z, measurements.ratio
        forward = np.zeros_like(z)
        if self.is_idle:
            return forward, forward > 0.0
        if self.predict is not None:
            assert prior.bands is not None
            ahead = self.predict(measurements, prior, plant, settings, watch)
            if np.shape(ahead) != z.shape:
                raise ValueError(f"the prediction takes the shape {z.shape}, (n_steps, n_modes), not {np.shape(ahead)}")
            known = ~np.isnan(ahead)
            forward = -np.where(known, ahead, 0.0)
            z = z - np.where(known, online_reference(prior.bands, z, measurements.dt), 0.0)
        lost = np.isnan(z).any() or (self.ngs and n is not None and np.isnan(measurements.z_ngs[n::n]).any())
        if self.step_law is None and not (lost or (take_missing(laws) and measurements.lgs_stars is not None)):
            inputs = np.stack([z, np.nan_to_num(measurements.z_ngs)], axis=1) if self.ngs else z[:, None]
            asked = np.column_stack([law.run(inputs[:, :, mode]) for mode, law in enumerate(laws)]) + forward
            columns = zip(laws, asked.T, z.T, forward.T, strict=True)
            taken, wanted = zip(*(_limit_commands(plant.mirror, *of_mode) for of_mode in columns), strict=True)
            u = np.column_stack(taken)
            return u, u != np.column_stack(wanted)
        own = self._step_law(laws, prior, plant, settings, measurements.sampling)
        assert own is not None
        u, wanted, last = np.empty_like(z), np.empty_like(z), np.zeros(z.shape[1])
        for k, frame in enumerate(frames_of(measurements, watch)):
            own.see_stars(frame.stars)
            wanted[k] = own.command(z[k], frame.ngs if self.ngs else None, forward[k])
            last = u[k] = plant.mirror.clip_commands(wanted[k], last)
            own.tell(last, forward[k])
        return u, u != wanted

    def _takes_missing(self, laws: Sequence[Law]) -> bool:
        return self.step_law is not None or (self.predict is None and take_missing(laws))


def _line_width(settings: Settings) -> float:
    return getattr(getattr(settings, "multipeak", None), "line_width", LINE_WIDTH)


def _limit_commands(mirror: Mirror, law: Law, u: Array, z: Array, forward: Array) -> tuple[Array, Array]:
    """(commands that the mirror takes, commands wanted) of one mode, (n_steps,); u : those wanted without limits."""
    if mirror.within(u):
        return u, u
    if law.gain is None:  # it has no feedback of a limit
        return mirror.follow(u), u
    return limited_integrator(mirror, law.gain, law.leak, z, forward)
