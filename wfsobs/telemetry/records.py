"""Reading and writing of records: files of any format, checked, in one form. See docs/data.md.

Whether the data exclude the sign or the delay of the commands of a closed loop.

The spectrum of a disturbance in white noise falls, lines aside; that of z under a wrong sign or delay has the humps of the loop.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import ArrayLike
from scipy.fft import rfft
from scipy.ndimage import binary_dilation, median_filter
from scipy.optimize import isotonic_regression

from wfsobs.files import write_whole
from wfsobs.progress import QUIET, Watch
from wfsobs.record import DELAY, Record, RecordError, hold_last
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import paper
from wfsobs.sensors.modes import TIP_TILT
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.columns import join_clock, to_contents
from wfsobs.telemetry.command_response import LONGEST, MOST_STEPS, command_response
from wfsobs.telemetry.formats import format_of, writer_of
from wfsobs.telemetry.formats.contents import Contents, FileColumns
from wfsobs.telemetry.formats.csv import write
from wfsobs.telemetry.formats.npz import write as write_npz
from wfsobs.telemetry.intake import DeclaredFormat, to_record
from wfsobs.telemetry.modal import LoopMatrix, matrix_of, split_source
from wfsobs.typing import Array

REVERSED = 0.7
"""Minimum correlation of what is new in a command and in the measurement of its row, of a sign that is reversed."""

BANDS, LINE = 60, 10.0
"""Bands of a spectrum that falls; how often the median about it a bin is that is left out, as one of a line."""

CLEAR, CLEAR_DELAY, FALLS = 30.0, 0.01, 0.5
"""Log-likelihood by which a sign is excluded; per sample, a delay (at least twice the first); that a falling band may lack."""


def contradiction(record: Record, sign: int = 1) -> str:
    """Return in a line why the data exclude that y = disturbance + u, `record.delay` steps later; empty where they do not.

    sign : of the commands as it was stated, for the line alone; that of the record is +1
    """
    response = command_response(record)
    if response is None:
        return ""
    y, u = (hold_last(x[LONGEST:MOST_STEPS, : len(TIP_TILT)]) for x in (record.y_lgs, record.u))
    moving = np.ptp(u, axis=0) > 0
    y, u = (x[:, moving] / max(np.abs(y).max(), np.abs(u).max()) for x in (y, u))
    ways = [(0, 1), *((s, d) for s in (1, -1) for d in {*range(1, LONGEST + 1), record.delay})]
    fits = sum(_falling(*mode, ways) for mode in zip(y.T, u.T, strict=True))
    likelihood, lacks = (dict(zip(ways, x, strict=True)) for x in np.transpose(fits))
    best, reverse = (max((w for w in ways if w[0] == s), key=lambda w: likelihood[w]) for s in (1, -1))
    falls = "the spectrum of z falls as that of a disturbance does, lines aside"
    if response.reply > REVERSED and likelihood[reverse] - max(likelihood[best], likelihood[0, 1]) > CLEAR:
        row = f"commands move with the measurement of their row (correlation {response.reply:+.2f})"
        return f"command sign {sign:+d} is excluded by the data: {row}, and with {-sign:+d} {falls}"
    clear = max(2.0 * CLEAR, CLEAR_DELAY * len(y))
    if likelihood[best] - max(likelihood[1, record.delay], likelihood[0, 1]) > clear and lacks[best] < FALLS * BANDS * y.shape[1]:
        return f"command delay {record.delay} is excluded by the data: with {best[1]}, not with {record.delay}, {falls}"
    return ""


def _falling(y: Array, u: Array, ways: Sequence[tuple[int, int]]) -> Array:
    """Return for every sign and delay the log-likelihood of the falling spectrum that is likeliest, and what it lacks, (ways, 2).

    Lines are left out: bins far above those about them, of y or u, whatever the sign and the delay are.
    """
    n = len(y)
    f = np.arange(2, n // 2) / n
    Y, U = (rfft((x - x.mean()) * np.hanning(n + 2)[1:-1])[2 : n // 2] for x in (y, u))
    keep = np.ones(len(f), dtype=bool)
    for power in (np.abs(Y) ** 2, np.abs(U) ** 2):
        keep &= ~binary_dilation(power > LINE * median_filter(power, min(201, len(f) // 20 | 1)), iterations=3)
    edges = np.unique(np.concatenate([[0], np.geomspace(20, len(f), BANDS).astype(int)]))[:-1]
    count = np.add.reduceat(keep.astype(float), edges)
    out, known = [], count > 0
    for sign, delay in ways:
        power = keep * np.abs(Y - sign * np.exp(-2j * np.pi * f * delay) * U) ** 2
        level = np.add.reduceat(power, edges)[known] / count[known]
        level = np.maximum(level, max(1e-20 * level.max(), 1e-300))
        S = isotonic_regression(level, weights=count[known], increasing=False).x
        out.append([-0.5 * count[known] @ np.log(S), 0.5 * count[known] @ np.log(S / level)])  # half the bins: of a taper
    return np.array(out)


MOST_BYTES = 4_000_000_000
"""Maximum bytes of numbers in a file."""


def save_record(path: str | Path, record: Record, scenario_toml: str | None = None) -> None:
    """Write a record in the format of the name's ending. Raises OSError, RecordError."""
    try:
        write = writer_of(str(path))
        write_whole(path, lambda file: write(file, record_arrays(record, scenario_toml)))
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from None


