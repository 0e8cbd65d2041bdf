"""What results depend on, by name: a record on the settings that its simulation reads, an estimate on what its observer receives.

The name of an estimate is a digest of the signals that its observer receives, of its prior as it was built and of its own
settings as they count: what changed nothing of these changes nothing of the estimate. So there is no list of which setting
reaches which observer.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from functools import partial
from types import FunctionType
from typing import Any, TypeVar
from weakref import WeakValueDictionary

import numpy as np

from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import Observer
from wfsobs.prior import Lines, Part, Prior, Training
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Estimate, Record
from wfsobs.scenario import Scenario
from wfsobs.settings.values import Plain
from wfsobs.simulation.loop import record_settings, simulate, training_settings

T = TypeVar("T")

MODELS = frozenset(("kalman", "butterworth"))
"""Groups of what all observers are told."""

LINES = "multipeak"
"""Group of how the lines are told, to those that ask for them."""


class Memo:
    """Values by name, as long as somebody else holds them: it takes no memory of its own. For any thread."""

    def __init__(self) -> None:
        self._values: WeakValueDictionary[str, Any] = WeakValueDictionary()

    def get(self, name: str) -> Any:
        """Return the value of a name, or None."""
        return self._values.get(name)

    def put(self, name: str, value: T) -> T:
        """Note a value under a name, and return it."""
        self._values[name] = value
        return value

    def keep(self, name: str, make: Callable[[], T]) -> T:
        """Return the value of a name, made where it is not known; None, which nobody can hold, is made every time."""
        if (known := self.get(name)) is not None:
            return known
        made = make()
        return made if made is None else self.put(name, made)

    def __len__(self) -> int:
        return len(self._values)


def digest(*values: Any) -> str:
    """Return a digest of numbers, texts, arrays, and what is made of these, functions of modules that are bound to them too.

    Raises TypeError for anything else, which has no value to compare.

    >>> digest(1, [2.0]) == digest(1, [2.0]) != digest(1, 2.0)
    True
    """
    h = hashlib.blake2b(digest_size=16)
    for part in _parts(values):
        h.update(len(part).to_bytes(8, "big"))
        h.update(part)
    return h.hexdigest()


def _parts(value: Any) -> Iterator[Any]:
    if value is None or isinstance(value, (bool, int, float, complex, str)):
        yield f"{type(value).__name__} {value!r}".encode()
    elif isinstance(value, np.generic):
        yield from _parts(value.item())
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype.str} {value.shape}".encode()
        yield np.ascontiguousarray(value).reshape(-1).view(np.uint8)
    elif isinstance(value, (tuple, list)):
        yield f"{type(value).__name__} {len(value)}".encode()
        for item in value:
            yield from _parts(item)
    elif isinstance(value, Mapping):
        yield from _parts(sorted(value.items()))
    elif isinstance(value, partial) and _is_of_module(value.func):
        yield f"partial {value.func.__module__}.{value.func.__name__}".encode()
        yield from _parts((value.args, value.keywords))
    elif is_dataclass(value):
        yield type(value).__name__.encode()
        for field in fields(value):
            yield from _parts(getattr(value, field.name))
    else:
        raise TypeError(f"a {type(value).__name__} has no digest")


def _is_of_module(function: Any) -> bool:
    """Return whether a function is all that its name says: one made within another may hold values of it."""
    return isinstance(function, FunctionType) and function.__qualname__ == function.__name__ != "<lambda>"


def record_digest(record: Record) -> str:
    """Return the digest of a record without its training data."""
    return digest(replace(record, training=None))


def simulate_once(scenario: Scenario, memo: Memo | None = None, watch: Watch = QUIET) -> Record:
    """Simulate a record, unless one of the same settings is known. Raises SettingError, Cancelled.

    Where the training data alone differs, the record stays and the training data is simulated.
    """
    if memo is None:
        return simulate(scenario, watch=watch)
    whole, measured = digest(training_settings(scenario)), digest(record_settings(scenario))
    scenario.validate()
    found = memo.get(f"training {whole}")
    if found is None:
        found = simulate(scenario, watch=watch, like=memo.get(f"record {measured}"))
        memo.put(f"record {measured}", found)
        memo.put(f"training {whole}", found)
    return found


def observers_reached(before: Scenario, now: Scenario) -> set[str] | None:
    """Return the observers that a change of settings may reach, before their priors are built; None where the record changes.

    A group of an observer's own reaches that observer; training data and lines those that ask for them; the model and the bands
    of all observers those that ask for a prior.
    """
    if record_settings(before) != record_settings(now):
        return None
    values = before.effective_values()
    changed = {name for name, used in now.effective_values().items() if used != values[name]}
    parts: set[Part] = {Lines} if LINES in changed else set()
    if training_settings(before) != training_settings(now):
        parts.add(Training)
    shared = bool(changed & MODELS)
    return {o.id for o in OBSERVERS.values() if o.group in changed or (shared and o.prior) or parts.intersection(o.prior)}


class RecordMemo:
    """The estimates that are known of a record: looked for in a memo, and noted there.

    record : digest of the record;  known_observers : observers whose estimates were known
    """

    memo: Memo
    record: str

    def __init__(self, memo: Memo, record: Record):
        self.memo, self.record = memo, record_digest(record)
        self.known_observers: set[str] = set()
        self._of = record
        self._names: dict[str, str] = {}
        self._signals: dict[frozenset[str], str] = {}

    def name(self, observer: Observer, prior: Prior, own: Plain | None) -> str:
        """Return the name of an observer's estimates; own : its settings that have an effect."""
        key = frozenset((*observer.sensors, *observer.needs))
        if key not in self._signals:
            self._signals[key] = digest(observer.measurements(self._of))
        return digest(observer.id, self._signals[key], prior, own)

    def find(self, observer: Observer, prior: Prior, own: Plain | None) -> tuple[str, list[Estimate]]:
        """Return the name of an observer's estimates, and the estimates, one per target; none unless all are known."""
        name = self.name(observer, prior, own)
        found = [self.memo.get(f"{name} {target}") for target in observer.targets]
        if any(e is None for e in found):
            return name, []
        self.known_observers.add(observer.id)
        self._names[observer.id] = name
        return name, found

    def note(self, name: str, estimate: Estimate) -> None:
        """Note an estimate of this name."""
        self._names[estimate.observer] = name
        self.memo.put(f"{name} {estimate.target}", estimate)

    def derive(self, estimate: Estimate, what: str, make: Callable[[], T]) -> T:
        """Return what follows from an estimate of an observer, or from all together, and the record; made where it is not known.

        what : says what it is, and on what else it depends
        """
        of = self._names.get(estimate.observer)
        if of is None:
            return make()
        return self.memo.keep(f"{what} of {of} {estimate.target} in {self.record}", make)
