"""What is written comes back as it was, in every format and either byte order."""

from __future__ import annotations

import gzip
import io
import re
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import wfsobs
from wfsobs.record import Record, RecordError, Training
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import paper
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.formats import FORMATS, format_of
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.records import load_record, name_differences, read_record, record_arrays, save_record
from wfsobs.units import micrometres_per

AOT = ".aot.fits"
ENDINGS = [fmt.endings[0] for fmt in FORMATS if fmt.write]
NOT_IN_AOT = ("turbulence", "vibration", "open_loop_y", "training")

NUMBERS = st.floats(-1e3, 1e3, allow_subnormal=False) | st.just(float("nan"))
FINITE = st.floats(-1e12, 1e12, allow_subnormal=False)


@st.composite
def records(draw) -> Record:
    """Any record that the checks let through: gaps, one mode or two, with and without each optional part."""
    n, modes = draw(st.integers(2, 9)), draw(st.integers(1, 2))

    def signal(elements=NUMBERS, rows: int = n):
        return draw(arrays(np.float64, (rows, modes), elements=elements))

    def maybe(make):
        return make() if draw(st.booleans()) else None

    y, u = signal(), signal()
    y[0], u[0] = draw(st.floats(-1.0, 1.0)), draw(st.floats(-1.0, 1.0))  # of every mode one measurement and command at least
    ratio = draw(st.integers(1, 5))
    y_ngs = maybe(signal)
    if y_ngs is not None:
        steps = np.arange(n)
        y_ngs[(steps % ratio != 0) | (steps < ratio) | np.isnan(y_ngs).any(axis=1)] = np.nan
    rows = draw(st.integers(1, 12))
    training = maybe(lambda: Training(signal(FINITE, rows), signal(FINITE, rows), maybe(lambda: signal(FINITE, rows))))
    return Record(
        y,
        u,
        draw(st.floats(1e-5, 1.0)),
        y_ngs,
        None if y_ngs is None else ratio,
        turbulence=maybe(signal),
        vibration=maybe(signal),
        open_loop_y=maybe(signal),
        training=training,
        delay=draw(st.integers(1, 7)),
        origin=draw(st.sampled_from(["", "unit nm, command sign -1"])),
    )


def same(a: Record, b: Record, leave: tuple[str, ...] = ()) -> None:
    for field in fields(a):
        mine, other = getattr(a, field.name), getattr(b, field.name)
        if field.name == "gate":  # of the settings that it is read with, not of the file
            assert other == Scenario().gate
        elif field.name in leave:
            assert other is None
        elif field.name == "training" and mine is not None:
            for part in fields(mine):
                np.testing.assert_array_equal(getattr(other, part.name), getattr(mine, part.name))
        elif isinstance(mine, np.ndarray):
            np.testing.assert_array_equal(other, mine)
            assert other.dtype == np.float64 and other.dtype.isnative
        else:
            assert (other, type(other)) == (mine, type(mine)), field.name


def written(record: Record, ending: str) -> io.BytesIO:
    file = io.BytesIO()
    format_of(ending).write(file, record_arrays(record, "[run]\nseed = 1"))
    file.seek(0)
    return file


@pytest.mark.slow
@pytest.mark.parametrize(
    "ending", [pytest.param(e, marks=pytest.mark.slow) if e == ".h5" else e for e in ENDINGS if e != AOT]
)  # a process for every file of HDF5
@settings(max_examples=25, deadline=None)
@given(record=records())
@example(record=Record(np.zeros((2, 1)), np.zeros((2, 1)), 5.5734074831433874e-05))  # of 17 digits
def test_every_record_comes_back(ending: str, record: Record) -> None:
    same(record, read_record(written(record, ending), f"r{ending}"))


@pytest.mark.slow
@settings(max_examples=6, deadline=None)  # aotpy takes a tenth of a second
@given(record=records())
@example(record=Record(np.zeros((2, 1)), np.zeros((2, 1)), 5.5734074831433874e-05))  # of 17 digits
def test_what_aot_has_a_place_for_comes_back(record: Record) -> None:
    same(record, read_record(written(record, AOT), f"r{AOT}"), NOT_IN_AOT)


@pytest.mark.parametrize("ending", [".npz", ".csv", ".fits", AOT])
def test_a_simulated_record_comes_back_through_a_file(ending: str, tmp_path) -> None:
    record = simulate(paper().replace({"run.duration": 1.5}))
    save_record(tmp_path / f"r{ending}", record, "[run]\nseed = 1")
    same(record, load_record(tmp_path / f"r{ending}"), NOT_IN_AOT if ending == AOT else ())
    assert [p.name for p in tmp_path.iterdir()] == [f"r{ending}"]


