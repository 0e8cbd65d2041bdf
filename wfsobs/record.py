"""Types of one run's data: `Measurements`, `Record`, which adds the truth where there is one, and `Estimates` of an observer."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wfsobs.notebook import PlotAccessor, html_table, import_extra
from wfsobs.settings.values import shorten
from wfsobs.signal.gate import GateSettings, OutlierGate, frame_mean_of, let_through
from wfsobs.typing import Array, fill_masked
from wfsobs.units import unit_refusal

if TYPE_CHECKING:
    import xarray


DELAY = 2
"""The paper's delay: a command is computed once y_lgs[k] is known, acts during step k + 1, and is seen at k + 2."""

OF_MODES = ("y_lgs", "u", "y_ngs", "open_loop_y", "turbulence", "vibration")
"""Signals of a record, (n_steps, n_modes)."""

LARGEST = 1e12
"""Largest number of a signal, whatever its unit: a kilometre in nanometres."""

SENSORS = ("lgs", "ngs")
"""Whose measurements a record has."""


class RecordError(ValueError):
    """Error: a record that cannot be used; one line naming what, where and what is expected."""


class Sampling(NamedTuple):
    """What of a loop an observer is designed for.

    n_modes : number of modes;  dt : fast step [s]
    ratio   : fast steps per NGS frame, None without NGS
    delay   : steps from a command to the first measurement that sees it
    """

    n_modes: int
    dt: float
    ratio: int | None = None
    delay: int = DELAY


@dataclass(frozen=True)
class Training:
    """Training record of the offline GPR.

    Attributes
    ----------
    y_lgs, u : Array
        LGS measurement and command, (n, n_modes) [um].
    open_loop_y : Array or None
        Open-loop measurement of the same sensors, (n, n_modes) [um].
    """

    y_lgs: Array
    u: Array
    open_loop_y: Array | None = None

    def copy(self, modes: Sequence[int] | None = None) -> Training:
        """Return a copy in memory of its own; modes : of these alone."""
        own = slice(None) if modes is None else list(modes)
        open_loop_y = None if self.open_loop_y is None else _own(self.open_loop_y[:, own])
        return Training(_own(self.y_lgs[:, own]), _own(self.u[:, own]), open_loop_y)


@dataclass(frozen=True)
class Signals:
    """Measurements and commands, one row per fast (LGS) step.

    NaN is a missing sample; `wfsobs.observers.missing` replaces it.

    Attributes
    ----------
    y_lgs : Array
        Combined LGS measurement, (n_steps, n_modes) [um]; y_lgs[k] = phi_res[k-1] + noise.
    u : Array
        Mirror command, (n_steps, n_modes) [um], computed once y_lgs[k] is known.
    dt : float
        Time step [s].
    y_ngs : Array or None
        NGS measurement, (n_steps, n_modes) [um], NaN in steps without a frame.
    ratio : int or None
        Fast steps per NGS frame; None without NGS.
    open_loop_y : Array or None
        Open-loop LGS measurement, with the mirror at rest, (n_steps, n_modes) [um].
    delay : int
        Steps from a command to the first measurement that sees it, y_lgs[k] = phi_dist[k-1] + u[k-delay] + noise.
    lgs_stars : Array or None
        Number of LGS that y_lgs is the combination of, the first ones, (n_steps,), integers; None where it is all, or not known.
    y_stars : Array or None
        Measurement of each LGS by itself, (n_steps, n_lgs, n_modes) [um], NaN where a star is out or a frame is missing; None
        where it is not known, or where all see the same.
    """

    y_lgs: Array
    u: Array
    dt: float
    y_ngs: Array | None = None
    ratio: int | None = None
    open_loop_y: Array | None = None
    delay: int = DELAY
    lgs_stars: Array | None = field(default=None, kw_only=True)
    y_stars: Array | None = field(default=None, kw_only=True)

    @property
    def n_steps(self) -> int:
        """Number of fast steps."""
        return self.y_lgs.shape[0]

    @property
    def n_modes(self) -> int:
        """Number of Zernike modes."""
        return self.y_lgs.shape[1]

    @property
    def sampling(self) -> Sampling:
        """Modes, step, NGS ratio and delay."""
        return Sampling(self.n_modes, self.dt, self.ratio, self.delay)

    @property
    def missing(self) -> int:
        """Number of steps in which a mode has no LGS measurement."""
        return int(np.isnan(self.y_lgs).any(axis=1).sum())

    @property
    def ngs_gaps(self) -> Array:
        """Which NGS frames a mode has no measurement of, bool (frames,)."""
        frames = self.y_lgs[:0] if self.y_ngs is None or self.ratio is None else self.y_ngs[self.ratio :: self.ratio]
        return np.asarray(np.isnan(frames).any(axis=1))

    @property
    def z(self) -> Array:
        """Pseudo-open-loop LGS measurement, z[k] = y_lgs[k] - u[k-delay] = phi_dist[k-1] + noise [um]; NaN where either is."""
        return pseudo_open_loop(self.y_lgs, self.u, self.delay)

    @property
    def z_stars(self) -> Array:
        """Pseudo-open-loop measurement of each LGS, (n_steps, n_lgs, n_modes) [um]. Raises RecordError without stars apart."""
        if self.y_stars is None:
            raise RecordError("the record has no y_stars")
        return self.y_stars - delay_signal(self.u, self.delay)[:, None]

    @property
    def z_ngs(self) -> Array:
        """Pseudo-open-loop NGS measurement [um], NaN without a frame. Raises RecordError without NGS.

        The mean of u[k-2] ... u[k-n-1] (delay 2), the mirror during the frame, is subtracted.
        """
        if self.y_ngs is None or self.ratio is None:
            raise RecordError("the record has no NGS measurement")
        return self.y_ngs - frame_mean(delay_signal(self.u, self.delay - 1), self.ratio)


