"""Which changes of code make an entry run anew, by a package that is written here."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from wfsobs_arena import identity
from wfsobs_arena.challengers import CHALLENGERS
from wfsobs_arena.identity import code_version

import wfsobs
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.observers import OBSERVERS

ASK = """
import sys
from importlib import import_module
from wfsobs_arena.identity import code_version

for sys.path[0] in sys.argv[1:]:
    for name in [name for name in sys.modules if name.partition(".")[0] == "mine"]:
        del sys.modules[name]
    print(code_version(import_module("mine.entry").ME))
"""
FILES = {
    "__init__.py": "",
    "entry.py": """
from functools import partial
from wfsobs.observers.base import Observer
from mine import helper
from .weights import load

def run(order, measurements, prior, settings, watch):
    from mine.late import more
    return {}

ME = Observer("me", "Me", ("vibration",), partial(run, 3))
""",
    "helper.py": "import mine.deeper",
    "deeper.py": "",
    "late.py": "more = 1",
    "weights.py": "def load(): pass",
    "weights.npz": "numbers",
    "other.py": "",
}


@pytest.mark.slow
def test_a_change_of_what_it_imports_is_another_version_and_one_of_the_rest_is_not(tmp_path: Path) -> None:
    folders = [tmp_path / changed for changed in ("nothing", "other.py", "entry.py", "deeper.py", "late.py", "weights.npz")]
    for folder in folders:
        (folder / "mine").mkdir(parents=True)
        for name, text in FILES.items():
            whole = text + "\n# changed\n" * (name == folder.name)
            (folder / "mine" / name).write_text(whole, encoding="utf-8")
    asked = subprocess.run([sys.executable, "-c", ASK, *folders], check=True, capture_output=True, text=True)
    versions = asked.stdout.splitlines()
    assert versions[0].startswith(f"wfsobs {wfsobs.__version__} mine 0 ")
    assert versions[0] == versions[1] and len(versions) == 6 and len(set(versions)) == 5


def test_code_of_wfsobs_that_an_observer_uses_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The Kalman filter is a module of its own; the session of a page is none of an observer's business."""
    names = ("kf-lgs", "persistence")
    before = [code_version(OBSERVERS[name]) for name in names]
    digest = identity._digest
    assert all(before)
    for changed, same in (("filters.py", [False, True]), ("sessions.py", [True, True])):
        monkeypatch.setattr(identity, "_digest", lambda path, changed=changed: b"x" if path.name == changed else digest(path))
        assert [code_version(OBSERVERS[name]) == was for name, was in zip(names, before, strict=True)] == same


@pytest.mark.slow
def test_what_is_told_counts_and_what_people_read_does_not() -> None:
    nothing, kf = CONTROLLERS["none"], OBSERVERS["kf-lgs"]
    assert code_version(nothing) == code_version(replace(nothing, label="Still")) != code_version(CONTROLLERS["integrator"])
    assert code_version(kf) == code_version(replace(kf, help="else")) != code_version(replace(kf, prior=()))
    assert code_version(CHALLENGERS["rls"].algorithm) != code_version(CHALLENGERS["imm"].algorithm)
