"""The tutorials run, and print what they say they print."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs" / "tutorials").glob("[!R]*.md"))
NUMBER = re.compile(r"[-+]?\d+(?:\.(\d+))?")


def runner():
    spec = importlib.util.spec_from_file_location("tutorial", ROOT / "docs" / "scripts" / "tutorial.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def numbers(text: str) -> list[tuple[float, float]]:
    """(value, one of its last digits) of every number."""
    return [(float(m.group()), 10.0 ** -len(m.group(1) or "")) for m in NUMBER.finditer(text)]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_a_tutorial_prints_what_it_shows(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Words are the same; numbers to one of their last digits, which another processor may round the other way."""
    monkeypatch.chdir(tmp_path)
    ran = runner().run(page)
    assert ran
    for code, shown, printed in ran:
        assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", shown).split(), code
        for (value, digit), (was, _) in zip(numbers(printed), numbers(shown), strict=True):
            assert abs(value - was) <= 1.01 * digit, (code, printed)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_its_figures_are_those_that_its_code_saves(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    shown = set(re.findall(r"!\[[^]]+\]\((\w[\w-]*\.png)\)", text))
    assert shown == set(re.findall(r'savefig\("([\w-]+\.png)"', text))
    assert all((page.parent / name).read_bytes().startswith(b"\x89PNG") for name in shown)


def test_there_are_three() -> None:
    assert len(PAGES) == 3