def save(path: str | Path, record: Record) -> None:
    """Write a record: .npz, .csv, .fits, .aot.fits, .h5, .mat or .parquet (docs/data.md).

    Parameters
    ----------
    path : str or Path
        The file, whose ending gives the format; one that is there is replaced once the new one is whole.
    record : Record
        Measurements and commands [um], and the truth where the format has a place for it.

    Raises
    ------
    OSError
        The file cannot be written.
    RecordError
        There is no such format, or it is only read.
    """
    save_record(path, record)


def name_differences(record: Record, other: Record) -> list[str]:
    """Return the parts of a record that another does not have, or has otherwise."""

    def differs(one: object, two: object) -> bool:
        if one is None or two is None or not hasattr(one, "__dict__"):
            return one is not two if one is None or two is None else not np.array_equal(one, two, equal_nan=True)  # type: ignore[arg-type]
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

    Raises RecordError, also where it cannot be read later.
    """
    try:
        folder = Path(path).is_dir()
        with _open_folder(Path(path)) if folder else open(path, "rb") as file:
            if sha256 is not None:
                found = hashlib.file_digest(file, "sha256").hexdigest()
                if found != sha256.lower():
                    raise RecordError(f"{path}: is another file: its SHA-256 is {found}, not {sha256[:64]}")
                file.seek(0)
            yield file, f"{path}.npz" if folder else str(path)
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
    stated = declaration.command_sign or 1
    return stated if declaration.trust and declaration.command_sign else int(contents.arrays.get("command_sign", stated))


def stated_delay(contents: Contents, declaration: DeclaredFormat) -> float:
    """Return the delay of the commands as the file or the user states it [steps], with its fraction."""
    stated = declaration.command_delay or DELAY
    return stated if declaration.trust and declaration.command_delay else float(contents.arrays.get("delay", stated))


def contradiction_of(record: Record, contents: Contents, declaration: DeclaredFormat) -> str:
    """Return why the data exclude the sign or the delay with which a record was read; empty where they do not, or are not to."""
    return "" if declaration.trust else contradiction(record, stated_sign(contents, declaration))


def read_contents(file: IO[bytes], name: str, roles: Mapping[str, str], most: int = MOST_BYTES) -> Contents:
    """Read the named arrays of an open file, those of its columns that have these roles among them. Raises RecordError."""
    return to_contents(read_columns(file, name, most), roles)


def read_columns(file: IO[bytes], name: str, most: int = MOST_BYTES) -> FileColumns:
    """Read the columns of an open file under its own names; its name gives the format. Raises RecordError."""
    return join_clock(format_of(name).read(file, most))


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
