"""The preview of a file from a stranger: its numbers where it is a record, one line where it is anything else."""

from __future__ import annotations

import gzip
import io
import struct
import tracemalloc
import zipfile
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from astropy.io import fits

from wfsobs.progress import Cancelled, Watch
from wfsobs.record import RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import paper
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry import preview as module
from wfsobs.telemetry.formats import FORMATS, format_of, npz
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.preview import MOST_FILE, preview
from wfsobs.telemetry.records import read_record, record_arrays

ENDINGS = [fmt.endings[0] for fmt in FORMATS if fmt.write]
RECORD = replace(simulate(paper().replace({"run.duration": 1.5, "turbulence.rms": 0.01})), training=None)


def content(ending: str, record=RECORD) -> bytes:
    file = io.BytesIO()
    format_of(ending).write(file, record_arrays(record))
    return file.getvalue()


CONTENT = {ending: content(ending) for ending in ENDINGS}


@pytest.mark.slow
@pytest.mark.parametrize("ending", ENDINGS)
def test_the_numbers_of_a_record(ending: str) -> None:
    found = preview(CONTENT[ending], f"night{ending}")
    assert (found.rate, found.duration, found.record.missing) == (pytest.approx(1000.0), pytest.approx(1.5), 0)
    assert found.rms["y_lgs"] == pytest.approx(np.sqrt(np.mean(RECORD.y_lgs**2, axis=0)))
    assert found.rms["z"] == pytest.approx(np.sqrt(np.mean(RECORD.z[RECORD.delay :] ** 2, axis=0)))
    assert found.lines()[0] == "1500 steps at 1000 Hz, 1.5 s, 0 missing"
    assert found.lines()[3] == "NGS: 200 Hz, 0 frames missing"


def test_the_spectrum_of_a_tone() -> None:
    """40 Hz of 1 and 2 nm amplitude: half its square as variance, all of it within a Hann window's width."""
    tone = 1e-3 * np.outer(np.cos(2 * np.pi * 40.0 * 1e-3 * np.arange(4000)), [1.0, 2.0])
    data = {"y_lgs": tone * 1e6, "u": np.zeros((4000, 2)), "dt": 1e-3, "unit": "nm"}
    file = io.BytesIO()
    np.savez(file, **data)
    found = preview(file.getvalue(), "a.npz")
    near = np.abs(found.frequency - 40.0) < 1.5
    power = found.spectrum[near].sum(axis=0) * found.frequency[1]
    np.testing.assert_allclose(power, [0.5, 2.0], rtol=1e-3)
    np.testing.assert_allclose(found.rms["y_lgs"], np.sqrt([0.5, 2.0]), rtol=1e-6)


def test_what_is_stated_and_what_is_missing() -> None:
    y, ngs = RECORD.y_lgs.copy(), RECORD.y_ngs.copy()
    y[100:110], ngs[20] = np.nan, np.nan
    found = preview(
        content(".csv", replace(RECORD, y_lgs=y, y_ngs=ngs, turbulence=None, vibration=None)),
        "a.csv",
        Scenario().replace({"telescope.diameter": 10.0}),
        DeclaredFormat(command_delay=2),
    )
    assert found.lines() == [
        "1500 steps at 1000 Hz, 1.5 s, 10 missing",
        "2 modes, in um rms",
        "a command is seen 2 steps later",
        "NGS: 200 Hz, 1 frames missing",
        "truth: none, scored by prediction of the next measurement",
    ]
    assert np.isfinite(found.spectrum).all()


def refused(data: bytes, name: str) -> str:
    """The one line by which it is refused; nothing else may come of it."""
    with pytest.raises(RecordError) as caught:
        preview(data, name)
    line = str(caught.value)
    assert "\n" not in line and len(line) < 400
    return line


