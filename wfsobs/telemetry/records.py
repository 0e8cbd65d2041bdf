"""The one door by which records come in and go out: files of any format, in one form and checked. docs/data.md has it all."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO

import numpy as np

from wfsobs.files import write_whole
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.telemetry.formats import format_of
from wfsobs.telemetry.formats.npz import write as write_npz
from wfsobs.telemetry.intake import Stated, record_of
from wfsobs.typing import Array

MOST_BYTES = 4_000_000_000
"""Of numbers in a file."""


def save_record(path: str | Path, record: Record, scenario_toml: str | None = None) -> None:
    """Write a record in the format that the name ends in. Raises OSError, RecordError."""
    try:
        fmt = format_of(str(path))
        write_whole(path, lambda file: fmt.write(file, record_arrays(record, scenario_toml)))
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from None


def record_arrays(record: Record, scenario_toml: str | None = None) -> dict[str, Array]:
    """What the file of a record holds, by name."""
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
    path: str | Path, scenario: Scenario | None = None, stated: Stated | None = None, sha256: str | None = None
) -> Record:
    """Read and check the record of a file. Raises RecordError with one line saying what, where and what is expected.

    sha256 : of the file, in hexadecimal digits; another file is refused
    """
    try:
        with open(path, "rb") as file:
            if sha256 is not None:
                found = hashlib.file_digest(file, "sha256").hexdigest()
                if found != sha256.lower():
                    raise RecordError(f"{path}: is another file: its SHA-256 is {found}, not {sha256[:64]}")
                file.seek(0)
            return read_record(file, str(path), scenario, stated)
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
) -> Record:
    """Read the record of a file: .npz, .csv, .fits or AOT (docs/data.md).

    scenario      : its telescope and modes, where the file needs them to be understood; the defaults unless given
    unit          : of the signals where the file states none, one of `wfsobs.units.UNITS`; um unless given
    command_sign  : +1 where a command adds to what the sensor sees, -1 where it is taken off
    command_delay : steps from a command to the first measurement that sees it
    rate          : of the rows where they have no time [Hz]
    Raises RecordError with one line saying what, where and what is expected.
    """
    return load_record(path, scenario, Stated(unit, command_sign, command_delay, rate))


def read_record(
    file: IO[bytes], name: str, scenario: Scenario | None = None, stated: Stated | None = None, most: int = MOST_BYTES
) -> Record:
    """The record of an open file; its name says the format and is never opened. most : bytes of numbers."""
    try:
        return record_of(format_of(name).read(file, most), scenario or Scenario(), stated or Stated())
    except RecordError as error:
        raise RecordError(f"{name}: {error}") from None
