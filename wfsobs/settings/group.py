"""A tree of settings: dotted paths, strict checks, plain dictionaries, differences.

The settings themselves are declared once, in `wfsobs.scenario.scenario` and by the observers; widgets, command-line settings,
TOML files and shareable links all go through the functions here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, NamedTuple, Self, TypeVar, cast

import param

from wfsobs.notebook import html_table
from wfsobs.settings.values import (
    Plain,
    Reals,
    SettingError,
    allowed_values,
    hint,
    leaves,
    put_value,
    settings_once,
    shorten,
    to_native,
    unit_of,
)

UsedWhen = Mapping[str, tuple[str, tuple[Any, ...]]]
"""Setting -> another one of its group, and the values of it with which it has an effect."""

SHOWN = 3
"""Maximum number of settings in the representation of a group."""


def why_idle(group: Group, other: str, values: tuple[Any, ...]) -> str:
    """Say that a setting has an effect only for some values of another one."""
    allowed = " or ".join({True: "on", False: "off"}[v] if isinstance(v, bool) else str(v) for v in values)
    return f"Used only where {group.settings()[other].label} is {allowed}"


class Group(param.Parameterized):
    """A named group of settings; groups nest, and a list of groups can grow and shrink.

    Values out of bounds raise `SettingError` at once when they come by path, dictionary or file, and
    `ValueError` (from param, naming the parameter) on plain attribute assignment. Names that do not
    exist are refused on every way in.

    used_when : setting -> another one of the group, and the values of it with which it has an effect
    """

    used_when: ClassVar[UsedWhen] = {}

    def __init_subclass__(cls) -> None:
        """Make a declaration that of the class: without this param copies it for every object whose value is set."""
        super().__init_subclass__()
        for p in vars(cls).values():
            if isinstance(p, param.Parameter):
                p.per_instance = False

    def __init__(self, **values: Any):
        for name, p in self.settings().items():
            if name in values:
                continue
            if isinstance(p, param.List):
                values[name] = [v.copy() if isinstance(v, Group) else v for v in p.default or []]
            elif isinstance(p, param.ClassSelector):
                values[name] = cast(type[Group], p.class_)()
        super().__init__(**values)

    def __setattr__(self, name: str, value: Any) -> None:
        if not name.startswith("_") and name != "name" and name not in type(self).param:
            raise AttributeError(f"{type(self).__name__} has no setting {name!r}")
        super().__setattr__(name, to_native(value))

    def idle(self) -> dict[str, str]:
        """Return the settings without effect for the present values of the others: name -> reason in one line."""
        return {
            name: why_idle(self, other, values)
            for name, (other, values) in self.used_when.items()
            if getattr(self, other) not in values
        }

    def effective_values(self) -> Plain:
        """Return the tree as nested plain values, without the settings that have no effect."""
        idle = self.idle()
        return {name: _effective(getattr(self, name)) for name in self.settings() if name not in idle}

    def __repr__(self) -> str:
        changed = self._changed_settings()
        shown = ", ".join(f"{path}={value}" for path, value in changed[:SHOWN])
        return f"{type(self).__name__}({shown}{f', and {len(changed) - SHOWN} more' if len(changed) > SHOWN else ''})"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        changed = self._changed_settings()
        return html_table((type(self).__name__, "" if changed else "default settings"), changed)

    def _changed_settings(self) -> list[tuple[str, str]]:
        """Return (dotted path, value, shortened) of the settings that are not at their defaults."""

        def text(value: Any) -> str:
            return f"[{len(value)} entries]" if isinstance(value, list) and len(value) > 3 else shorten(value, 40)

        return [(path, text(value)) for path, value in leaves(self.difference(type(self)()))]

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Group) and type(self) is type(other) and self.to_dict() == other.to_dict())

    def __hash__(self) -> int:
        return hash(repr(self.to_dict()))

    def copy(self) -> Self:
        """Return an independent copy of the whole tree."""
        return type(self).from_dict(self.to_dict())

    # ------------------------------------------------------------------ plain values

    @classmethod
    def settings(cls) -> dict[str, param.Parameter[Any]]:
        """Return name -> param.Parameter of every setting, in order of declaration; not to be changed."""
        return settings_once(cls)

    def to_dict(self) -> Plain:
        """Return the tree as nested plain values."""
        return {name: _plain(getattr(self, name)) for name in self.settings()}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Return a tree with `values` on top of the defaults. Raises SettingError."""
        tree = cls()
        tree.update(values)
        return tree

    def update(self, values: Mapping[str, Any], prefix: str = "") -> None:
        """Set every value of a (partial) dictionary; whole lists are replaced. Raises SettingError."""
        for name, value in values.items():
            self._set_one(str(name), value, prefix)

    def _set_one(self, name: str, value: Any, prefix: str) -> None:
        path = f"{prefix}{name}"
        p = self.settings().get(name)
        if p is None:
            raise SettingError(f"{path}: no such setting; {name!r} is not one of {', '.join(self.settings())}")
        current = getattr(self, name)
        if isinstance(current, Group) and not isinstance(value, Group):
            if not isinstance(value, Mapping):
                raise SettingError(f"{path} = {shorten(value)}: this is a group of settings, not a value")
            current.update(value, f"{path}.")
            return
        if isinstance(p, param.List) and holds_groups(p):
            value = _groups(p, value, path)
        elif isinstance(value, Group):
            value = value.copy()
        if type(value) is type(current) and value == current:
            return  # most of a copy: to set these again takes half the time
        try:
            setattr(self, name, value)
        except (ValueError, TypeError, RecursionError) as error:  # the last of param's words for a value nested very deep
            raise SettingError(f"{path} = {shorten(value)}: {allowed_values(p)}{hint(value)}") from error

    def difference(self, base: Group) -> Plain:
        """Return the settings in which this tree differs from `base`, as a partial dictionary."""
        out: Plain = {}
        for name in self.settings():
            mine, other = getattr(self, name), getattr(base, name)
            if isinstance(mine, Group):
                if inner := mine.difference(other):
                    out[name] = inner
            elif _plain(mine) != _plain(other):
                out[name] = _plain(mine)
        return out

    # ------------------------------------------------------------------ dotted paths

    def set(self, path: str, value: Any) -> None:
        """Set one setting by its dotted path.

        Parameters
        ----------
        path : str
            Dotted path, with list items by number; the number one past the end of a list adds an item.
        value : object
            New value, plain.

        Raises
        ------
        SettingError
            The setting does not exist, or takes no such value.

        Examples
        --------
        >>> from wfsobs.scenario import Scenario
        >>> s = Scenario()
        >>> s.set("vibration.peaks.0.frequency", 45)
        >>> s.vibration.peaks[0].frequency
        45.0
        """
        fresh = self.replace({path: value})
        for name in self.settings():
            setattr(self, name, getattr(fresh, name))

    def lookup(self, path: str) -> Any:
        """Return the value of a setting by its dotted path; items of lists by number."""
        node: Any = self
        for key in path.split("."):
            node = node[int(key)] if isinstance(node, list) else getattr(node, key)
        return node

    def replace(self, changes: Mapping[str, Any]) -> Self:
        """Return a copy with some settings changed: dotted path -> plain value. Raises SettingError."""
        trial = self.to_dict()
        for path, value in changes.items():
            if put_value(trial, path.split("."), value, path):
                trial = type(self).from_dict(trial).to_dict()  # a new item has its other settings, too
        return type(self).from_dict(trial)

    def walk(self, prefix: str = "") -> Iterator[tuple[str, Group, param.Parameter[Any]]]:
        """Yield (dotted path, group that owns it, parameter) of every setting that is a value or a list."""
        for name, p in self.settings().items():
            value = getattr(self, name)
            if isinstance(value, Group):
                yield from value.walk(f"{prefix}{name}.")
            elif isinstance(p, param.List) and holds_groups(p):
                for i, item in enumerate(value):
                    yield from item.walk(f"{prefix}{name}.{i}.")
            else:
                yield f"{prefix}{name}", self, p

    def parameter(self, path: str) -> param.Parameter[Any] | None:
        """Return the parameter of a setting, that of the list for a number in it; None where there is no such setting."""
        known = {at: p for at, _, p in self.walk()}
        above, _, number = path.rpartition(".")
        return known.get(path) or (p if number.isdecimal() and isinstance(p := known.get(above), Reals) else None)

    def unit(self, path: str) -> str:
        """Return the unit of a setting, empty where it has none or there is no such setting."""
        p = self.parameter(path)
        return "" if p is None else unit_of(p)

    def lists(self, prefix: str = "") -> Iterator[tuple[str, param.List[Any]]]:
        """Yield (dotted path, parameter) of every list of groups."""
        for name, p in self.settings().items():
            value = getattr(self, name)
            if isinstance(value, Group):
                yield from value.lists(f"{prefix}{name}.")
            elif isinstance(p, param.List) and holds_groups(p):
                yield f"{prefix}{name}", p


