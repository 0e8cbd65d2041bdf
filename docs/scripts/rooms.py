"""Draws the plan of the code: packages of wfsobs as boxes on floors, each above all that it imports.

Read from the imports as they are written, without running anything. `python docs/scripts/rooms.py > rooms.svg` prints it.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2] / "wfsobs"
WIDTH, HEIGHT, GAP, FLOOR = 132, 40, 14, 84
"""Size of a box, space between two, height of a floor [px]."""

FUNCTION = (ast.FunctionDef, ast.AsyncFunctionDef)

Graph = Mapping[str, set[str]]
"""Room -> the rooms that it imports."""


class Plan(NamedTuple):
    """imports : when a room is imported; later : inside functions, when they are called; says : first line of its docstring."""

    imports: dict[str, set[str]]
    later: dict[str, set[str]]
    says: dict[str, str]


def plan(root: Path = ROOT) -> Plan:
    """Packages and modules of the top level, and what each imports of the others."""
    rooms: dict[str, list[Path]] = {}
    for entry in sorted(root.iterdir()):
        if (entry / "__init__.py").exists():
            rooms[entry.name] = sorted(entry.rglob("*.py"))
        elif entry.suffix == ".py" and not entry.stem.startswith("__"):
            rooms[entry.stem] = [entry]
    imports, later, says = {}, {}, {}
    for room, files in rooms.items():
        trees = [ast.parse(file.read_text(encoding="utf-8")) for file in files]
        at_once = {name for tree in trees for node in _at_import(tree) for name in _rooms_named(node, rooms)}
        functions = [node for tree in trees for node in ast.walk(tree) if isinstance(node, FUNCTION)]
        called = {name for function in functions for node in ast.walk(function) for name in _rooms_named(node, rooms)}
        imports[room], later[room] = at_once - {room}, called - at_once - {room}
        says[room] = (ast.get_docstring(trees[0]) or "").split("\n")[0]
    return Plan(imports, later, says)


def _at_import(tree: ast.Module) -> Iterator[ast.AST]:
    """Statements that run when a module is imported."""
    nodes: list[ast.AST] = list(tree.body)
    while nodes:
        node = nodes.pop()
        yield node
        if isinstance(node, (ast.Try, ast.With)) or (isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.dump(node.test)):
            nodes += ast.iter_child_nodes(node)


def _rooms_named(node: ast.AST, rooms: Mapping[str, object]) -> set[str]:
    """Rooms that an import statement names."""
    names: list[str] = []
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom) and not node.level:
        names = [f"{node.module}.{alias.name}" for alias in node.names]
    parts = [name.split(".") for name in names]
    return {p[1] for p in parts if p[0] == "wfsobs" and len(p) > 1 and p[1] in rooms}


def floors(graph: Graph) -> dict[str, int]:
    """The floor of every room, 0 for one that imports nothing. Rooms that import each other in a circle share a floor."""
    below = reachable(graph)
    circle = {room: {room} | {other for other in below[room] if room in below[other]} for room in graph}
    found: dict[str, int] = {}

    def floor(room: str) -> int:
        if room not in found:
            outside = set().union(*(graph[r] for r in circle[room])) - circle[room]
            found[room] = 1 + max(map(floor, outside), default=-1)
        return found[room]

    return {room: floor(room) for room in graph}


def reachable(graph: Graph) -> dict[str, set[str]]:
    """All that a room imports, directly or through others."""
    out = {room: set(others) for room, others in graph.items()}
    for middle in graph:
        for others in out.values():
            if middle in others:
                others |= out[middle]
    return out


def reduced(graph: Graph) -> dict[str, set[str]]:
    """Without the arrows that others imply."""
    below = reachable(graph)
    return {
        room: {o for o in others if not any(o in below[p] and room not in below[p] for p in others - {o})}
        for room, others in graph.items()
    }


def rows(graph: Graph) -> list[list[str]]:
    """Rooms by floor, the ground first, each near what it imports."""
    level = floors(graph)
    out = [sorted(r for r in graph if level[r] == i) for i in range(max(level.values()) + 1)]
    arrows, place = reduced(graph), {}
    for _ in range(4):
        for row in out:
            place |= {room: (i + 0.5) / len(row) for i, room in enumerate(row)}
        for row in out[1:]:
            row.sort(key=lambda room: sum(place[o] for o in arrows[room]) / max(len(arrows[room]), 1))
            place |= {room: (i + 0.5) / len(row) for i, room in enumerate(row)}
    return out


def svg(told: Plan) -> str:
    """The drawing, in the colour of the text around it."""
    lines = rows(told.imports)
    broad = max(map(len, lines)) * (WIDTH + GAP) + GAP
    tall = len(lines) * FLOOR
    spot = {
        room: ((i + 0.5) * broad / len(line), tall - (n + 0.5) * FLOOR)
        for n, line in enumerate(lines)
        for i, room in enumerate(line)
    }
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {broad} {tall}" role="img" '
        'aria-label="Packages of wfsobs on floors, each above what it imports" font-family="inherit" font-size="15">'
    ]
    for kind, dashes in ((reduced(told.imports), ""), (told.later, ' stroke-dasharray="4 4"')):
        out += [_arrow(spot[room], spot[other], dashes) for room in spot for other in sorted(kind[room])]
    for room, (x, y) in spot.items():
        out.append(
            f'<g><title>{escape(told.says[room])}</title><rect x="{x - WIDTH / 2:.0f}" y="{y - HEIGHT / 2:.0f}" '
            f'width="{WIDTH}" height="{HEIGHT}" rx="6" fill="var(--md-default-bg-color, #fff)" stroke="currentColor"/>'
            f'<text x="{x:.0f}" y="{y + 5:.0f}" text-anchor="middle" fill="currentColor">{escape(room)}</text></g>'
        )
    return "".join([*out, "</svg>"])


def _arrow(start: tuple[float, float], end: tuple[float, float], dashes: str) -> str:
    (x1, y1), (x2, y2) = start, end
    down = 1 if y2 >= y1 else -1
    y1, y2 = y1 + down * HEIGHT / 2, y2 - (down if y2 != y1 else -1) * HEIGHT / 2
    bend = (y1 + y2) / 2 if y2 != y1 else y1 + 0.8 * (FLOOR - HEIGHT)  # beside each other: a bow below
    return (
        f'<path d="M{x1:.0f} {y1:.0f}C{x1:.0f} {bend:.0f} {x2:.0f} {bend:.0f} {x2:.0f} {y2:.0f}" fill="none" '
        f'stroke="currentColor" stroke-opacity="0.45"{dashes}/>'
    )


def table(told: Plan) -> str:
    """Every room, what it holds and what it imports, the highest floor first."""
    level = floors(told.imports)
    out = ["| Floor | Package or module | Holds | Imports |", "|---|---|---|---|"]
    for room in sorted(told.imports, key=lambda r: (-level[r], r)):
        names = ", ".join(f"`{o}`" for o in sorted(told.imports[room])) or "-"
        names += "; when called " + ", ".join(f"`{o}`" for o in sorted(told.later[room])) if told.later[room] else ""
        out.append(f"| {level[room]} | `{room}` | {told.says[room]} | {names} |")
    return "\n".join(out)


if __name__ == "__main__":
    print(svg(plan()))
