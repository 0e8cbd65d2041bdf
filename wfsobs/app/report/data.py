"""What a report holds: the rows of every state, and its lines as few points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wfsobs.app.style import observers_of
from wfsobs.app.views.errors import lines_of_failures, main_observers
from wfsobs.app.work import TRUTH
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.run import closed_loop
from wfsobs.closed_loop.run import rows as controller_rows
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.bound import NO_BOUND
from wfsobs.evaluation.budget import Budget, budget_row, error_budget
from wfsobs.evaluation.evidence import Evidence
from wfsobs.evaluation.exact_errors import cumulative_rms, spectra
from wfsobs.evaluation.result import Result, Row, row_label, score_rows
from wfsobs.evaluation.scores import RESIDUAL, SCORED
from wfsobs.evaluation.verdict import verdict
from wfsobs.observers.base import TARGETS
from wfsobs.priors_from.scenario import usual_observers
from wfsobs.record import RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import Variation
from wfsobs.signal.envelope import envelope, envelope_times
from wfsobs.simulation.true_spectra import has_known_spectra
from wfsobs.typing import Array

Floats = NDArray[np.float32]

WINDOW_S = 0.5
"""A stretch in the middle of the record that keeps every sample [s]."""


@dataclass(frozen=True)
class Grid:
    """Which points of a line are kept.

    They are the extremes of bins, but every sample between `first` and `last`, and where bins save nothing.
    """

    n: int
    dt: float
    bins: int

    @property
    def whole(self) -> bool:
        """Whether every sample of the record is kept."""
        return self.n <= 2 * self.bins + self.width

    @property
    def width(self) -> int:
        """Samples in the window."""
        return min(round(WINDOW_S / self.dt), self.n)

    @property
    def first(self) -> int:
        """The window's first sample."""
        return 0 if self.whole else (self.n - self.width) // 2

    @property
    def last(self) -> int:
        """One past the window's last sample."""
        return self.n if self.whole else self.first + self.width

    def _parts(self) -> list[tuple[int, int, int]]:
        """(start, stop, bins) of the pieces, all samples where the bins are 0."""
        left, right = self.first, self.n - self.last
        share = round(self.bins * left / max(left + right, 1))
        parts = [(0, left, share), (self.first, self.last, 0), (self.last, self.n, self.bins - share)]
        return [part for part in parts if part[1] > part[0]]

    def times(self) -> Array:
        """Return the times [s] of the points kept."""
        return np.concatenate([envelope_times(a, b, bins or b - a, self.dt) for a, b, bins in self._parts()])

    def thin(self, x: Array) -> Floats:
        """Select the points kept of a signal (n,)."""
        return np.concatenate([envelope(x[a:b], bins or b - a) for a, b, bins in self._parts()]).astype(np.float32)


POINTS = 1_250_000
"""Points of all lines of all states together, spectra included: three states stay below 4 MB with Bokeh."""

SPECTRUM, SPECTRUM_BINS = 400, 100
"""Points of a spectrum that are kept as they are (up to 200 Hz), and pairs of extremes of those above."""

CUMULATIVE = 150
"""Points of a cumulative spectrum, evenly spaced on a logarithmic axis."""

FEWEST, MOST_BINS = 200, 10_000
"""Pairs of extremes kept of a line, however many states there are, and however few."""


