"""Check the names of functions and classes: none is a bare participle, none stands for two things.

    python scripts/check_names.py

A function is a verb with a noun (`fit_ar3`), or the noun of what it returns (`rms`); `fitted` says neither what is fitted nor
that anything is done.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "wfsobs"

IRREGULAR = frozenset(
    "begun broken brought built caught chosen done drawn driven felt found given gone grown held hidden kept known lost made "
    "meant met said seen sent shown sold spent spoken taken taught thought thrown told worn written".split()
)
"""Participles that do not end in -ed."""

PARTICIPLES = {
    "Cancelled": "an exception; the word of concurrent code",
}
"""Allowed, and why."""

DOUBLES = {
    "prior_of": "the same of a scenario and of an identification: the module says of which",
    "read": "every file format has a function of this name: `Format.read`",
    "write": "every file format has a function of this name: `Format.write`",
    "design": "of one observer or controller for a user's loop, and of all controllers for a comparison",
    "compute": "what a kind of job of the dashboard does: the module says which kind",
    "main": "the usual name of an entry point",
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


def faults() -> list[str]:
    """Return one line for every name that breaks a rule."""
    homes: dict[str, list[str]] = defaultdict(list)
    out = []
    for path in sorted(PACKAGE.rglob("*.py")):
        where = path.relative_to(PACKAGE.parent).as_posix()
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
    print(*found, sep="\n", end="\n" if found else "")
    sys.exit(bool(found))
