"""What can be reached from the arguments of an observer or a controller, and whether any of it is the truth."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from functools import partial
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any

import numpy as np

from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.run import Run

SEED = 918_273_645
"""A seed that is found where it should not be: no other number is likely to be the same."""


def walk_references(*roots: Any) -> Iterator[Any]:
    """Yield everything reachable from the roots, by references, bases of arrays, closures, defaults and partials.

    Classes and modules are the program, and so are the globals of a function.
    """
    seen, waiting = set[int](), list(roots)
    while waiting:
        x = waiting.pop()
        if id(x) in seen or isinstance(x, (type, ModuleType, BuiltinFunctionType)):
            continue
        seen.add(id(x))
        yield x
        if isinstance(x, FunctionType):
            waiting += [cell.cell_contents for cell in x.__closure__ or ()]
            waiting += [x.__defaults__, x.__kwdefaults__, x.__dict__]
        elif isinstance(x, partial):
            waiting += [x.func, x.args, x.keywords]
        else:
            waiting += gc.get_referents(x)
            if isinstance(x, np.ndarray):
                waiting.append(x.base)


def given_away(record: Record, *roots: Any, seed: int = SEED) -> set[str]:
    """Find what can be reached from the roots that should not: names of types, of signals of the truth, or "seed"."""
    found = set()
    for x in walk_references(*roots):
        if isinstance(x, (Scenario, Run, Record)):
            found.add(type(x).__name__)
        elif isinstance(x, int) and x == seed:
            found.add("seed")
        elif isinstance(x, np.ndarray) and x.dtype == float:
            for name in ("turbulence", "vibration"):
                truth = getattr(record, name)
                if np.shares_memory(x, truth) or any(np.isin(column, x).all() for column in truth.T if column.any()):
                    found.add(name)
    return found
