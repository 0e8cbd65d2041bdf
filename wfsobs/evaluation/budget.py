"""Error budget: the mean square error of an observer, cause by cause.

The measurements are a sum of sources,

    z[k] = phi_dist[k-1] + noise + what the sensors see beside the turbulence on the axis,

in which the vibration is cut into the lines that an observer is given and the others: each frequency belongs to the nearest line.
So are the estimates of a linear observer and its errors,

    e = e_noise + e_cone + e_lines + e_lag + e_mismatch.

The term of a cause is the mean of e_cause e. The terms add up to the mean of e^2, whatever the record and without an order of the
causes; between independent sources it is the mean of e_cause^2 but for chance. The response to the signal is compared with
that of the Kalman filter of the right model: what this lacks is lag, the difference of the two mismatch. Its turbulence has the
true spectrum, of third order where that is no autoregressive process, its lines and its noise are those of the scenario. Both
sensors together tell the slow error of the LGS from the turbulence, so that it is in the model of their filter, as is the
turbulence that the LGS alone see; the LGS by themselves cannot.

An observer that is not linear runs on every combination of sources, and e_cause is the mean over all orders of switching
them on (Shapley, Contributions to the Theory of Games II, 1953): those that learn from measurements learn anew each time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations
from math import factorial
from typing import TYPE_CHECKING, Any

import numpy as np

from wfsobs.evaluation.bound import TRUE_MODEL
from wfsobs.evaluation.result import NO_ESTIMATE, given_lines, is_near, own_bound
from wfsobs.evaluation.scores import Score
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS, TURBULENCE, VIBRATION, Observer
from wfsobs.observers.kalman.filters import MIN_NOISE, beam_model, estimated_cycle, steady_mode
from wfsobs.observers.kalman.step import KalmanEstimator, lgs_mean
from wfsobs.observers.step import Estimator
from wfsobs.prior import Beams, LgsStars, Line, Lines, Prior
from wfsobs.priors_from.scenario import beams_of, modelled_turbulence, observer_settings, prior_of, vibration_continuum
from wfsobs.progress import QUIET, Watch, detach_watch
from wfsobs.record import TOTAL, Measurements, Record, delay_signal, frame_mean
from wfsobs.registry import name_list
from wfsobs.scenario import Scenario
from wfsobs.signal.autoregressive import Ar2, Ar3
from wfsobs.simulation.disturbance import processes, vibration_lines
from wfsobs.simulation.loop import measure_closed_loop, simulate_noise
from wfsobs.simulation.sensing import OpenLoop, lgs_noise_rms
from wfsobs.simulation.sensor_noise import noise_rms
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.evaluation.result import Result

NOISE, CONE, LINES, SIGNAL = "noise", "cone", "lines", "signal"
"""White noise of the sensors; what they see beside the turbulence on the axis; vibration lines that an observer is not given;
turbulence on the axis and the lines that it is given."""

SOURCES = (NOISE, CONE, LINES, SIGNAL)

LAG, MISMATCH = "lag", "mismatch"

TERMS = {
    NOISE: "Noise",
    LAG: "Lag",
    LINES: "Unmodelled peaks",
    MISMATCH: "Model mismatch",
    CONE: "Cone effect and aliasing",
}
"""Terms of a budget, and their labels."""

LINEAR, AVERAGED = "linear", "averaged over orders"
"""How the terms were found."""

ONLY_NAMED = "only if named"
"""End of the reason why an observer has no budget that can have one."""


Estimates = dict[str, Array]


@dataclass(frozen=True)
class Budget:
    """Error budget of one observer, target and mode.

    Attributes
    ----------
    observer, target, mode : str
        Of what.
    total : float
        Mean square error, as scored [um^2].
    terms : dict of str to float
        Term -> its part of the total, in the order of TERMS [um^2]; empty where there is no budget.
    bound : float or None
        Minimum mean square error of any causal observer of the same measurements [um^2], a mark beside the terms; None where
        it is not known.
    method : str
        LINEAR or AVERAGED.
    reason : str
        Why there is no budget.
    """

    observer: str
    target: str
    mode: str
    total: float
    terms: dict[str, float] = field(default_factory=dict)
    bound: float | None = None
    method: str = LINEAR
    reason: str = ""

    @property
    def shares(self) -> dict[str, float]:
        """Term -> its share of the total; zero where there is no error."""
        return {name: part / self.total if self.total else 0.0 for name, part in self.terms.items()}


@dataclass(frozen=True)
class Source:
    """One part of a record.

    Attributes
    ----------
    measurement : OpenLoop
        What the sensors measure of it, NaN where the record has no measurement.
    truth : dict of str to Array
        Target, or TOTAL -> part of the truth, (n_steps, n_modes) [um].
    """

    measurement: OpenLoop
    truth: dict[str, Array]


def error_budget(
    result: Result, *, observers: Sequence[str] | None = None, mode: str | None = None, watch: Watch = QUIET
) -> list[Budget]:
    """Split the mean square error of every observer of a run into its causes.

    Parameters
    ----------
    result : Result
        What `run` returned.
    observers : sequence of str, optional
        Ids of the observers; by default all that gave an estimate. Those that are not linear have a budget only if they are
        named: it takes 16 runs of the observer.
    mode : str, optional
        Name of a mode; by default all.
    watch : Watch, optional
        Receives the progress, and is asked between observers whether to stop.

    Returns
    -------
    list of Budget
        One per score, without the bounds and the observer that gives zero.

    Raises
    ------
    ValueError
        The record was not simulated from the scenario, or its vibration names no lines.
    Cancelled
        `watch` asks to stop.

    See Also
    --------
    run : Simulates a record and runs the observers.

    Examples
    --------
    >>> import wfsobs
    >>> result = wfsobs.run(wfsobs.PRESETS["paper"]().replace({"run.duration": 2.0}), observers=["kf-lgs"])
    >>> budget = wfsobs.error_budget(result)[0]
    >>> abs(sum(budget.terms.values()) / budget.total - 1.0) < 1e-9
    True
    """
    scenario, record, observers = result.scenario, result.record.without_outliers, name_list(observers)
    if (
        record.turbulence is None
        or record.vibration is None
        or (record.n_steps, record.n_modes) != (scenario.n_steps, len(scenario.modes))
    ):
        raise ValueError("error budget: takes a record that was simulated from its scenario")
    if scenario.vibration.source == "psd":
        raise ValueError("error budget: vibration.source = psd is a table, not lines that a model could have")
    chosen = [name for name in dict.fromkeys(e.observer for e in result.estimates) if observers is None or name in observers]
    parts, out = _Parts(scenario, record), dict[str, list[Budget]]()
    linewise = sorted(
        (name for name in chosen if name != NO_ESTIMATE), key=parts.given_lines
    )  # the same lines one after the other
    for i, name in enumerate(linewise):
        watch.step(i / len(chosen))
        own = [s for s in result.scores if s.observer == name and mode in (None, s.mode)]
        observer, limit, reason = OBSERVERS[name], own_bound(name), ""
        if not observer.causal:
            reason = "looks ahead"
        elif "y_stars" in observer.needs:
            reason = "takes every LGS by itself"
        elif not observer.linear and observers is None:
            reason = f"not linear, takes 16 runs: {ONLY_NAMED}"
        values = with_total({e.target: e.values for e in result.estimates if e.observer == name})
        terms = [dict[str, float]()] * len(own) if reason or not own else _terms(observer, parts, values, own, watch)
        bounds = {(s.target, s.mode): s.rms**2 for s in result.scores if s.observer == limit}
        method = LINEAR if reason or observer.linear else AVERAGED
        out[name] = [
            Budget(name, s.target, s.mode, s.rms**2, of, bounds.get((s.target, s.mode)), method, reason)
            for s, of in zip(own, terms, strict=True)
        ]
    return [it for name in chosen for it in out.get(name, ())]


ModeLines = tuple[tuple[float, ...], ...]
"""Lines that an observer is given [Hz], mode by mode."""


class _Parts:
    """The sources of a record and what the loop makes of them, kept as long as they are asked for the same lines."""

    def __init__(self, scenario: Scenario, record: Record):
        self.scenario, self.record = scenario, record
        self.all_lines = [[line[0] for line in vibration_lines(scenario, i)] for i in range(record.n_modes)]
        noise = simulate_noise(scenario)
        self.sources = lru_cache(1)(lambda lines: split_record(record, noise, self.all_lines, lines))
        self.reference = lru_cache(4 * record.n_modes)(self._follow_signal)
        self.measurements = lru_cache(2 * (len(SOURCES) + 1))(self._measure)

    def given_lines(self, name: str) -> ModeLines:
        """Return which lines an observer is given; one without a prior that learns can find every line."""
        observer, before = OBSERVERS[name], self.scenario.before_events
        finds_all = not observer.prior and not observer.linear
        columns = range(self.record.n_modes)
        return tuple(tuple(self.all_lines[i] if finds_all else given_lines(before, name, i)) for i in columns)

    def _measure(self, lines: ModeLines, names: tuple[str, ...], modes: tuple[int, ...]) -> Measurements:
        sources = self.sources(lines)
        seen = _add([sources[name].measurement for name in names], sources[SIGNAL].measurement)
        return measure_closed_loop(self.scenario, OpenLoop(seen.lgs.take(modes, 1), seen.ngs.take(modes, 1), seen.stars))

    def _follow_signal(self, lines: ModeLines, mode: int, sensors: tuple[str, ...]) -> Estimates:
        before, signal = self.scenario.before_events, self.measurements(lines, (SIGNAL,), (mode,))
        stars = prior_of(before, self.record, (LgsStars,), modes=(mode,))
        return with_total(follow_signal(before, mode, lines[mode], sensors, signal, stars))


def _terms(observer: Observer, of: _Parts, values: Estimates, scores: Iterable[Score], watch: Watch) -> list[dict[str, float]]:
    """Return the terms of the budget of every score: the mean of part times error over its samples."""
    columns = [mode.name for mode in of.scenario.modes]
    lines = of.given_lines(observer.id)
    sources, out = of.sources(lines), []
    modes = tuple(range(len(columns)) if observer.couples_modes else sorted({columns.index(s.mode) for s in scores}))
    responses, rest = _responses(observer, of, lines, modes, watch)
    for s in scores:
        i = columns.index(s.mode)
        at = modes.index(i)
        truth = {name: part.truth[s.target][:, i] for name, part in sources.items()}
        parts = {name: responses[name][s.target][:, at] - truth[name] for name in sources}
        watch.check()
        lag = of.reference(lines, i, observer.sensors)[s.target] - truth[SIGNAL]
        parts |= {LAG: lag, MISMATCH: parts.pop(SIGNAL) - lag + rest[s.target][:, at]}
        error = values[s.target][:, i] - sum(truth.values())
        assert s.start is not None and s.stop is not None
        scored = slice(round(s.start / of.record.dt), round(s.stop / of.record.dt))
        out.append({name: float(np.nanmean(parts[name][scored] * error[scored])) for name in TERMS})
    return out


def with_total(parts: Mapping[str, Array]) -> Estimates:
    """Return what there is of each target, and where there is both also the sum."""
    both = set(TARGETS) <= set(parts)
    return {**parts, TOTAL: parts[TURBULENCE] + parts[VIBRATION]} if both else {**parts}


def budget_row(budget: Budget) -> dict[str, Any]:
    """Return a budget as a plain dictionary: what `wfsobs run --budget --json` adds to a row."""
    return {
        "total_um2": budget.total,
        "terms_um2": budget.terms or None,
        "bound_um2": budget.bound,
        "method": budget.method if budget.terms else None,
        "reason": budget.reason or None,
    }


# ---------------------------------------------------------------------- sources


def split_record(
    record: Record, noise: OpenLoop, lines: Sequence[Sequence[float]], given_lines: Sequence[Sequence[float]]
) -> dict[str, Source]:
    """Split a record into its sources.

    Parameters
    ----------
    record : Record
        The record.
    noise : OpenLoop
        White noise of the sensors in it, of `simulate_noise`.
    lines, given_lines : sequence
        All the lines [Hz] of the vibration, and those that an observer is given, mode by mode.

    Returns
    -------
    dict of str to Source
        The sources by name; their sum is the record.
    """
    assert record.turbulence is not None and record.vibration is not None and record.ratio is not None
    assert record.open_loop_y is not None
    total = OpenLoop(record.open_loop_y, record.z_ngs, record.lgs_stars)
    nothing = np.zeros_like(record.vibration)
    columns = zip(record.vibration.T, lines, given_lines, strict=True)
    known = np.column_stack([split_lines(x, record.dt, *of) for x, *of in columns])
    others = record.vibration - known
    on_axis = _see(record.turbulence + record.vibration, record.ratio)
    beside = OpenLoop(total.lgs - noise.lgs - on_axis.lgs, total.ngs - noise.ngs - on_axis.ngs)
    parts = {
        NOISE: (noise, nothing, nothing),
        CONE: (beside, nothing, nothing),
        LINES: (_see(others, record.ratio), nothing, others),
        SIGNAL: (_see(record.turbulence + known, record.ratio), record.turbulence, known),
    }
    return {  # NaN where the record has no measurement
        name: Source(_add([seen], total), with_total({TURBULENCE: turbulence, VIBRATION: vibration}))
        for name, (seen, turbulence, vibration) in parts.items()
    }


def split_lines(vibration: Array, dt: float, lines: Sequence[float], given_lines: Sequence[float]) -> Array:
    """Return the part (n,) of a vibration (n,) whose frequencies belong to a line [Hz] that is given.

    A frequency belongs to the nearest of the lines; where there are none it is a line itself.
    """
    bins = np.fft.rfftfreq(vibration.size, dt)
    at = np.asarray(lines, dtype=float) if len(lines) else bins
    nearest = np.argmin(np.abs(bins[:, None] - at), axis=1) if len(lines) else np.arange(bins.size)
    known = is_near(at, given_lines)
    if known.all():
        return vibration
    return np.fft.irfft(np.fft.rfft(vibration) * known[nearest], vibration.size)


def _add(parts: Iterable[OpenLoop], total: OpenLoop) -> OpenLoop:
    """Return several measurements together, zero without any, where the whole is measured."""
    lgs, ngs = 0.0 * total.lgs, 0.0 * total.ngs
    for one in parts:
        lgs += one.lgs
        ngs += one.ngs
    return OpenLoop(lgs, ngs, total.stars)


def _see(signal: Array, ratio: int) -> OpenLoop:
    """Return the noiseless measurements of a signal that is the same for all stars."""
    return OpenLoop(delay_signal(signal, 1), frame_mean(signal, ratio))


# ---------------------------------------------------------------------- responses


def _responses(
    observer: Observer, of: _Parts, lines: ModeLines, modes: tuple[int, ...], watch: Watch
) -> tuple[dict[str, Estimates], Estimates]:
    """Split an observer's estimate into source -> target -> response, and the estimate from nothing; the sum is the estimate."""
    before = of.scenario.before_events
    settings = observer_settings(observer, before)
    prior = prior_of(before, of.record, observer.parts(settings), modes=modes)
    silent = replace(watch, progress=lambda _: None, partial=lambda *_: None)
    if observer.linear and observer.step is not None and observer.run is None:
        designed = observer.step(prior, settings, of.measurements(lines, (), modes).sampling, 0.0)  # once for all sources

        def from_rest(*_: object) -> Estimator:
            designed.reset()
            return designed

        observer = replace(observer, step=from_rest)

    def estimate(names: tuple[str, ...]) -> Estimates:
        watch.check()
        measured = of.measurements(lines, names, modes)
        own = measured if "open_loop_y" in observer.needs else replace(measured, open_loop_y=None)
        with detach_watch(silent) as alone:
            found = observer.estimate(own, prior, settings, alone)
        return with_total({target: np.nan_to_num(values) for target, values in found.items()})

    rest = estimate(())
    if not observer.linear:
        return shapley_shares(SOURCES, estimate, rest), rest
    return {name: {target: x - rest[target] for target, x in estimate((name,)).items()} for name in SOURCES}, rest


