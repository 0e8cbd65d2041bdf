"""Files whose columns have names of their own: what each is said to be, or what its name suggests."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner

from wfsobs.cli import main
from wfsobs.record import Record, RecordError
from wfsobs.telemetry.columns import suggest_clock, suggest_roles
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.preview import ColumnsPreview, preview_any
from wfsobs.telemetry.records import read_columns, read_record
from wfsobs.units import SECONDS

RNG = np.random.default_rng(2)
N = 50
Y, U = RNG.standard_normal((N, 2)), RNG.standard_normal((N, 2))
TIME = 4.0 + 0.002 * np.arange(N)
NAMES = ("t [ms]", "wfs x [nm]", "wfs y [nm]", "cmd x [nm]", "cmd y [nm]", "flux")
ROLES = dict(zip(("time", "y_lgs/tip", "y_lgs/tilt", "u/tip", "u/tilt"), NAMES, strict=False))


def text(heading: bool = True) -> bytes:
    rows = np.column_stack([1e3 * TIME, Y, U, np.ones(N)])
    lines = [",".join(map(repr, row.tolist())) for row in rows]
    return "\n".join([*([",".join(NAMES)] if heading else []), *lines]).encode()


def test_csv_by_the_roles_that_names_suggest() -> None:
    """Units beside the names are used: nm for the signals, ms for the time."""
    file = read_columns(io.BytesIO(text()), "a.csv")
    assert suggest_roles(file.columns) == ROLES and [*file.columns] == [*NAMES]
    record = read_record(io.BytesIO(text()), "a.csv", declaration=DeclaredFormat(columns=ROLES))
    np.testing.assert_allclose(record.y_lgs, 1e-3 * Y, rtol=1e-12)
    np.testing.assert_allclose(record.u, 1e-3 * U, rtol=1e-12)
    assert record.dt == pytest.approx(0.002, rel=1e-9) and record.origin == "unit nm, column flux not used"


def test_csv_without_a_heading() -> None:
    roles = {role: f"column {i + 1}" for i, role in enumerate(ROLES)}
    del roles["time"]
    stated = DeclaredFormat(unit="nm", rate=500.0, columns=roles)
    record = read_record(io.BytesIO(text(heading=False)), "a.csv", declaration=stated)
    np.testing.assert_allclose(record.u, 1e-3 * U, rtol=1e-12)
    assert record.n_steps == N, "the first row is one of numbers"


def test_npz_with_arrays_of_two_columns_either_way_round() -> None:
    file = io.BytesIO()
    np.savez(file, slopes=Y, dm=U.T, dt=np.array(0.002), note=np.array("x"))
    roles = suggest_roles(read_columns(file, "a.npz").columns)
    asked = preview_any(file.getvalue(), "a.npz")
    assert isinstance(asked, ColumnsPreview) and asked.roles == roles
    assert roles == {"y_lgs/tip": "slopes[0]", "y_lgs/tilt": "slopes[1]", "u/tip": "dm[0]", "u/tilt": "dm[1]"}
    record = read_record(file, "a.npz", declaration=DeclaredFormat(columns=roles))
    np.testing.assert_array_equal(record.y_lgs, Y)
    np.testing.assert_array_equal(record.u, U)
    assert record.dt == 0.002


def test_fits_tables_and_images() -> None:
    file = io.BytesIO()
    table = fits.BinTableHDU.from_columns([fits.Column("CENTROID", "2D", unit="mas", array=Y), fits.Column("T", "D", array=TIME)])
    fits.HDUList([fits.PrimaryHDU(), table, fits.ImageHDU(U, name="COMMANDS")]).writeto(file)
    file.seek(0)
    columns = read_columns(file, "a.fits")
    roles = suggest_roles(columns.columns)
    assert roles["time"] == "T" and roles["y_lgs/tilt"] == "CENTROID[1]" and roles["u/tip"] == "COMMANDS[0]"
    record = read_record(file, "a.fits", declaration=DeclaredFormat(columns=roles))
    for signal, column in ((record.u, U), (record.y_lgs, Y)):  # commands that have no unit have that of the measurements
        np.testing.assert_allclose(signal, column * 0.1 / 10.3132, rtol=1e-4)  # 100 nm on 8 m, to the digits of the constant


@pytest.mark.parametrize(
    ("roles", "line"),
    [
        (
            {"y_lgs/tipp": "flux"},
            "a.csv: 'y_lgs/tipp' is no part of a record; a column is one of time, frame, y_lgs/tip, y_lgs/tilt, u/",
        ),
        ({"y_lgs/tip": "wfs z"}, r"a.csv: has no column 'wfs z'; it has t \[ms\], wfs x \[nm\], wfs y \[nm\], cmd x"),
        ({"y_lgs/tip": NAMES[1]}, "a.csv: has no u; a record needs y_lgs, u and dt"),
        ({"y_lgs/tip": NAMES[1], "u/tilt": NAMES[4], "time": NAMES[0]}, "a.csv: u has the modes tilt; y_lgs has tip"),
    ],
)
def test_what_cannot_be(roles: dict[str, str], line: str) -> None:
    with pytest.raises(RecordError, match=line):
        read_record(io.BytesIO(text()), "a.csv", declaration=DeclaredFormat(columns=roles))


OWN = ("time_s", "y_lgs/tip_nm", "y_lgs/tilt_nm", "u/tip_nm", "u/tilt_nm")
"""Names of a record."""


def table(heading: Sequence[str], *columns: np.ndarray, separator: str = ",", decimal: str = ".") -> bytes:
    rows = zip(*(c if c.dtype.kind == "U" else [repr(x).replace(".", decimal) for x in c.tolist()] for c in columns), strict=True)
    return "\n".join(separator.join(cells) for cells in ([*heading] if heading else [], *rows) if cells).encode()


def is_as_clean(record: Record, said: str, missing: int = 0) -> None:
    """Whether a record has all of Y and U [nm] at 500 Hz, and says so much of how it was read."""
    there = ~np.isnan(record.y_lgs[:, 0])
    assert record.missing == missing and record.n_steps == N and record.origin == said
    np.testing.assert_allclose(record.y_lgs[there], 1e-3 * Y[there], rtol=1e-12)
    np.testing.assert_allclose(record.u[there], 1e-3 * U[there], rtol=1e-12)
    assert record.dt == 0.002


@pytest.mark.parametrize(
    ("name", "factor"),
    [
        ("time_s", 1.0),
        ("time", 1.0),
        ("time_ms", 1e3),
        ("time_us", 1e6),
        ("time [ns]", 1e9),
        ("Time (µs)", 1e6),
        ("time_ns", 1e9),
    ],
)
@pytest.mark.parametrize("start", [0, 1_762_145_600])
def test_a_time_in_the_unit_of_its_name(name: str, factor: float, start: int) -> None:
    """Of an epoch as well, where a double resolves 0.2 us: the rate is the roundest within that."""
    stamps = start * factor + np.round(0.002 * factor * np.arange(N), 6)
    is_as_clean(read_record(io.BytesIO(table((name, *OWN[1:]), stamps, *Y.T, *U.T)), "a.csv"), "unit nm")
    file = io.BytesIO()
    unit = name.rpartition("_")[2] if "_" in name else "s"
    if unit in SECONDS and "_" in name:
        columns = [fits.Column("TIME", "D", unit=unit, array=stamps), fits.Column("Y_LGS", "2D", unit="nm", array=Y)]
        fits.BinTableHDU.from_columns([*columns, fits.Column("U", "2D", unit="nm", array=U)]).writeto(file)
        is_as_clean(read_record(io.BytesIO(file.getvalue()), "a.fits"), "unit nm")
        file = io.BytesIO()
        np.savez(file, y_lgs=Y, u=U, unit="nm", **{name: stamps})
        is_as_clean(read_record(file, "a.npz"), "unit nm")


@pytest.mark.parametrize("ending", [".csv", ".npz", ".fits"])
def test_columns_that_nobody_names_keep_their_names(ending: str) -> None:
    stated, stamps, file = DeclaredFormat(columns={"time": "stamp_ms", "u/tilt": "b", "u/tip": "a"}), 1e3 * TIME, io.BytesIO()
    if ending == ".csv":
        file.write(table(("stamp_ms", *OWN[1:3], "a", "b"), stamps, *Y.T, *U.T))
    elif ending == ".npz":
        np.savez(file, y_lgs=Y, a=U[:, 0], b=U[:, 1], stamp_ms=stamps, unit="nm", cube=np.zeros((3, 4, 5)), note=np.array("x"))
    else:
        columns = [fits.Column("stamp_ms", "D", array=stamps), fits.Column("Y_LGS", "2D", unit="nm", array=Y)]
        columns += [fits.Column(name, "D", array=u) for name, u in zip("ab", U.T, strict=True)]
        fits.BinTableHDU.from_columns(columns).writeto(file)
    file.seek(0)
    unused = ", columns cube, note not used" * (ending == ".npz")
    is_as_clean(read_record(file, f"a{ending}", declaration=stated), f"unit nm{unused}")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["frame", "FrameCounter", "frame_no", "wfs frame counter"])
@pytest.mark.parametrize("bits", [8, 16, 32])
@pytest.mark.parametrize("every", [1, 4])
@pytest.mark.parametrize("lost", [[], [7], [19, 20, 21, 40]])
def test_a_frame_counter_says_what_is_missing(name: str, bits: int, every: int, lost: list[int]) -> None:
    """It may start anew at its highest number, and count more than there are rows."""
    there = np.delete(np.arange(N), lost)
    count = ((2**bits - 20 * every + every * np.arange(N)) % 2**bits)[there]
    stated, said = DeclaredFormat(rate=500.0), f"unit nm, frames counted by {name}"
    record = read_record(io.BytesIO(table((name, *OWN[1:]), count, *Y[there].T, *U[there].T)), "a.csv", declaration=stated)
    is_as_clean(record, said, len(lost))
    assert np.isnan(record.y_lgs[lost]).all()
    assert np.isnan(record.z[[k + 2 for k in lost]]).all(), "whose command was lost"
    file = io.BytesIO()
    np.savez(file, y_lgs=Y[there], u=U[there], unit="nm", **{name: count.astype(np.uint32)})
    is_as_clean(read_record(file, "a.npz", declaration=stated), said, len(lost))
    signed = table((name, *OWN[1:]), count - 2 ** (bits - 1), *Y[there].T, *U[there].T)
    is_as_clean(read_record(io.BytesIO(signed), "a.csv", declaration=stated), said, len(lost))
    rng = np.random.default_rng(1)
    stamps = TIME[there] + 1e-3 * rng.standard_normal(there.size) * (there % (N - 1) > 0)
    both = table((OWN[0], name, *OWN[1:]), stamps, count, *Y[there].T, *U[there].T)
    record = read_record(io.BytesIO(both), "a.csv")
    is_as_clean(record, record.origin, len(lost))
    assert "steps rms off the frames counted" in record.origin


@pytest.mark.parametrize(
    ("count", "line"),
    [
        (np.where(np.arange(N) < 9, np.arange(N), np.arange(N) - 1), "frame does not count at row 9: from 8 to 8"),
        (np.where(np.arange(N) < 9, np.arange(N), np.arange(N) - 5), "frame does not count at row 9: from 8 to 4"),
        (np.where(np.arange(N) < 9, np.arange(N), np.arange(N) + 99), "99 frames are missing, more than the 50 measured"),
    ],
)
def test_a_counter_that_does_not_count(count: np.ndarray, line: str) -> None:
    with pytest.raises(RecordError, match=line):
        read_record(io.BytesIO(table(("frame", *OWN[1:]), count, *Y.T, *U.T)), "a.csv", declaration=DeclaredFormat(rate=500.0))


@pytest.mark.parametrize(("step", "unit"), [(2, "ms"), (2000, "us"), (2_000_000, "ns")])
def test_stamps_that_are_seconds_apart_are_in_another_unit(step: int, unit: str) -> None:
    """No loop is so slow; a unit that is stated holds."""
    frames = np.arange(5, N, 5)
    ngs = {"y_ngs": np.random.default_rng(2).standard_normal((frames.size, 2)), "time_ngs": step * frames}
    file = io.BytesIO()
    np.savez(file, y_lgs=Y, u=U, time=step * np.arange(N), unit="nm", **ngs)
    record = read_record(file, "a.npz")
    assert (record.dt, record.ratio, record.origin) == (0.002, 5, f"unit nm, time in {unit}, time_ngs in {unit}")
    assert read_record(io.BytesIO(table(OWN, step * np.arange(N), *Y.T, *U.T)), "a.csv").dt == step


def test_tables_as_a_spreadsheet_writes_them() -> None:
    """A first line for itself, cells and headings that are empty at the end, and headings that come twice."""
    rows = table([*OWN, "flux", "flux", "", ""], TIME, *Y.T, *U.T, TIME, TIME, *np.full((2, N), np.nan)).decode()
    content = "sep=;\n" + rows.replace(",", ";").replace("nan", "")
    read = read_record(io.BytesIO(content.encode()), "a.csv")
    is_as_clean(read, "unit nm, cells separated by semicolons, columns flux, flux (7) not used")


def test_what_is_not_used_is_named() -> None:
    """Names alone make no counter, nor do numbers alone; two counters are none."""
    stated, count = DeclaredFormat(rate=500.0), np.arange(N)
    for names, columns, said in (
        (["frame", "frame_rate"], [0 * count, 0 * count + 500], "columns frame, frame_rate not used"),
        (["row"], [count], "column row not used"),
        (["frame", "counter"], [count, count], "columns frame, counter not used"),
        ([f"c{i}" for i in range(9)], [count] * 9, "columns c0, c1, c2, c3, c4 and 4 more not used"),
        (["frame time [ms]"], [count], "column frame time [ms] not used"),
    ):
        content = table([*OWN[1:], *names], *Y.T, *U.T, *columns)
        is_as_clean(read_record(io.BytesIO(content), "a.csv", declaration=stated), f"unit nm, {said}")
    with pytest.raises(RecordError, match=r"has no dt and no time; .* which column is the time\? It has when"):
        read_record(io.BytesIO(table([*OWN[1:], "when"], *Y.T, *U.T, TIME)), "a.csv")


def test_stamps_and_counter_that_do_not_agree() -> None:
    """A pause of 0.1 s within which no frame was counted."""
    k = np.arange(400)
    y = RNG.standard_normal((400, 2))
    content = table(("time_s", "frame", *OWN[1:]), 0.002 * k + 0.1 * (k > 200), k, *y.T, *y.T)
    with pytest.raises(RecordError, match="time and frame do not agree"):
        read_record(io.BytesIO(content), "a.csv")


@pytest.mark.parametrize("separator", [",", ";", "\t", " ", "   "])
@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize("heading", [True, False])
def test_separators_and_decimal_commas(separator: str, decimal: str, heading: bool) -> None:
    if separator == decimal:
        return
    content = table(OWN if heading else [], TIME, *Y.T, *U.T, separator=separator, decimal=decimal)
    roles = dict(zip(ROLES, (f"column {i + 1}" for i in range(5)), strict=True))
    stated = DeclaredFormat() if heading else DeclaredFormat(unit="nm", columns=roles)
    name = {",": "", ";": ", cells separated by semicolons", "\t": ", cells separated by tabs"}
    said = name.get(separator, ", cells separated by blanks") + ", decimal commas" * (decimal == ",")
    is_as_clean(read_record(io.BytesIO(content), "a.txt", declaration=stated), f"unit nm{said}")


def test_exponents_of_fortran() -> None:
    """As its D descriptor and IDL write double precision."""
    written = [np.array([f"{x:.17E}".replace("E", "D") for x in column]) for column in (*Y.T, *U.T)]
    is_as_clean(read_record(io.BytesIO(table(OWN, TIME, *written, separator=" ")), "a.txt"), "unit nm, cells separated by blanks")
    with pytest.raises(RecordError, match=r"line 2, y_lgs/tip.*: 'added' is not a number"):
        read_record(io.BytesIO(table(OWN, TIME, np.full(len(TIME), "added"), *written[1:])), "a.csv")


def test_columns_of_text() -> None:
    """Left out where it begins with text or comes to it, also with a separator between quotation marks; never what is needed."""
    good = np.array(["ok", '"seen, then lost"'] * (N // 2))
    late = np.array(["1"] * (N - 1) + ["saturated"])
    content = table([*OWN, "comment", "flag"], TIME, *Y.T, *U.T, good, late)
    is_as_clean(read_record(io.BytesIO(content), "a.csv"), "unit nm, columns comment (text), flag (text) not used")
    for name in ("flag", "comment"):
        with pytest.raises(RecordError, match=rf"a.csv: line \d+, {name}: '\w+' is not a number"):
            read_record(io.BytesIO(content), "a.csv", declaration=DeclaredFormat(columns={"u/tip": name}))
    with pytest.raises(RecordError, match=r"a.csv: line 51, u/tilt_nm: 'saturated' is not a number"):
        read_record(io.BytesIO(table(OWN, TIME, *Y.T, U.T[0], late)), "a.csv")


@pytest.mark.parametrize("row", ["{},{},{},{},{},{}", "[{}],[{}],[{}],[{}],[{}],[{}]", '({}),"{}",{},{},{},{}'])
@pytest.mark.parametrize("counted", ["-", "", "none", "counts"])
def test_a_row_of_units_below_the_heading(row: str, counted: str) -> None:
    names = ["frame", *(name.rpartition("_")[0] for name in OWN)]
    heading, *rows = table(names, np.arange(N), 1e3 * TIME, *Y.T, *U.T).decode().split("\n")
    content = "\n".join([heading, row.format(counted, "ms", "nm", "nm", "nm", "nm"), *rows])
    is_as_clean(read_record(io.BytesIO(content.encode()), "a.csv"), "unit nm, frames counted by frame")


@pytest.mark.parametrize("word", ["NA", "-", "null", ""])
def test_words_for_a_missing_sample(word: str) -> None:
    tip = np.array([word, *map(repr, Y[1:, 0].tolist())])
    record = read_record(io.BytesIO(table(OWN, TIME, tip, Y[:, 1], *U.T)), "a.csv")
    assert np.flatnonzero(np.isnan(record.y_lgs[:, 0])).tolist() == [0] and record.origin == "unit nm"


def test_tilt_alone_is_said_to_be_called_tip() -> None:
    record = read_record(io.BytesIO(table([OWN[0], *OWN[2::2]], TIME, Y[:, 1], U[:, 1])), "a.csv")
    np.testing.assert_allclose(record.y_lgs, 1e-3 * Y[:, 1:], rtol=1e-12)
    assert record.origin == "unit nm, tilt alone, called tip"


@pytest.mark.parametrize("name", ["unit", "UNIT", "units"])
def test_the_unit_of_an_npz_in_any_spelling(name: str) -> None:
    file = io.BytesIO()
    np.savez(file, **{"y_lgs": Y, "U": U, "time": TIME, name: "nm"})
    is_as_clean(read_record(file, "a.npz"), "unit nm")


def test_a_micro_sign_of_an_old_code_page() -> None:
    content = table([name.replace("nm", "µm") for name in OWN], TIME, *Y.T, *U.T)
    record = read_record(io.BytesIO(content.decode().encode("latin-1")), "a.csv")
    np.testing.assert_allclose(record.y_lgs, Y, rtol=1e-12)


def in_hdf5(names: tuple[str, str], unit: str = "nm", clock: str = "s", factor: float = 1.0) -> io.BytesIO:
    out = io.BytesIO()
    with h5py.File(out, "w") as file:
        for name, values, of in (
            *((name, x, unit) for name, x in zip(names, (Y, U), strict=True)),
            ("time", factor * TIME, clock),
        ):
            file[name] = values
            file[name].attrs["units"] = of
    return out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("unit", "factor"), [("milliseconds", 1e3), ("MSEC", 1e3), ("usec", 1e6), ("seconds since 2026-01-01", 1.0), ("", 1.0)]
)
def test_units_of_a_clock_in_other_words(unit: str, factor: float) -> None:
    assert read_record(in_hdf5(("y_lgs", "u"), "nm", unit, factor), "a.h5").dt == pytest.approx(0.002, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("names", [("y_lgs", "u"), ("slopes", "cmds")])
def test_what_is_no_unit_is_refused_unless_one_is_stated(names: tuple[str, str]) -> None:
    roles = {} if names[0] == "y_lgs" else dict(zip(("y_lgs", "u"), names, strict=True))
    way = DeclaredFormat(columns=roles)
    with pytest.raises(RecordError, match=r"(y_lgs|u) is in 'pixel', which is no unit of a wavefront: state one of um, nm, mas"):
        read_record(in_hdf5(names, "pixel"), "a.h5", declaration=way)
    is_as_clean(read_record(in_hdf5(names, "pixel"), "a.h5", declaration=replace(way, unit="nm")), "unit nm")
    with pytest.raises(RecordError, match=r"time is in 'cycles', which is no unit of time; it takes s, ms, us, ns or d"):
        read_record(in_hdf5(names, "nm", "cycles"), "a.h5", declaration=way)
    # 1 urad on 8 m are 2 um
    found = read_record(in_hdf5(names, "microradians"), "a.h5", declaration=way)
    np.testing.assert_allclose(found.y_lgs, 2.0 * Y, rtol=1e-12)


@pytest.mark.parametrize("unit", [" nm", "_nm", " [nm]", "[nm]", " (nm)", " [Nanometres]"])
def test_units_of_modes_however_they_stand_behind_them(unit: str) -> None:
    names = ["time_s", *(f"{signal}/{mode}{unit}" for signal in ("y_lgs", "u") for mode in ("tilt", "tip"))]
    is_as_clean(read_record(io.BytesIO(table(names, TIME, *Y.T[::-1], *U.T[::-1])), "a.csv"), "unit nm")


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_missing_numbers_of_scaled_integers(scale: float) -> None:
    raw = np.round(Y / scale).astype(np.int16)
    raw[7] = -32768
    columns = [fits.Column(name, "2I", unit="nm", array=raw, null=-32768) for name in ("Y_LGS", "U")]
    hdu = fits.BinTableHDU.from_columns(columns)
    hdu.header["DT"] = 1e-3
    if scale != 1.0:
        hdu.header["TSCAL1"] = hdu.header["TSCAL2"] = scale
    hdu.writeto(file := io.BytesIO())
    record = read_record(io.BytesIO(file.getvalue()), "a.fits")
    assert np.flatnonzero(np.isnan(record.y_lgs).any(axis=1)).tolist() == [7] == np.flatnonzero(np.isnan(record.u[:, 0])).tolist()


def test_numbers_given_for_every_row() -> None:
    arrays = {"y_lgs": Y, "u": U, "unit": "nm"}
    np.savez(file := io.BytesIO(), **arrays, dt=np.full(N, 0.002))
    is_as_clean(read_record(file, "a.npz"), "unit nm")
    np.savez(file := io.BytesIO(), **arrays, dt=np.append(np.full(N - 1, 0.002), 0.003))
    with pytest.raises(RecordError, match=rf"dt holds {N} numbers that differ; it takes one"):
        read_record(file, "a.npz")
    np.savez(file := io.BytesIO(), y_lgs=1.0, u=1.0, dt=0.002)
    with pytest.raises(RecordError, match=r"y_lgs has shape \(1, 1\); it takes"):
        read_record(file, "a.npz")


def test_tip_comes_first_in_whatever_order_the_columns_are() -> None:
    order = [0, 2, 1, 4, 3]
    content = table([OWN[i] for i in order], *(np.column_stack([TIME, Y, U])[:, order].T))
    is_as_clean(read_record(io.BytesIO(content), "a.csv"), "unit nm")
    roles = dict(reversed(ROLES.items()))
    is_as_clean(
        read_record(io.BytesIO(text()), "a.csv", declaration=DeclaredFormat(columns=roles)), "unit nm, column flux not used"
    )


def test_names_that_suggest_nothing() -> None:
    assert suggest_roles(["a", "b", "column 1", "", "x"]) == {}


def test_slopes_and_commands_of_actuators_are_suggested_whole() -> None:
    file = io.BytesIO()
    np.savez(file, slopes=np.ones((N, 9)), dm_cmd=np.ones((N, 5)), recon=np.ones((2, 9)))
    with pytest.raises(
        RecordError, match=r"has no y_lgs.*: --column 'y_lgs=slopes' --column 'u=dm_cmd'; slopes need a --reconstructor"
    ):
        read_record(file, "a.npz", declaration=DeclaredFormat(rate=500.0))


def test_on_the_command_line(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rng = np.random.default_rng(1)
    n = 600
    rows = np.column_stack([np.arange(n) * 2.0, rng.standard_normal((n, 4))])
    path.write_text("\n".join([",".join(NAMES[:5]), *(",".join(map(repr, row.tolist())) for row in rows)]))
    words = [word for role, name in ROLES.items() for word in ("--column", f"{role}={name}")]
    settings = ["--set", "run.warm_up=0.2", "--json"]
    done = CliRunner().invoke(main, ["observe", str(path), *words, *settings])
    assert done.exit_code == 0, done.output
    rms = {row["mode"]: row["rms_um"] for row in json.loads(done.stdout) if row["target"] == "residual y"}
    late = rows[100:, 1:3]
    for mode, values in zip(("tip", "tilt"), late.T, strict=True):
        assert rms[mode] == pytest.approx(1e-3 * np.sqrt(np.mean(values**2)), rel=1e-2), "to the samples that are scored"
    done = CliRunner().invoke(main, ["observe", str(path), "--column", "time"])
    assert done.exit_code != 0 and "--column time: takes ROLE=NAME" in done.output
    done = CliRunner().invoke(main, ["observe", str(path), *words, "--column", "u/tip=flux"])
    assert (done.exit_code, done.stderr) == (2, "wfsobs: --column u/tip=flux: u/tip is stated twice\n")


def test_what_always_rises_is_proposed_as_the_time() -> None:
    """With jitter and a lost row; a count of frames is not, nor what has a name that says what it is."""
    count, lost = np.arange(float(N)), np.delete(TIME + 1e-4 * RNG.standard_normal(N), 7)
    assert suggest_clock({"n": count, "a": Y[:, 0], "b": lost}) == "b"
    assert suggest_clock({"n [ms]": count}) == "n [ms]", "a rate of 1 kHz"
    assert suggest_clock({"n": count, "a": Y[:, 0], "b": np.full(3, np.nan)}) is None
    table = np.column_stack([TIME, Y, U]).tolist()
    for first, role in (("p", {"time": "p"}), ("wfs x", {"y_lgs/tip": "wfs x"})):
        lines = [f"{first},q,r,s,v", *(",".join(map(repr, row)) for row in table)]
        found = preview_any("\n".join(lines).encode(), "a.csv")
        assert isinstance(found, ColumnsPreview) and found.roles == role
        assert "50 values, 4, 4.002, 4.004 ..." in found.columns[first]
