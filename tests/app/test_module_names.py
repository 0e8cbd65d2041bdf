"""`panel serve app` has the folder in the search path while a page is made; processes that begin meanwhile inherit the path."""

import sys
from importlib.util import find_spec
from pathlib import Path

import wfsobs.app


def test_no_module_hides_one_of_python_or_of_a_package() -> None:
    folder = Path(next(iter(wfsobs.app.__path__)))
    names = {path.stem for path in folder.iterdir() if path.suffix == ".py" or path.is_dir()} - {
        "__init__",
        "__pycache__",
        "main",
    }
    assert "dashboard" in names
    assert sorted(name for name in names if name in sys.stdlib_module_names or find_spec(name) is not None) == []
