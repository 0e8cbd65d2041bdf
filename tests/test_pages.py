"""Tables of the pages and the scripts that make them. A marker stands by every table or group of tables:

    <!-- script.py table: seeds 1 to 20, 2026-11-22, checked to 40 % -->

Those that are "checked" are made anew for the first seed. Medians of ten seeds differ from one seed by what seeds differ by, a
third at most in these; of theory, without random numbers, by rounding of what is printed and of a search to 1e-3.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Any

import pytest

DOCS = Path(__file__).parents[1] / "docs"
MARKER = re.compile(
    r"^<!-- (\w+)\.py(?: ([\w -]+?)(?: --[\w ,=-]+)?)?: (seeds \d+ to \d+|no random numbers), (\d{4}-\d\d-\d\d)"
    r"(?:, checked to ([\d.]+) %)? -->$",
    re.M,
)
NUMBER = re.compile(r"([\d.]+)(?: \(.*\))?")
MADE = ("closed_loop", "events", "higher-orders", "identification", "reproduction", "tuning")
"""Pages whose tables are made by scripts."""
DIGIT = 1.01e-3
"""One of the last digits of a gain, which may be rounded either way."""
Table = dict[str, list[float]]
"""First cell of a row -> the numbers that stand alone in the others, or before a range in brackets."""


def script(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, DOCS / "scripts" / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def text(page: str) -> str:
    return (DOCS / f"{page}.md").read_text(encoding="utf-8")


def tables(markdown: str) -> list[Table]:
    out = []
    for block in re.findall(r"(?:^\|.*\n)+", markdown, flags=re.M):
        rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines()[2:]]
        out.append({row[0]: [float(m[1]) for cell in row[1:] if (m := NUMBER.fullmatch(cell))] for row in rows})
    return out


def checked() -> Iterator[tuple[str, str, str, float, str]]:
    """Page, script, table, tolerance and what stands on the page from its marker to the next."""
    for page in MADE:
        marks = list(MARKER.finditer(text(page)))
        ends = [m.start() for m in marks[1:]] + [len(text(page))]
        for m, end in zip(marks, ends, strict=True):
            if m[5]:
                yield page, m[1], m[2], float(m[5]) / 100.0, text(page)[m.end() : end]


@pytest.mark.parametrize("page", MADE)
def test_who_made_the_tables_of_a_page(page: str) -> None:
    """Every marker is well formed, of a script that there is and a table that it has."""
    marks = list(MARKER.finditer(text(page)))
    assert marks and len(marks) == len(re.findall(r"^<!--", text(page), flags=re.M))
    for m in marks:
        source = (DOCS / "scripts" / f"{m[1]}.py").read_text(encoding="utf-8")
        assert date.fromisoformat(m[4])
        for word in (m[2] or "").split():
            assert word.isdigit() or f'"{word}"' in source or f"def {word}(" in source, m[0]
        first, last = (int(n) for n in re.findall(r"\d+", m[3])) if m[3].startswith("seeds") else (0, 1)
        assert first < last


def test_every_table_of_a_reproduction_has_a_marker() -> None:
    assert sorted(m[2] for m in MARKER.finditer(text("reproduction"))) == sorted(script("reproduction").TABLES)
    assert {m[2] for m in MARKER.finditer(text("closed_loop"))} == set(script("closed_loop").TABLES)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "name", "table", "tolerance", "shown"), [pytest.param(*c, id=f"{c[1]}-{c[2]}") for c in checked()]
)
def test_a_page_shows_what_its_script_makes(
    page: str,
    name: str,
    table: str,
    tolerance: float,
    shown: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    module = script(name)
    module.SEEDS = (1,)
    module.TABLES[table]()
    made, here = tables(capsys.readouterr().out), tables(shown)
    assert made and len(made) <= len(here), page
    for new, old in zip(made, here, strict=False):
        assert new.keys() == old.keys()
        for row, numbers in new.items():
            assert len(numbers) == len(old[row]) > 0
            for value, was in zip(numbers, old[row], strict=True):
                assert value == pytest.approx(was, rel=tolerance, abs=DIGIT), (page, table, row)
