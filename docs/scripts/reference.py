"""Makes the reference from the code: a page per package, and the tables of presets, observers and controllers."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import click
from settings_table import changes

from wfsobs.cli import main
from wfsobs.closed_loop.run import controller_needs
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.observers import OBSERVERS
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS

ROOT = Path(__file__).parents[2]
APART = ("app", "assets")
"""Packages that are no library: the dashboard, and files."""


def pages() -> dict[str, str]:
    """Path of a page in the site -> its Markdown."""
    return {
        **api(),
        "reference/presets.md": presets(),
        "reference/observers.md": observers(),
        "reference/controllers.md": controllers(),
        "reference/command-line.md": commands(),
    }


def commands() -> str:
    """Every command with its arguments and options, as `--help` has them."""
    out = ["# Command line\n\n[The command line](../command-line.md) is an introduction with examples.\n"]
    whole = click.Context(main, info_name="wfsobs", **main.context_settings)
    for name, command, parent in every_command(main, whole):
        context = click.Context(command, info_name=name.split()[-1], parent=parent)
        records = (p.get_help_record(context) for p in command.get_params(context))
        rows = ((f"`{option}`", linked(text)) for option, text in filter(None, records) if text)
        usage = command.get_usage(context).removeprefix("Usage: ")
        text = linked(inspect.cleandoc(command.help or ""))
        out.append(f"## wfsobs {name}\n\n{text}\n\n    {usage}\n\n{table(('Option', 'Meaning'), rows)}\n")
    return "\n".join(out)


def every_command(group: click.Group, context: click.Context) -> Iterator[tuple[str, click.Command, click.Context]]:
    """Name, command and context of the group above it, of the commands of a group and of the groups in it."""
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield name, command, context
        if isinstance(command, click.Group):
            below = every_command(command, click.Context(command, info_name=name, parent=context))
            yield from ((f"{name} {inner}", one, parent) for inner, one, parent in below)


def linked(text: str) -> str:
    """A text of the program, the pages that it names as links."""
    return re.sub(r"docs/([\w-]+)\.md", r"[\1](../\1.md)", text.replace("|", "\\|"))


def api() -> dict[str, str]:
    """The public names, a page per package with all its modules, and the list of both for the navigation."""
    out = {
        "reference/api/index.md": "# Public names\n\nWhat `import wfsobs` gives.\n\n"
        "::: wfsobs\n    options:\n      show_root_heading: false\n      show_root_toc_entry: false\n      heading_level: 2\n"
        "      members_order: [__all__]\n"
    }
    links = ["* [Public names](index.md)"]
    for package in packages(ROOT / "wfsobs"):
        name = ".".join(package.relative_to(ROOT).parts)
        out[f"reference/api/{name}.md"] = package_page(name, package)
        links.append(f"* [{name}]({name}.md)")
    out["reference/api/SUMMARY.md"] = "\n".join(links) + "\n"
    return out


def packages(root: Path) -> list[Path]:
    """The folder of the package and those of its packages that have a module beside `__init__`."""
    found = sorted(file.parent for file in root.rglob("__init__.py"))
    return [p for p in found if p.relative_to(root).parts[:1] not in [(name,) for name in APART] and any(modules(p))]


def modules(package: Path) -> list[Path]:
    """The modules of a folder."""
    return [file for file in sorted(package.glob("*.py")) if not file.stem.startswith("__")]


def package_page(name: str, package: Path) -> str:
    """What a package says of itself, then its modules."""
    about = ast.get_docstring(ast.parse((package / "__init__.py").read_text(encoding="utf-8"))) or ""
    about = "" if name == "wfsobs" else about
    parts = [f"# {name}", about, *(f"::: {name}.{file.stem}" for file in modules(package))]
    return "\n\n".join(filter(None, parts)) + "\n"


def presets() -> str:
    """Every preset: what it is, and what it changes."""
    out = [
        "# Presets\n\nA preset is a scenario to start from: `wfsobs run --preset NAME`, or `wfsobs.PRESETS[NAME]()` in "
        "Python. `wfsobs presets NAME` prints one in full. The tables list the settings in which a preset differs from the "
        "[defaults](../settings.md).\n"
    ]
    for name, make in PRESETS.items():
        rows = ([f"`{path}`", value] for path, value in changes(make(), Scenario()))
        out.append(f"## {name}\n\n{inspect.getdoc(make)}\n\n{table(('Setting', 'Value'), rows)}\n")
    return "\n".join(out)


def observers() -> str:
    """Every observer: what it needs and costs, and what its function says."""
    out = [
        "# Observers\n\nThe registry of observers. [Observers](../observers.md) has a line on what each one is, "
        "[Model](../model.md#observers) the equations.\n"
    ]
    for o in OBSERVERS.values():
        function = o.run or getattr(o.step, "func", o.step)
        rows = (
            ("Estimates", ", ".join(o.targets)),
            ("Needs beside measurements", o.needs_text()),
            ("Needs of a record", listed(("y_lgs", "u", *o.needs) if o.id != "zero" else ())),
            ("Causal", "yes" if o.causal else "no: a reference that looks ahead"),
            ("Computing time, Kalman filter = 1", f"{o.weight:g}"),
            ("Its settings", listed([o.group] if o.group else ())),
            ("Settings that are tuned", listed(o.tunable.usual)),
            ("Function", reference(function)),
        )
        about = f"{o.help[:1].upper()}{o.help[1:]}.\n\n" if o.help else ""
        out.append(f"## {o.label} (`{o.id}`)\n\n{about}{table(('Property', 'Value'), rows)}\n\n{inspect.getdoc(function)}\n")
    return "\n".join(out)


def controllers() -> str:
    """Every controller: what it needs and costs."""
    rows = (
        (f"`{c.id}`", c.label, controller_needs(c.id, Scenario()), "yes" if c.ngs else "no", f"{c.weight:g}")
        for c in CONTROLLERS.values()
    )
    head = ("Id", "Name", "Needs beside measurements", "Uses the NGS", "Computing time, linear law = 1")
    about = (
        "The registry of controllers, which `wfsobs loop` compares. [Closed loop](../closed_loop.md) has the method and the "
        "results. What the integrators need is that of `control.integrator` = optimised."
    )
    return f"# Controllers\n\n{about}\n\n{table(head, rows)}\n"


def listed(names: Iterable[str]) -> str:
    """Names as code, or a dash."""
    return ", ".join(f"`{name}`" for name in names) or "-"


def reference(function: Callable) -> str:
    """A link to a function's place in the reference."""
    return f"[`{function.__name__}`][{function.__module__}.{function.__qualname__}]"


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    lines = [list(head), *map(list, rows)]
    lines.insert(1, ["---"] * len(lines[0]))
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