def shapley_shares(
    names: Sequence[str], estimate: Callable[[tuple[str, ...]], Estimates], rest: Estimates
) -> dict[str, Estimates]:
    """Return the mean over all orders of what a source adds to the estimate from those before it."""
    n = len(names)
    found = {frozenset(of): estimate(of) if of else rest for size in range(n + 1) for of in combinations(names, size)}
    out = {}
    for name in names:
        weight = {of: factorial(len(of)) * factorial(n - len(of) - 1) / factorial(n) for of in found if name not in of}
        out[name] = {
            target: sum(w * (found[of | {name}][target] - found[of][target]) for of, w in weight.items()) for target in rest
        }
    return out


# ---------------------------------------------------------------------- filter of the right model


def follow_signal(
    scenario: Scenario, mode: int, given_lines: Sequence[float], sensors: Sequence[str], signal: Measurements, stars: Prior
) -> dict[str, Array]:
    """Run the Kalman filter of the right model on the noiseless measurements of one mode.

    Parameters
    ----------
    scenario : Scenario
        Settings of the simulation, without events.
    mode : int
        Index of the mode.
    given_lines : sequence of float
        Lines [Hz] in the model.
    sensors : sequence of str
        Sensors in use, of "lgs" and "ngs".
    signal : Measurements
        What the sensors measure of turbulence and lines, of this mode alone; NaN where a frame is missing.
    stars : Prior
        The LGS of this mode alone.

    Returns
    -------
    dict of str to Array
        Target -> estimate, (n_steps,) [um].
    """
    lines = [Line(*line) for line in vibration_lines(scenario, mode)]
    near = is_near(np.array([line.frequency for line in lines]), given_lines)
    known = tuple(line for line, is_given in zip(lines, near, strict=True) if is_given)
    continuum = vibration_continuum(scenario, mode) if near.all() else ()  # given all lines, of what is no line as well
    vibration = Lines(0.0, scenario.dt, lines=known, continuum=continuum).vibration(scenario.multipeak.line_width)
    noise, both = max(lgs_noise_rms(scenario, mode), MIN_NOISE), set(sensors) == {"lgs", "ngs"}
    beams = true_beams(scenario, mode) if both else Beams(true_turbulence(scenario, mode))
    if not (vibration or beams.common or beams.target):
        return {target: np.zeros(len(signal.y_lgs)) for target in TARGETS}
    model = beam_model(beams, vibration)
    if "ngs" not in sensors:
        kalman = steady_mode(model, noise, lgs_mean(stars, 0))
    else:
        ngs_noise = max(noise_rms(scenario, "ngs")[mode], MIN_NOISE)
        cycle = estimated_cycle(model, scenario.sensors.exposure_ratio, noise, ngs_noise, beams.lgs)
        used = np.array([[float(both)], [1.0]])
        kalman = cycle._replace(steps=[(A, used * C, Q, R) for A, C, Q, R in cycle.steps]).filter(stars, 0)
    found = KalmanEstimator([kalman]).run(signal, QUIET)
    return {target: found[target][:, 0] for target in TARGETS}


def true_beams(scenario: Scenario, mode: int) -> Beams:
    """Return processes that have the spectra of the turbulence as the target has it and as the LGS see it, or are nearest."""
    if _is_sum(scenario):
        return replace(beams_of(scenario, mode), common=true_turbulence(scenario, mode), target=())
    return beams_of(scenario.replace(TRUE_MODEL), mode)


def true_turbulence(scenario: Scenario, mode: int) -> tuple[Ar2 | Ar3, ...]:
    """Return processes that have the spectrum of the turbulence, or are nearest to it."""
    if _is_sum(scenario):
        return tuple(processes(scenario, mode, scenario.dt))
    return (modelled_turbulence(scenario.replace(TRUE_MODEL), mode, scenario.dt),)


def _is_sum(scenario: Scenario) -> bool:
    """Return whether the turbulence is a sum of processes, or of none."""
    return scenario.turbulence.source not in ("frozen-flow", "psd")
