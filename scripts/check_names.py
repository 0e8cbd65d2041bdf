"""Check the names of functions, classes, fields, attributes and parameters; name long modules.

    python scripts/check_names.py

None is a bare participle, none stands for two things. A function is a verb with a noun (`fit_ar3`), or the noun of what it
returns (`rms`); `fitted` says neither what is fitted nor that anything is done. A field or a parameter is the noun of what it
holds (`measurements`); `measured` leaves open what. A module of more than LONGEST lines may hold more than one idea: it is named
in a warning.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "wfsobs"

LONGEST = 600
"""Lines of a module beyond which a warning is printed."""

IRREGULAR = frozenset(
    "begun broken brought built caught chosen done drawn driven felt found given gone grown heard held hidden kept known lost "
    "made meant met said seen sent shown sold spent spoken taken taught thought thrown told worn written".split()
)
"""Participles that do not end in -ed."""

PARTICIPLES = {
    "Control.supervised": "a setting, `control.supervised`, in the files of users",
    "Loop.closed": "a setting, `loop.closed`, in the files of users; closed loop is the term of the field",
    "Cancelled": "an exception; the word of concurrent code",
    "LoopPredictor.fitted": "read by the loop that calls the predictor: the interface of pyRTC",
}
"""Allowed, and why."""

DOUBLES = {
    "prior_of": "the same of a scenario and of an identification: the module says of which",
    "read": "every file format has a function of this name: `Format.read`",
    "columns": "every file format whose columns have names of their own: `Format.columns`",
    "write": "every file format has a function of this name: `Format.write`",
    "design": "of one observer or controller for a user's loop, and of all controllers for a comparison",
    "compute": "what a kind of job of the dashboard does: the module says which kind",
    "main": "the usual name of an entry point",
    "envelope": "the command, and the extremes of a signal that figures draw",
    "export": "the command, and the function that it calls",
    "identify": "the command, and the function that it calls",
    "observe": "the command, and the function that it calls",
    "run": "the command, and the function that it calls",
    "serve": "the command, and the function that it calls",
    "tune": "the command, and the function that it calls",
    "seconds": "the estimate of an observer's computing time, in the module of the observer",
}
"""Allowed at the level of modules, and why."""


def is_participle(name: str) -> bool:
    """Return whether a name is one word, and that a participle.

    >>> [is_participle(name) for name in ("_fitted", "seen", "fit_ar3", "seed", "Tuned")]
    [True, True, False, False, True]
    """
    word = name.strip("_").lower()
    return word in IRREGULAR or (re.fullmatch(r"[a-z]+[^e]ed", word) is not None and word not in ("seed", "embed"))


def names(path: Path) -> Iterator[tuple[str, bool]]:
    """Yield the functions and classes of a module, and whether they are at its top level."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node.name, True
        if isinstance(node, ast.ClassDef):
            yield from ((n.name, False) for n in node.body if isinstance(n, ast.FunctionDef))


def fields_and_parameters(source: str) -> Iterator[str]:
    r"""Yield the fields of classes and the parameters of functions in a source, each after its owner.

    >>> list(fields_and_parameters("class A:\n  seen: int\n  said = String()\n  def f(self, told, *made, kept=1): pass"))
    ['A.seen', 'A.said', 'f.self', 'f.told', 'f.kept', 'f.made']
    """
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ClassDef):
            fields = [t for n in node.body for t in _targets(n)]
            yield from (f"{node.name}.{field.id}" for field in fields if isinstance(field, ast.Name))
        elif isinstance(node, ast.FunctionDef):
            a = node.args
            every = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
            yield from (f"{node.name}.{parameter.arg}" for parameter in every)


def _targets(statement: ast.stmt) -> list[ast.expr]:
    """Return what a statement assigns to: a field with an annotation, or a parameter of `param` without one."""
    return (
        statement.targets
        if isinstance(statement, ast.Assign)
        else [statement.target]
        if isinstance(statement, ast.AnnAssign)
        else []
    )


def attributes(source: str) -> Iterator[str]:
    r"""Yield the attributes that the methods of classes in a source set on their objects, each once, after its class.

    >>> list(attributes("class A:\n  def f(self):\n    self.x, self._made = 1, 2\n    self.x: int = self.y"))
    ['A.x', 'A._made']
    """
    for owner in ast.walk(ast.parse(source)):
        if isinstance(owner, ast.ClassDef):
            stored = (n for n in ast.walk(owner) if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store))
            names = (n.attr for n in stored if isinstance(n.value, ast.Name) and n.value.id == "self")
            yield from (f"{owner.name}.{name}" for name in dict.fromkeys(names))


def long_modules(package: Path = PACKAGE) -> list[str]:
    """Return one line for every long module in a package."""
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in sorted(package.rglob("*.py"))}
    return [
        f"{path.relative_to(package.parent).as_posix()}: {length} lines: is it one idea?"
        for path, length in lengths.items()
        if length > LONGEST
    ]


def faults(package: Path = PACKAGE) -> list[str]:
    """Return one line for every name in a package that breaks a rule."""
    homes: dict[str, list[str]] = defaultdict(list)
    out = []
    for path in sorted(package.rglob("*.py")):
        where = path.relative_to(package.parent).as_posix()
        source = path.read_text(encoding="utf-8")
        out += [
            f"{where}: {name}: a bare participle; take the noun of what it holds"
            for name in (*fields_and_parameters(source), *attributes(source))
            if is_participle(name.rpartition(".")[2]) and name not in PARTICIPLES
        ]
        for name, is_top in names(path):
            if is_participle(name) and name not in PARTICIPLES:
                out.append(f"{where}: {name}: a bare participle; say what is done to what")
            if is_top and not name.startswith("_") and name not in DOUBLES:
                homes[name].append(where)
    return out + [
        f"{', '.join(where)}: {name}: one name in {len(where)} modules" for name, where in homes.items() if len(where) > 1
    ]


if __name__ == "__main__":
    found = faults()
    for line in [*(f"Warning: {line}" for line in long_modules()), *found]:
        print(line)
    sys.exit(bool(found))
