"""Records as CSV: one row per step, one column per signal and mode, such as y_lgs/tip_um.

Lines before the heading that start with #, %, ! or // can hold numbers and texts, such as `# dt: 0.001`. `nan` and an empty
cell are a missing sample; where a column is empty to the end, it ends there.
"""

from __future__ import annotations

import csv
import io
import re
from array import array
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator, Mapping
from itertools import chain
from typing import IO

import numpy as np

from wfsobs.record import RecordError
from wfsobs.telemetry.formats.contents import (
    ABSENT,
    NUMBERS,
    STAMP,
    TEXTS,
    UNIT,
    FileColumns,
    TooLargeError,
    numbers_and_texts,
    parse_cell,
    parse_heading,
    to_columns,
)
from wfsobs.typing import Array
from wfsobs.units import SECONDS, parse_unit

SEPARATORS: dict[str | None, str] = {"\t": "tabs", ";": "semicolons", "|": "bars", ",": "commas", None: "blanks"}
"""What separates cells: the first of these that makes numbers of the first line, or that is in the heading."""

COMMENTS = ("#", "%", "!", "//")
"""What a comment begins with."""

CONTROL = re.compile(r"[\x00-\x08\x0e-\x1f\x7f-\x9f]")
"""What is in no text."""

LONGEST_LINE = 65_536
"""Maximum length of a line [bytes]."""


def read(file: IO[bytes], most: int) -> FileColumns:
    """Read every column, whatever its name; without a heading they are column 1, column 2, ...

    A column that holds text is left out, unless it has the name of a part of a record. Raises RecordError naming the line,
    TooLargeError.
    """
    out = FileColumns()
    if file.read(2) in (BOM_UTF16_LE, BOM_UTF16_BE):
        file.seek(0)
        file = io.BytesIO(file.read(most).decode("utf-16", "replace").encode())
    file.seek(0)
    heading, separator, rows, named = _head(file, out)
    seen = set[str]()
    for i, name in enumerate(heading):
        if name in seen and parse_heading(name):
            raise RecordError(f"two columns have the same heading, {name}")
        heading[i] = f"{name} ({i + 1})" if name and name in seen else name
        seen.add(name)
    width, commas = len(heading), False
    points = dict[int, str]()
    cells_of, ends = {i: array("d") for i in range(width)}, [0] * width
    first = next(rows, None)
    units = [cell.strip(" []()-") for cell in first[1]] if first else []
    if any(x in SECONDS or parse_unit(x) for x in units) and all(x.lower() in ABSENT or not _is_number(x) for x in units):
        out.column_units = dict(zip(heading, units, strict=False))
    elif first:
        rows = chain([first], rows)
    for step, (line, cells) in enumerate(rows):
        if len(cells) != width:
            raise RecordError(f"line {line} has {len(cells)} cells, the heading {width}; cells are separated by {separator}")
        if (step + 1) * width * 8 > most:
            raise TooLargeError(most)
        for i, column in [*cells_of.items()]:
            text = cells[i].strip()
            if text:
                ends[i] = step + 1
            try:
                column.append(float(text or "nan"))
                if "." in text and i not in points:
                    points[i] = f"line {line}, {heading[i]}: {text[:40]!r}"
                continue
            except ValueError:
                pass
            try:
                column.append(parse_cell(text))
            except ValueError:
                out.leave(heading[i], f"line {line}, {heading[i]}: {text[:40]!r} is not a number")
                del cells_of[i]
                continue
            if STAMP.fullmatch(text):
                out.column_units[heading[i]] = "s"
            else:
                commas |= "," in text
    if commas and (point := next((where for i, where in points.items() if i in cells_of), "")):
        raise RecordError(f"{point} has a decimal point, where other cells have decimal commas")
    out.columns = {heading[i]: np.array(column[: ends[i]]) for i, column in cells_of.items() if heading[i] or ends[i]}
    out.guesses += ["heading of the comment above"] * named
    out.guesses += [f"cells separated by {separator}"] * (separator != "commas") + ["decimal commas"] * commas
    return out


def numbered_lines(file: IO[bytes]) -> Iterator[tuple[int, str]]:
    """Yield (number, text) of every line that is not blank."""
    number = 0
    while line := file.readline(LONGEST_LINE + 1):
        number += 1
        if len(line) > LONGEST_LINE:
            raise RecordError(f"line {number} is longer than {LONGEST_LINE} bytes")
        try:
            text = line.decode("utf-8-sig" if number == 1 else "utf-8")
        except UnicodeDecodeError:  # as old programs write a micro sign
            text = line.decode("latin-1")
        text = text.strip(" \r\n")
        if CONTROL.search(text):
            raise RecordError(f"line {number} is not text")
        if text.strip():
            yield number, text


def _head(file: IO[bytes], contents: FileColumns) -> tuple[list[str], str, Iterator[tuple[int, list[str]]], bool]:
    """Return the heading, what separates cells, the rows as (line, cells), and whether a comment is taken for the heading.

    Numbers and texts of comments go to `contents`.
    """
    lines, comment = numbered_lines(file), ""
    for number, text in lines:
        if text[:4].lower() == "sep=":  # as Excel writes it; what follows tells as well
            continue
        if not text.startswith(COMMENTS):
            signs = [sign for sign in SEPARATORS if sign is None or sign in text]
            sign = next((sign for sign in signs if all(map(_is_number, _cells(text, sign)))), signs[0])
            heading = [cell.strip().strip('"') for cell in _cells(text, sign)]
            rows = ((n, _cells(t, sign)) for n, t in lines if not t.startswith(COMMENTS))
            if not all(map(_is_number, heading)):
                return heading, SEPARATORS[sign], rows, False
            rows, names = chain([(number, heading)], rows), [cell.strip() for cell in _cells(comment, sign)]
            if len(names) == len(heading) and len(names) > 1 and not any(map(_is_number, names)):
                return names, SEPARATORS[sign], rows, True
            return [f"column {i + 1}" for i in range(len(heading))], SEPARATORS[sign], rows, False
        comment = text.lstrip("#%!/ ")
        name, colon, value = comment.partition("=" if UNIT.fullmatch(comment.partition("=")[0]) else ":")
        name = name.strip().lower().replace(" ", "_")
        if colon and (name in TEXTS or UNIT.fullmatch(name)):
            contents.add(name, value.strip())
        elif colon and name in NUMBERS:
            try:
                contents.arrays[name] = np.array(float(value))
            except ValueError:
                raise RecordError(f"line {number}: {name} takes a number, not {value.strip()[:40]!r}") from None
    raise RecordError("holds no table")


def _cells(text: str, sign: str | None) -> list[str]:
    """Return the cells of a line; between quotation marks a separator is none."""
    return next(csv.reader([text], delimiter=sign)) if sign and '"' in text else text.split(sign)


def _is_number(text: str) -> bool:
    try:
        parse_cell(text)
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
