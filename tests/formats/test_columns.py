"""Files whose columns have names of their own: what each is said to be, or what its name suggests."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from wfsobs.cli import main
from wfsobs.record import RecordError
from wfsobs.telemetry.columns import suggest_clock, suggest_roles
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.preview import ColumnsPreview, preview_any
from wfsobs.telemetry.records import read_columns, read_record

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
    assert record.dt == pytest.approx(0.002, rel=1e-9) and record.origin == "unit nm"


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
    fits = pytest.importorskip("astropy.io.fits")
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
            "a.csv: 'y_lgs/tipp' is no part of a record; a column is one of time, y_lgs/tip, y_lgs/tilt, u/",
        ),
        ({"y_lgs/tip": "wfs z"}, r"a.csv: has no column 'wfs z'; it has t \[ms\], wfs x \[nm\], wfs y \[nm\], cmd x"),
        ({"y_lgs/tip": NAMES[1]}, "a.csv: has no u; a record needs y_lgs, u and dt"),
        ({"y_lgs/tip": NAMES[1], "u/tilt": NAMES[4], "time": NAMES[0]}, "a.csv: u has the modes tilt; y_lgs has tip"),
    ],
)
def test_what_cannot_be(roles: dict[str, str], line: str) -> None:
    with pytest.raises(RecordError, match=line):
        read_record(io.BytesIO(text()), "a.csv", declaration=DeclaredFormat(columns=roles))


def test_names_that_suggest_nothing() -> None:
    assert suggest_roles(["a", "b", "column 1", "", "x"]) == {}


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