@dataclass(frozen=True)
class Measurements(Signals):
    """Signals in memory of their own, as an observer receives them: no truth, no training record."""


@dataclass(frozen=True, repr=False)
class Record(Signals):
    """Signals, with truth, training record and origin where known.

    Attributes
    ----------
    turbulence, vibration : Array or None
        Truth, (n_steps, n_modes) [um]. For scores alone: no observer receives it.
    training : Training or None
        Training record of the offline GPR.
    origin : str
        Unit, sign and timing that a file had before conversion, one line.
    gate : GateSettings or None
        How outliers are kept from observers and controllers, `wfsobs.signal.gate`; None for a record that has none.
    """

    turbulence: Array | None = None
    vibration: Array | None = None
    training: Training | None = None
    origin: str = ""
    gate: GateSettings | None = field(default=None, kw_only=True)
    plot: ClassVar[PlotAccessor] = PlotAccessor()

    def __post_init__(self) -> None:
        """Take lists, tables and numbers of any kind. Raises RecordError where they are no record."""
        for name in (*OF_MODES, "y_stars"):
            if (values := getattr(self, name)) is not None:
                object.__setattr__(self, name, numbers := as_signal(name, values))
                if self.y_lgs.ndim != 2:
                    raise RecordError(f"y_lgs has shape {self.y_lgs.shape}; expected (n_steps, n_modes)")
                if name == "y_stars" and (numbers.ndim != 3 or numbers.shape[::2] != self.y_lgs.shape):
                    raise RecordError(f"y_stars has shape {numbers.shape}; expected ({self.n_steps}, n_lgs, {self.n_modes})")
                if name != "y_stars" and numbers.shape != self.y_lgs.shape:
                    raise RecordError(f"{name} has shape {numbers.shape}; expected {self.y_lgs.shape}, that of y_lgs")
                check_size(name, numbers)
        if self.lgs_stars is not None:
            object.__setattr__(self, "lgs_stars", star_counts(self.lgs_stars, self.n_steps))
        try:
            object.__setattr__(self, "dt", float(self.dt))
        except (TypeError, ValueError):
            raise RecordError(f"dt takes a time step [s], not {self.dt!r}") from None
        if not 0.0 < self.dt < np.inf:
            raise RecordError(f"dt takes a time step above 0 s, not {self.dt:g}")
        for name in ("delay",) if self.ratio is None else ("delay", "ratio"):
            if not (whole := as_whole(getattr(self, name))):
                raise RecordError(f"{name} takes a whole number of steps from 1, not {shorten(getattr(self, name))}")
            object.__setattr__(self, name, whole)
        if self.y_ngs is not None:
            if self.ratio is None:
                raise RecordError("y_ngs needs ratio, the number of fast steps per NGS frame")
            check_frames(self.y_ngs, self.ratio)

    def __repr__(self) -> str:
        return f"Record({', '.join(f'{what} {value}' for what, value in self._summary())})"

    def _repr_html_(self) -> str:
        return html_table(("Record", ""), self._summary())

    def _summary(self) -> list[tuple[str, str]]:
        """Return a few lines of name and value."""
        parts = [("turbulence", self.turbulence), ("vibration", self.vibration)]
        return [
            ("length", f"{self.n_steps * self.dt:g} s"),
            ("rate", f"{1.0 / self.dt:g} Hz"),
            ("modes", str(self.n_modes)),
            ("NGS", "none" if self.ratio is None else f"every {self.ratio} steps"),
            ("truth", " and ".join(name for name, x in parts if x is not None) or "none"),
            ("missing", str(self.missing)),
            *([("outliers", str(self.outliers))] if self.gate else []),
        ]

    def to_xarray(self) -> xarray.Dataset:
        """Return measurements, commands and truth as labelled arrays.

        Returns
        -------
        xarray.Dataset
            Every signal that there is, over `time` [s] and `mode` (Noll index); `y_stars` over `star`, too.

        Raises
        ------
        ImportError
            xarray is not installed.
        """
        signals = {name: (("time", "mode"), x, {"units": "um"}) for name in OF_MODES if (x := getattr(self, name)) is not None}
        stars = {} if self.y_stars is None else {"y_stars": (("time", "star", "mode"), self.y_stars, {"units": "um"})}
        coordinates = {
            "time": ("time", self.dt * np.arange(self.n_steps), {"units": "s"}),
            "mode": ("mode", np.arange(2, self.n_modes + 2), {"long_name": "Noll index of the Zernike mode"}),
        }
        about = {"time_step_s": self.dt, "steps_per_ngs_frame": self.ratio or 0, "delay_steps": self.delay, "origin": self.origin}
        return import_extra("xarray", "arrays").Dataset(signals | stars, coordinates, about)

    def measurements(self, open_loop: bool = False, *, sensors: Collection[str] = SENSORS) -> Measurements:
        """Return copies of the signals alone: no array is a view of another.

        open_loop : with the open-loop measurement
        sensors   : whose measurements; there is nothing of the NGS without them, and zeros for those of the LGS
        """
        lgs, ngs, of = "lgs" in sensors, "ngs" in sensors, self.without_outliers
        return Measurements(
            _own(of.y_lgs) if lgs else np.zeros_like(of.y_lgs),
            _own(of.u),
            of.dt,
            _copy(of.y_ngs) if ngs else None,
            of.ratio if ngs else None,
            _copy(of.open_loop_y) if open_loop else None,
            of.delay,
            lgs_stars=None if of.lgs_stars is None or not lgs else of.lgs_stars.copy(),
            y_stars=_copy(of.y_stars) if lgs else None,
        )

    @property
    def without_outliers(self) -> Record:
        """The record with outliers missing, or clipped, as observers receive it: of the LGS, of each of them, of NGS frames."""
        return self if self.gate is None else self._after_gate

    @cached_property
    def _after_gate(self) -> Record:
        settings = self.gate or GateSettings()

        def gate(y: Array, z: Array, first: int) -> Array:
            """Test all but the first samples, which lack commands of before the record."""
            n_columns = int(np.prod(z.shape[1:]))
            passed = OutlierGate(n_columns, settings).check_all(z[first:].reshape(-1, n_columns))
            return let_through(y, z, np.concatenate([z[:first], passed.reshape(z[first:].shape)]))

        n, y_ngs = self.ratio, self.y_ngs
        y_lgs = gate(self.y_lgs, self.z, self.delay)
        if y_ngs is not None and n is not None:
            y_ngs, whole = y_ngs.copy(), (self.n_steps - 1) // n * n
            beside = frame_mean_of(replace(self, y_lgs=y_lgs).z[1 : 1 + whole].reshape(-1, n, self.n_modes))
            passed = gate(y_ngs[n::n], self.z_ngs[n::n] - beside, -(-(self.delay - 1) // n))
            y_ngs[n::n] = np.where(np.isnan(beside), y_ngs[n::n], passed)
        y_stars = None if self.y_stars is None else gate(self.y_stars, self.z_stars, self.delay)
        y_open = None if self.open_loop_y is None else gate(self.open_loop_y, self.open_loop_y, self.delay)
        return replace(self, y_lgs=y_lgs, y_ngs=y_ngs, y_stars=y_stars, open_loop_y=y_open, gate=None)

    @cached_property
    def training_record(self) -> Record | None:
        """Training data as a record with the gate of this one, which runs once for all observers; None without training data."""
        t = self.training
        return None if t is None else Record(t.y_lgs, t.u, self.dt, open_loop_y=t.open_loop_y, delay=self.delay, gate=self.gate)

    @property
    def outliers(self) -> int:
        """Number of steps whose LGS measurement the gate does not let through as it is, but for those whose command is lost."""
        return int(((self.without_outliers.y_lgs != self.y_lgs) & ~np.isnan(self.z)).any(axis=1).sum()) if self.gate else 0

    def truth(self, target: str) -> Array | None:
        """Return the true signal of `target` ("turbulence", "vibration", or "total", their sum), or None."""
        if target == "total":
            return None if self.turbulence is None or self.vibration is None else self.turbulence + self.vibration
        return {"turbulence": self.turbulence, "vibration": self.vibration}[target]


def as_signal(name: str, values: ArrayLike) -> Array:
    """Return a signal as float64. Raises RecordError."""
    if why := unit_refusal(values):
        raise RecordError(f"{name} {why}")
    try:
        raw = fill_masked(values)
        if raw.dtype.kind in "fiuO":
            return raw.astype(np.float64, copy=False)
    except (TypeError, ValueError):
        raise RecordError(f"{name} holds no numbers, or rows of unlike lengths") from None
    raise RecordError(f"{name} holds {raw.dtype}, not numbers")


def check_size(name: str, signal: Array, *, is_whole: bool = False) -> None:
    """Raise RecordError for a number of a signal that is infinite or too large, and for a missing one where it is whole."""
    bad = ~(np.abs(signal) <= LARGEST) if is_whole else np.abs(signal) > LARGEST
    if bad.any():
        step, *_, mode = at = tuple(np.argwhere(bad)[0])
        most = f" up to {LARGEST:g}, NaN where one is missing" if np.isfinite(signal[at]) else ""
        raise RecordError(f"{name} is {signal[at]} at step {step}, mode {mode}; it takes finite numbers{most}")


def check_frames(y_ngs: Array, ratio: int) -> None:
    """Raise RecordError where NGS frames are at other steps than 0, n, 2n, ..., the first of which saw nothing."""
    is_off = np.asarray(~np.isnan(y_ngs).all(axis=1))
    is_off[::ratio] = False
    if is_off.any():
        raise RecordError(
            f"y_ngs has a frame at step {int(np.argmax(is_off))}; with ratio = {ratio} "
            f"frames are at steps {ratio}, {2 * ratio}, ... and NaN elsewhere"
        )


def star_counts(counts: ArrayLike, n_steps: int) -> NDArray[np.int_]:
    """Return the number of LGS in every step as integers. Raises RecordError."""
    raw = fill_masked(counts)
    is_count = raw.dtype.kind in "fiu" and raw.shape == (n_steps,) and np.isfinite(raw).all()
    if not is_count or not ((raw >= 0) & (raw % 1 == 0)).all():
        raise RecordError(f"lgs_stars takes {n_steps} whole numbers from 0, not {raw.dtype} of shape {raw.shape}")
    return raw.astype(int, copy=False)


def as_whole(value: object) -> int:
    """Return a whole number from 1 as an int, 0 for anything else."""
    value = value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        return 0
    return int(value) if 1 <= value < np.inf and value % 1 == 0 else 0


def _copy(x: Array | None) -> Array | None:
    return None if x is None else _own(x)


def _own(x: Array) -> Array:
    return np.array(x, dtype=float, order="C", copy=True, subok=False)


def delay_signal(x: Array, steps: int) -> Array:
    """Return x[k - steps], zero before the start; same shape as x."""
    out = np.zeros_like(x)
    out[steps:] = x[: max(x.shape[0] - steps, 0)]
    return out


def pseudo_open_loop(y: Array, u: Array, delay: int = DELAY) -> Array:
    """Return the pseudo-open-loop measurement z[k] = y[k] - u[k-delay] (paper, eq. 3 to 5)."""
    return y - delay_signal(u, delay)


def frame_mean(x: Array, n: int) -> Array:
    """Return the mean of x[k-1] ... x[k-n] at every k, zeros before the start; same shape as x."""
    total = np.zeros_like(x)
    for j in range(1, n + 1):
        total += delay_signal(x, j)
    return total / n


def fuse_frames(z: Array, z_ngs: Array, n: int) -> Array:
    """Return z (n_steps, n_modes) with the mean of every NGS frame from the NGS, and NaN where there is no whole frame [um].

    z_ngs : at the steps k at which a frame of n steps has come, the mean over z[k-n+1] ... z[k] but for noise; else NaN
    """
    out, ends = np.full_like(z, np.nan), np.flatnonzero(~np.isnan(z_ngs).all(axis=1))
    ends = ends[ends >= n - 1]
    rows = ends[:, None] + np.arange(1 - n, 1)
    out[rows] = z[rows] + (z_ngs[ends] - frame_mean_of(z[rows]))[:, None]
    return out


def hold_last(x: Array) -> Array:
    """Return x (n, n_columns) with every NaN replaced by the last number before it in its column, zero where there is none."""
    gone = np.isnan(x)
    if not gone.any():
        return x
    last = np.maximum.accumulate(np.where(gone, -1, np.arange(x.shape[0])[:, None]), axis=0)
    return np.where(last < 0, 0.0, np.take_along_axis(x, np.maximum(last, 0), axis=0))


TURBULENCE, VIBRATION = "turbulence", "vibration"
TARGETS = (TURBULENCE, VIBRATION)

TOTAL, NEXT_Z = "total", "next z"
"""Of the standard deviations: the sum of turbulence and vibration, and the next measurement, as the sum predicts it."""


class Estimates(dict[str, Array]):
    """Estimates of an observer, target -> (n_steps, n_modes) [um], and how sure it is of them.

    Parameters
    ----------
    values : mapping of str to Array
        Target -> estimate, NaN where there is none.
    sd : mapping of str to Array, optional
        Target -> standard deviation of the estimate's error by the observer's own model, (n_steps, n_modes) [um], perhaps a
        read-only view of fewer numbers; no target without a model, NaN where not known. TOTAL and NEXT_Z, too, where the model
        has them: of the sum of its estimates, less the disturbance at the step and less z of the next.
    """

    def __init__(self, values: Mapping[str, Array], sd: Mapping[str, Array] | None = None):
        super().__init__(values)
        self.sd: dict[str, Array] = dict(sd or {})


def by_name(x: Array) -> dict[str, Array]:
    """Return the columns of x (n, 2 to 4, n_modes) by what they are: targets, and of standard deviations TOTAL and NEXT_Z."""
    return {name: x[:, i] for i, name in zip(range(x.shape[1]), (*TARGETS, TOTAL, NEXT_Z), strict=False)}


@dataclass(frozen=True)
class Estimate:
    """Estimate of one target by one observer.

    Attributes
    ----------
    observer, target : str
        Of whom, and of what.
    values : Array
        Estimate, (n_steps, n_modes) [um]; NaN where there is none.
    seconds_per_step : float
        Computing time per step and mode [s].
    sd : Array or None
        Standard deviation of its error by the observer's own model, (n_steps, n_modes) [um]; None where it has no model, NaN
        where there is no number.
    sd_of_sum : mapping of str to Array
        TOTAL and NEXT_Z -> that of all estimates of the observer together; empty where it has no such model.
    """

    observer: str
    target: str
    values: Array
    seconds_per_step: float
    sd: Array | None = None
    sd_of_sum: Mapping[str, Array] = field(default_factory=dict[str, Array])

    def __repr__(self) -> str:
        n_steps, n_modes = self.values.shape
        return (
            f"Estimate({self.observer}, {self.target}, steps {n_steps}, modes {n_modes}, {self.seconds_per_step:.3g} s per step)"
        )