@settings(max_examples=30, deadline=None)
@given(record=records(), order=st.sampled_from("<>"), single=st.booleans())
def test_npz_of_either_byte_order(record: Record, order: str, single: bool) -> None:
    kind = f"{order}f{4 if single else 8}"
    file = io.BytesIO()
    plain = {k: v.astype(kind) if v.ndim == 2 else v for k, v in record_arrays(record).items()}
    plain["dt"] = plain["dt"].astype(f"{order}f8")
    np.savez(file, **plain)
    again = read_record(file, "r.npz")
    np.testing.assert_array_equal(again.y_lgs, record.y_lgs.astype(kind))
    np.testing.assert_array_equal(again.u, record.u.astype(kind))
    assert again.y_lgs.dtype.isnative and again.dt == record.dt


@pytest.mark.slow
@pytest.mark.parametrize("ending", ENDINGS)
def test_packed_by_gzip(ending: str, tmp_path: Path) -> None:
    record = simulate(paper().replace({"run.duration": 0.5, "run.warm_up": 0.1}))
    plain, packed = tmp_path / f"r{ending}", tmp_path / f"r{ending}.gz"
    save_record(plain, record)
    packed.write_bytes(gzip.compress(plain.read_bytes(), 1))
    assert not name_differences(wfsobs.load(plain), wfsobs.load(packed))
    with pytest.raises(RecordError, match=r"r2.*\.gz: its name ends in none of"):
        wfsobs.save(tmp_path / f"r2{ending}.gz", record)


@pytest.mark.parametrize("kind", ["f8", "f4", "i4", "i2"])
@pytest.mark.parametrize("as_table", [True, False])
def test_fits_of_any_number_type(kind: str, as_table: bool) -> None:
    """FITS is big-endian on disk whatever it is made from; integers may be scaled."""
    y = np.arange(-6, 6, dtype=f"<{kind}").reshape(6, 2)
    if as_table:
        names = ("y_lgs", "u")
        table = fits.BinTableHDU.from_columns(
            [fits.Column(n, f"2{ {'f8': 'D', 'f4': 'E', 'i4': 'J', 'i2': 'I'}[kind] }", array=y) for n in names]
        )
        hdus = [fits.PrimaryHDU(), table]
    else:
        hdus = [fits.PrimaryHDU(), fits.ImageHDU(y, name="Y_LGS"), fits.ImageHDU(y, name="U")]
    hdus[1].header["DT"] = 0.001
    file = io.BytesIO()
    fits.HDUList(hdus).writeto(file)
    record = read_record(file, "r.fits")
    np.testing.assert_array_equal(record.y_lgs, y)
    assert record.u.dtype == np.float64 and record.u.dtype.isnative


def test_scaled_integers_and_blanks() -> None:
    physical = np.array([[1.0, 2.0], [3.5, -4.0], [0.0, 7.5]])
    image = fits.ImageHDU(physical.copy(), name="Y_LGS")
    image.scale("int16", bzero=1.5, bscale=0.25)
    blank = fits.ImageHDU(np.array([[1, 2], [-99, 3], [4, 5]], dtype=np.int32), name="U")
    blank.header["BLANK"] = -99
    image.header["DT"] = 0.001
    file = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), image, blank]).writeto(file)
    record = read_record(file, "r.fits")
    np.testing.assert_array_equal(record.y_lgs, physical)
    np.testing.assert_array_equal(record.u, [[1, 2], [np.nan, 3], [4, 5]])


@pytest.mark.parametrize("zero", [0, 32768])
@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize("blank", [-32768, 0])
def test_blanks_of_unsigned_and_of_scaled_images(zero: int, scale: float, blank: int) -> None:
    """The keyword BLANK is of the integers as they are stored."""
    stored = np.array([[1, 2], [blank, blank], [4, -5], [7, 8]], dtype=np.int16)
    images = [fits.ImageHDU(stored, name=name) for name in ("Y_LGS", "U")]
    images[0].header.update(QLANK=blank, QZERO=zero, QSCALE=scale, DT=0.001)  # astropy changes its own
    fits.HDUList([fits.PrimaryHDU(), *images]).writeto(file := io.BytesIO())
    content = re.sub(rb"Q(LANK |ZERO |SCALE)  =", rb"B\1  =", file.getvalue())
    record = read_record(io.BytesIO(content), "r.fits", declaration=DeclaredFormat(unit="um", trust=True))
    np.testing.assert_array_equal(record.y_lgs, np.where(stored == blank, np.nan, scale * stored + zero))