@pytest.mark.slow
@pytest.mark.parametrize("ending", ENDINGS)
def test_cut_anywhere(ending: str) -> None:
    whole = CONTENT[ending]
    for length in (0, 1, 9, 100, 2880, len(whole) // 3, len(whole) - 3000):
        if ending == ".csv" and length > 3000:
            length = whole.index(b"\n", length) - 30  # within a row
        assert refused(whole[:length], f"cut{ending}").startswith(f"cut{ending}: ")


@pytest.mark.slow
@pytest.mark.parametrize("ending", ENDINGS)
def test_the_wrong_kind(ending: str) -> None:
    for other, data in (*CONTENT.items(), ("", b"\x89PNG\r\n\x1a\n" + bytes(range(256)))):
        if other.rpartition(".")[2] != ending.rpartition(".")[2] and (ending, other) != (".mat", ".h5"):
            refused(data, f"a{ending}")
    assert "its name ends in none of .npz" in refused(CONTENT[ending], "a.exe")


@pytest.mark.slow
@pytest.mark.parametrize("ending", ENDINGS)
def test_any_byte_changed(ending: str) -> None:
    """Read or refused: no other error, whatever becomes of a byte."""
    rng = np.random.default_rng(3)
    small = content(
        ending,
        replace(
            RECORD, **{k: getattr(RECORD, k)[:60] for k in ("y_lgs", "u", "y_ngs", "turbulence", "vibration", "open_loop_y")}
        ),
    )
    for _ in range(12 if ending == ".aot.fits" else 60):
        data = bytearray(small)
        for place in rng.integers(0, min(len(data), 12_000), size=rng.integers(1, 6)):
            data[place] = rng.integers(256)
        with suppress(RecordError):
            read_record(io.BytesIO(bytes(data)), f"a{ending}")


def test_names_are_never_opened(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret.csv").write_text("y_lgs/tip_um,u/tip_um\n1,2\n")
    for name in ("secret.csv", str(tmp_path / "secret.csv"), "../secret.csv", "a\0b.csv", "http://localhost/x.csv", "", ".csv"):
        line = refused(b"", name)
        assert "/" not in line.partition(":")[0] and "\0" not in line
    assert "<script>" not in refused(b"", "<script>.csv")


# ---------------------------------------------------------------------- bombs


def zipped(members: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return file.getvalue()


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array(file, array, allow_pickle=True)
    return file.getvalue()


def test_a_zip_bomb_is_not_unpacked(monkeypatch) -> None:
    bomb = zipped({"y_lgs.npy": npy(np.zeros((2_000_000, 2))), "u.npy": npy(np.zeros((2, 2)))})
    assert len(bomb) < 100_000
    monkeypatch.setattr(module, "MOST_NUMBERS", 10_000_000)
    tracemalloc.start()
    try:
        assert "holds more than 10 MB of numbers" in refused(bomb, "bomb.npz")
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()


def test_a_gzip_bomb_and_a_damaged_file(monkeypatch) -> None:
    monkeypatch.setattr(module, "MOST_NUMBERS", 10_000_000)
    bomb = gzip.compress(bytes(32_000_000))
    tracemalloc.start()
    try:
        assert "holds more than 10 MB" in refused(bomb, "bomb.csv.gz")
        assert tracemalloc.get_traced_memory()[1] < 40_000_000, "a few times what is allowed"
    finally:
        tracemalloc.stop()
    packed = gzip.compress(b"y_lgs,u\n" + b"0.5,0.25\n" * 2000)
    assert "cannot be unpacked" in refused(packed[:-20], "cut.csv.gz")
    assert "cannot be unpacked" in refused(b"y_lgs,u\n0.5,0.25\n", "no.csv.GZ")


def test_zeros_that_no_measurement_packs_like_are_not_unpacked(monkeypatch) -> None:
    bomb = zipped({"y_lgs.npy": npy(np.zeros((2_000_000, 2))), "u.npy": npy(np.zeros((2, 2)))})
    monkeypatch.setattr(npz, "LARGE", 10_000_000)
    tracemalloc.start()
    try:
        with pytest.raises(RecordError, match=r"^bomb\.npz: unpacks from 0\.\d+ to 32 MB, as no measurements do$"):
            read_record(io.BytesIO(bomb), "bomb.npz")
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", ["bytes.npz", "bytes.npy", "bytes.fits"])
def test_small_numbers_count_as_many_bytes_as_they_take(monkeypatch, name: str) -> None:
    y = np.random.default_rng(0).integers(0, 99, (200_000, 2)).astype(np.uint8)
    data = {"npz": zipped({"y_lgs.npy": npy(y)}), "npy": npy(y), "fits": fits_of(fits.ImageHDU(y, name="Y_LGS"))}
    monkeypatch.setattr(module, "MOST_NUMBERS", 8 * y.size - 1)
    assert "holds more than" in refused(data[name.partition(".")[2]], name)


def test_steps_are_checked_before_the_record_is_made(monkeypatch) -> None:
    def check_steps(n: int) -> None:
        raise ValueError(f"{n} steps")

    monkeypatch.setattr(module, "to_record", lambda *_: pytest.fail("it was made"))
    with pytest.raises(ValueError, match=f"^{RECORD.n_steps} steps$"):
        preview(CONTENT[".npz"], "a.npz", check_steps=check_steps)
    with pytest.raises(Cancelled):
        preview(CONTENT[".npz"], "a.npz", watch=Watch(is_cancelled=lambda: True))


def test_a_zip_that_lies_about_its_size(monkeypatch) -> None:
    """The directory says 1000 bytes where 32 MB come out."""
    honest = zipped({"y_lgs.npy": npy(np.zeros((2_000_000, 2)))})
    with zipfile.ZipFile(io.BytesIO(honest)) as archive:
        size = archive.infolist()[0].file_size
    lying = honest.replace(struct.pack("<L", size), struct.pack("<L", 1000))
    assert lying != honest
    monkeypatch.setattr(module, "MOST_NUMBERS", 10_000_000)
    tracemalloc.start()
    try:
        assert "damaged" in refused(lying, "bomb.npz")
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()


def test_a_header_that_lies_about_its_shape() -> None:
    y = npy(np.zeros((10, 2)))
    for shape in (b"(10000000000, 2)", b"(-10, 2)", b"(10, 9)"):
        old = b"(10, 2), }" + b" " * 20
        changed = y.replace(old, (shape + b", }").ljust(len(old)))
        assert changed != y
        refused(zipped({"y_lgs.npy": changed, "u.npy": y, "dt.npy": npy(np.array(1e-3))}), "a.npz")


def test_objects_are_not_unpickled() -> None:
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("the file was unpickled",))

    trap = npy(np.array([[Trap()]], dtype=object))
    y = npy(np.zeros((10, 2)))
    assert "more than plain arrays" in refused(zipped({"y_lgs.npy": trap, "u.npy": y, "dt.npy": npy(np.array(1.0))}), "a.npz")
    # of a name that is not read it stays where it is
    data = zipped({"x.npy": trap, "y_lgs.npy": y, "u.npy": y, "dt.npy": npy(np.array(1.0))})
    assert preview(data, "a.npz").record.n_steps == 10


def test_a_huge_table(monkeypatch) -> None:
    table = b"y_lgs/tip_um,u/tip_um\n" + b"1,2\n" * 200_000
    monkeypatch.setattr(module, "MOST_NUMBERS", 1_000_000)
    assert "holds more than 1 MB of numbers" in refused(table, "a.csv")
    assert "65536 bytes" in refused(b"," * 100_000, "a.csv")
    assert f"at most {MOST_FILE / 1e6:.0f} MB are taken" in refused(bytes(MOST_FILE + 1), "a.csv")


@pytest.mark.parametrize("data", [b"y_lgs/tip_um\xff\x80\n", b"a,b\n\x00,1\n"])
def test_a_table_that_is_not_text(data: bytes) -> None:
    assert "is not text" in refused(data, "a.csv")


def fits_of(*hdus) -> bytes:
    file = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(file)
    return file.getvalue()


def test_fits_of_all_kinds() -> None:
    """Images and tables in one file, NaN, and parts that mean nothing."""
    y = np.linspace(-1.0, 1.0, 40).reshape(20, 2).astype("<f4")
    y[3] = np.nan
    commands = fits.BinTableHDU.from_columns(
        [fits.Column("U", "2E", unit="nm", array=1000 * np.ones((20, 2))), fits.Column("NOTE", "4A", array=["abcd"] * 20)]
    )
    image = fits.ImageHDU(y, name="y_lgs")
    image.header["BUNIT"] = "micron"
    commands.header["DT"] = 0.002
    found = preview(fits_of(image, commands, fits.ImageHDU(np.zeros((3, 3)), name="DARK")), "a.fits")
    np.testing.assert_array_equal(found.record.y_lgs, y)
    np.testing.assert_array_equal(found.record.u, 1.0)
    assert (found.record.missing, found.rate) == (1, 500.0)


def test_fits_that_lies_about_its_size(monkeypatch) -> None:
    image = fits.ImageHDU(np.zeros((20, 2)), name="Y_LGS")
    whole = fits_of(image)
    for rows in (b"2000000000", b"        -5"):
        changed = whole.replace(b"NAXIS2  =                   20", b"NAXIS2  =           " + rows)
        assert changed != whole
        refused(changed, "a.fits")
    compressed = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(np.zeros((20, 2)), name="Y_LGS")]).writeto(compressed)
    assert "Y_LGS is a compressed image, which is not read" in refused(compressed.getvalue(), "a.fits")
    assert "compressed one" in refused(b"\x1f\x8b" + whole, "a.fits")
    monkeypatch.setattr(module, "MOST_NUMBERS", 100)
    assert "holds more than" in refused(whole, "a.fits")


