"""Observers and controllers by id: those of wfsobs, those of installed packages, and those that a script registers.

A package declares its own by entry points of the groups "wfsobs.observers" and "wfsobs.controllers", which are read when a
registry is first used. Higher rooms are named by strings: nothing is imported before it is used.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator, Mapping, MutableMapping
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from threading import RLock
from typing import Any, Protocol, TypeVar

import param

from wfsobs.settings.group import Group
from wfsobs.settings.sections import Section

log = logging.getLogger(__name__)

OBSERVERS, CONTROLLERS = "wfsobs.observers", "wfsobs.controllers"
"""Groups of entry points."""

HOMES = {OBSERVERS: ("wfsobs.observers", "OBSERVERS"), CONTROLLERS: ("wfsobs.control.controllers", "CONTROLLERS")}
"""Group -> module and name of its registry."""

ID = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
GROUP_NAME = re.compile(r"[a-z][a-z0-9_]*")

_SECTIONS: dict[str, Section] = {}
_LOCK = RLock()
"""One for all registries: a package that is imported for one may read the others."""


class RegistrationError(ValueError):
    """Error: an observer or a controller that cannot be registered; one line with the reason."""


class Entry(Protocol):
    """Interface of an entry."""

    @property
    def id(self) -> str:
        """Id in tables and files."""
        ...

    @property
    def label(self) -> str:
        """Label for people."""
        ...


E = TypeVar("E", bound=Entry)


class Registry(MutableMapping[str, E]):
    """Entries by id, in the order of tables and legends: first those of wfsobs, then those of installed packages.

    Parameters
    ----------
    kind : type
        Type of the entries.
    group : str
        Group of entry points.
    built_in : iterable
        Entries of wfsobs.
    reserved_ids : iterable of str
        Ids that are used for something else.
    """

    def __init__(self, kind: type[E], group: str, built_in: Iterable[E], reserved_ids: Iterable[str] = ()):
        self.kind, self.group, self.reserved_ids = kind, group, frozenset(reserved_ids)
        self._entries: dict[str, E] = {}
        self._complete, self._reading = False, False
        for entry in built_in:
            self._put(entry)

    def add(self, entry: E) -> None:
        """Register an entry; the same one again changes nothing. Raises RegistrationError."""
        with _LOCK:
            self.complete()
            if self._entries.get(entry.id) is not entry:
                self._check(entry)
                self._put(entry)
                _scenario().settings()  # those made before have its settings from now on, too

    def complete(self) -> None:
        """Load the entries of installed packages, once; one that cannot be used is logged and left out."""
        if self._complete:
            return
        with _LOCK:
            if self._reading:  # by a package that is being imported
                return
            self._reading = True
            for point in sorted(entry_points(group=self.group)):
                self._load(point)
            self._complete = True

    def _load(self, point: EntryPoint) -> None:
        try:
            entry = point.load()
            if not isinstance(entry, self.kind):
                raise RegistrationError(f"takes a wfsobs {self.kind.__name__}, not {_kind(entry)}")
            self.add(entry)
        except (Exception, SystemExit) as error:
            what = str(error) if isinstance(error, RegistrationError) else f"{type(error).__name__}: {error}"
            package = f" of {point.dist.name}" if point.dist else ""
            log.warning("wfsobs: %s %s%s is left out: %s", self._word, point.value, package, " ".join(what.split()))

    def _put(self, entry: E) -> None:
        self._entries[entry.id] = entry
        for own in _settings(entry):
            if isinstance(own, Section):
                _SECTIONS.setdefault(own.name, own)

    def _check(self, entry: E) -> None:
        where = f"{self._word} {entry.id!r}"
        if not isinstance(entry.id, str) or not ID.fullmatch(entry.id):
            raise RegistrationError(f"{where}: an id takes lower-case letters, digits and hyphens between them")
        if entry.id in self._entries:
            raise RegistrationError(f"{where}: the id is taken, by {self._entries[entry.id].label}")
        if entry.id in self.reserved_ids:
            raise RegistrationError(f"{where}: the id is taken, by a row of the tables")
        if entry.label in (other.label for other in self._entries.values()):
            raise RegistrationError(f"{where}: the label {entry.label!r} is taken")
        for own in _settings(entry):
            _check_settings(own, where)

    @property
    def _word(self) -> str:
        return self.kind.__name__.lower()

    def __getitem__(self, id_: str) -> E:
        self.complete()
        return self._entries[id_]

    def __setitem__(self, id_: str, entry: E) -> None:
        self.complete()
        self._entries[id_] = entry

    def __delitem__(self, id_: str) -> None:
        self.complete()
        del self._entries[id_]

    def __iter__(self) -> Iterator[str]:
        self.complete()
        return iter(tuple(self._entries))

    def __len__(self) -> int:
        self.complete()
        return len(self._entries)


def register(entry: Any) -> None:
    """Register an observer or a controller, beside those of wfsobs.

    An installed package declares its own by an entry point instead, which other processes see as well.

    Parameters
    ----------
    entry : Observer or Controller
        What to register; the same one again changes nothing.

    Raises
    ------
    RegistrationError
        An id or a group of settings is taken or has forbidden characters, or `entry` is neither.
    """
    for group in HOMES:
        registry = _registry(group)
        if isinstance(entry, registry.kind):
            registry.add(entry)
            return
    raise RegistrationError(f"register: takes an Observer or a Controller, not {_kind(entry)}")


def sections() -> Mapping[str, Section]:
    """Return the groups of settings of observers and controllers, by name, in the order of the registries."""
    _registry(OBSERVERS).complete()
    if _is_installed(CONTROLLERS):  # else none has to be imported: those of wfsobs bring no settings
        _registry(CONTROLLERS).complete()
    return dict(_SECTIONS)


@cache
def _is_installed(group: str) -> bool:
    return bool(entry_points(group=group))


def _registry(group: str) -> Registry[Any]:
    module, name = HOMES[group]
    return getattr(import_module(module), name)


def _scenario() -> Any:
    return import_module("wfsobs.scenario").Scenario


def _settings(entry: Entry) -> tuple[Any, ...]:
    """Return the settings of an entry: its own sections, or names of groups of a scenario."""
    own = getattr(entry, "settings", None)
    if own is None:
        return ()
    return own if isinstance(own, tuple) and not isinstance(own, Section) else (own,)


def _check_settings(own: Any, where: str) -> None:
    """Raise RegistrationError where a scenario cannot have these settings."""
    if isinstance(own, str) and own in _scenario().settings():
        return
    if isinstance(own, str):
        raise RegistrationError(f"{where}: settings {own!r}: no scenario has such a group")
    if not isinstance(own, Section) or not (isinstance(own.group, type) and issubclass(own.group, Group)):
        raise RegistrationError(f"{where}: settings takes a Section of a Group, not {_kind(own)}")
    if not GROUP_NAME.fullmatch(own.name):
        raise RegistrationError(f"{where}: settings {own.name!r}: a name takes lower-case letters, digits and underscores")
    if _SECTIONS.get(own.name, own) != own or (own.name not in _SECTIONS and hasattr(_scenario(), own.name)):
        raise RegistrationError(f"{where}: settings {own.name!r}: the name is taken")
    for name, p in own.group.settings().items():
        low, high = getattr(p, "bounds", None) or (None, None)
        if isinstance(p, param.Number) and (low is None or high is None):
            raise RegistrationError(f"{where}: settings {own.name}.{name}: a number takes bounds, lowest and highest")


def _kind(value: Any) -> str:
    return f"the class {value.__name__}" if isinstance(value, type) else f"a {type(value).__name__}"