def test_what_the_dashboard_saves_as_csv_is_read() -> None:
    """Its headings: truth/..., estimates that are left aside, time with nine digits."""
    rows = "\n".join(f"{0.002 * k:.9g},{k},{-k},0.5,{k + 0.25},7" for k in range(5))
    heading = "time_s,truth/vibration/tip_um,y_lgs/tip_um,y_ngs/tip_um,u/tip_um,kf-lgs/vibration/tip_um"
    text = f"# [run]\n# seed = 1\n{heading}\n{rows}\n"
    with pytest.raises(RecordError, match="y_ngs needs ratio"):
        read_record(io.BytesIO(text.encode()), "d.csv")
    record = read_record(io.BytesIO(text.replace("y_ngs/", "other/").encode()), "d.csv")
    assert record.dt == 0.002 and record.vibration is not None
    np.testing.assert_array_equal(record.vibration[:, 0], np.arange(5))
    np.testing.assert_array_equal(record.y_lgs[:, 0], -np.arange(5))


def test_aot_from_slopes_and_commands() -> None:
    """A file as an observatory might write it: slopes of many subapertures, commands in metres, matrices to modes, stamps."""
    import aotpy

    rng = np.random.default_rng(0)
    slopes, commands = rng.standard_normal((20, 2, 5)), rng.standard_normal((20, 4)).astype(np.float32)
    to_modes, to_tilt = rng.standard_normal((2, 2, 5)), rng.standard_normal((2, 4))
    telescope = aotpy.MainTelescope(uid="T")
    star = aotpy.NaturalGuideStar(uid="S")
    stamps = 1.6e9 + 0.002 * np.delete(np.arange(21), 7)
    time = aotpy.Time(uid="t", timestamps=list(stamps))
    sensor = aotpy.ShackHartmann(
        uid="W", source=star, n_valid_subapertures=5, measurements=aotpy.Image("slopes", slopes, unit="pix", time=time)
    )
    mirror = aotpy.DeformableMirror(uid="M", telescope=telescope, n_valid_actuators=4)
    loop = aotpy.ControlLoop(
        uid="L",
        commanded_corrector=mirror,
        input_sensor=sensor,
        commands=aotpy.Image("cmd", commands, unit="m"),
        measurements_to_modes=aotpy.Image("s2m", to_modes),
        commands_to_modes=aotpy.Image("c2m", to_tilt),
        delay=1.3,
    )
    system = aotpy.AOSystem(
        ao_mode="SCAO",
        main_telescope=telescope,
        sources=[star],
        wavefront_sensors=[sensor],
        wavefront_correctors=[mirror],
        loops=[loop],
    )
    file = io.BytesIO()
    aotpy.AOTFITSWriter(system).get_hdulist().writeto(file)
    record = read_record(file, "night.fits")
    there = np.delete(np.arange(21), 7)
    assert (record.n_steps, record.missing, record.delay, record.dt) == (21, 1, 1, pytest.approx(0.002, rel=1e-6))
    np.testing.assert_allclose(record.y_lgs[there], np.einsum("tds,mds->tm", slopes, to_modes), rtol=1e-12)
    u = np.full((21, 2), np.nan)
    u[there] = commands.astype(float) @ to_tilt.T
    np.testing.assert_allclose(record.u[1:], 0.7 * u[1:] + 0.3 * u[:-1], rtol=1e-12)  # of 1.3 steps


def slopes_of_a_loop(rng: np.random.Generator, unit: str, to_modes: np.ndarray | None, control: np.ndarray | None) -> Any:
    """A system whose slopes, of five subapertures, no matrix of its file makes modes of unasked."""
    import aotpy

    telescope, star = aotpy.MainTelescope(uid="T"), aotpy.NaturalGuideStar(uid="S")
    grid = np.array([[0, 1, -1], [2, 3, 4]])
    sensor = aotpy.ShackHartmann(
        uid="W",
        source=star,
        n_valid_subapertures=5,
        measurements=aotpy.Image("slopes", rng.standard_normal((20, 2, 5)), unit=unit),
        subaperture_mask=aotpy.Image("grid", grid),
        subaperture_intensities=aotpy.Image("flux", rng.random((20, 5))),
    )
    n = 2 if to_modes is None else to_modes.shape[1]
    matrices: dict[str, Any] = {} if control is None else {"control_matrix": aotpy.Image("cm", control)}
    matrices |= {} if to_modes is None else {"commands_to_modes": aotpy.Image("c2m", to_modes)}
    loop = aotpy.ControlLoop(
        uid="L",
        commanded_corrector=(mirror := aotpy.DeformableMirror(uid="M", telescope=telescope, n_valid_actuators=n)),
        input_sensor=sensor,
        commands=aotpy.Image("cmd", rng.standard_normal((20, n)), unit="um"),
        framerate=1000.0,
        **matrices,
    )
    parts: dict[str, Any] = {"wavefront_sensors": [sensor], "wavefront_correctors": [mirror], "loops": [loop]}
    return aotpy.AOSystem(ao_mode="SCAO", main_telescope=telescope, sources=[star], **parts)


