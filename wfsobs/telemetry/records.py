"""Reading and writing of records: files of any format, checked, in one form. See docs/data.md."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO

import numpy as np

from wfsobs.files import write_whole
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.telemetry.columns import to_contents
from wfsobs.telemetry.contradiction import contradiction
from wfsobs.telemetry.formats import format_of
from wfsobs.telemetry.formats.contents import Contents, FileColumns
from wfsobs.telemetry.formats.npz import write as write_npz
from wfsobs.telemetry.intake import DeclaredFormat, to_record
from wfsobs.typing import Array

MOST_BYTES = 4_000_000_000
"""Maximum bytes of numbers in a file."""


def save_record(path: str | Path, record: Record, scenario_toml: str | None = None) -> None:
    """Write a record in the format of the name's ending. Raises OSError, RecordError."""
    try:
        fmt = format_of(str(path))
        write_whole(path, lambda file: fmt.write(file, record_arrays(record, scenario_toml)))
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from None


def record_arrays(record: Record, scenario_toml: str | None = None) -> dict[str, Array]:
    """Return the contents of a record's file, by name."""
    arrays = {name: np.asarray(value) for name, value in vars(record).items() if name != "training" and value is not None}
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
    try:
        with open(path, "rb") as file:
            if sha256 is not None:
                found = hashlib.file_digest(file, "sha256").hexdigest()
                if found != sha256.lower():
                    raise RecordError(f"{path}: is another file: its SHA-256 is {found}, not {sha256[:64]}")
                file.seek(0)
            return read_record(file, str(path), scenario, declaration)
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror or error}") from None


def load(
    path: str | Path,
    *,
    scenario: Scenario | None = None,
    unit: str | None = None,
    command_sign: int | None = None,
    command_delay: int | None = None,
    rate: float | None = None,
    trust: bool = False,
) -> Record:
    """Read the record of a file: .npz, .csv, .fits or AOT (docs/data.md).

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
    command_delay : int, optional
        Steps from a command to the first measurement that sees it.
    rate : float, optional
        Rate of rows without time stamps [Hz].
    trust : bool
        Whether sign and delay of the commands hold though the data exclude them.

    Returns
    -------
    Record
        Measurements and commands [um], and the truth where the file has it.

    Raises
    ------
    RecordError
        The file cannot be used; one line naming what, where and what is expected.
    """
    return load_record(path, scenario, DeclaredFormat(unit, command_sign, command_delay, rate, trust=trust))


def read_record(
    file: IO[bytes],
    name: str,
    scenario: Scenario | None = None,
    declaration: DeclaredFormat | None = None,
    most: int = MOST_BYTES,
) -> Record:
    """Read the record of an open file; its name gives the format and is never opened. most : maximum bytes of numbers."""
    try:
        stated = declaration or DeclaredFormat()
        contents = read_contents(file, name, stated.columns, most)
        record = to_record(contents, scenario or Scenario(), stated)
        if why := contradiction_of(record, contents, stated):
            raise RecordError(f"{why}; --trust goes on")
        return record
    except RecordError as error:
        raise RecordError(f"{name}: {error}") from None


def stated_sign(contents: Contents, declaration: DeclaredFormat) -> int:
    """Return the sign of the commands as the file or the user states it, 1 where neither does."""
    return int(contents.arrays.get("command_sign", declaration.command_sign or 1))


def contradiction_of(record: Record, contents: Contents, declaration: DeclaredFormat) -> str:
    """Return why the data exclude the sign or the delay with which a record was read; empty where they do not, or are not to."""
    return "" if declaration.trust else contradiction(record, stated_sign(contents, declaration))


def read_contents(file: IO[bytes], name: str, roles: Mapping[str, str], most: int = MOST_BYTES) -> Contents:
    """Read the named arrays of an open file, those of its columns that have these roles among them. Raises RecordError."""
    return to_contents(read_columns(file, name, most), roles)


def read_columns(file: IO[bytes], name: str, most: int = MOST_BYTES) -> FileColumns:
    """Read the columns of an open file under its own names; its name gives the format. Raises RecordError."""
    return format_of(name).read(file, most)
