"""Errors over one or two settings, each point with several seeds, and the observer that is best in each.

Points are those of a grid, a sample of ranges, or a table of conditions.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product as cartesian
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import scipy

from wfsobs.cost import run_seconds
from wfsobs.evaluation.evidence import FEWEST, Evidence, Key, gather_evidence
from wfsobs.evaluation.scores import BOUNDS, Score
from wfsobs.evaluation.verdict import Verdict, contenders
from wfsobs.notebook import PlotAccessor, import_extra
from wfsobs.observers import OBSERVERS
from wfsobs.pipeline import observe
from wfsobs.priors_from.scenario import common_observers
from wfsobs.progress import QUIET, Watch
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import Variation, format_value, parse_variation
from wfsobs.scenario.scenario import idle_settings, why_idle_at
from wfsobs.settings.values import SettingError, leaves
from wfsobs.simulation.loop import simulate

Changes = Mapping[str, Any]
"""Dotted path -> value."""

METHODS = ("sobol", "latin-hypercube")
MAX_POINTS = 1_000_000
"""Maximum number of scenarios."""


def product(axes: Sequence[Sequence[Changes]]) -> Iterable[Changes]:
    """Yield every combination of the points of several axes, the last one changing fastest.

    >>> list(product([[{"a": 1}, {"a": 2}], [{"b": 3}]]))
    [{'a': 1, 'b': 3}, {'a': 2, 'b': 3}]
    """
    if math.prod(map(len, axes)) > MAX_POINTS:
        raise SettingError(f"{math.prod(map(len, axes))} scenarios, at most {MAX_POINTS} are allowed")
    for points in cartesian(*axes):
        merged: dict[str, Any] = {}
        for point in points:
            twice = merged.keys() & point.keys()
            if twice:
                raise SettingError(f"{min(twice)}: set by two of grid, sample and conditions")
            merged |= point
        yield merged


def grid(values: Mapping[str, Any]) -> list[Changes]:
    """Return all combinations of lists of values.

    >>> grid({"turbulence.wind_speed": [5, 10], "run.duration": [2]})
    [{'turbulence.wind_speed': 5, 'run.duration': 2}, {'turbulence.wind_speed': 10, 'run.duration': 2}]
    """
    for path, of in values.items():
        if not isinstance(of, list) or not of:
            raise SettingError(f"grid.{path} = {of!r}: takes a list of values")
    return list(product([[{path: value} for value in of] for path, of in values.items()]))


def check_keys(table: Mapping[str, Any], where: str, *names: str) -> None:
    """Raise SettingError for a key of a table of a plan that is not known."""
    for key in table:
        if key not in names:
            raise SettingError(f"{where}.{key}: takes {', '.join(names)}")


def sample(table: Mapping[str, Any]) -> list[Changes]:
    """Return the points of a Sobol sequence or a Latin hypercube in ranges of settings.

    Parameters
    ----------
    table : mapping
        "method" (sobol or latin-hypercube), "points", "seed", "between" ({setting: [low, high]}), "log" (settings whose
        logarithm is sampled evenly).

    Returns
    -------
    list of mapping
        Dotted path -> value; a single empty point for an empty table.

    Raises
    ------
    SettingError
        A value cannot be used.
    """
    if not table:
        return [{}]
    check_keys(table, "sample", "method", "points", "seed", "between", "log")
    method, points, seed = table.get("method", "sobol"), table.get("points", 16), table.get("seed", 1)
    between, log = table.get("between"), table.get("log", [])
    ranges = dict(leaves(between)) if isinstance(between, dict) else {}
    if method not in METHODS:
        raise SettingError(f"sample.method = {method!r}: takes one of {', '.join(METHODS)}")
    if not isinstance(points, int) or not 1 <= points <= MAX_POINTS:
        raise SettingError(f"sample.points = {points!r}: takes a whole number from 1 to {MAX_POINTS}")
    if not isinstance(seed, int) or seed < 0:
        raise SettingError(f"sample.seed = {seed!r}: takes a whole number from 0")
    if not ranges:
        raise SettingError("sample.between: takes {setting: [low, high]}")
    if not isinstance(log, list) or not all(path in list(ranges) for path in log):
        raise SettingError(f"sample.log = {log!r}: takes a list of settings of sample.between")
    limits = [_limits(path, of, path in log) for path, of in ranges.items()]
    return [
        {
            path: low * (high / low) ** u if path in log else low + (high - low) * u
            for path, (low, high), u in zip(ranges, limits, row, strict=True)
        }
        for row in _unit_points(method, points, len(ranges), seed)
    ]


def _limits(path: str, of: Any, log: bool) -> tuple[float, float]:
    if not isinstance(of, list) or len(of) != 2 or not all(isinstance(v, (int, float)) for v in of) or not of[0] < of[1]:
        raise SettingError(f"sample.between.{path} = {of!r}: takes [low, high], numbers")
    if log and not of[0] > 0:
        raise SettingError(f"sample.between.{path} = {of!r}: takes numbers above 0, for sample.log")
    return float(of[0]), float(of[1])


def _unit_points(method: str, points: int, dimensions: int, seed: int) -> list[list[float]]:
    """Return points of the unit cube."""
    if method == "sobol":  # the first points of a power of two, for which the sequence is balanced
        power = max(0, math.ceil(math.log2(points)))
        return scipy.stats.qmc.Sobol(dimensions, rng=seed).random_base2(power)[:points].tolist()
    return scipy.stats.qmc.LatinHypercube(dimensions, rng=seed).random(points).tolist()


def conditions(table: Mapping[str, Any], folder: Path) -> list[Changes]:
    """Return one point per row of a CSV table of conditions.

    Parameters
    ----------
    table : mapping
        "file", and "columns": {column: setting} or {column: {setting, factor}}.
    folder : Path
        Where the file is looked for.

    Returns
    -------
    list of mapping
        Dotted path -> number; a single empty point for an empty table. Rows without a number in a column are left out.

    Raises
    ------
    SettingError
        The file cannot be read, or has no such column.
    """
    if not table:
        return [{}]
    check_keys(table, "conditions", "file", "columns")
    columns = table.get("columns")
    if not isinstance(columns, dict) or not columns:
        raise SettingError('conditions.columns: takes {column = "setting"} or {column = {setting = "...", factor = 1.0}}')
    path = folder / str(table.get("file", ""))
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = csv.DictReader(line for line in file if not line.startswith("#"))
            rows, names = list(lines), lines.fieldnames or []
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SettingError(f"conditions.file = {path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    for column in columns:
        if column not in names:
            raise SettingError(f"conditions.columns.{column}: {path} has the columns {', '.join(names)}")
    points = [p for p in (_point(row, columns) for row in rows) if p is not None]
    if not points:
        raise SettingError(f"conditions.file = {path}: no row has a number in each of {', '.join(columns)}")
    return points


def _point(row: Mapping[str, str], columns: Mapping[str, Any]) -> Changes | None:
    """Return the settings of a row, None where a number is missing."""
    out: dict[str, Any] = {}
    for column, of in columns.items():
        fields = of if isinstance(of, dict) else {"setting": of}
        setting, factor = fields.get("setting"), fields.get("factor", 1.0)
        if not isinstance(setting, str) or not isinstance(factor, (int, float)):
            raise SettingError(f'conditions.columns.{column}: takes "setting" or {{setting = "...", factor = 1.0}}')
        try:
            out[setting] = float(row[column]) * factor
        except (TypeError, ValueError):
            return None
        if not math.isfinite(out[setting]):
            return None
    return out


if TYPE_CHECKING:
    import pandas
    import xarray

MOST_CELLS = 400
"""Maximum number of scenarios."""

MOST_VALUES = 50
"""Maximum number of values of a setting."""

MOST_SEEDS = 100
EACH_RUN, EACH_FLOW, EACH_STEP = 0.4, 2.2, 1e-5
"""Time of a run beside `run_seconds` [s]: whatever its length (designs of the observers, scores, bounds); for frozen flow beside;
for every step and mode (all quick observers). Measured as processor time: `paper` of 2, 10 and 60 s, `ut4` of 2 and 10 s."""

SEED, LOOP_ONLY = "run.seed", ("control.", "plant.")
RANGE = re.compile(r"([^:,]+):([^:,]+):([^:,]+?)(:log)?")


def parse_axis(text: str) -> Variation:
    """Return a setting and its values.

    Parameters
    ----------
    text : str
        "a.b=low:high:number", evenly spaced, with ":log" at the end on a logarithmic scale; or "a.b=v1,v2,v3" as
        `wfsobs export --vary` takes them.

    Returns
    -------
    Variation
        Setting and values.

    Raises
    ------
    SettingError
        The text has another form.

    Examples
    --------
    >>> parse_axis("turbulence.wind_speed=5:20:4").values
    (5, 10, 15, 20)
    >>> parse_axis("kalman.frequency=1:100:3:log").values
    (1, 10, 100)
    >>> parse_axis("sensors.exposure_ratio=2,5,10").values
    (2, 5, 10)
    """
    path, _, listed = (part.strip() for part in text.partition("="))
    if not (found := RANGE.fullmatch(listed)):
        return parse_variation(text, "--over")
    try:
        low, high, count = float(found[1]), float(found[2]), int(found[3])
    except ValueError:
        low, high, count = 0.0, 0.0, 0
    if not (isfinite(low) and isfinite(high) and 2 <= count <= MOST_VALUES):
        takes = f"low:high:number with a number from 2 to {MOST_VALUES}, such as 5:20:4, or values with commas"
        raise SettingError(f"--over {text}: takes {takes}")
    if not low < high or (found[4] and low <= 0):
        raise SettingError(f"--over {text}: the first number must be below the second{' and above 0' if found[4] else ''}")
    values = np.geomspace(low, high, count) if found[4] else np.linspace(low, high, count)
    return Variation(path, tuple(_round_off(v) for v in values.tolist()))


def _round_off(value: float) -> float | int:
    """Return a number without the last digits, a whole one as such."""
    value = float(f"{value:.6g}")
    return int(value) if value.is_integer() else value


@dataclass(frozen=True)
class Sweep:
    """What a sweep runs; made by `plan_sweep`.

    Attributes
    ----------
    base : Scenario
        All other settings; its seed is the first one.
    axes : tuple of Variation
        One or two settings and their values.
    seeds : int
        Number of seeds of each scenario, the same ones in all.
    observers : tuple of str
        Ids.
    """

    base: Scenario
    axes: tuple[Variation, ...]
    seeds: int
    observers: tuple[str, ...]

    @cached_property
    def cells(self) -> list[Changes]:
        """Changes of each scenario, dotted path -> value; the last setting changes fastest."""
        return grid({axis.path: list(axis.values) for axis in self.axes})

    @property
    def n_runs(self) -> int:
        """Number of runs."""
        return len(self.cells) * self.seeds

    def scenario(self, cell: int, number: int = 0) -> Scenario:
        """Return the scenario of a cell with one of the seeds, from 0. Raises SettingError."""
        made = self.base.replace({**self.cells[cell], SEED: self.base.run.seed + number})
        made.validate()
        return made

    def value(self, cell: int, path: str) -> Any:
        """Return the value of a setting in a cell."""
        return self.cells[cell][path] if path in self.cells[cell] else self.base.lookup(path)

    def has_base(self, scenario: Scenario) -> bool:
        """Return whether all settings that the sweep does not change are those of a scenario."""
        try:
            return scenario.replace({axis.path: self.value(0, axis.path) for axis in self.axes}) == self.scenario(0)
        except SettingError:
            return False

    @cached_property
    def edge(self) -> list[int]:
        """Cells in which every value of every setting occurs: all others are checked when they run."""
        last = len(self.axes[-1].values)
        return sorted({*range(last), *range(0, len(self.cells), last)})

    @cached_property
    def seconds(self) -> float:
        """Estimated time of all runs [s], from the mean of `edge`."""
        return self.n_runs * float(np.mean([self._seconds_of(self.scenario(cell)) for cell in self.edge]))

    def _seconds_of(self, scenario: Scenario) -> float:
        flow = EACH_FLOW if scenario.turbulence.source == "frozen-flow" else 0.0
        steps = EACH_STEP * scenario.n_steps * len(scenario.modes)
        return EACH_RUN + flow + steps + run_seconds(scenario, self.observers)


def plan_sweep(base: Scenario, axes: Sequence[Variation], seeds: int, observers: Sequence[str] | None = None) -> Sweep:
    """Return the sweep over one or two settings.

    Parameters
    ----------
    base : Scenario
        All other settings.
    axes : sequence of Variation
        Settings and their values, of `parse_axis`.
    seeds : int
        Number of seeds of each scenario: base.run.seed, base.run.seed + 1, ...
    observers : sequence of str, optional
        Ids; by default all that every scenario has something for.

    Returns
    -------
    Sweep
        What is to be run.

    Raises
    ------
    SettingError
        A setting refuses one of its values, or there are too many.
    """
    if not 1 <= len(axes) <= 2:
        raise SettingError(f"--over: takes one or two settings, not {len(axes)}")
    if len(axes) == 2 and axes[0].path == axes[1].path:
        raise SettingError(f"--over {axes[0].path}: is given twice")
    for axis in axes:
        if axis.path == SEED:
            raise SettingError(f"--over {SEED}: every scenario has the same seeds; give their number")
        if not 2 <= len(axis.values) <= MOST_VALUES:
            raise SettingError(
                f"--over {axis.path}: {len(axis.values)} values; takes 2 to {MOST_VALUES}, as low:high:number or with commas"
            )
    OBSERVERS.check_ids(observers or ())
    if not 1 <= seeds <= MOST_SEEDS:
        raise SettingError(f"seeds = {seeds}: takes a whole number from 1 to {MOST_SEEDS}")
    chosen = tuple(name for name in OBSERVERS if observers is None or name in observers)
    sweep = Sweep(base, tuple(axes), seeds, chosen)
    if len(sweep.cells) > MOST_CELLS:
        counts = " x ".join(str(len(axis.values)) for axis in axes)
        raise SettingError(f"--over: {counts} = {len(sweep.cells)} scenarios, at most {MOST_CELLS} are allowed")
    scenarios = [sweep.scenario(cell) for cell in sweep.edge]
    _check_effect(axes, scenarios)
    return sweep if observers is not None else replace(sweep, observers=common_observers(scenarios))


def _check_effect(axes: Sequence[Variation], scenarios: Sequence[Scenario]) -> None:
    """Raise SettingError for a setting that changes no error in any of the scenarios."""
    idle = [idle_settings(scenario) for scenario in scenarios]
    for axis in axes:
        if axis.path.startswith(LOOP_ONLY):
            raise SettingError(f"--over {axis.path}: changes no error of an observer; only the closed loop uses it")
        reasons = [why_idle_at(axis.path, known) for known in idle]
        if all(reasons):
            raise SettingError(f"--over {axis.path}: changes no error here; {reasons[0][0].lower()}{reasons[0][1:]}")


def run_cell(sweep: Sweep, cell: int, number: int, watch: Watch = QUIET) -> tuple[Score, ...]:
    """Run a scenario with one of the seeds, and return the scores; with the first also the bounds, which no seed changes.

    Raises SettingError, Cancelled.
    """
    scenario = sweep.scenario(cell, number)
    record = simulate(scenario, watch=watch)
    return observe(record, scenario, observers=sweep.observers, watch=watch, is_simulated=number == 0, gate=False).scores


@dataclass(frozen=True)
class Winner:
    """The best observer in a scenario, for a target and mode.

    Attributes
    ----------
    name : str
        Observer with the smallest mean error over the seeds.
    rms : float
        That mean [um].
    margin : float or None
        Mean error of the second over that of the best, less 1; None where there is no second.
    ties : tuple of str
        Observers whose errors do not differ significantly from those of the best.
    seeds : int
        Number of seeds.
    """

    name: str
    rms: float
    margin: float | None
    ties: tuple[str, ...]
    seeds: int

    @property
    def is_significant(self) -> bool:
        """Whether all others are significantly worse; never with fewer than FEWEST seeds."""
        return self.seeds >= FEWEST and not self.ties


NO_EVIDENCE = gather_evidence(())
"""That of a scenario without a run."""


@dataclass(frozen=True)
class SweepResults:
    """What is known of a sweep so far.

    Attributes
    ----------
    sweep : Sweep
        What is run.
    scores : mapping
        Cell -> scores of its seeds in order.
    evidence : mapping
        Cell -> errors over its seeds.
    failures : mapping
        Cell -> why it cannot be run.
    """

    sweep: Sweep
    scores: Mapping[int, tuple[tuple[Score, ...], ...]] = field(default_factory=dict)
    evidence: Mapping[int, Evidence] = field(default_factory=dict)
    failures: Mapping[int, str] = field(default_factory=dict)
    plot: ClassVar[PlotAccessor] = PlotAccessor()

    def add(self, cell: int, scores: Sequence[Score]) -> SweepResults:
        """Return the results with those of one more seed of a cell."""
        seeds = (*self.scores.get(cell, ()), tuple(scores))
        return replace(self, scores={**self.scores, cell: seeds}, evidence={**self.evidence, cell: gather_evidence(seeds)})

    def add_failure(self, cell: int, reason: str) -> SweepResults:
        """Return the results with the reason why a cell cannot be run."""
        return replace(self, failures={**self.failures, cell: reason})

    def seeds(self, cell: int) -> int:
        """Return the number of seeds of a cell that have been run."""
        return len(self.scores.get(cell, ()))

    @property
    def n_done(self) -> int:
        """Number of runs that are done or cannot be done."""
        return sum(self.sweep.seeds if cell in self.failures else self.seeds(cell) for cell in range(len(self.sweep.cells)))

    def next_run(self) -> tuple[int, int] | None:
        """Return (cell, number of the seed) of the next run: every cell has its first seed before any has its second."""
        left = [cell for cell in range(len(self.sweep.cells)) if cell not in self.failures]
        cell = min(left, key=self.seeds, default=None)
        return None if cell is None or self.seeds(cell) >= self.sweep.seeds else (cell, self.seeds(cell))

    def winner(self, cell: int, target: str, mode: str) -> Winner | None:
        """Return the best observer of a cell; None where nothing is known."""
        evidence = self.evidence.get(cell, NO_EVIDENCE)
        ranked = evidence.ranking(target, mode)
        if not ranked:
            return None
        errors = [evidence.mean((name, target, mode)) or 0.0 for name in ranked[:2]]
        margin = max(errors[1] / errors[0] - 1.0, 0.0) if len(errors) > 1 and errors[0] > 0 else None
        return Winner(ranked[0], errors[0], margin, evidence.leaders(target, mode)[1:], evidence.n_seeds)

    def verdict(self, cell: int, target: str, mode: str) -> Verdict | None:
        """Return the verdict on a cell, without what does harm; None where nothing is known."""
        evidence = self.evidence.get(cell, NO_EVIDENCE)
        if not evidence.ranking(target, mode):
            return None
        places = contenders(self.sweep.scenario(cell), evidence, self.scores[cell][0], target, mode)
        return Verdict(target, mode, places, 0, (), evidence.n_seeds)

    def error(self, cell: int, key: Key) -> tuple[float, float, float] | None:
        """Return the mean error of an observer over the seeds of a cell, and the interval of that mean [um].

        Without an interval, the ends are the mean; a bound has none. None where the error is not known.
        """
        evidence = self.evidence.get(cell, NO_EVIDENCE)
        mean = evidence.mean(key)
        if key[0] in BOUNDS:
            known = [s.rms for scores in self.scores.get(cell, ()) for s in scores if (s.observer, s.target, s.mode) == key]
            mean = float(np.mean(known)) if known else None
        return None if mean is None else (mean, *(evidence.interval(key) or (mean, mean)))

    def known_keys(self) -> list[Key]:
        """Return (observer, target, mode) of all that is known in some cell, in the order of the scores."""
        return list(dict.fromkeys((s.observer, s.target, s.mode) for seeds in self.scores.values() for s in seeds[0]))

    def to_xarray(self) -> xarray.Dataset:
        """Return mean errors `rms` and the ends `low` and `high` of their intervals [um], as `error` does, as labelled arrays.

        Dimensions are settings (lists as text), observer, target and mode; NaN is not known. Raises ImportError without xarray.
        """
        known = self.known_keys()
        labels = [list(dict.fromkeys(key[i] for key in known)) for i in range(3)]
        dims = {
            axis.path: [format_value(value) if isinstance(value, (dict, list)) else value for value in axis.values]
            for axis in self.sweep.axes
        } | dict(zip(("observer", "target", "mode"), labels, strict=True))
        values = np.full((len(self.sweep.cells), *map(len, labels), 3), np.nan)
        for cell in range(len(self.sweep.cells)):
            for key in known:
                if (error := self.error(cell, key)) is not None:
                    values[(cell, *(of.index(name) for of, name in zip(labels, key, strict=True)))] = error
        shaped = values.reshape(*map(len, dims.values()), 3)
        ends = {name: (tuple(dims), shaped[..., i], {"units": "um"}) for i, name in enumerate(("rms", "low", "high"))}
        units = {name: {"units": unit} for name in dims if (unit := self.sweep.base.unit(name))}
        return import_extra("xarray", "arrays").Dataset(ends, {name: (name, of, units.get(name)) for name, of in dims.items()})

    def to_dataframe(self) -> pandas.DataFrame:
        """Return `rows` as a pandas table. Raises ImportError without pandas."""
        return import_extra("pandas", "arrays").DataFrame(self.rows())

    def rows(self) -> list[dict[str, Any]]:
        """Return one plain dictionary per cell, target, mode and observer, errors in [nm]."""
        out = []
        for cell, changes in enumerate(self.sweep.cells):
            for key in self.known_keys():
                error, best = self.error(cell, key), self.winner(cell, *key[1:])
                if error is None:
                    continue
                few = self.seeds(cell) < FEWEST or key[0] in BOUNDS
                first = best is not None and key[0] == best.name
                out.append(
                    {
                        **changes,
                        "target": key[1],
                        "mode": key[2],
                        "observer": key[0],
                        "seeds": self.seeds(cell),
                        "mean_rms_nm": 1e3 * error[0],
                        "low_nm": None if few else 1e3 * error[1],
                        "high_nm": None if few else 1e3 * error[2],
                        "rank": "best" if first else "tied" if best and key[0] in best.ties else "",
                        "margin": best.margin if best and first else None,
                    }
                )
        return out


def run_sweep(sweep: Sweep, watch: Watch = QUIET) -> SweepResults:
    """Run all cells of a sweep with all seeds.

    Parameters
    ----------
    sweep : Sweep
        What is to be run.
    watch : Watch, optional
        Receives the progress, and is asked at every block of work whether to stop.

    Returns
    -------
    SweepResults
        Errors of every cell.

    Raises
    ------
    Cancelled
        `watch` asks to stop.
    """
    results = SweepResults(sweep)
    while (following := results.next_run()) is not None:
        inner = watch.part(results.n_done / sweep.n_runs, 1.0 / sweep.n_runs)
        try:
            results = results.add(following[0], run_cell(sweep, *following, inner))
        except SettingError as error:
            results = results.add_failure(following[0], str(error))
    return results
