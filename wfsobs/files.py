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
        File to write.
    write : callable
        Receives the open file.

    Raises
    ------
    OSError
        The file cannot be written; a file that was at `path` before is unchanged.
    """
    path = Path(path)
    with NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
        try:
            write(file)
            file.flush()
            os.chmod(file.name, 0o644)
            os.replace(file.name, path)
        except BaseException:
            os.unlink(file.name)
            raise


def check_writable(path: str | Path) -> None:
    """Raise OSError where `write_whole` could not write to `path`."""
    path = Path(path)
    folder = path.parent
    number, where = (
        (errno.EISDIR, path)
        if path.is_dir()
        else (errno.ENOENT, folder)
        if not folder.exists()
        else (errno.ENOTDIR, folder)
        if not folder.is_dir()
        else (errno.EACCES, folder)
        if not os.access(folder, os.W_OK | os.X_OK)
        else (0, path)
    )
    if number:
        raise OSError(number, os.strerror(number), str(where))
