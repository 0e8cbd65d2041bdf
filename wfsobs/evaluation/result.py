"""The result of a run, scores as plain rows, the labels of rows in every table, what each observer knows beforehand."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import nan
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from wfsobs.evaluation.scores import (
    BOUND,
    BOUND_ASTERISM,
    BOUND_BOTH,
    BOUND_BOTH_MODES,
    BOUND_MODES,
    BOUND_STARS,
    BOUNDS,
    LOOP,
    PREDICTION,
    Score,
)
from wfsobs.notebook import PlotAccessor, html_table, import_extra
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import SPECTRA
from wfsobs.prior import TRUE, Bands, Lines, Model, Part, PriorSource, Training, asks_for
from wfsobs.priors_from.scenario import modelled_peak
from wfsobs.record import TOTAL, Estimate, Record
from wfsobs.scenario import Scenario
from wfsobs.simulation.disturbance import vibration_lines
from wfsobs.typing import Array

if TYPE_CHECKING:
    import pandas
    import xarray


Row = dict[str, Any]

TIME = "time_per_step_us"
"""Computing time per step and mode [us]: in the table, but not part of the result, which the seed determines."""

STATED = ("sd_um", "within_68", "within_95", "crps_um")
"""What an observer states of its errors, and how it fits them (`Calibration`)."""

NOT_OBSERVERS = {
    LOOP: "Recorded loop",
    BOUND: "Theoretical limit, mean of the LGS",
    BOUND_BOTH: "Theoretical limit, LGS and NGS",
    BOUND_STARS: "Theoretical limit, every LGS apart, and NGS",
    BOUND_MODES: "Theoretical limit, mean of the LGS in all modes",
    BOUND_BOTH_MODES: "Theoretical limit, LGS and NGS in all modes",
    BOUND_ASTERISM: "Theoretical limit, every LGS in all modes, and NGS",
}
"""Labels of rows in a table of observers that are not observers."""

NO_ESTIMATE = "zero"
"""The observer that stands for having none; it is never the best, nor worse than itself."""

JOINT_BOUNDS = {"kf-coupled": BOUND_MODES, "multirate-coupled": BOUND_BOTH_MODES, "kf-asterism": BOUND_ASTERISM}
"""Observers of all modes together, and the bound of what they measure."""


def own_bound(observer: str) -> str | None:
    """Return the bound of the measurements of an observer; None where there is none: it looks ahead, or has the NGS alone.

    >>> own_bound("kf-lgs"), own_bound("multirate-multi"), own_bound("kf-ngs")
    ('bound', 'bound-both', None)
    """
    if observer in NOT_OBSERVERS or observer == NO_ESTIMATE or not OBSERVERS[observer].causal:
        return None
    of_sensors = {("lgs",): BOUND, ("lgs", "ngs"): BOUND_BOTH}
    return JOINT_BOUNDS.get(observer) or of_sensors.get(OBSERVERS[observer].sensors)


def target_title(target: str) -> str:
    """Return a target as the beginning of a heading."""
    return {TOTAL: "Turbulence and vibration together", PREDICTION: "Next measurement"}.get(target, target.capitalize())


def score_rows(scores: Iterable[Score], seed: int | None, *, source: PriorSource = TRUE) -> list[Row]:
    """Return one plain dictionary per score: the keys of `wfsobs run --json`, and TIME.

    source : where the prior of the observers comes from
    """
    return [
        {
            "observer": s.observer,
            "target": s.target,
            "mode": s.mode,
            "rms_um": s.rms,
            "truth_rms_um": s.truth_rms,
            "normalised_rms": s.normalised_rms,
            "lag_s": s.lag,
            "start_s": s.start,
            "stop_s": s.stop,
            "apart": s.apart,
            "needs": SPECTRA
            if s.observer in BOUNDS
            else ""
            if s.observer == LOOP
            else OBSERVERS[s.observer].needs_text(source=source),
            "interval_um": None if s.interval is None else list(s.interval),
            "phases_um": None if s.phases is None else list(s.phases),
            **dict(zip(STATED, s.calibration or (None,) * len(STATED), strict=True)),
            "seed": seed,
            TIME: None if s.observer in NOT_OBSERVERS else s.seconds_per_step * 1e6,
        }
        for s in scores
    ]


def interval_text(x: float, interval: Sequence[float] | None, scale: float) -> str:
    """Return the interval of a value, "low - high"; "-" where there is none, and "unknown" where it `is_unknown`.

    >>> interval_text(0.044, (0.03, 0.06), 1e3), interval_text(0.044, (1e-4, 12.8), 1e3)
    ('30.00 - 60.00', 'unknown')
    """
    if interval is None or is_unknown(x, interval):
        return "-" if interval is None else "unknown"
    return f"{interval[0] * scale:.2f} - {interval[1] * scale:.2f}"


def is_unknown(x: float, interval: Sequence[float]) -> bool:
    """Return whether an interval reaches beyond ten times the value: errors that one record has a single time."""
    return interval[1] > 10.0 * x


def uncertainty_text(x: float, interval: Sequence[float], write: Callable[[float], str]) -> str:
    """Return half the width of an interval, or both of its ends where it is wider than the value, as formatted by `write`.

    It is unknown where it `is_unknown`.

    >>> uncertainty_text(9.63, (9.21, 10.05), "{:.2f}".format), uncertainty_text(21.9, (2.57, 187.0), "{:.1f}".format)
    ('± 0.42', '(2.6 to 187.0)')
    >>> uncertainty_text(17.1, (0.3, 1020.5), "{:.1f}".format)
    '(interval unknown)'
    """
    low, high = interval
    if is_unknown(x, interval):
        return "(interval unknown)"
    return f"± {write(0.5 * (high - low))}" if high - low <= x else f"({write(low)} to {write(high)})"


def row_label(observer: str) -> str:
    """Return the label of a row."""
    return NOT_OBSERVERS.get(observer) or OBSERVERS[observer].label


EQUAL = 0.25
"""Largest share by which errors may differ, or an interval reach to either side, to be called equal: what few seeds cannot tell
apart may well be different."""


def above_bound(rms: float, interval: Sequence[float] | None, bound: float | None) -> float | None:
    """Return by which share an error is above the bound of what the observer measures, 0 where they are equal.

    With the bound in the error's interval they are, unless that reaches further than EQUAL to either side: then NaN, not known.
    None without a bound.

    >>> above_bound(9.7, (9.2, 10.2), 10.0), round(above_bound(11.0, (10.5, 11.5), 10.0), 6), above_bound(9.7, None, None)
    (0.0, 0.1, None)
    >>> above_bound(48.0, (30.0, 66.0), 32.0)
    nan
    """
    if not bound:
        return None
    if interval is not None and interval[0] <= bound <= interval[1]:
        return 0.0 if interval[1] - interval[0] <= 2.0 * EQUAL * rms else nan
    return rms / bound - 1.0


def can_be_best(observer: str, apart: bool) -> bool:
    """Return whether a row can be the best: not a bound, nor a row that is not causal or was scored on samples of its own."""
    return observer not in NOT_OBSERVERS and not is_non_causal(observer) and not apart


def scored_interval(rows: Iterable[Row]) -> str:
    """Return the interval of the scored samples of comparable rows, empty where there are none.

    >>> scored_interval([{"start_s": 4.001, "stop_s": 9.999, "apart": False}, {"start_s": None, "stop_s": None, "apart": False}])
    '4.00 to 10.00 s'
    """
    return _span([r for r in rows if not r["apart"]])


def own_interval(row: Row) -> str:
    """Return the interval of the scored samples of a row that stands apart, empty for any other."""
    return f"{_span([row])} only" if row["apart"] else ""


def _span(rows: Sequence[Row]) -> str:
    known = [(r["start_s"], r["stop_s"]) for r in rows if r["start_s"] is not None]
    return f"{min(start for start, _ in known):.2f} to {max(stop for _, stop in known):.2f} s" if known else ""


def is_non_causal(observer: str) -> bool:
    """Return whether an estimate uses later samples."""
    return observer not in NOT_OBSERVERS and not OBSERVERS[observer].causal


HALF_WIDTH = 1.5
"""What counts as at a line [Hz] to either side, three bins of a spectrum with 0.5 Hz."""


PEAKS, ONE_PEAK, TRAINED, BANDS, TRUE_SPECTRA, NOTHING = "peaks", "one peak", "training data", "bands", "spectra", "nothing"
"""Kinds of prior knowledge: the frequencies of peaks, a model with one, training data, frequency bands, the spectra, and none."""

_KINDS: tuple[tuple[Part, str], ...] = ((Lines, PEAKS), (Model, ONE_PEAK), (Training, TRAINED), (Bands, BANDS))


def prior_knowledge(observer: str) -> str:
    """Return which kind of prior knowledge an observer has.

    >>> prior_knowledge("kf-multi"), prior_knowledge("kf-lgs"), prior_knowledge("kf-adaptive")
    ('peaks', 'one peak', 'nothing')
    """
    return knowledge_of(OBSERVERS[observer].prior)


def knowledge_of(prior: Iterable[Part]) -> str:
    """Return which kind of prior knowledge these parts of a prior are."""
    return next((kind for part, kind in _KINDS if asks_for(part, prior)), NOTHING)


def group_by_knowledge(names: Iterable[str], source: PriorSource = TRUE) -> dict[str, list[str]]:
    """Group rows of a table by what they know before they measure: title -> rows, which keep their order.

    source : where the prior of the observers comes from

    >>> group_by_knowledge(["bound", "multirate-multi", "kf-multi", "kf-adaptive"])
    {'Prior knowledge: none': ['kf-adaptive'], 'Prior knowledge: peak frequencies': ['multirate-multi', 'kf-multi'], \
'Theoretical limit, from the true spectra': ['bound']}
    """
    peaks = "peak frequencies" if source == TRUE else f"{source} peak frequencies"
    known = {NOTHING: "none", PEAKS: peaks, ONE_PEAK: "one peak", BANDS: "frequency bands", TRAINED: "training data"}
    titles = {LOOP: "Recorded loop", **dict.fromkeys(BOUNDS, "Theoretical limit, from the true spectra")}
    groups: dict[str, list[str]] = {f"Prior knowledge: {words}": [] for words in known.values()}
    for name in names:
        title = titles.get(name) or f"Prior knowledge: {known[prior_knowledge(name)]}"
        groups.setdefault(title, []).append(name)
    return {title: of for title, of in groups.items() if of}


def given_lines(scenario: Scenario, observer: str, column: int) -> Sequence[float]:
    """Return the frequencies [Hz] of what an observer is given in one mode; scenario : what its prior is made from."""
    kind = prior_knowledge(observer)
    if kind == PEAKS:
        return [line[0] for line in vibration_lines(scenario, column)]
    if kind == ONE_PEAK:
        return [modelled_peak(scenario, column)[0]]
    return scenario.butterworth.frequencies if asks_for(Bands, OBSERVERS[observer].prior) else ()


def is_near(frequency: Array, lines: Sequence[float]) -> Array:
    """Return which frequencies [Hz] are at one of the lines, bool, of the same shape."""
    apart = np.abs(np.asarray(frequency)[:, None] - np.asarray(lines, dtype=float))
    return np.any(apart <= HALF_WIDTH, axis=1)


@dataclass(frozen=True)
class Failure:
    """An observer without an estimate, and the reason in one line."""

    observer: str
    reason: str


@dataclass(frozen=True, repr=False)
class Result:
    """Result of a run: scenario, record, estimates and scores.

    Attributes
    ----------
    scenario : Scenario
        Settings of the run.
    record : Record
        Measurements, commands and truth.
    estimates : tuple of Estimate
        One per observer and target, in the order of the registry.
    scores : tuple of Score
        One per observer, target and mode; the bounds last.
    failures : tuple of Failure
        Observers without an estimate.
    prior_source : {"true", "identified", "given"}
        Where the prior of the observers comes from: the settings of the simulation, an identification, or settings alone.
    """

    scenario: Scenario
    record: Record
    estimates: tuple[Estimate, ...]
    scores: tuple[Score, ...]
    failures: tuple[Failure, ...] = ()
    prior_source: PriorSource = TRUE
    plot: ClassVar[PlotAccessor] = PlotAccessor()

    def __repr__(self) -> str:
        left_out = f", {len(self.failures)} left out" if self.failures else ""
        observers = len({e.observer for e in self.estimates})
        return f"Result({observers} observers, {len(self.scores)} scores{left_out}, {self.record!r})"

    def _repr_html_(self) -> str:
        cells = [(s.target, s.mode, s.observer, f"{s.rms * 1e3:.2f}") for s in self.scores]
        return html_table(("Target", "Mode", "Observer", "error, nm"), cells)

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the scores as a pandas table, one row per score.

        Returns
        -------
        pandas.DataFrame
            The keys of `wfsobs run --json` as columns.

        Raises
        ------
        ImportError
            pandas is not installed.
        """
        return import_extra("pandas", "arrays").DataFrame(
            score_rows(self.scores, self.scenario.run.seed, source=self.prior_source)
        )

    def to_xarray(self) -> xarray.Dataset:
        """Return the record and the estimates as labelled arrays.

        Returns
        -------
        xarray.Dataset
            That of the record; `turbulence_estimate` and `vibration_estimate` over `observer`, `time` [s] and `mode` (its name),
            NaN where there is none, and `..._sd`, the standard deviation that an observer states.

        Raises
        ------
        ImportError
            xarray is not installed.
        """
        out = self.record.to_xarray()
        out = out.assign_coords(mode=[m.name for m in self.scenario.modes][: self.record.n_modes])
        names = list(dict.fromkeys(e.observer for e in self.estimates))
        nothing = np.full_like(self.record.y_lgs, np.nan)
        for target in dict.fromkeys(e.target for e in self.estimates):
            own = {e.observer: e for e in self.estimates if e.target == target}
            for name, what in ((f"{target}_estimate", "values"), (f"{target}_sd", "sd")):
                found = {key: x for key, e in own.items() if (x := getattr(e, what)) is not None}
                if found:
                    stacked = np.stack([found.get(key, nothing) for key in names])
                    out[name] = (("observer", "time", "mode"), stacked, {"units": "um"})
        return out.assign_coords(observer=names)

    def estimate(self, observer: str, target: str) -> Estimate | None:
        """Return the estimate of one observer and target.

        Parameters
        ----------
        observer : str
            Id of the observer.
        target : str
            "turbulence" or "vibration".

        Returns
        -------
        Estimate or None
            None where there is no such estimate.
        """
        return next((e for e in self.estimates if (e.observer, e.target) == (observer, target)), None)
