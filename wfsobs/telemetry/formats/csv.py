"""Records as CSV: one row per step, one column per signal and mode, such as y_lgs/tip_um.

Lines before the heading that start with # can hold numbers and texts, such as `# dt: 0.001`. `nan` and an empty cell are a
missing sample; where a column is empty to the end, it ends there.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping
from itertools import chain
from typing import IO

import numpy as np

from wfsobs.record import RecordError
from wfsobs.telemetry.formats.contents import (
    NUMBERS,
    TEXTS,
    Contents,
    FileColumns,
    TooLargeError,
    from_columns,
    numbers_and_texts,
    pad_fast,
    to_columns,
)
from wfsobs.typing import Array

LONGEST_LINE = 65_536
"""Maximum length of a line [bytes]."""


def read(file: IO[bytes], most: int) -> Contents:
    """Read a CSV file. Raises RecordError naming the line, TooLargeError."""
    table = columns(file, most)
    contents = from_columns(table.columns)
    pad_fast(contents)
    contents.arrays |= table.plain
    return contents


def columns(file: IO[bytes], most: int) -> FileColumns:
    """Read every column, whatever its name; without a heading they are column 1, column 2, ... Raises as `read`."""
    plain, heading, rows = _head(file)
    if len(set(heading)) < len(heading):
        raise RecordError("two columns have the same heading")
    width = len(heading)
    cells_of, ends = [array("d") for _ in heading], [0] * width
    for step, (line, cells) in enumerate(rows):
        if len(cells) != width:
            raise RecordError(f"line {line} has {len(cells)} cells, the heading {width}; cells are separated by commas")
        if (step + 1) * width * 8 > most:
            raise TooLargeError(most)
        for i, cell in enumerate(cells):
            text = cell.strip()
            if text:
                ends[i] = step + 1
            try:
                cells_of[i].append(float(text or "nan"))
            except ValueError:
                raise RecordError(f"line {line}, {heading[i]}: {text[:40]!r} is not a number") from None
    return FileColumns({name: np.array(c[:end]) for name, c, end in zip(heading, cells_of, ends, strict=True)}, plain)


def numbered_lines(file: IO[bytes]) -> Iterator[tuple[int, str]]:
    """Yield (number, text) of every line that is not blank."""
    number = 0
    while line := file.readline(LONGEST_LINE + 1):
        number += 1
        if len(line) > LONGEST_LINE:
            raise RecordError(f"line {number} is longer than {LONGEST_LINE} bytes")
        try:
            text = line.decode("utf-8-sig" if number == 1 else "utf-8").strip()
        except UnicodeDecodeError:
            raise RecordError(f"line {number} is not UTF-8 text") from None
        if "\0" in text:
            raise RecordError(f"line {number} is not text")
        if text:
            yield number, text


def _head(file: IO[bytes]) -> tuple[dict[str, Array], list[str], Iterator[tuple[int, list[str]]]]:
    """Return numbers and texts of the comments, the heading, and the rows as (line, cells)."""
    plain: dict[str, Array] = {}
    lines = numbered_lines(file)
    for number, text in lines:
        if not text.startswith("#"):
            heading = [cell.strip().strip('"') for cell in text.split(",")]
            rows = ((n, t.split(",")) for n, t in lines if not t.startswith("#"))
            if not all(map(_is_number, heading)):
                return plain, heading, rows
            return plain, [f"column {i + 1}" for i in range(len(heading))], chain([(number, heading)], rows)
        name, colon, value = text.lstrip("# ").partition(":")
        if colon and name in TEXTS:
            plain[name] = np.array(value.strip())
        elif colon and name in NUMBERS:
            try:
                plain[name] = np.array(float(value))
            except ValueError:
                raise RecordError(f"line {number}: {name} takes a number, not {value.strip()[:40]!r}") from None
    raise RecordError("holds no table")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def write(file: IO[bytes], arrays: Mapping[str, Array]) -> None:
    """Write the arrays, every number with enough digits to read it back exactly."""
    plain = numbers_and_texts(arrays)
    scenario = str(plain.pop("scenario", ""))
    head = [f"# {name}: {value}" for name, value in plain.items()]
    head += [f"# {line}".rstrip() for line in scenario.splitlines()]
    named = to_columns(arrays)
    file.write("\n".join([*head, ",".join(named), ""]).encode())
    texts = [list(map(repr, values.astype(float).tolist())) for values in named.values()]
    longest = max(map(len, texts), default=0)
    padded = [text + [""] * (longest - len(text)) for text in texts]
    for row in zip(*padded, strict=True):
        file.write((",".join(row) + "\n").encode())
