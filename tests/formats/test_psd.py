"""A user's own spectrum from a file."""

from __future__ import annotations

import io
from importlib.resources import files

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner

from wfsobs.cli import main
from wfsobs.record import RecordError
from wfsobs.telemetry.formats.psd import load_psd, read_psd

F, TIP, TILT = np.array([5.0, 10.0, 20.0]), np.array([1.0, 4.0, 2.0]), np.array([0.0, 3.0, 1.5])
CSV = "# measured\nfrequency [Hz],tip [{u}],extra,tilt [{u}]\n" + "".join(
    f"{f},{a},x,{b}\n" for f, a, b in zip(F, TIP, TILT, strict=True)
)


def fits_image(unit: str | None) -> bytes:
    hdu = fits.PrimaryHDU(np.array([F, TIP, TILT]))
    if unit:
        hdu.header["BUNIT"] = unit
    file = io.BytesIO()
    hdu.writeto(file)
    return file.getvalue()


def fits_table(unit: str | None) -> bytes:
    columns = [
        fits.Column("FREQUENCY", "D", unit="Hz", array=F),
        *(fits.Column(n, "D", unit=unit, array=x) for n, x in (("TIP", TIP), ("TILT", TILT))),
    ]
    file = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns)]).writeto(file)
    return file.getvalue()


MAKE = {
    "a.csv": lambda unit: CSV.replace(" [{u}]", f" [{unit}]" if unit else "").encode(),
    "image.fits": fits_image,
    "table.fits": fits_table,
}


@pytest.mark.parametrize("name", MAKE)
@pytest.mark.parametrize(("unit", "factor"), [("um", 1.0), ("nm", 1e-6), ("mas", (2e3 * np.pi / 648_000) ** 2)])
def test_every_format_and_unit(name: str, unit: str, factor: float) -> None:
    for written, told in ((f"{unit}^2/Hz", None), (f"{unit}2 / Hz", unit), (f"{unit}**2/Hz", None), (None, unit)):
        if name == "table.fits" and written and "**" in written:
            continue
        table = read_psd(io.BytesIO(MAKE[name](written)), name, told)
        assert list(table) == ["frequency", "tip", "tilt"] and table["frequency"] == F.tolist()
        np.testing.assert_allclose(table["tip"], TIP * factor, rtol=1e-12)
        np.testing.assert_allclose(table["tilt"], TILT * factor, rtol=1e-12)


@pytest.mark.parametrize("name", MAKE)
def test_a_unit_is_never_guessed(name: str) -> None:
    with pytest.raises(RecordError, match=f"{name}: has no unit of tip: state one of um, nm, mas, arcsec, rad"):
        read_psd(io.BytesIO(MAKE[name](None)), name)
    with pytest.raises(RecordError, match=r"tip is in nm\^2/Hz, but um is stated"):
        read_psd(io.BytesIO(MAKE[name]("nm^2/Hz")), name, "um")
    with pytest.raises(RecordError, match="tip is in 'nm/Hz'; it takes the square"):
        read_psd(io.BytesIO(MAKE[name]("nm/Hz")), name)


@pytest.mark.parametrize("unit", ["nm²/Hz", "nm2/Hz", "nm**2 / Hz", "nm² Hz⁻¹", "nm^2 Hz^-1"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_squares_however_they_are_written(unit: str, encoding: str) -> None:
    text = f"frequency [Hz],tip [{unit}],tilt [{unit}]\n1,2,3\n2,4,5\n"
    assert read_psd(io.BytesIO(text.encode(encoding)), "a.csv")["tip"] == pytest.approx([2e-6, 4e-6])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no table"),
        ("f,tip,tilt\n1,2,3\n", "has no column frequency"),
        ("frequency [kHz],tip [nm^2/Hz],tilt [nm^2/Hz]\n1,2,3\n", "frequency is in 'kHz'; it takes Hz"),
        ("frequency,tip,tilt\n1,2\n", "line 2 has 2 cells, the heading 3"),
        ("frequency,tip,tilt\n1,nan,2\n", "tip does not hold one finite number per row"),
    ],
)
def test_wrong_tables(text: str, message: str) -> None:
    with pytest.raises(RecordError, match=message):
        read_psd(io.BytesIO(text.encode()), "a.csv", "nm")


