"""The checks of names and of circles, `scripts/check_names.py` and `count_circles.py`: what they find in a small package."""

from __future__ import annotations

import doctest
import importlib.util
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def check() -> ModuleType:
    return script("check_names")


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parents[1] / "scripts" / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SOURCE = """
class Spectra:
    measured: float
    noise: float
    hidden = param.List([])

    def draw(self):
        self._drawn, self.lines = 1, self.shown

def estimate(record, told, /, *made, seen=None, speed=1.0, **hidden): ...
def fitted(): ...
"""


def test_participles_are_found_wherever_a_name_is_given(check: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text(SOURCE, encoding="utf-8")
    found = [line.split(": ")[1] for line in check.faults(tmp_path)]
    parameters = ["estimate.told", "estimate.seen", "estimate.made", "estimate.hidden"]
    assert found == ["Spectra.measured", "Spectra.hidden", *parameters, "Spectra._drawn", "fitted"]


def test_long_modules_are_found(check: ModuleType, tmp_path: Path) -> None:
    for name, length in (("long", check.LONGEST + 1), ("whole", check.LONGEST)):
        (tmp_path / f"{name}.py").write_text("\n" * length, encoding="utf-8")
    (found,) = check.long_modules(tmp_path)
    assert f"{tmp_path.name}/long.py: {check.LONGEST + 1} lines" in found, "and none of what is just within it"
    assert check.faults(tmp_path) == []


def test_one_name_in_two_modules_is_found(check: ModuleType, tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.py").write_text("def rms(x): ...\ndef _inner(x): ...\n", encoding="utf-8")
    assert [line.split(": ")[1:] for line in check.faults(tmp_path)] == [["rms", "one name in 2 modules"]]


def test_examples_of_the_check(check: ModuleType) -> None:
    results = doctest.testmod(check)
    assert results.attempted >= 2 and results.failed == 0


def test_modules_in_a_circle_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An import for types alone and one inside a function close it; `d` is imported by all, and imports none."""
    sources = {
        "__init__": "",
        "a": "from circular.b import B\nfrom circular import d",
        "b": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from circular.c import C",
        "c": "def f():\n    import circular.a, circular.d",
        "d": "",
    }
    (tmp_path / "circular").mkdir()
    for name, source in sources.items():
        (tmp_path / "circular" / f"{name}.py").write_text(source, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    found = script("count_circles").circles("circular")
    assert found == [["circular.a", "circular.b", "circular.c"]]
