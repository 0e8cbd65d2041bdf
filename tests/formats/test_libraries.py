"""Files of other programs: MATLAB, HDF5, IDL, Parquet, numpy's .npy, text of any dialect, tables of a real-time computer."""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Callable
from contextlib import nullcontext, suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from astropy.io import fits
from click.testing import CliRunner

import wfsobs
from wfsobs.cli import main
from wfsobs.record import Record, RecordError, Training
from wfsobs.telemetry.columns import LoopMatrix
from wfsobs.telemetry.formats import FORMATS
from wfsobs.telemetry.formats.contents import TooLargeError
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.records import name_differences, read_columns, read_record

RNG = np.random.default_rng(4)
N = 400
PHI = np.cumsum(RNG.standard_normal((N, 2)), axis=0)
"""A disturbance [nm]; the noise of its measurement is a tenth of its step."""


def loop(delay: float = 2.0, gain: float = 1.0, rail: float = np.inf) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measurements and commands of an integrator, and what is measured without a mirror; the mirror holds every command."""
    rng = np.random.default_rng(5)
    z, u, y = PHI + 0.1 * rng.standard_normal((N, 2)), np.zeros((N, 2)), np.zeros((N, 2))
    d, part = int(delay), delay % 1
    for k in range(N):
        held = [np.clip(u[k - d - i], -rail, rail) if k >= d + i else np.zeros(2) for i in (0, 1)]
        y[k] = z[k] + gain * ((1 - part) * held[0] + part * held[1])
        u[k] = (u[k - 1] if k else 0.0) - 0.3 * y[k]
    return y, u, z


Y, U, Z = loop()


def saved(write: Callable[[io.BytesIO], Any]) -> bytes:
    file = io.BytesIO()
    write(file)
    return file.getvalue()


def matlab(**arrays: Any) -> bytes:
    return saved(lambda file: scipy.io.savemat(file, arrays, do_compression=True))


def npz(**arrays: Any) -> bytes:
    return saved(lambda file: np.savez(file, **arrays))


def with_object(content: bytes) -> bytes:
    """Return a MATLAB file with an object, such as a string of today, and the unnamed array that it is made of."""

    def element(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data + b"\0" * (-len(data) % 8)

    flags = [element(6, struct.pack("<II", of, 0)) for of in (17, 9)]
    names = b"".join(element(1, word) for word in (b"night", b"MCOS", b"string"))
    unnamed = flags[1] + element(5, struct.pack("<ii", 1, 8)) + element(1, b"") + element(2, bytes(8))
    return content + element(14, flags[0] + names) + element(14, unnamed)


def hdf5(fill: Callable[[h5py.File], Any], userblock: int = 0) -> bytes:
    def write(file: io.BytesIO) -> None:
        with h5py.File(file, "w", userblock_size=userblock) as f:
            fill(f)

    content = saved(write)
    return b"MATLAB 7.3 MAT-file".ljust(userblock)[:userblock] + content[userblock:]


def parquet(**columns: Any) -> bytes:
    return saved(lambda file: pq.write_table(pa.table(columns), file))


def sav(**arrays: np.ndarray) -> bytes:
    """Write a save file as IDL does: records of a kind and where the next one is, of big-endian words."""
    content = b"SR\x00\x04"

    def add(kind: int, body: bytes) -> None:
        nonlocal content
        content += struct.pack(">iIIi", kind, len(content) + 16 + len(body), 0, 0) + body

    def text(value: str) -> bytes:
        return struct.pack(">i", len(value)) + value.encode() + b"\0" * (-len(value) % 4)

    for name, values in arrays.items():
        dims = [*values.shape[::-1]] + [1] * (8 - values.ndim)
        sizes = (8, 8, values.nbytes, values.size, values.ndim, 0, 0, 8)
        add(2, text(name.upper()) + struct.pack(">ii", 5, 4) + struct.pack(">8i", *sizes) + struct.pack(">8i", *dims)
            + struct.pack(">i", 7) + values.astype(">f8").tobytes())  # fmt: skip
    return content + struct.pack(">iIIi", 6, 0, 0, 0)


def table(head: str, rows: Any, separator: str = ",") -> bytes:
    lines = [separator.join(x if isinstance(x, str) else repr(float(x)) for x in row) for row in rows]
    return "\n".join([*([head] if head else []), *lines]).encode()


def sparta(file: io.BytesIO) -> None:
    k = np.arange(N)
    columns = [("FrameCounter", "J", k + 100), ("Seconds", "J", 1762145600 + k // 1000), ("USeconds", "J", k % 1000 * 1000)]
    columns += [("Gradients", "2D", Y), ("ITTM_Positions", "2D", U)]
    fits.BinTableHDU.from_columns([fits.Column(n, f, array=a) for n, f, a in columns]).writeto(file)


def cubes(file: io.BytesIO) -> None:
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(Y.reshape(N, 1, 2), name="SLOPES"), fits.ImageHDU(U.T, name="COMMANDS")]
    hdus[0].header["LOOPFREQ"] = 1000.0
    fits.HDUList(hdus).writeto(file)


def structured(f: h5py.File) -> None:
    f["loop"] = np.rec.fromarrays([*Y.T, *U.T], names="y0,y1,u0,u1")
    f.attrs["fs"] = 1000.0


def mapped(f: h5py.File) -> None:
    f["loop/slopes_tt"], f["loop/commands_tt"], f.attrs["frame_rate_hz"] = Y, U, 1000.0


def of_matlab_73(f: h5py.File) -> None:
    f["y_lgs"], f["u"], f["dt"] = Y.T, U.T, np.array([[1e-3]])


def as_matlab_73(name: str, values: np.ndarray, **attributes: Any) -> Callable[[h5py.File], None]:
    """Return what adds an array, and a loop in a structure, as MATLAB does: axes the other way round, texts as numbers."""

    def fill(f: h5py.File) -> None:
        numbers = {"loop/wfs/slopes": Y.T, "loop/dm/cmd": U.T, "loop/fs": np.array([[1000.0]]), name: values}
        for path, array in numbers.items():
            f[path] = array
            f[path].attrs["MATLAB_class"] = np.bytes_("double")
        f[name].attrs.update(attributes)
        f["loop/wfs/unit"] = np.array([[ord(letter)] for letter in "nm"], np.uint16)
        f["loop/wfs/unit"].attrs["MATLAB_class"] = np.bytes_("char")

    return fill


NOTHING = {"MATLAB_empty": np.uint8(1)}
SIZES = np.array([0, 0], np.uint64)


def array(kind: str) -> bytes:
    rows = np.c_[Y, U] if kind == "plain" else np.rec.fromarrays([*Y.T, *U.T], names="a,b,c,d")
    return saved(lambda file: np.save(file, rows))


STEPS = np.arange(N)
NOON = datetime(2026, 11, 3, 12, tzinfo=UTC)
STAMPS = [(NOON + timedelta(milliseconds=int(k))).isoformat(timespec="milliseconds") for k in STEPS]
HEAD = "y_lgs/tip_nm,y_lgs/tilt_nm,u/tip_nm,u/tilt_nm"
COLUMNS = {f"{signal}/{mode}": f"{signal}/{mode}_nm" for signal in ("y_lgs", "u") for mode in ("tip", "tilt")}
OWN = {"y_lgs": Y, "u": U, "dt": 1e-3, "unit": "nm"}
NM, KHZ = {"unit": "nm"}, {"unit": "nm", "rate": 1000.0}

CASES: list[tuple[str, bytes, dict[str, Any], str]] = [
    ("a.mat", matlab(**OWN, delay=2), {}, "unit nm"),
    ("a.mat", with_object(matlab(**OWN)), {}, "unit nm, column night not used"),
    ("a.mat", matlab(y_lgs=Y.T, u=U.T, time=1e-3 * STEPS), NM, "unit nm, y_lgs and u with a row per mode"),
    ("a.mat", matlab(d={"s": Y, "c": U, "fs": 1000}), NM | {"columns": {"y_lgs": "d.s", "u": "d.c"}}, "unit nm, 1000 Hz by d.fs"),
    (
        "a.mat",
        matlab(d={"s": Y, "c": U, "fs": 1000, "unit": "nm"}),
        {"columns": {"y_lgs": "d.s", "u": "d.c"}},
        "unit nm, 1000 Hz by d.fs",
    ),
    *(
        (
            "a.mat",
            hdf5(as_matlab_73("info", SIZES, **NOTHING), 512),
            {"columns": {"y_lgs": f"loop{sign}wfs{sign}slopes", "u": f"loop{sign}dm{sign}cmd"}},
            "unit nm, 1000 Hz by loop.fs, column info not used",
        )
        for sign in "./"
    ),
    ("a.mat", hdf5(of_matlab_73, 512), NM, "unit nm, y_lgs and u with a row per mode"),
    ("a.mat", matlab(y_lgs={"tip": Y[:, :1], "tilt": Y[:, 1:]}, u={"tip": U[:, :1], "tilt": U[:, 1:]}, dt=1e-3), NM, "unit nm"),
    (
        "a.h5",
        hdf5(mapped),
        NM | {"columns": {"y_lgs": "loop/slopes_tt", "u": "loop/commands_tt"}},
        "unit nm, 1000 Hz by frame_rate_hz",
    ),
    (
        "a.hdf5",
        hdf5(structured),
        NM | {"columns": dict(zip(COLUMNS, ("loop.y0", "loop.y1", "loop.u0", "loop.u1"), strict=True))},
        "unit nm, 1000 Hz by fs",
    ),
    ("a.sav", sav(y=Y, c=U.T), KHZ | {"columns": {"y_lgs": "y", "u": "c"}}, "unit nm"),
    ("a.npy", array("plain"), KHZ | {"columns": dict(zip(COLUMNS, (f"array[{i}]" for i in range(4)), strict=True))}, "unit nm"),
    ("a.npy", array("fields"), KHZ | {"columns": dict(zip(COLUMNS, (f"array.{i}" for i in "abcd"), strict=True))}, "unit nm"),
    (
        "a.parquet",
        parquet(when=[NOON + timedelta(milliseconds=int(k)) for k in STEPS], **dict(zip("abcd", [*Y.T, *U.T], strict=True))),
        NM | {"columns": dict(zip(("time", *COLUMNS), ("when", *"abcd"), strict=True))},
        "unit nm",
    ),
    ("a.parquet", parquet(y=Y.tolist(), c=U.tolist(), time=STAMPS), NM | {"columns": {"y_lgs": "y", "u": "c"}}, "unit nm"),
    (
        "a.fits",
        saved(sparta),
        NM | {"columns": {"y_lgs": "Gradients", "u": "ITTM_Positions"}},
        "unit nm, time by Seconds and USeconds, frames counted by FrameCounter",
    ),
    ("a.fits", saved(cubes), NM | {"columns": {"y_lgs": "SLOPES", "u": "COMMANDS"}}, "unit nm, 1000 Hz by LOOPFREQ"),
    ("a.csv", table(f"time,{HEAD}", ([s, *r] for s, r in zip(STAMPS, np.c_[Y, U], strict=True))), {}, "unit nm"),
    ("a.csv", table(f"MJD,{HEAD}", np.c_[60982.5 + STEPS * 1e-3 / 86400, Y, U]), KHZ, "unit nm"),
    ("a.csv", table(f"time,{HEAD}", np.c_[1e-3 * STEPS, Y, U]).decode().encode("utf-16"), {}, "unit nm"),
    (
        "a.txt",
        table("t|a|b|c|d\nms|nm|nm|nm|nm", np.c_[STEPS, Y, U], "|"),
        {"columns": dict(zip(("time", *COLUMNS), "tabcd", strict=True))},
        "unit nm, cells separated by bars",
    ),
    ("a.csv", table(f"time,{HEAD},", ([s[11:], *r, ""] for s, r in zip(STAMPS, np.c_[Y, U], strict=True))), {}, "unit nm"),
    (
        "a.csv",
        table(f"time,{HEAD}", ([str(1762145600 * 10**6 + 1000 * int(k)), *r] for k, r in zip(STEPS, np.c_[Y, U], strict=True))),
        {},
        "unit nm, time in us",
    ),
    (
        "a.csv",
        table(f"t,{HEAD}", np.c_[60982.5 + STEPS * 1e-3 / 86400, Y, U]),
        KHZ | {"columns": {"time": "t"}},
        "unit nm, time in d",
    ),
    (
        "a.dat",
        table("% taken at night\n% a b c d", np.c_[Y, U], "  "),
        KHZ | {"columns": dict(zip(COLUMNS, "abcd", strict=True))},
        "unit nm, heading of the comment above, cells separated by blanks",
    ),
]


@pytest.mark.parametrize(("name", "content", "stated", "origin"), CASES, ids=[f"{i}{case[0]}" for i, case in enumerate(CASES)])
def test_every_file_gives_the_record_and_says_what_is_guessed(name: str, content: bytes, stated: dict, origin: str) -> None:
    """All numbers are written with all digits; a modified Julian date resolves 1 us."""
    record = read_record(io.BytesIO(content), name, declaration=DeclaredFormat(**stated))
    np.testing.assert_allclose(record.y_lgs, 1e-3 * Y, rtol=1e-12)
    np.testing.assert_allclose(record.u, 1e-3 * U, rtol=1e-12)
    assert (record.dt, record.delay, record.missing, record.origin) == (0.001, 2, 0, origin)


@pytest.mark.parametrize("kind", [pa.list_(pa.float64()), pa.list_(pa.float64(), 2), pa.list_(pa.int32(), 2)])
@pytest.mark.parametrize("lost", [[7], [0, 1, 5], [N - 2, N - 1], [*range(0, N, 2)]])
@pytest.mark.parametrize("names", [("y_lgs", "u"), ("slopes", "cmd")])
def test_null_lists_are_missing_samples(kind: pa.DataType, lost: list[int], names: tuple[str, str]) -> None:
    """Also half of them, which are as many numbers as lists of one number would be, and those at the end."""
    rows = np.round(Y).tolist()
    for row in lost:
        rows[row] = None
    rows[20] = [None, 3.0]
    content = parquet(**dict(zip(names, (pa.array(rows, kind), pa.array(U.tolist())), strict=True)))
    stated = DeclaredFormat(
        columns=dict(zip(("y_lgs", "u"), names, strict=True)) if names[0] != "y_lgs" else {}, **KHZ, trust=True
    )
    expected = np.round(Y)
    expected[lost], expected[20] = np.nan, (np.nan, 3.0)
    record = read_record(io.BytesIO(content), "a.parquet", declaration=stated)
    np.testing.assert_allclose(record.y_lgs, 1e-3 * expected, rtol=1e-12)


@pytest.mark.parametrize("ratio", [2, 5])
def test_null_lists_between_the_frames_of_a_slow_sensor(ratio: int) -> None:
    """Up to the last row, whether a frame comes in it or not; or one row per frame, and nulls to the end."""
    frames = {k: float(k) for k in range(ratio, N, ratio)}
    in_rows = [[frames[k]] * 2 if k in frames else None for k in range(N)]
    by_frame = [*([x] * 2 for x in frames.values()), *[None] * (N - len(frames))]
    for rows in (in_rows, by_frame):
        table = pa.table({"y_lgs": Y.tolist(), "u": U.tolist(), "y_ngs": rows}).replace_schema_metadata({"ratio": str(ratio)})
        content = saved(lambda file, table=table: pq.write_table(table, file))
        record = read_record(io.BytesIO(content), "a.parquet", declaration=DeclaredFormat(**KHZ))
        assert record.y_ngs is not None and {k: 1e3 * x for k, x in enumerate(record.y_ngs[:, 1]) if x == x} == pytest.approx(
            frames
        )


# ---------------------------------------------------------------------- what belongs to what

PARTS = {"y_lgs": "wfs{0}slopes", "u": "dm{0}cmd"}
CASES_OF_UNITS: list[tuple[dict[str, Any], str]] = [
    ({"wfs.unit": "um", "dm.unit": "nm"}, "unit nm"),
    ({"wfs.unit": "um", "unit": "nm"}, "unit nm"),
    ({"wfs.unit": "um", "dm.unit": "nm", "unit": "mas"}, "unit nm"),
    ({"wfs.unit": "um", "dm.unit": "V"}, "u is in 'V', which is no unit of a wavefront: state one of um, nm"),
    ({"wfs.unit": "um", "cfg.unit": "nm"}, "u is in 'nm or um', which is no unit of a wavefront: state one of um, nm"),
    ({"cfg.unit": "um", "log.unit": "nm"}, "y_lgs is in 'nm or um', which is no unit of a wavefront: state one of um, nm"),
    ({"wfs.unit": "um", "dm.unit": "nm", "wfs.time": 1e-3 * STEPS}, "unit nm"),
    ({"wfs.unit": "um", "dm.unit": "nm", "clock.time": STEPS, "clock.unit": "ms"}, "unit nm"),
]


def parts_in(kind: str, parts: dict[str, Any]) -> bytes:
    """Return a file with parts {path: values}; texts as arrays, or as attributes of their group or root."""

    def fill(f: h5py.File) -> None:
        for path, values in parts.items():
            group, _, key = path.replace(".", "/").rpartition("/")
            if isinstance(values, np.ndarray) or kind == "a.h5":
                f[path.replace(".", "/")] = values
            else:
                f.require_group(f"/{group}").attrs[key] = values

    tree: dict[str, Any] = {}
    for path, values in parts.items():
        group, _, key = path.rpartition(".")
        (tree.setdefault(group, {}) if group else tree)[key] = values
    return matlab(**tree) if kind == "a.mat" else hdf5(fill)


@pytest.mark.slow
@pytest.mark.parametrize(("more", "said"), CASES_OF_UNITS)
@pytest.mark.parametrize("kind", ["a.mat", "a.h5", "attributes.h5"])
def test_a_unit_is_that_of_what_it_stands_beside(kind: str, more: dict[str, Any], said: str) -> None:
    parts = {"wfs.slopes": 1e-3 * Y, "dm.cmd": U} | more
    separator = "." if kind == "a.mat" else "/"
    columns = {role: name.format(separator) for role, name in PARTS.items()}
    columns.update(("time", name.replace(".", separator)) for name in more if name.endswith("time"))
    stated = DeclaredFormat(columns=columns, rate=1000.0, trust=True)
    if said.startswith("unit"):
        record = read_record(io.BytesIO(parts_in(kind, parts)), kind, declaration=stated)
        np.testing.assert_allclose(record.y_lgs, 1e-3 * Y, rtol=1e-12)
        np.testing.assert_allclose(record.u, 1e-3 * U, rtol=1e-12)
        assert record.origin == said
    else:
        with pytest.raises(RecordError, match=f"^{kind}: {said}"):
            read_record(io.BytesIO(parts_in(kind, parts)), kind, declaration=stated)


def with_comment(line: str) -> bytes:
    return table(f"{line}\ntime,{HEAD.replace('_nm', '')}", np.c_[1e-3 * STEPS, Y, U])


def with_attribute(name: str, value: Any, at: tuple[str, ...] = ("y_lgs", "u")) -> bytes:
    def fill(f: h5py.File) -> None:
        f["y_lgs"], f["u"], f["dt"] = Y, U, 1e-3
        for path in at:
            f[path].attrs[name] = value

    return hdf5(fill)


def with_metadata(name: str, of_fields: bool) -> bytes:
    columns = pa.table(dict(zip(COLUMNS, np.c_[Y, U].T, strict=True)))
    if of_fields:
        schema = pa.schema([field.with_metadata({name: "nm"}) for field in columns.schema], {"dt": "0.001"})
        return saved(lambda file: pq.write_table(columns.cast(schema), file))
    return saved(lambda file: pq.write_table(columns.replace_schema_metadata({name: "nm", "dt": "0.001"}), file))


SPELLINGS = ["unit", "Unit", "UNITS", "unit "]
ARRAYS = {"y_lgs": Y, "u": U, "dt": 1e-3}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *(("a.csv", with_comment(f"# {word}{sign} nm")) for word in SPELLINGS for sign in ":="),
        *(("a.h5", with_attribute(word, "nm")) for word in SPELLINGS),
        *(("a.h5", with_attribute("unit", value, at)) for value in (["nm"], ["nm", "nm"]) for at in (("y_lgs", "u"), ("/",))),
        ("a.h5", with_attribute("Units", np.array([b"nm", b"nm"]), ("/",))),
        *(("a.parquet", with_metadata(word, of_fields)) for word in SPELLINGS for of_fields in (True, False)),
        *((f"a{end}", save(unit=["nm", "nm"], **ARRAYS)) for end, save in ((".npz", npz), (".mat", matlab))),
    ],
)
def test_a_unit_in_any_spelling(name: str, content: bytes) -> None:
    record = read_record(io.BytesIO(content), name)
    np.testing.assert_allclose(record.y_lgs, 1e-3 * Y, rtol=1e-12)
    np.testing.assert_allclose(record.u, 1e-3 * U, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "content", "unit"),
    [
        ("a.csv", with_comment("# unit: nm\n# Units: um"), "nm and um"),
        ("a.csv", with_comment("# Units: furlong"), "furlong"),
        ("a.h5", with_attribute("units", ["nm", "um"]), "nm and um"),
        ("a.npz", npz(unit=["nm", "um"], **ARRAYS), "nm and um"),
        ("a.mat", matlab(units=["nm", "um"], **ARRAYS), "nm and um"),
        ("a.npz", npz(units="pixel", **ARRAYS), "pixel"),
    ],
)
def test_units_that_differ_or_are_none_are_refused_unless_one_is_stated(name: str, content: bytes, unit: str) -> None:
    with pytest.raises(RecordError, match=f"(y_lgs|u) is in '{unit}', which is no unit of a wavefront: state one of um, nm"):
        read_record(io.BytesIO(content), name)
    record = read_record(io.BytesIO(content), name, declaration=DeclaredFormat(unit="nm"))
    np.testing.assert_allclose(record.y_lgs, 1e-3 * Y, rtol=1e-12)


def with_rate(name: str, value: float, unit: str) -> bytes:
    def fill(f: h5py.File) -> None:
        f["y_lgs"], f["u"], f[name] = Y, U, value
        f[name].attrs["unit"] = unit

    return hdf5(fill)


@pytest.mark.parametrize(
    ("name", "value", "unit", "line"),
    [
        ("dt", 1, "ms", ""),
        ("dt", 1000.0, "us", ""),
        ("dt", 1e-3, "s", ""),
        ("rate", 1, "kHz", ""),
        ("frame_rate", 1000.0, "Hz", ""),
        ("dt", 1.0, "nm", "dt is in 'nm', which is no unit of time; it takes s, ms"),
        ("rate", 1.0, "ms", "rate is in 'ms', which is no unit of a rate; it takes Hz or kHz"),
    ],
)
def test_the_unit_of_a_step_or_a_rate(name: str, value: float, unit: str, line: str) -> None:
    content = io.BytesIO(with_rate(name, value, unit))
    if line:
        with pytest.raises(RecordError, match=line):
            read_record(content, "a.h5", declaration=DeclaredFormat(**NM))
    else:
        assert read_record(content, "a.h5", declaration=DeclaredFormat(**NM)).dt == pytest.approx(1e-3, rel=1e-12)


def test_a_matrix_makes_modes_of_what_has_no_unit() -> None:
    stated = DeclaredFormat(reconstructor=LoopMatrix("R", ((1e-3, 0.0), (0.0, 1e-3))), trust=True)
    content = npz(unit="pixel", **ARRAYS)
    record = read_record(io.BytesIO(content), "a.npz", declaration=replace(stated, open_loop=True))
    np.testing.assert_allclose(record.y_lgs, 1e-3 * Y, rtol=1e-12)
    with pytest.raises(RecordError, match="u is in 'pixel', which is no unit"):
        read_record(io.BytesIO(content), "a.npz", declaration=stated)


@pytest.mark.parametrize(
    ("line", "delay", "sign"),
    [("# Delay: 3", 3, 1), ("# delay : 3", 3, 1), ("# Command_Sign: -1", 2, -1), ("# DELAY: 1\n# command sign : -1", 1, -1)],
)
def test_delay_and_sign_in_any_spelling(line: str, delay: int, sign: int) -> None:
    record = read_record(io.BytesIO(with_comment(line)), "a.csv", declaration=DeclaredFormat(unit="nm", trust=True))
    assert record.delay == delay
    np.testing.assert_allclose(record.u, 1e-3 * sign * U, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("fields", [True, False])
def test_the_unit_of_a_table_is_not_that_of_its_clock(fields: bool) -> None:
    rows = np.c_[1e-3 * STEPS, Y, U]
    names = [f"loop.{x}" for x in "tabcd"] if fields else [f"loop[{i}]" for i in range(5)]

    def fill(f: h5py.File) -> None:
        f["loop"] = np.rec.fromarrays([*rows.T], names="t,a,b,c,d") if fields else rows
        f["loop"].attrs["unit"] = "nm"

    stated = DeclaredFormat(columns=dict(zip(("time", *COLUMNS), names, strict=True)))
    record = read_record(io.BytesIO(hdf5(fill)), "a.h5", declaration=stated)
    np.testing.assert_allclose(record.u, 1e-3 * U, rtol=1e-12)
    assert (record.dt, record.origin) == (0.001, "unit nm")


def rates_in(kind: str, stated: dict[str, dict[str, float]]) -> bytes:
    """Return a file whose root, LGS and NGS state a rate each, as attributes or keywords."""
    arrays = {"lgs": (Y, "Y_LGS"), "dm": (U, "U"), "ngs": (Y[::5], "SLOPES")}
    if kind == "a.h5":

        def fill(f: h5py.File) -> None:
            for group, (values, name) in arrays.items():
                f[f"{group}/{name.lower()}"] = values
            for group, numbers in stated.items():
                f[f"/{group}"].attrs.update(numbers)

        return hdf5(fill)
    hdus = {"": fits.PrimaryHDU()} | {group: fits.ImageHDU(values, name=name) for group, (values, name) in arrays.items()}
    for group, numbers in stated.items():
        hdus[group].header.update(numbers)
    return saved(fits.HDUList([*hdus.values()]).writeto)


@pytest.mark.slow
@pytest.mark.parametrize("key", ["DT", "RATE"])
@pytest.mark.parametrize("kind", ["a.h5", "a.fits"])
def test_the_rate_of_the_root_comes_first_and_others_must_agree(kind: str, key: str) -> None:
    fast, slow = ({key: x if key == "DT" else 1.0 / x} for x in (1e-3, 5e-3))
    way = DeclaredFormat(unit="nm", columns={"y_lgs": "lgs/y_lgs", "u": "dm/u"} if kind == "a.h5" else {})
    for stated in ({"": fast, "ngs": slow}, {"": fast, "lgs": slow, "ngs": slow}, {"lgs": fast}, {"lgs": fast, "ngs": fast}):
        assert read_record(io.BytesIO(rates_in(kind, stated)), kind, declaration=way).dt == 0.001
    for stated in ({"lgs": fast, "ngs": slow}, {"ngs": slow, "lgs": fast}):
        content = rates_in(kind, stated)
        with pytest.raises(RecordError, match=r"1000 Hz by .* and 200 Hz by .*: state one \(--rate, rate=\)"):
            read_record(io.BytesIO(content), kind, declaration=way)
        assert read_record(io.BytesIO(content), kind, declaration=replace(way, rate=1000.0)).dt == 0.001


def test_a_folder_of_arrays_on_the_command_line(tmp_path: Path) -> None:
    """Which column is what by --column, or by a table of a settings file."""
    (tmp_path / "night").mkdir()
    np.save(tmp_path / "night" / "slopes.npy", Y)
    np.save(tmp_path / "night" / "commands.npy", U)
    (tmp_path / "f.toml").write_text('preset = "ut4"\n[columns]\ny_lgs = "slopes"\nu = "commands"\n')
    words = ["convert", str(tmp_path / "night"), str(tmp_path / "out.h5"), "--unit", "nm", "--rate", "1000"]
    for given in (["--column", "y_lgs=slopes", "--column", "u=commands"], ["--config", str(tmp_path / "f.toml")]):
        done = CliRunner().invoke(main, [*words, *given])
        assert done.exit_code == 0 and "has no place" not in done.output, done.output
        np.testing.assert_allclose(wfsobs.load(tmp_path / "out.h5").y_lgs, 1e-3 * Y, rtol=1e-12)
        (tmp_path / "out.h5").unlink()
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 2 and "as its names suggest: --column 'u=commands' --column 'y_lgs=slopes'" in done.output
    assert done.output.startswith(f"wfsobs: {tmp_path / 'night'}: has no y_lgs")
    assert not (tmp_path / "out.h5").exists()
    (tmp_path / "night" / "slopes.npy").rename(tmp_path / "night" / "primary.npy")
    done = CliRunner().invoke(main, words)
    assert "suggest: --column 'u=commands'; which of its columns is what? It has primary\n" in done.output, (
        "arrays, not their columns"
    )


# ---------------------------------------------------------------------- what the loop is


@pytest.mark.parametrize("delay", [1.0, 1.5, 2.0, 2.4])
@pytest.mark.parametrize("gain", [1.0, (1.2, 0.8)])
@pytest.mark.parametrize("rail", [None, 12.0])
def test_the_loop_as_stated_gives_what_no_mirror_has_touched(tmp_path: Path, delay: float, gain: Any, rail: float | None) -> None:
    """But for the frames whose commands came before the record."""
    y, u, z = loop(delay, np.asarray(gain), rail or np.inf)
    np.savez(tmp_path / "a.npz", y_lgs=y, u=u, dt=1e-3, unit="nm", delay=delay)
    record = wfsobs.load(tmp_path / "a.npz", command_gain=gain, rail=rail)
    np.testing.assert_allclose(1e3 * record.z[4:], z[4:], rtol=0, atol=1e-9)
    assert record.delay == int(delay) and ("delay" in record.origin) == (delay % 1 > 0)


def test_a_stated_delay_comes_before_that_of_the_file_where_it_is_trusted(tmp_path: Path) -> None:
    y, u, z = loop(1.5)
    np.savez(tmp_path / "a.npz", y_lgs=y, u=u, dt=1e-3, unit="nm", delay=2, command_sign=-1)
    with pytest.raises(RecordError, match=r"delay is 2, but 1\.5 is stated; --trust takes that"):
        wfsobs.load(tmp_path / "a.npz", command_delay=1.5)
    record = wfsobs.load(tmp_path / "a.npz", command_delay=1.5, command_sign=1, trust=True)
    np.testing.assert_allclose(1e3 * record.z[4:], z[4:], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["a.npz", "a.fits", "a.mat"])
def test_what_is_no_part_of_a_record_has_no_room_where_it_is_large(name: str, tmp_path: Path) -> None:
    pixels = np.zeros((len(Z), 50, 50), np.uint8)
    if name == "a.fits":
        images = [fits.ImageHDU(x, name=key) for key, x in (("y_lgs", Z), ("u", U), ("pixels", pixels))]
        fits.HDUList([fits.PrimaryHDU(), *images]).writeto(tmp_path / name)
    elif name == "a.mat":
        scipy.io.savemat(tmp_path / name, {"y_lgs": Z, "u": U, "pixels": pixels})
    else:
        np.savez(tmp_path / name, y_lgs=Z, u=U, pixels=pixels)
    content = (tmp_path / name).read_bytes()
    found = read_columns(io.BytesIO(content), name, 2 * pixels.size)
    np.testing.assert_array_equal(found.arrays["y_lgs"], Z)
    assert not any("pixels" in column.lower() for column in found.columns)


def test_open_loop_needs_no_commands(tmp_path: Path) -> None:
    for arrays in ({}, {"u": U}):
        np.savez(tmp_path / "a.npz", y_lgs=Z, dt=1e-3, unit="nm", **arrays)
        record = wfsobs.load(tmp_path / "a.npz", open_loop=True)
        np.testing.assert_allclose(1e3 * record.z, Z, rtol=1e-12)
        assert record.origin == f"unit nm, open loop{', u not used' * bool(arrays)}"
    for gain in ([1.0, 1.0, 1.0], 1e300, 0.0, np.nan):
        with pytest.raises(RecordError, match=r"a command gain takes a number from 1e-9 to 1e9, or 2, one per mode"):
            wfsobs.load(tmp_path / "a.npz", command_gain=gain)


def test_a_rail_below_every_command_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", y_lgs=Z, u=np.where(Z < 0, -250.0, 125.0), dt=1e-3, unit="nm")
    assert "commands beyond the rail of 200" in wfsobs.load(tmp_path / "a.npz", rail=200.0, trust=True).origin
    with pytest.raises(RecordError, match=r"rail = 100 is below every command; the largest is 250, in their unit$"):
        wfsobs.load(tmp_path / "a.npz", rail=100.0)


# ---------------------------------------------------------------------- what is refused


def referring(f: h5py.File) -> None:
    f["u"] = U
    f.create_dataset("y_lgs", (2,), dtype=h5py.ref_dtype)


def linked(link: Any) -> Callable[[h5py.File], None]:
    def fill(f: h5py.File) -> None:
        f["u"], f["y_lgs"] = U, link

    return fill


def outside(f: h5py.File) -> None:
    f.create_dataset("y_lgs", (N, 2), dtype="f8", external=[("/etc/passwd", 0, 16 * N)])


def virtual(f: h5py.File) -> None:
    layout = h5py.VirtualLayout(shape=(N, 2), dtype="f8")
    layout[:] = h5py.VirtualSource("other.h5", "y", shape=(N, 2))
    f.create_virtual_dataset("y_lgs", layout)


def endless(f: h5py.File) -> None:
    f.create_group("a")["again"] = f["/"]


def bomb() -> bytes:
    """A MATLAB file whose packed part says that it is of 200 MB, and is."""
    packed = zlib.compress(struct.pack("<II", 14, 200_000_000) + bytes(200_000_000), 9)
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(packed)) + packed


CELLS = np.empty(2, dtype=object)
CELLS[:] = [Y, U]


def packed_images(file: io.BytesIO) -> None:
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(Y, name="Y_LGS"), fits.CompImageHDU(U, name="U")]).writeto(file)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("a.mat", matlab(y_lgs=CELLS, u=U), "y_lgs is a MATLAB cell, which is not read"),
        ("a.mat", hdf5(as_matlab_73("y_ngs", SIZES, **NOTHING), 512), "y_ngs is empty"),
        (
            "a.mat",
            hdf5(as_matlab_73("flux", Y.T), 512),
            "has no y_lgs; a record needs y_lgs, u and dt; as its names suggest: --column "
            "'u=loop.dm.cmd' --column 'y_lgs=loop.wfs.slopes'",
        ),
        ("a.mat", matlab(y_lgs=np.rec.fromarrays([[1, 2]], names="a"), u=U), "y_lgs is a MATLAB struct, which is not read"),
        ("a.mat", b"MATLAB 5.0 MAT-file" + bytes(9), "damaged, or not a MATLAB file"),
        ("a.h5", hdf5(referring), "y_lgs holds objects or references, not numbers"),
        ("a.h5", hdf5(linked(h5py.ExternalLink("other.h5", "/y"))), "y_lgs is a link, which is not followed"),
        ("a.h5", hdf5(linked(h5py.SoftLink("/u"))), "y_lgs is a link, which is not followed"),
        ("a.h5", hdf5(outside), "y_lgs lies in another file, which is not opened"),
        ("a.h5", hdf5(virtual), "y_lgs lies in another file, which is not opened"),
        ("a.h5", hdf5(endless), "has more than 1000 groups and arrays"),
        ("a.h5", b"no", "damaged, or not an HDF5 file"),
        ("a.sav", b"SR\x00\x04", "damaged, or not a save file of IDL"),
        ("a.sav", b"no", "damaged, or not a save file of IDL"),
        ("a.parquet", b"PAR1", "damaged, or not a Parquet file"),
        ("a.parquet", parquet(y_lgs=[{"a": 1}]), "y_lgs holds struct<a: int64>, not numbers"),
        (
            "a.parquet",
            parquet(y_lgs=[[1.0], None, [2.0, 3.0, 4.0]]),
            "y_lgs holds lists of 1 to 3 numbers; it takes lists of one",
        ),
        ("a.parquet", parquet(y_lgs=[["a"]]), "y_lgs holds list<element: string>, not numbers"),
        ("a.parquet", parquet(y_ngs=pa.array([None, None], pa.list_(pa.float64()))), "y_ngs is empty"),
        ("a.fits", saved(packed_images), "Y_LGS is a compressed image, which is not read: unpack it, as funpack does"),
        ("a.npy", saved(lambda file: np.save(file, CELLS, allow_pickle=True)), "damaged, or holds more than plain arrays"),
    ],
)
def test_what_is_refused_in_a_line(name: str, content: bytes, line: str) -> None:
    with pytest.raises(RecordError) as caught:
        read_record(io.BytesIO(content), name)
    assert str(caught.value).startswith(f"{name}: {line}") and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.mat", saved(lambda file: scipy.io.savemat(file, {"s": {"y": Y[:40], "c": "x"}, "fs": 1000}))),
        ("a.sav", sav(y_lgs=Y[:60], u=U[:60])),
        ("a.npy", array("fields")),
        ("a.parquet", parquet(y=Y[:50].tolist(), time=STAMPS[:50])),
    ],
)
def test_a_damaged_file_is_read_or_refused(name: str, content: bytes) -> None:
    """Whatever becomes of its bytes; libraries may end the process at some."""
    rng = np.random.default_rng(6)
    for _ in range(100):
        data = bytearray(content)
        for place in rng.integers(0, min(len(data), 4000), size=rng.integers(1, 5)):
            data[place] = rng.integers(256)
        with suppress(RecordError):
            read_columns(io.BytesIO(bytes(data)), name)


def packed_sav() -> bytes:
    content = zlib.compress(bytes(200_000_000), 9)
    return b"SR\x00\x06" + struct.pack(">iIIi", 2, 20 + len(content), 0, 0) + content


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.mat", bomb()),
        ("a.sav", packed_sav()),
        ("a.h5", hdf5(lambda f: f.create_dataset("y", (30_000_000,), dtype="f8", compression="gzip"))),
        ("a.h5", hdf5(lambda f: f.create_dataset("y", (1,), "f8", maxshape=(None,), chunks=(30_000_000,), compression="gzip"))),
        ("a.parquet", parquet(y=np.zeros(8_000_000))),
        ("a.npy", saved(lambda file: np.save(file, np.zeros(8_000_000)))),
    ],
)
def test_sizes_are_known_before_anything_grows(name: str, content: bytes) -> None:
    """Of 60 MB at most where more would be unpacked."""
    with pytest.raises(TooLargeError):
        read_columns(io.BytesIO(content), name, 60_000_000)


# ---------------------------------------------------------------------- from one format to another


def of_everything() -> Record:
    y, y_ngs = Y.copy(), np.full((N, 2), np.nan)
    y[17], y[40, 1] = np.nan, np.nan
    y_ngs[5::5] = Y[5::5]
    y_ngs[25] = np.nan
    stars = RNG.standard_normal((N, 3, 2))
    training = Training(Y[:50], U[:50], Z[:50])
    truth = {"turbulence": 0.9 * Z, "vibration": 0.1 * Z, "open_loop_y": Z}
    apart = {"lgs_stars": np.full(N, 3), "y_stars": stars}
    return Record(y, U, 1 / 997, y_ngs, 5, delay=3, training=training, origin="unit µm", **truth, **apart)


NO_PLACE = {
    ".aot.fits": {"turbulence", "vibration", "open_loop_y", "training", "lgs_stars", "y_stars"},
    ".csv": {"lgs_stars", "y_stars"},
    ".fits": {"lgs_stars", "y_stars"},
    ".parquet": {"lgs_stars", "y_stars"},
}


@pytest.mark.slow
@pytest.mark.parametrize("ending", [fmt.endings[0] for fmt in FORMATS if fmt.write])
def test_what_is_converted_is_what_it_was(tmp_path: Path, ending: str) -> None:
    """Or what has no place is named; no temporary file is left."""
    record = of_everything()
    wfsobs.save(tmp_path / "a.npz", record)
    assert name_differences(record, wfsobs.load(tmp_path / "a.npz", trust=True)) == []
    out = tmp_path / f"b{ending}"
    done = CliRunner().invoke(main, ["convert", str(tmp_path / "a.npz"), str(out), "--trust"])
    assert done.exit_code == 0, done.output
    again = wfsobs.load(out, trust=True)
    lost = NO_PLACE.get(ending, set())
    assert set(name_differences(record, again)) == lost
    line = re.search(r"wfsobs: (.*: has no place for .*)", done.output)
    assert (line is not None) == bool(lost)
    with pytest.warns(UserWarning, match=f"^{re.escape(line[1])}$") if line else nullcontext():
        wfsobs.save(out, record)
    assert again.origin == ("unit ?m" if ".fits" in ending else "unit µm") and {path.name for path in tmp_path.iterdir()} == {
        "a.npz",
        f"b{ending}",
    }


def test_what_is_missing_is_said_and_stays_missing(tmp_path: Path) -> None:
    y = np.random.default_rng(1).standard_normal((300, 2))
    y[7] = np.nan
    wfsobs.save(tmp_path / "gap.npz", Record(y, np.zeros_like(y), 1e-3))
    done = CliRunner().invoke(main, ["convert", str(tmp_path / "gap.npz"), str(tmp_path / "gap.csv")])
    assert done.stderr == f"wfsobs: {tmp_path / 'gap.npz'}: 1 of 300 frames are missing\n"
    np.testing.assert_array_equal(wfsobs.load(tmp_path / "gap.csv").y_lgs, y)


def test_formats_that_are_only_read(tmp_path: Path) -> None:
    for ending in (".npy", ".sav"):
        with pytest.raises(RecordError, match=r"its name ends in none of \.npz, ((?!\.npy|\.sav).)*\.pq$"):
            wfsobs.save(tmp_path / f"a{ending}", Record(Y, U, 1e-3))
    assert not [*tmp_path.iterdir()]
