"""From slopes to modes and from actuators to modes, by the matrices of a loop."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wfsobs.record import RecordError
from wfsobs.telemetry.formats.aot import TRANSLATED
from wfsobs.telemetry.formats.contents import MEAN_SLOPES, FileColumns, mean_slopes
from wfsobs.typing import Array
from wfsobs.units import split_unit

WORST = 1e4
"""Condition beyond which modes are not told from each other."""


@dataclass(frozen=True)
class LoopMatrix:
    """A matrix of a loop.

    Attributes
    ----------
    source : str
        Where it comes from, FILE or FILE:NAME.
    values : tuple of tuple of float
        Its rows.
    keeps_unit : bool
        Whether modes have the unit of slopes, as their means have.
    """

    source: str
    values: tuple[tuple[float, ...], ...]
    keeps_unit: bool = False

    def with_columns(self, n: int, what: str) -> Array:
        """Return it with n columns, transposed where that fits. Raises RecordError."""
        matrix = np.array(self.values, dtype=float)
        if matrix.shape[1] != n:
            matrix = matrix.T
        if matrix.shape[1] != n or not np.isfinite(matrix).all():
            shape = " x ".join(map(str, np.shape(self.values)))
            raise RecordError(f"{self.source}: a matrix of {shape}; it takes one of finite numbers for {n} {what}")
        return matrix


def split_source(text: str) -> tuple[str, str]:
    """Return the file and the name of the array in it, empty where there is none.

    >>> split_source("night.fits:RECON"), split_source("matrix.npy")
    (('night.fits', 'RECON'), ('matrix.npy', ''))
    """
    path, colon, name = text.rpartition(":")
    is_whole = Path(text).is_file() or path.lower() in TRANSLATED
    return (path, name) if colon and not is_whole else (text, "")


def matrix_of(file: FileColumns, source: str, name: str = "") -> LoopMatrix:
    """Return a matrix of a file. Raises RecordError where there is none of that name, or several without one.

    file : with the matrices of a loop; or an array of two dimensions as columns name[0], name[1], ...; or the positions x and y
        of subapertures: tip and tilt are then the mean slopes of the axes, their least-squares fit whatever the positions are
    """
    if file.matrices:
        name = name or next(iter(file.matrices))
        if name not in file.matrices:
            raise RecordError(f"{source}: has no matrix {name!r}; it has {', '.join(file.matrices)}")
        of = f"{source.removesuffix(f':{name}')}:{name}"
        return LoopMatrix(of, tuple(map(tuple, file.matrices[name].tolist())), name == MEAN_SLOPES)
    axes = {re.split("[^a-z]", split_unit(key)[0].lower())[-1]: values.size for key, values in file.columns.items()}
    if axes.keys() == {"x", "y"} and len(file.columns) == 2:
        return LoopMatrix(source, tuple(map(tuple, mean_slopes(axes["x"]).tolist())), keeps_unit=True)
    found: dict[str, list[Array]] = {}
    for key, values in file.columns.items():
        found.setdefault(key.partition("[")[0], []).append(values)
    if not name and (len(found) > 1 and all(len(columns) == 1 for columns in found.values())):  # a table without names
        found = {"": [column for columns in found.values() for column in columns]}
    name = name or (next(iter(found)) if len(found) == 1 else "")
    if name not in found:
        raise RecordError(f"{source}: has no matrix {name!r}; it has {', '.join(sorted(found)[:20])}: give FILE:NAME")
    if len({column.size for column in found[name]}) > 1:
        raise RecordError(f"{source}: {name} has rows of unlike lengths")
    return LoopMatrix(source, tuple(map(tuple, np.array(found[name]).tolist())))


def apply_matrices(signals: dict[str, Array], reconstructor: LoopMatrix | None, command_modes: LoopMatrix | None) -> list[str]:
    """Turn slopes and commands of actuators into modes; return in a few words what was done.

    Modes are R s of slopes s, R (n_modes, n_slopes), and the least-squares solution a = M^+ c of commands c = M a of actuators,
    M (n_actuators, n_modes). A frame of which a slope is missing is missing; NGS and training data are left. Raises RecordError.
    """
    said = []
    for matrix, name, what in ((reconstructor, "y_lgs", "slopes"), (command_modes, "u", "commands")):
        if matrix is not None and name in signals:
            n = signals[name].shape[1]
            rows = matrix.with_columns(n, what)
            if name == "u":
                rows = np.linalg.pinv(rows.T)
            mean = ", the mean of each axis" * matrix.keeps_unit
            said.append(
                f"{len(rows)} modes of {n} {what} by {matrix.source}{mean}, condition {_condition(rows, matrix.source):.3g}"
            )
            signals[name] = signals[name] @ rows.T
    return said


def _condition(rows: Array, source: str) -> float:
    sizes = np.linalg.svd(rows, compute_uv=False)
    condition = float(sizes[0] / sizes[-1]) if sizes[-1] > 0.0 else np.inf
    if len(rows) > rows.shape[1] or condition > WORST:
        raise RecordError(f"{source}: does not tell {len(rows)} modes apart, its condition is {condition:.3g}")
    return condition
