"""Files are written whole or not at all, and errors name what the user named."""

from __future__ import annotations

import errno
import os
from contextlib import nullcontext
from pathlib import Path
from typing import IO, NoReturn

import numpy as np
import pytest
from click.testing import CliRunner

from wfsobs.cli import main
from wfsobs.files import check_writable, write_whole
from wfsobs.handover import ENDINGS
from wfsobs.telemetry.formats import WRITTEN


def full(_file: IO[bytes]) -> NoReturn:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_names_the_file_and_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "kept.txt"
    path.write_bytes(b"old")
    with pytest.raises(OSError, match=r"No space left on device: '.*/kept\.txt'$") as caught:
        write_whole(path, full)
    assert caught.value.filename == str(path) and caught.value.errno == errno.ENOSPC
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["kept.txt"]


def test_an_error_without_a_number_names_the_file(tmp_path: Path) -> None:
    def write(_file: IO[bytes]) -> NoReturn:
        raise OSError("Not enough space on disk")

    with pytest.raises(OSError, match=r"Not enough space on disk: '.*/a\.fits'$"):
        write_whole(tmp_path / "a.fits", write)


@pytest.mark.parametrize("name", ["nowhere/a.npz", "folder/a.npz"])
def test_errors_name_the_users_file_not_the_temporary_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder" / "a.npz").mkdir(parents=True)
    with pytest.raises(OSError, match=f": '{name}'$"):
        write_whole(name, lambda file: file.write(b"new"))
    assert os.listdir("folder") == ["a.npz"]


def test_a_link_stays_one(tmp_path: Path) -> None:
    (tmp_path / "far").mkdir()
    link, target = tmp_path / "link.txt", tmp_path / "far" / "target.txt"
    link.symlink_to("far/target.txt")
    for content in (b"first", b"second"):  # of a link that leads to nothing yet, and of one to a file
        check_writable(link)
        write_whole(link, lambda file, content=content: file.write(content))
        assert link.is_symlink() and target.read_bytes() == content
    assert os.listdir(tmp_path / "far") == ["target.txt"]


def test_a_pipe_is_written_to() -> None:
    receive, send = os.pipe()
    check_writable(f"/dev/fd/{send}", endings=(".npz",))
    write_whole(f"/dev/fd/{send}", lambda file: file.write(b"through"))
    os.close(send)
    with os.fdopen(receive, "rb") as file:
        assert file.read() == b"through"


def test_the_ending_is_that_of_the_name_which_is_given(tmp_path: Path) -> None:
    for name, target in (("a.npz", "blob"), ("blob", "a.npz")):
        folder = tmp_path / name
        folder.mkdir()
        (folder / name).symlink_to(folder / target)
        says = pytest.raises(OSError, match="its name ends in none of") if name == "blob" else nullcontext()
        with says:
            check_writable(folder / name, endings=(".npz",))


@pytest.mark.parametrize("link", [False, True])
def test_a_file_that_cannot_be_written_is_named_before_anything_is_computed(tmp_path: Path, link: bool) -> None:
    path = tmp_path / "nowhere" / "a.npz"
    if link:
        (tmp_path / "a.npz").symlink_to(path)
    result = CliRunner().invoke(main, ["run", "--save", str(tmp_path / "a.npz" if link else path)])
    assert (result.exit_code, result.output) == (2, f"wfsobs: {path.parent}: No such file or directory\n")


@pytest.mark.parametrize(
    "arguments",
    [
        "convert night.npz night.npz",
        "identify night.npz --out link.npz",
        "observe night.npz --out night.npz",
        "observe none.npz --train night.npz --out night.npz",
        "identify none.npz --reconstructor night.npz:R --out night.npz",
        "identify none.npz --command-modes night.npz --out night.npz",
        "tune --observer kf-lgs --record night.npz --out night.npz",
        "live --headless --replay night.npz --record night.npz",
        "live --headless --record night.npz --log night.npz",
        "run --vibration-psd night.npz --save night.npz",
        "identify none.npz --config own.toml --out own.toml",
        f"identify none.npz --set butterworth.frequencies={[*range(11, 99)]} --config own.toml --out own.toml".replace(", ", ","),
        "observe none.npz --prior night.npz --out night.npz",
        "tune --observer kf-lgs --config own.toml --out own.toml",
        "sweep --over turbulence.wind_speed=10,12 --config own.toml --csv own.toml",
        "export own.toml --config own.toml",
        "design --controller integrator --to npz --prior night.npz --out night.npz",
    ],
)
def test_a_file_that_is_read_is_not_replaced(arguments: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez("night.npz", R=np.eye(2))
    Path("link.npz").symlink_to("night.npz")
    Path("own.toml").write_text("run.seed = 5\n")
    out = arguments.split()[-1]
    before = Path(out).read_bytes()
    result = CliRunner().invoke(main, arguments.split())
    says = "is also named as another file of this command; write to another"
    assert (result.exit_code, result.output) == (2, f"wfsobs: {out}: {says}\n")
    assert Path(out).read_bytes() == before


@pytest.mark.parametrize(
    ("arguments", "endings"),
    [
        ("observe none.npz --out", ".npz"),
        ("probe --out", ".npz"),
        ("export", ".html, .htm"),
        ("run --save", ", ".join(WRITTEN)),
        ("live --headless --record", ", ".join(WRITTEN)),
        *((f"design --controller integrator --to {form} --out", ending) for form, ending in ENDINGS.items()),
    ],
)
def test_an_ending_of_another_format_is_refused(arguments: str, endings: str) -> None:
    result = CliRunner().invoke(main, [*arguments.split(), "a.npy"])
    assert (result.exit_code, result.output) == (2, f"wfsobs: a.npy: its name ends in none of {endings}\n")
    assert not Path("a.npy").exists()
