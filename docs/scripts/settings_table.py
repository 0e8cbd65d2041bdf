"""Writes docs/settings.md from the declarations in the scenario and the observers: `python docs/scripts/settings_table.py`."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import param

from wfsobs.scenario import Scenario
from wfsobs.settings.group import Group, holds_groups
from wfsobs.settings.values import Reals, unit_of

PAGE = Path(__file__).parents[1] / "settings.md"

HEAD = """\
# Settings

Every setting of a run, by the path that it has on the command line (`--set path=value`), in TOML files and in
`Scenario.replace`. Items of a list are numbered from 0, and the number one past the end adds an item; N stands for such a
number. The defaults are those of `Scenario()`; `wfsobs presets NAME` prints those of a preset.

This page is written by [settings_table.py](scripts/settings_table.py) from the declarations in `wfsobs/scenario` and
`wfsobs/observers`.
"""


def page() -> str:
    """The whole page."""
    return "\n".join([HEAD, *sections(Scenario(), "")])


def sections(group: Group, prefix: str) -> list[str]:
    """One table per group, in the order of declaration."""
    out, rows = [], []
    inner: list[str] = []
    for name, p in group.settings().items():
        value = getattr(group, name)
        if isinstance(value, Group):
            inner += sections(value, f"{prefix}{name}.")
        elif isinstance(p, param.List) and holds_groups(p):
            inner += sections(p.item_type(), f"{prefix}{name}.N.")
        else:
            rows.append(f"| `{prefix}{name}` | {shown(value)} | {span(p)} | {unit_of(p) or '-'} | {meaning(p)} |")
    if rows:
        out.append(
            "\n".join(
                [
                    f"## {prefix.rstrip('.')}\n",
                    f"{inspect.getdoc(type(group))}\n",
                    "| Path | Default | Range | Unit | Meaning |",
                    "|---|---|---|---|---|",
                    *rows,
                    "",
                ]
            )
        )
    return out + inner


def shown(value: object) -> str:
    """A value as TOML and the command line write it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.10g}"
    if isinstance(value, list):
        return "[" + ", ".join(map(shown, value)) + "]"
    return str(value)


def span(p: param.Parameter) -> str:
    """What a setting takes."""
    if isinstance(p, Reals):
        (low, high), (shortest, longest) = p.item_bounds, p.bounds
        return f"{shortest} to {longest} numbers, each {low:g} to {high:.10g}"
    if isinstance(p, param.Selector):
        return ", ".join(map(str, p.objects))
    if isinstance(p, param.Boolean):
        return "true, false"
    low, high = p.bounds
    below = "" if p.inclusive_bounds[1] else "below "
    return f"{'whole, ' if isinstance(p, param.Integer) else ''}{low:g} to {below}{high:.10g}"


def meaning(p: param.Parameter) -> str:
    """The documentation without its unit, in one line."""
    text = re.sub(r"\s+\[[^\]]+\]", "", p.doc or "", count=1) if unit_of(p) else p.doc or ""
    return " ".join(text.split()).replace("|", "\\|")


def changes(scenario: Group, base: Group, prefix: str = "") -> list[tuple[str, str]]:
    """(path, value) of every setting in which a preset differs from the defaults."""
    out = []
    for name in scenario.settings():
        mine, other = getattr(scenario, name), getattr(base, name)
        if isinstance(mine, Group):
            out += changes(mine, other, f"{prefix}{name}.")
        elif isinstance(mine, list) and mine != other and mine and isinstance(mine[0], Group):
            out.append((f"{prefix}{name}", f"{len(mine)} {name}"))
        elif mine != other:
            out.append((f"{prefix}{name}", shown(mine)))
    return out


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