@pytest.mark.parametrize("first", [0.25, 0.0, 5.0])
def test_bins_of_a_spectrum_keep_all_their_power(first: float) -> None:
    """Most of it in the first bin, as windshake has it; the first of 0 Hz is half as wide as the others."""
    f = first + 0.25 * np.arange(1000)
    f = f.astype(np.float32).astype(float)  # as a file of single precision has it
    density = 1e8 / (1.0 + np.arange(1000.0)) ** 2
    rows = [f"{a!r},{x!r},{x!r}" for a, x in zip(f.tolist(), density.tolist(), strict=True)]
    text = "\n".join(["frequency,tip [nm^2/Hz],tilt [nm^2/Hz]", *rows])
    table = read_psd(io.BytesIO(text.encode()), "a.csv")
    expected = 0.25 * (density.sum() - (0.5 * density[0] if first == 0 else 0.0))
    assert np.trapezoid(table["tip"], table["frequency"]) == pytest.approx(1e-6 * expected, rel=1e-6), "to single precision"
    assert table["frequency"][0] == max(first - 0.125, 0.0) and np.all(np.diff(table["frequency"]) > 0)
    uneven = read_psd(io.BytesIO("\n".join([*text.split("\n")[:20], *text.split("\n")[30:]]).encode()), "a.csv")
    assert uneven["frequency"][0] == first, "a curve, not bins"


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas(separator: str) -> None:
    text = (
        f"frequency{separator}tip [nm^2/Hz]{separator}tilt [nm^2/Hz]\n0,5{separator}1,5{separator}2\n1{separator}2{separator}3\n"
    )
    assert read_psd(io.BytesIO(text.encode()), "a.csv")["tip"] == pytest.approx([1.5e-6, 2e-6])


@pytest.mark.slow
def test_the_command_runs_on_it(tmp_path) -> None:
    """The shipped table is such a file; the vibration's rms is that of its bins, joined by straight lines."""
    path = tmp_path / "eris.csv"
    path.write_text(files("wfsobs.assets").joinpath("eris_ut4.csv").read_text(encoding="utf-8"))
    table = load_psd(path)
    quick = ["--set", "run.duration=2", "--set", "gpr_online.training_size=20", "--set", "gpr_offline.training_size=50"]
    done = CliRunner().invoke(
        main,
        [
            "run",
            "--vibration-psd",
            str(path),
            *quick,
            "--set",
            "run.warm_up=0",
            "--set",
            "vibration.cutoff=100",
            "--set",
            "vibration.synthesis=random-phase",
            "--save",
            str(tmp_path / "record.npz"),
        ],
    )
    assert done.exit_code == 0, done.stderr
    with np.load(tmp_path / "record.npz") as saved:
        rms = np.sqrt(np.mean(saved["vibration"] ** 2, axis=0))
    for mode, found in zip(("tip", "tilt"), rms, strict=True):
        assert found == pytest.approx(np.sqrt(np.trapezoid(table[mode], table["frequency"])), rel=1e-6)
    none = CliRunner().invoke(main, ["run", "--vibration-psd", str(tmp_path / "none.csv")])
    assert none.exit_code == 2 and "none.csv: cannot be read" in none.stderr and none.stderr.count("\n") == 1


def test_a_table_of_too_many_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wfsobs.telemetry.formats.psd.MOST", 8)
    with pytest.raises(RecordError, match=r"^a\.csv: holds more than"):
        read_psd(io.BytesIO(b"frequency,tip,tilt\n1,1,1\n"), "a.csv")
