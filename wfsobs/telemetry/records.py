"""Reading and writing of records: files of any format, checked, in one form. See docs/data.md."""

from __future__ import annotations

import hashlib
import io
import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike

from wfsobs.files import write_whole
from wfsobs.identification.plant import Contradiction, contradiction
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import paper
from wfsobs.settings.values import check_kind
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.columns import LoopMatrix, join_clock, matrix_of, split_source, to_contents
from wfsobs.telemetry.formats import format_of, from_gzip, writer_of
from wfsobs.telemetry.formats.aot import TRANSLATED, translate
from wfsobs.telemetry.formats.contents import Contents, FileColumns
from wfsobs.telemetry.formats.csv import write
from wfsobs.telemetry.formats.npz import write as write_npz
from wfsobs.telemetry.intake import DeclaredFormat, stated_delay, stated_sign, to_record
from wfsobs.typing import Array
from wfsobs.units import UNITS, micrometres_per, parse_unit

MOST_BYTES = 4_000_000_000
"""Maximum bytes of numbers in a file."""


def save_record(path: str | Path, record: Record, scenario_toml: str | None = None) -> str:
    """Write a record in the format of the name's ending; return a line if that has no place for parts of it.

    Raises OSError, RecordError.
    """
    try:
        write = writer_of(str(path))
        write_whole(path, lambda file: write(file, record_arrays(record, scenario_toml)))
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from None
    return line_of_lost(path, [name for name in format_of(str(path)).omits if getattr(record, name) is not None])


def line_of_lost(path: str | Path, names: Sequence[str]) -> str:
    """Return the line that a file has no place for these parts of a record; empty without any."""
    return f"{path}: has no place for {', '.join(names)}" if names else ""


def save(path: str | Path, record: Record) -> None:
    """Write a record: .npz, .csv, .fits, .aot.fits, .h5, .mat or .parquet (docs/data.md).

    Parameters
    ----------
    path : str or Path
        The file, whose ending gives the format; one that is there is replaced once the new one is whole.
    record : Record
        Measurements and commands [um], and the truth where the format has a place for it.

    Warns
    -----
    UserWarning
        The format has no place for parts of the record, which are named.

    Raises
    ------
    OSError
        The file cannot be written.
    RecordError
        There is no such format, or it is only read.
    """
    check_kind("save", record, Record)
    if lost := save_record(path, record):
        warnings.warn(lost, stacklevel=2)


def name_differences(record: Record, other: Record) -> list[str]:
    """Return the parts of a record that another does not have, or has otherwise."""

    def differs(one: Any, two: Any) -> bool:
        if one is None or two is None or not hasattr(one, "__dict__"):
            return one is not two if one is None or two is None else not np.array_equal(one, two, equal_nan=True)
        return any(differs(part, vars(two)[name]) for name, part in vars(one).items())

    names = [one.name for one in fields(record) if one.name not in ("origin", "gate")]
    return [name for name in names if differs(getattr(record, name), getattr(other, name))]


def record_arrays(record: Record, scenario_toml: str | None = None) -> dict[str, Array]:
    """Return the contents of a record's file, by name."""
    names = [one.name for one in fields(record) if one.name not in ("training", "gate")]
    arrays = {name: np.asarray(value) for name in names if (value := getattr(record, name)) is not None}
    arrays |= {"unit": np.array("um"), "command_sign": np.array(1)}
    if not record.origin:
        del arrays["origin"]
    if record.training is not None:
        t = record.training
        arrays |= {"training_y": t.y_lgs, "training_u": t.u}
        if t.open_loop_y is not None:
            arrays["training_open_loop_y"] = t.open_loop_y
    if scenario_toml is not None:
        arrays["scenario"] = np.array(scenario_toml)
    return arrays


def save_arrays(path: str | Path, arrays: Mapping[str, Array]) -> None:
    """Write named arrays as a compressed `.npz`. Raises OSError."""
    write_whole(path, lambda file: write_npz(file, arrays))


def load_record(
    path: str | Path, scenario: Scenario | None = None, declaration: DeclaredFormat | None = None, sha256: str | None = None
) -> Record:
    """Read and check the record of a file. Raises RecordError with one line naming what, where and what is expected.

    sha256 : of the file, in hexadecimal digits; another file is refused
    """
    with open_record(path, sha256) as (file, name):
        return read_record(file, name, scenario, declaration)


@contextmanager
def open_record(path: str | Path, sha256: str | None = None) -> Iterator[tuple[IO[bytes], str]]:
    """Open a file, or a folder of arrays, whose SHA-256 is this one; yield it and the name whose ending gives the format.

    An observatory's dump is NAME:FOLDER,..., such as naomi:night,1 (docs/data.md). Raises RecordError, also where it cannot be
    read later.
    """
    dump, colon, rest = str(path).partition(":")
    try:
        if colon and dump.lower() in TRANSLATED and not Path(path).exists():
            yield translate(dump.lower(), rest.split(",")), f"{path}.aot.fits"
            return
        folder = Path(path).is_dir()
        with _open_folder(Path(path)) if folder else open(path, "rb") as file:
            if sha256 is not None:
                found = hashlib.file_digest(file, "sha256").hexdigest()
                if found != sha256.lower():
                    raise RecordError(f"{path}: is another file: its SHA-256 is {found}, not {sha256[:64]}")
                file.seek(0)
            yield file, f"{Path(path)}/.npz" if folder else str(path)
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror or error}") from None