@dataclass(frozen=True)
class State:
    """One combination of the settings varied, and what came of it.

    rows    : as `wfsobs run --json` gives them, and the computing time
    reasons : why an observer gave nothing, and why there is no bound, a line each
    grid    : the points kept of the traces
    lines   : "kind/target/observer/mode" -> points; kind is signal, error [um], psd, psd-error [um^2/Hz], cumulative or
              cumulative-error [um]; frequencies [Hz] of the latter two pairs as "frequency", "frequency-cumulative"
    loop    : as `wfsobs loop --json` gives them, of the controllers without a GPR; none where the record has no truth
    budgets : as `wfsobs run --budget --json` gives them, of the linear observers; none where the sources are not known
    verdicts : (target, mode, sentences); none where the record has no truth
    main    : target -> the observers whose lines are shown at first
    seeds   : what further seeds say: their number, and by "target/mode" the best and those that do not differ significantly from
              it; empty for one record
    """

    scenario: Scenario
    rows: list[Row]
    reasons: tuple[str, ...]
    grid: Grid
    lines: Mapping[str, Floats]
    loop: Sequence[Row] = ()
    budgets: Sequence[Row] = ()
    seeds: Mapping[str, Any] = field(default_factory=dict)
    verdicts: Sequence[tuple[str, str, list[str]]] = ()
    main: Mapping[str, list[str]] = field(default_factory=dict)

    @property
    def is_truthless(self) -> bool:
        """Whether errors are those of predicting the next measurement."""
        return any(row["target"] == RESIDUAL for row in self.rows)


@dataclass(frozen=True)
class Report:
    """All of a report: states are the product of the variations, the last one running fastest.

    preset : what the settings are compared with; base : the settings that were varied; is_recorded : whether on a record
    that was loaded or kept, not simulated from the settings; command : what makes the estimates of such a record again;
    sweep : maps of the last sweep, a title, axes, and cells row by row, and its rows; comparison : the runs that the one shown is
    compared with, and a table per target and mode; observers : those that were chosen, none where all usual ones ran
    """

    preset: str
    base: Scenario
    variations: tuple[Variation, ...]
    states: tuple[State, ...]
    is_recorded: bool = False
    command: str = ""
    sweep: Mapping[str, Any] | None = None
    comparison: Mapping[str, Any] | None = None
    observers: Sequence[str] = ()

    @property
    def start(self) -> int:
        """The state shown first: that of the settings as they were, if it is one."""
        return next((i for i, state in enumerate(self.states) if state.scenario == self.base), 0)


def bins_for(states: int, observers: int, modes: int) -> int:
    """How many pairs of extremes of a line can be kept."""
    lines = modes * (2 * observers + len(TARGETS))  # signals and errors; of the truth the signal alone
    points = POINTS / max(states * lines, 1) - SPECTRUM - 2 * SPECTRUM_BINS - CUMULATIVE - 1000 * WINDOW_S
    return int(np.clip(points / 2, FEWEST, MOST_BINS))


def state_of(
    result: Result,
    states: int = 1,
    *,
    is_simulated: bool = True,
    evidence: Evidence | None = None,
    observers: Sequence[str] | None = None,
) -> State:
    """Select what a report of so many states keeps of a run.

    is_simulated : whether the record was made from the settings; evidence : errors over several seeds; observers : those that
    were to run, by default the usual ones
    """
    record, scenario = result.record, result.scenario
    names = [m.name for m in scenario.modes][: record.n_modes]
    lines: dict[str, Floats] = {}
    drawn = {(e.target, e.observer): e.values for e in result.estimates if e.observer in observers_of(e.target)}
    grid = Grid(record.n_steps, record.dt, bins_for(states, len(drawn), len(names)))
    truths = {target: record.truth(target) for target in TARGETS}
    drawn |= {(target, TRUTH): truth for target, truth in truths.items() if truth is not None}
    for (target, observer), values in drawn.items():
        truth = truths[target]
        signals = {"signal": values}
        if truth is not None and observer != TRUTH:
            signals["error"] = values - truth
        found = spectra(record, target, values, scenario.run.warm_up)
        for i, mode in enumerate(names):
            where = f"{target}/{observer}/{mode}"
            lines |= {f"{kind}/{where}": grid.thin(signal[:, i]) for kind, signal in signals.items()}
            if found:
                lines |= _frequencies(found[0])
                for suffix, density in zip(("", "-error"), found[1 : 1 + len(signals)], strict=False):
                    lines[f"psd{suffix}/{where}"], lines[f"cumulative{suffix}/{where}"] = _spectra(found[0], density[:, i])
    scores = [evidence.over_seeds(score) for score in result.scores] if evidence else result.scores
    rows = score_rows(scores, scenario.run.seed, source=result.prior_source)
    budgets, simulation = (list_budgets(result), scenario) if is_simulated else ([], None)
    of = scenario, record, result.estimates, result.scores
    no_bound = [NO_BOUND] if is_simulated and not has_known_spectra(scenario) else []
    known = {"simulation": simulation, "evidence": evidence, "budgets": budgets, "source": result.prior_source}
    return State(
        scenario,
        rows,
        (*_reasons(result, usual_observers(scenario, record) if observers is None else observers), *no_bound),
        grid,
        lines,
        loop_rows(result),
        [{"observer": it.observer, "target": it.target, "mode": it.mode, **budget_row(it)} for it in budgets],
        seeds_of(evidence) if evidence else {},
        [
            (target, mode, found.sentences())
            for target in TARGETS
            for mode in names
            if (found := verdict(*of, target, mode, **known)) is not None
        ],
        {target: main_observers(result.scores, target, names[0], evidence) for target in TARGETS},
    )


