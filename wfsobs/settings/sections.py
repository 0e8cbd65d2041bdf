"""Settings that are a group of their own: in a tree, and of an observer or a controller."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar, cast

import param

from wfsobs.settings.group import Group

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