def _open_folder(path: Path) -> io.BytesIO:
    """Return a folder of .npy files as the .npz of them. Raises RecordError where there are none, or too many bytes of them."""
    members = sorted(path.glob("*.npy"))
    if not members or sum(member.stat().st_size for member in members) > MOST_BYTES:
        raise RecordError(f"{path}: is a folder; it takes one of .npy files, of {MOST_BYTES / 1e9:g} GB at most")
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for member in members:
            archive.write(member, member.name)
    file.seek(0)
    return file


def load(
    path: str | Path,
    *,
    scenario: Scenario | None = None,
    unit: str | None = None,
    command_sign: int | None = None,
    command_delay: float | None = None,
    rate: float | None = None,
    trust: bool = False,
    columns: Mapping[str, str] | None = None,
    command_gain: float | Sequence[float] | None = None,
    rail: float | None = None,
    open_loop: bool = False,
    reconstructor: str | ArrayLike | None = None,
    command_modes: str | ArrayLike | None = None,
) -> Record:
    """Read the record of a file of any format, or of a folder of .npy files (docs/data.md).

    Parameters
    ----------
    path : str or Path
        The file; its ending gives the format.
    scenario : Scenario, optional
        Telescope and modes, where the file needs them; by default the defaults.
    unit : str, optional
        Unit of the signals where the file gives none, one of `wfsobs.units.UNITS`; um by default.
    command_sign : {1, -1}, optional
        +1 where y = disturbance + u, -1 where y = disturbance - u.
    command_delay : float, optional
        Steps from a command to the first measurement that sees it, also parts of one.
    rate : float, optional
        Rate of rows without time stamps [Hz].
    trust : bool
        Whether sign and delay of the commands hold though the file says others, or the data exclude them.
    columns : mapping, optional
        Which column or array of the file is what, such as {"y_lgs/tip": "slope_x"} or {"u": "commands"}.
    command_gain : float or sequence of float, optional
        What the mirror does of a command, for all modes or each.
    rail : float, optional
        Largest command that the mirror follows, in the unit of the commands.
    open_loop : bool
        Whether the mirror was at rest; commands are then not needed, and not used.
    reconstructor : str or array_like, optional
        Matrix from slopes to modes, (n_modes, n_slopes), where y_lgs holds slopes: "FILE", "FILE:NAME", or its numbers.
    command_modes : str or array_like, optional
        Matrix from modes to commands, (n_actuators, n_modes), where u holds commands of actuators: likewise.

    Returns
    -------
    Record
        Measurements and commands [um], and the truth where the file has it.

    Raises
    ------
    RecordError
        The file cannot be used; one line naming what, where and what is expected.
    """
    if unit is not None and parse_unit(str(unit)) is None:
        raise RecordError(f"unit = {unit!r}: takes one of {', '.join(UNITS)}")
    for name, value in (("rate", rate), ("rail", rail)):
        if value is not None and not value > 0:
            raise RecordError(f"{name} = {value:g}: takes a number above 0")
    unit = unit and parse_unit(unit)
    gain = None if command_gain is None else tuple(np.atleast_1d(command_gain).tolist())
    matrices = [read_loop_matrix(matrix) for matrix in (reconstructor, command_modes)]
    stated = DeclaredFormat(unit, command_sign, command_delay, rate, columns or {}, trust, gain, rail, open_loop, *matrices)
    return load_record(path, scenario, stated)


def read_loop_matrix(source: str | ArrayLike | None) -> LoopMatrix | None:
    """Return a matrix of a loop from "FILE" or "FILE:NAME" of any format, or from its numbers. Raises RecordError."""
    if source is None:
        return None
    if not isinstance(source, str):
        numbers = np.atleast_2d(np.asarray(source, dtype=float))
        if numbers.ndim != 2:
            raise RecordError(f"a matrix takes two dimensions, not {numbers.ndim}")
        return LoopMatrix("an array", tuple(map(tuple, numbers.tolist())))
    path, name = split_source(source)
    with open_record(path) as (file, where):
        try:
            return matrix_of(read_columns(file, where), source, name)
        except RecordError as error:
            raise RecordError(str(error) if str(error).startswith(source) else f"{source}: {error}") from None


def read_record(
    file: IO[bytes],
    name: str,
    scenario: Scenario | None = None,
    declaration: DeclaredFormat | None = None,
    most: int = MOST_BYTES,
) -> Record:
    """Read the record of an open file; its name gives the format and is never opened. most : maximum bytes of numbers."""
    return read_with_delay(file, name, scenario, declaration, most)[0]


