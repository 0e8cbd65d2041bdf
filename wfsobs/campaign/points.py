"""The points of a campaign: grids, samples of ranges, and tables of conditions."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import product as cartesian
from pathlib import Path
from typing import Any

from wfsobs.settings.errors import SettingError
from wfsobs.settings.tree import leaves

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
    for key in table:
        if key not in ("method", "points", "seed", "between", "log"):
            raise SettingError(f"sample.{key}: takes method, points, seed, between, log")
    method, points, seed = table.get("method", "sobol"), table.get("points", 16), table.get("seed", 1)
    ranges, log = dict(leaves(table.get("between", {}))), table.get("log", [])
    if method not in METHODS:
        raise SettingError(f"sample.method = {method!r}: takes one of {', '.join(METHODS)}")
    if not isinstance(points, int) or not 1 <= points <= MAX_POINTS:
        raise SettingError(f"sample.points = {points!r}: takes a whole number from 1 to {MAX_POINTS}")
    if not isinstance(seed, int) or seed < 0:
        raise SettingError(f"sample.seed = {seed!r}: takes a whole number from 0")
    if not ranges:
        raise SettingError("sample.between: takes {setting: [low, high]}")
    if not isinstance(log, list) or not set(log) <= set(ranges):
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
    from scipy.stats import qmc  # takes as long to import as all else

    if method == "sobol":  # the first points of a power of two, for which the sequence is balanced
        power = max(0, math.ceil(math.log2(points)))
        return qmc.Sobol(dimensions, rng=seed).random_base2(power)[:points].tolist()
    return qmc.LatinHypercube(dimensions, rng=seed).random(points).tolist()


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
    for key in table:
        if key not in ("file", "columns"):
            raise SettingError(f"conditions.{key}: takes file, columns")
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
        setting, factor = (of, 1.0) if isinstance(of, str) else (of.get("setting"), of.get("factor", 1.0))
        if not isinstance(setting, str) or not isinstance(factor, (int, float)):
            raise SettingError(f'conditions.columns.{column}: takes "setting" or {{setting = "...", factor = 1.0}}')
        try:
            out[setting] = float(row[column]) * factor
        except (TypeError, ValueError):
            return None
        if not math.isfinite(out[setting]):
            return None
    return out
