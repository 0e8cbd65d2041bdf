"""Writing of files: whole or not at all."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO


def write_whole(path: str | Path, write: Callable[[IO[bytes]], object]) -> None:
    """Call `write` on a temporary file in the folder of `path`, then rename it to `path`.

    Parameters
    ----------
    path : str or Path
        File to write; of a link, the file that it leads to. A device or a pipe is written to as it is.
    write : callable
        Receives the open file.

    Raises
    ------
    OSError
        The file cannot be written; it names `path`. A file that was there before is unchanged.
    """
    try:
        if is_device(path):
            with open(path, "wb") as file:
                write(file)
        else:
            _write_and_rename(Path(os.path.realpath(path)), write)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def write_text(path: str | Path, text: str) -> None:
    """Write a text as `write_whole` writes a file. Raises OSError."""
    write_whole(path, lambda file: file.write(text.encode()))


def is_device(path: str | Path) -> bool:
    """Return whether a path is that of a device or a pipe."""
    return os.path.exists(path) and not os.path.isfile(path) and not os.path.isdir(path)


def _write_and_rename(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    with NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
        try:
            write(file)
            file.flush()
            os.chmod(file.name, 0o644)
            os.replace(file.name, path)
        except BaseException:
            os.unlink(file.name)
            raise


def check_writable(path: str | Path, endings: tuple[str, ...] = ()) -> None:
    """Raise OSError where `write_whole` could not write to `path`.

    endings : those that its name takes; any where there are none
    """
    if is_device(path):
        return
    named = str(path)
    path = Path(os.path.realpath(path) if os.path.islink(path) else path)
    folder = path.parent
    for number, where, is_wrong in (
        (errno.EISDIR, path, path.is_dir()),
        (errno.ENOENT, folder, not folder.exists()),
        (errno.ENOTDIR, folder, not folder.is_dir()),
        (errno.EACCES, folder, not os.access(folder, os.W_OK | os.X_OK)),
    ):
        if is_wrong:
            raise OSError(number, os.strerror(number), str(where))
    if endings and not named.lower().endswith(endings):
        raise OSError(errno.EINVAL, f"its name ends in none of {', '.join(endings)}", named)