def test_lists_that_share_a_heap() -> None:
    """A thousand rows that all point at the same megabyte."""
    heap = np.zeros(1000)
    column = fits.Column("TIMESTAMPS", "PD()", array=np.array([heap, *[heap[:1]] * 999], dtype=object))
    table = fits.BinTableHDU.from_columns([column], name="AOT_TIME")
    data = bytearray(fits_of(table))
    start = data.index(struct.pack(">ll", 1000, 0))
    data[start : start + 8000] = struct.pack(">ll", 1000, 0) * 1000
    data = bytes(data).replace(b"EXTEND  =                    T", b"AOT-VERS= 'v2.0.0  '          ", 1)
    with pytest.raises(RecordError, match="holds more than"):
        read_record(io.BytesIO(data), "a.fits", most=1_000_000)


def test_aot_opens_nothing_else(tmp_path, monkeypatch) -> None:
    """An AOT file may name other files and addresses; none is opened."""
    import aotpy

    monkeypatch.chdir(tmp_path)
    fits.PrimaryHDU(np.zeros((20, 1, 2))).writeto("outside.fits")
    telescope, star = aotpy.MainTelescope(uid="T"), aotpy.NaturalGuideStar(uid="S")
    for outside in (aotpy.FITSFileImage("outside.fits"), aotpy.FITSURLImage.__new__(aotpy.FITSURLImage)):
        if isinstance(outside, aotpy.FITSURLImage):
            outside.url, outside.index = "http://127.0.0.1:9/x.fits", None
            outside.data, outside.unit = np.zeros((20, 1, 2)), None
        outside.time, outside.metadata, outside.name = None, [], "OUT"
        sensor = aotpy.ShackHartmann(uid="W", source=star, n_valid_subapertures=1, measurements=outside)
        mirror = aotpy.TipTiltMirror(uid="M", telescope=telescope)
        loop = aotpy.ControlLoop(uid="L", commanded_corrector=mirror, input_sensor=sensor, framerate=1000.0)
        file = io.BytesIO()
        aotpy.AOTFITSWriter(
            aotpy.AOSystem(
                ao_mode="SCAO",
                main_telescope=telescope,
                sources=[star],
                wavefront_sensors=[sensor],
                wavefront_correctors=[mirror],
                loops=[loop],
            )
        ).get_hdulist().writeto(file)
        with monkeypatch.context() as patch:
            opened: list[object] = []
            patch.setattr("aotpy.io.fits._file.fits.open", partial(noted, opened, fits.open))
            assert "disallow" in refused(file.getvalue(), "a.fits")
        assert opened and all(isinstance(what, io.BytesIO) for what in opened)


def noted(opened: list[object], function, what, *args, **kwargs):
    opened.append(what)
    return function(what, *args, **kwargs)


def test_units_that_the_size_of_z_leaves_open() -> None:
    """An arcsec is 4.848 urad, on 8 m 9.696 um of tip: numbers of 0.1 may be um or arcsec, and 1 um is 0.103 arcsec."""
    rng = np.random.default_rng(1)
    y = 0.1 * rng.standard_normal((2000, 2))
    file = io.BytesIO()
    np.savez(file, y_lgs=y, u=np.zeros_like(y), dt=np.array(1e-3))
    reading = preview(file.getvalue(), "a.npz").reading
    assert set(reading.units) == {"um", "arcsec"} and reading.response is None
    assert reading.units["arcsec"] == pytest.approx(9.696 * reading.units["um"], rel=1e-3)
    assert reading.units["um"] == pytest.approx(0.1, rel=0.05), "to the scatter of 2000 samples"
    assert reading.lines()[0] == "sign and delay: too few steps, or commands that do not move"
    assert reading.lines()[1].startswith("unit undecided: the numbers are plausible as um (")
    stated = preview(file.getvalue(), "a.npz", declaration=DeclaredFormat(unit="nm")).reading
    assert stated.units == {}
