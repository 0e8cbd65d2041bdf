"""Docstrings and signatures of the whole package: the same parameters, and defaults that can be read."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path

import pytest

import wfsobs

ROOT = Path(wfsobs.__file__).parent
Documented = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


def documented_parameters(docstring: str) -> list[str] | None:
    """Return the names of the section Parameters, None without one."""
    found = re.search(r"^Parameters\n-+\n(.*?)(?=^\w[\w ]*\n-{3,}$|\Z)", docstring, re.M | re.S)
    if found is None:
        return None
    heads = [line.partition(" : ")[0] for line in found[1].splitlines() if line and not line[0].isspace()]
    return [name.strip().lstrip("*") for head in heads for name in head.split(",")]


def own_parameters(node: Documented) -> list[str] | None:
    """Return the names of the signature without self, None of a class whose constructor is inherited."""
    if isinstance(node, ast.ClassDef):
        made = next((one for one in node.body if isinstance(one, ast.FunctionDef) and one.name == "__init__"), None)
        return None if made is None else own_parameters(made)
    a = node.args
    every = [*a.posonlyargs, *a.args, *([a.vararg] if a.vararg else []), *a.kwonlyargs, *([a.kwarg] if a.kwarg else [])]
    return [one.arg for one in every if one.arg not in ("self", "cls")]


def disagreements(text: str) -> list[str]:
    out = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, Documented) and (docstring := ast.get_docstring(node)):
            named, own = documented_parameters(docstring), own_parameters(node)
            if named is not None and own is not None and named != own:
                out.append(f"{node.name}: {', '.join(named)}: takes {', '.join(own)}")
    return out


@pytest.mark.slow
def test_parameters_of_docstrings_are_those_of_the_signatures() -> None:
    found = {str(path.relative_to(ROOT)): disagreements(path.read_text(encoding="utf-8")) for path in ROOT.rglob("*.py")}
    assert len(found) > 200
    assert {path: lines for path, lines in found.items() if lines} == {}


def test_a_parameter_that_is_missing_renamed_or_misplaced_is_found() -> None:
    text = 'def f(a, b, *, c):\n    """Do.\n\n    Parameters\n    ----------\n    {}\n\n    Raises\n    ------\n    E\n    """'
    assert disagreements(text.format("a, b : int\n        Two.\n    c : int")) == []
    for wrong in ("a : int\n    c : int", "a, d : int\n    c : int", "b, a : int\n    c : int"):
        assert len(disagreements(text.format(wrong))) == 1


@pytest.mark.parametrize("name", wfsobs.__all__)
def test_defaults_of_public_signatures_can_be_read(name: str) -> None:
    value = getattr(wfsobs, name)
    if inspect.isfunction(value):
        assert " at 0x" not in str(inspect.signature(value))
