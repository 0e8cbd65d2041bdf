"""What the results of an entry depend on: its code, with all of its package and of wfsobs that this imports.

A comment in any of it makes an entry run anew, too; that takes time, while a result of other code would be wrong. Packages beside
these two do not count, and what a module imports by a name made at run time is not in the digest.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
from collections.abc import Callable, Iterator
from dataclasses import fields
from functools import cache, partial
from importlib.metadata import packages_distributions, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from wfsobs import __version__


def code_version(algorithm: Any) -> str:
    """Return the version of wfsobs, that of an entry's package, and a digest of the code that it runs.

    Parameters
    ----------
    algorithm : Observer or Controller
        The entry.
    """
    homes = sorted({name for function in _functions(algorithm) if (name := getattr(function, "__module__", None))})
    packages = {home.partition(".")[0] for home in homes} | {"wfsobs"}
    digests: dict[str, str] = {}
    for home in homes:
        _follow(home, frozenset(packages), digests)
    told = [part.__name__ for part in algorithm.prior]
    digest = hashlib.sha256(repr([algorithm.id, told, sorted(digests.items())]).encode()).hexdigest()
    others = [f"{name} {_package_version(name)}" for name in sorted(packages - {"wfsobs"})]
    return " ".join([f"wfsobs {__version__}", *others, digest[:16]])


def _functions(algorithm: Any) -> Iterator[Callable[..., Any]]:
    """Yield the functions of an observer or a controller, and those among the arguments of a partial."""
    waiting = [getattr(algorithm, field.name) for field in fields(algorithm)]
    while waiting:
        value = waiting.pop()
        if isinstance(value, partial):
            waiting += [value.func, *value.args, *value.keywords.values()]
        elif inspect.isroutine(value):
            yield value
    yield type(algorithm)


def _follow(name: str, packages: frozenset[str], digests: dict[str, str]) -> None:
    """Add the digest of a module, and of all that it imports from these packages, to `digests`."""
    waiting = [name]
    while waiting:
        name = waiting.pop()
        if name in digests or name.partition(".")[0] not in packages:
            continue
        path = _source_of(name)
        if path is None:
            continue
        beside = sorted(file for file in path.parent.glob(f"{path.stem}.*") if file.is_file() and path.stem != "__init__")
        digests[name] = hashlib.sha256(b"".join(_digest(file) for file in beside or [path])).hexdigest()
        waiting += _imports(name, path)


def _source_of(name: str) -> Path | None:
    """Return the file of a module; None for one that has none, as what is no module at all."""
    try:
        spec = find_spec(name)
    except (ImportError, ValueError, AttributeError):
        return None
    return Path(spec.origin) if spec is not None and spec.origin and spec.origin.endswith(".py") else None


@cache
def _imports(name: str, path: Path) -> tuple[str, ...]:
    """Return what a module imports: modules, and names that may be modules."""
    found: list[str] = []
    package = name if path.stem == "__init__" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            up = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            home = ".".join([*up, *([node.module] if node.module else [])])
            found += [home, *(f"{home}.{alias.name}" for alias in node.names)]
    return tuple(found)


@cache
def _digest(path: Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).digest()


@cache
def _package_version(package: str) -> str:
    """Return the version of the distribution that has a package; "0" for a script."""
    names = packages_distributions().get(package, [])
    return version(names[0]) if names else "0"