def read_with_delay(
    file: IO[bytes],
    name: str,
    scenario: Scenario | None = None,
    declaration: DeclaredFormat | None = None,
    most: int = MOST_BYTES,
) -> tuple[Record, float]:
    """As `read_record`, and the delay of its commands with its fraction [steps], which those of the record have in them."""
    try:
        stated = declaration or DeclaredFormat()
        contents = read_contents(file, name, stated.columns, most)
        record = to_record(contents, scenario := scenario or Scenario(), stated)
        if why := contradiction_of(record, contents, stated, scenario):
            raise RecordError(f"{why.text}; --trust goes on")
        return record, stated_delay(contents, stated)
    except RecordError as error:
        raise RecordError(f"{name.removesuffix('/.npz')}: {error}") from None


def contradiction_of(record: Record, contents: Contents, declaration: DeclaredFormat, scenario: Scenario) -> Contradiction | None:
    """Return why the data exclude the plant or the unit with which a record was read; None where they do not, or are not to."""
    if declaration.trust:
        return None
    units = plausible_units(record, contents, declaration, scenario)
    if units and not PLAUSIBLE[0] / FAR < z_rms(record) < PLAUSIBLE[1] * FAR:
        plausible = " or ".join(units)
        return Contradiction(f"no unit is stated, and um is excluded by the size of z, plausible as {plausible}: state the unit")
    stated = stated_sign(contents, declaration), stated_delay(contents, declaration), declaration.command_gain or (1.0,)
    return contradiction(record, *stated)


PLAUSIBLE, FAR = (0.02, 5.0), 10.0
"""Rms of tip or tilt of turbulence and vibration on telescopes of 1 to 40 m, with a margin [um]; factor beyond which um, where no
unit is stated, is refused."""


def z_rms(record: Record) -> float:
    """Return the largest rms of a mode of z about its mean, which an offset of the commands is part of [um]."""
    known = (z[~np.isnan(z)] for z in record.z[record.delay :].T)
    return max(float(z.std()) if z.size else 0.0 for z in known)


def plausible_units(record: Record, contents: Contents, declaration: DeclaredFormat, scenario: Scenario) -> dict[str, float]:
    """Return the units under which the size of z is plausible, and its rms [um]; none where the unit is stated."""
    if declaration.unit or contents.units or "unit" in contents.arrays:
        return {}
    size = z_rms(record)
    units = {unit: size * micrometres_per(unit, scenario.telescope.diameter) for unit in UNITS}
    return {unit: x for unit, x in units.items() if PLAUSIBLE[0] <= x <= PLAUSIBLE[1]}


def read_contents(file: IO[bytes], name: str, roles: Mapping[str, str], most: int = MOST_BYTES) -> Contents:
    """Read the named arrays of an open file, those of its columns that have these roles among them. Raises RecordError."""
    return to_contents(read_columns(file, name, most), roles)


def read_columns(file: IO[bytes], name: str, most: int = MOST_BYTES) -> FileColumns:
    """Read the columns of an open file under its own names; its name gives the format, before .gz as well. Raises RecordError."""
    inner = re.sub(r"\.gz$", "", name, flags=re.I)
    return join_clock(format_of(inner).read(file if inner == name else from_gzip(file, most), most))


TEMPLATE = """\
# One row per step of the fast loop, one column per signal and mode. Lines that start with # may hold numbers and texts:
# ratio: 5
# command_sign: 1
# delay: 2
# y_lgs is the measurement, u the command that follows from the measurement of its row, y_ngs a slow sensor: cells are empty
# between its frames, and the columns may be left out. The command sign is 1 where measurement = disturbance + command, and -1
# where the command is taken off; the delay is that from a command to the first measurement that sees it, in rows; the ratio is
# that of rows to frames. Units at the end of names are um, nm, m, mas, arcsec, rad. An empty cell is a missing sample.
time_s,y_lgs/tip_nm,y_lgs/tilt_nm,u/tip_nm,u/tilt_nm,y_ngs/tip_nm,y_ngs/tilt_nm
0.000,12.1,-3.0,-3.6,0.9,,
0.001,,,-3.6,0.9,,
0.002,10.4,-2.2,-6.8,1.6,,
0.003,9.1,-1.7,-9.5,2.1,,
0.004,7.7,-0.9,-11.8,2.4,,
0.005,5.2,-0.4,-13.4,2.5,8.9,-1.6
"""

SAMPLE_S = 5.0
"""Length of the sample [s]."""


def sample_csv(watch: Watch = QUIET) -> bytes:
    """Return a sample record as CSV: SAMPLE_S of the preset paper in closed loop, with its truth. Raises Cancelled."""
    record = simulate(paper().replace({"run.duration": SAMPLE_S}), watch=watch)
    file = io.BytesIO()
    write(file, record_arrays(replace(record, open_loop_y=None, training=None)))
    return file.getvalue()
