"""Observers and controllers by id: those of wfsobs, those of installed packages, and those that a script registers.

A package declares its own by entry points of the groups "wfsobs.observers" and "wfsobs.controllers", which are read when a
registry is first used. The tree of all settings, a room above, announces itself: the settings of entries must fit it.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator, Mapping, MutableMapping
from importlib.metadata import EntryPoint, entry_points
from math import inf
from numbers import Real
from threading import RLock
from typing import Any, Protocol, TypeVar

import param

from wfsobs.settings.group import Group, Section
from wfsobs.settings.values import SettingError

log: logging.Logger = logging.getLogger(__name__)

OBSERVERS, CONTROLLERS = "wfsobs.observers", "wfsobs.controllers"
"""Groups of entry points."""

ID = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
GROUP_NAME = re.compile(r"[a-z][a-z0-9_]*")

_SECTIONS: dict[str, Section] = {}
_REGISTRIES: dict[str, Registry[Any]] = {}
"""Group of entry points -> its registry, once that is imported."""
_TREES: list[type[Group]] = []
"""The tree of all settings, once that is imported."""
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

    def check_fields(self) -> None:
        """Raise ValueError, one line, where a field has a value that it does not take."""
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

    group: str
    reserved_ids: frozenset[str]

    def __init__(self, kind: type[E], group: str, built_in: Iterable[E], reserved_ids: Iterable[str] = ()):
        self.kind, self.group, self.reserved_ids = kind, group, frozenset(reserved_ids)
        self._entries: dict[str, E] = {}
        self._complete, self._reading = False, False
        for entry in built_in:
            self._put(entry)
        self._built_in = frozenset(self._entries)
        _REGISTRIES.setdefault(group, self)

    def add(self, entry: E) -> None:
        """Register an entry; the same one again changes nothing. Raises RegistrationError."""
        with _LOCK:
            self.complete()
            if self._entries.get(entry.id) is not entry:
                self._check(entry)
                self._put(entry)
                for tree in _TREES:
                    tree.settings()  # those made before have its settings from now on, too

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
                raise RegistrationError(f"takes a wfsobs {self.kind.__name__}, not {kind_of(entry)}")
            self.add(entry)
        except (Exception, SystemExit) as error:
            what = str(error) if isinstance(error, RegistrationError) else f"{type(error).__name__}: {error}"
            package = f" of {point.dist.name}" if point.dist else ""
            log.warning("wfsobs: %s %s%s is left out: %s", self._word, point.value, package, " ".join(what.split()))

    def review(self) -> None:
        """Check the entries of packages again; one that cannot be used is logged and left out."""
        for id_, entry in list(self._entries.items()):
            try:
                if id_ not in self._built_in:
                    _check_settings(entry, f"{self._word} {id_!r}")
            except RegistrationError as error:
                del self._entries[id_]
                log.warning("wfsobs: %s is left out", error)

    def _put(self, entry: E) -> None:
        self._entries[entry.id] = entry
        for own in _settings(entry):
            if isinstance(own, Section):
                _SECTIONS.setdefault(own.name, own)

    def _check(self, entry: E) -> None:
        where = f"{self._word} {entry.id!r}"
        if not isinstance(entry.id, str) or not ID.fullmatch(entry.id):
            raise RegistrationError(f"{where}: an id takes lower-case letters, digits and hyphens between them")
        if not isinstance(entry.label, str) or not entry.label.strip():
            raise RegistrationError(f"{where}: label = {entry.label!r}: takes a text")
        if entry.id in self._entries:
            raise RegistrationError(f"{where}: the id is taken, by {self._entries[entry.id].label}")
        if entry.id in self.reserved_ids:
            raise RegistrationError(f"{where}: the id is taken, by a row of the tables")
        if entry.label in (other.label for other in self._entries.values()):
            raise RegistrationError(f"{where}: the label {entry.label!r} is taken")
        try:
            entry.check_fields()
        except ValueError as error:
            raise RegistrationError(f"{where}: {error}") from None
        _check_settings(entry, where)

    def check_ids(self, ids: Iterable[str]) -> None:
        """Raise SettingError for an id that is not there."""
        if unknown := set(ids) - set(self):
            raise SettingError(f"{self._word} {min(unknown)!r}: no such {self._word}; there are {', '.join(self)}")

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


def name_list(names: str | Iterable[str] | None) -> list[str] | None:
    """Return names as a list, a text as one name, and None as None."""
    return names if names is None else [names] if isinstance(names, str) else list(names)


def check_tuple(name: str, value: object, choices: Iterable[Any]) -> None:
    """Raise ValueError where the field `name` of an entry is no tuple out of some choices."""
    choices = list(choices)
    if not isinstance(value, tuple) or any(one not in choices for one in value):
        words = ", ".join(getattr(one, "__name__", one) for one in choices)
        raise ValueError(f"{name} = {value!r}: takes a tuple out of {words}")
    if len(set(value)) < len(value):
        raise ValueError(f"{name} = {value!r}: takes each of them once")


def check_weight(weight: object) -> None:
    """Raise ValueError where the weight of an entry is no number above 0."""
    if not isinstance(weight, Real) or not 0.0 < float(weight) < inf:
        raise ValueError(f"weight = {weight!r}: takes a number above 0")


def sections() -> Mapping[str, Section]:
    """Return the groups of settings of what is in the registries that are imported, by name, in their order."""
    for registry in _REGISTRIES.values():
        registry.complete()
    return dict(_SECTIONS)


def announce(tree: type[Group]) -> None:
    """Have the settings of entries fit the tree of all settings; those of packages that do not are logged and left out."""
    for name in [name for name in _SECTIONS if hasattr(tree, name)]:  # taken by the tree, before there was one to ask
        del _SECTIONS[name]
    _TREES.append(tree)
    for registry in _REGISTRIES.values():
        registry.review()


def _settings(entry: Entry) -> tuple[Any, ...]:
    """Return the settings of an entry: its own sections, or names of groups of a scenario."""
    own = getattr(entry, "settings", None)
    if own is None:
        return ()
    return own if isinstance(own, tuple) and not isinstance(own, Section) else (own,)


def _check_settings(entry: Entry, where: str) -> None:
    """Raise RegistrationError where the tree of all settings cannot have those of an entry."""
    for own in _settings(entry):
        if isinstance(own, str):
            if any(own not in tree.settings() for tree in _TREES):
                raise RegistrationError(f"{where}: settings {own!r}: no scenario has such a group")
            continue
        if not isinstance(own, Section) or not (isinstance(own.group, type) and issubclass(own.group, Group)):
            raise RegistrationError(f"{where}: settings takes a Section of a Group, not {kind_of(own)}")
        if not GROUP_NAME.fullmatch(own.name):
            raise RegistrationError(f"{where}: settings {own.name!r}: a name takes lower-case letters, digits and underscores")
        if _SECTIONS.get(own.name, own) != own or (own.name not in _SECTIONS and any(hasattr(t, own.name) for t in _TREES)):
            raise RegistrationError(f"{where}: settings {own.name!r}: the name is taken")
        for name, p in own.group.settings().items():
            low, high = getattr(p, "bounds", None) or (None, None)
            if isinstance(p, param.Number) and (low is None or high is None):
                raise RegistrationError(f"{where}: settings {own.name}.{name}: a number takes bounds, lowest and highest")
    _check_tunable(entry, where)


def _check_tunable(entry: Entry, where: str) -> None:
    """Raise RegistrationError where what can be tuned is no setting; those of a scenario count once that is imported."""
    own = {part.name: part.group for part in _settings(entry) if isinstance(part, Section)}
    known = {f"{name}.{path}" for name, group in own.items() for path, _, _ in group().walk()}
    known |= {path for tree in _TREES for path, _, _ in tree().walk()}
    for path in (path for part in getattr(entry, "tunable", ()) for path in part):
        if path not in known and (_TREES or path.partition(".")[0] in own):
            raise RegistrationError(f"{where}: tunable {path!r}: no scenario has such a setting")


def kind_of(value: Any) -> str:
    """Return what a value is, for a message."""
    return f"the class {value.__name__}" if isinstance(value, type) else f"a {type(value).__name__}"