def _effective(value: Any) -> Any:
    """Return a value as plain values, without settings that have no effect."""
    if isinstance(value, Group):
        return value.effective_values()
    return [_effective(v) for v in value] if isinstance(value, list) else _plain(value)


def _plain(value: Any) -> Any:
    if isinstance(value, Group):
        return value.to_dict()
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return value


def holds_groups(p: param.List[Any]) -> bool:
    """Return whether a list's items are groups of settings."""
    return isinstance(p.item_type, type) and issubclass(p.item_type, Group)


def settings_of(p: param.List[Any]) -> dict[str, param.Parameter[Any]]:
    """Return the settings of an item of a list of groups."""
    return cast(type[Group], p.item_type).settings()


def _groups(p: param.List[Any], value: Any, path: str) -> list[Group]:
    if not isinstance(value, (list, tuple)):
        raise SettingError(f"{path} = {shorten(value)}: takes a list of tables")
    _, high = p.bounds or (0, None)
    if high is not None and len(value) > high:
        raise SettingError(f"{path}: {len(value)} entries, at most {high} are allowed")
    out: list[Group] = []
    for i, item in enumerate(value):
        if isinstance(item, Group):
            out.append(item.copy())
        elif isinstance(item, Mapping):
            made = cast(type[Group], p.item_type)()
            made.update(item, f"{path}.{i}.")
            out.append(made)
        else:
            raise SettingError(f"{path}.{i} = {shorten(item)}: takes a table of settings")
    return out


G = TypeVar("G", bound=Group)


class Section(NamedTuple):
    """A group of settings of an observer or a controller.

    Attributes
    ----------
    name : str
        Name in a scenario, before the first dot of the paths and in TOML.
    label : str
        Label on the page.
    group : type of Group
        The settings.
    """

    name: str
    label: str
    group: type[Group]


class _Section(param.ClassSelector):
    """A setting that is a group; a tree made before the setting was declared gets a fresh one when it is read."""

    def __get__(self, obj: Any, objtype: Any) -> Any:
        value = super().__get__(obj, objtype)
        if value is None and obj is not None:
            value = cast(type[Group], self.class_)()
            self.__set__(obj, value)
        return value


def section(kind: type[G], label: str, doc: str = "") -> G:
    """Declare a setting that is a group of its own; each tree gets a fresh one."""
    return cast(G, _Section(class_=kind, label=label, doc=doc, per_instance=False))
