"""Writing files so that nothing is ever half-written."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO


def write_whole(path: str | Path, write: Callable[[IO[bytes]], object]) -> None:
    """Call `write` on a temporary file beside `path`, then rename it to `path`.

    Raises OSError; whatever stood at `path` before then still stands there.
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
    """Raises OSError where `write_whole` could not write to `path` later."""
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