def list_budgets(result: Result) -> list[Budget]:
    """Return the error budgets of the linear observers by target and mode; nothing where the sources are not known."""
    try:
        found = [it for it in error_budget(result) if it.terms]
    except ValueError:
        return []
    return sorted(found, key=lambda it: (SCORED.index(it.target), [m.name for m in result.scenario.modes].index(it.mode)))


def seeds_of(evidence: Evidence) -> dict[str, Any]:
    """Write what several seeds say as plain values."""
    groups = dict.fromkeys(key[1:] for key in evidence.errors)
    return {
        "count": evidence.n_seeds,
        "leaders": {"/".join(key): list(evidence.leaders(*key)) for key in groups},
    }


def loop_rows(result: Result) -> list[Row]:
    """Close the loop on the record of a run with the controllers that take a moment; nothing where the truth is not known."""
    quick = [name for name, controller in CONTROLLERS.items() if controller.is_quick]
    try:
        closed = closed_loop(result.record, design(result.scenario, quick))
        return controller_rows(closed, result.scenario.run.seed, source=result.prior_source)
    except RecordError:
        return []


def _reasons(result: Result, observers: Sequence[str]) -> list[str]:
    """Why an observer gave nothing."""
    done = {item.observer for item in (*result.estimates, *result.failures)}
    waiting = [f"{row_label(name)} left out: not finished when the report was made" for name in observers if name not in done]
    return lines_of_failures(result) + waiting


def _frequencies(frequency: Array) -> dict[str, Floats]:
    """Return the frequencies [Hz] of the points kept of spectra, from the first above zero."""
    n, step = frequency.size, float(frequency[1])
    high = envelope_times(min(SPECTRUM, n), n, SPECTRUM_BINS, step)
    return {
        "frequency": np.concatenate([frequency[1:SPECTRUM], high]).astype(np.float32),
        "frequency-cumulative": frequency[_spread_indices(n)].astype(np.float32),
    }


def _spectra(frequency: Array, density: Array) -> tuple[Floats, Floats]:
    """Select the points kept of a density and of its cumulative rms."""
    thin = np.concatenate([density[1:SPECTRUM], envelope(density[SPECTRUM:], SPECTRUM_BINS)])
    return thin.astype(np.float32), cumulative_rms(frequency[1:], density[1:])[_spread_indices(density.size) - 1].astype(
        np.float32
    )


def _spread_indices(n: int) -> NDArray[np.int64]:
    """Choose indices from 1 to n - 1, evenly on a logarithmic axis."""
    return np.unique(np.round(np.geomspace(1, n - 1, CUMULATIVE)).astype(np.int64))


def window_of(states: Sequence[State]) -> tuple[float, float] | None:
    """(start, end) [s] of the stretch that keeps every sample in all states; None where all of the record does."""
    grids = [s.grid for s in states]
    if all(g.whole for g in grids):
        return None
    if any((a.n, a.dt) != (b.n, b.dt) for a, b in pairwise(grids)):
        return None
    return grids[0].first * grids[0].dt, (grids[0].last - 1) * grids[0].dt