@pytest.mark.slow
def test_matrices_of_an_aot_file_as_reconstructors(tmp_path: Path) -> None:
    """Its control matrix, through its commands where these have modes, and the mean slopes of its subapertures."""
    import aotpy

    rng, path = np.random.default_rng(0), tmp_path / "night.fits"
    for to_modes in (None, rng.standard_normal((2, 4))):
        control = rng.standard_normal((2 if to_modes is None else 4, 2, 5))
        system = slopes_of_a_loop(rng, "pix", to_modes, control)
        aotpy.AOTFITSWriter(system).get_hdulist().writeto(path, overwrite=True)
        slopes = system.loops[0].input_sensor.measurements.data
        record = wfsobs.load(path, reconstructor=str(path), trust=True)
        rows = control if to_modes is None else np.tensordot(to_modes, control, 1)
        np.testing.assert_allclose(record.y_lgs, np.einsum("tds,mds->tm", slopes, rows), rtol=1e-12)
        assert re.search(r"2 modes of 10 slopes by .*night.fits:control_matrix, condition [\d.]+", record.origin)
        with pytest.raises(RecordError, match="has no matrix 'other'; it has control_matrix, mean_slopes"):
            wfsobs.load(path, reconstructor=f"{path}:other")
    aotpy.AOTFITSWriter(system := slopes_of_a_loop(rng, "rad", None, None)).get_hdulist().writeto(path, overwrite=True)
    mean = system.loops[0].input_sensor.measurements.data.mean(axis=2)
    with open(geometry := tmp_path / "xy.csv", "w") as file:
        file.write("x_m,y_m\n" + "".join(f"{x},{y}\n" for x, y in rng.random((5, 2))))
    for source in (str(path), str(geometry)):
        record = wfsobs.load(path, reconstructor=source, trust=True)
        np.testing.assert_allclose(record.y_lgs, mean * micrometres_per("rad", 8.0), rtol=1e-12)
        assert "the mean of each axis, condition 1" in record.origin


def test_a_dump_of_an_observatory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What aotpy's translator makes of it is read as an AOT file; one that it does not accept is one line."""
    from aotpy import translators

    rng, given = np.random.default_rng(0), []
    system = slopes_of_a_loop(rng, "pix", None, control := rng.standard_normal((2, 2, 5)))

    class Translator:
        @classmethod
        def translate(cls, *arguments: Any) -> Any:
            given.append(arguments)
            return system

    with pytest.raises(RecordError, match=r"no NAOMI dump that aotpy translates: .*NAOMI_LOOP_0001.fits"):
        wfsobs.load(f"naomi:{tmp_path},1")
    monkeypatch.setattr(translators, "NAOMITranslator", Translator)
    slopes = system.loops[0].input_sensor.measurements.data
    record = wfsobs.load(f"naomi:{tmp_path},1", reconstructor=f"naomi:{tmp_path},1", trust=True)
    assert given == [(str(tmp_path), 1)] * 2
    np.testing.assert_allclose(record.y_lgs, np.einsum("tds,mds->tm", slopes, control), rtol=1e-12)


@pytest.mark.parametrize(("module", "ending", "extra"), [("astropy.io", ".fits", "fits"), ("aotpy", AOT, "aot")])
def test_what_is_not_installed_is_named(module: str, ending: str, extra: str, monkeypatch) -> None:
    record = simulate(paper().replace({"run.duration": 0.2, "run.warm_up": 0.1}))
    file = written(replace(record, training=None), ending)
    monkeypatch.setitem(sys.modules, module, None)
    library = module.partition(".")[0]
    with pytest.raises(RecordError, match=rf"r{ending}: .* need {library}; install wfsobs with its extra: wfsobs\[{extra}\]"):
        read_record(file, f"r{ending}")
