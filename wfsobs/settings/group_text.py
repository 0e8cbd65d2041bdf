"""Groups of settings as text: what differs from the defaults, and why a setting has no effect."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from wfsobs.notebook import html_table
from wfsobs.settings.errors import shorten
from wfsobs.settings.tree import leaves

if TYPE_CHECKING:
    from wfsobs.settings.group import Group

SHOWN = 3
"""Maximum number of settings in the representation of a group."""


def one_line(group: Group) -> str:
    """Return a group with the first settings that are not at their defaults."""
    changed = _changed_settings(group)
    shown = ", ".join(f"{path}={value}" for path, value in changed[:SHOWN])
    return f"{type(group).__name__}({shown}{f', and {len(changed) - SHOWN} more' if len(changed) > SHOWN else ''})"


def settings_html(group: Group) -> str:
    """Return a table of the settings that are not at their defaults."""
    changed = _changed_settings(group)
    return html_table((type(group).__name__, "" if changed else "default settings"), changed)


def _changed_settings(group: Group) -> list[tuple[str, str]]:
    """Return (dotted path, value, shortened) of the settings that are not at their defaults."""

    def text(value: Any) -> str:
        return f"[{len(value)} entries]" if isinstance(value, list) and len(value) > 3 else shorten(value, 40)

    return [(path, text(value)) for path, value in leaves(group.difference(type(group)()))]


def why_idle(group: Group, other: str, values: tuple[Any, ...]) -> str:
    """Say that a setting has an effect only for some values of another one."""
    allowed = " or ".join({True: "on", False: "off"}[v] if isinstance(v, bool) else str(v) for v in values)
    return f"Used only where {group.settings()[other].label} is {allowed}"
