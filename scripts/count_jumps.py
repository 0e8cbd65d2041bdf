"""Count the jumps to a higher room while a preset is simulated, observed and scored.

Rooms stand on floors, each above all that it imports (docs/scripts/rooms.py). A jump is a pair of functions of which the one
below calls the one above: through a registry, a closure or a method of what it was given. Data is to flow one way, so that
there are few; what may take a callback (a watch of progress, a delivery of first results) is named where it is.

`python scripts/count_jumps.py` prints them; the status is 1 with more than `MOST` of them.
"""

from __future__ import annotations

import sys
import threading
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import CodeType, FrameType
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "docs" / "scripts"))

import rooms  # noqa: E402

import wfsobs  # noqa: E402
from wfsobs.testing import QUICK  # noqa: E402

MOST = 6
PACKAGE = Path(wfsobs.__file__).parent


class Place(NamedTuple):
    """A function: the room it stands in, and its name."""

    room: str
    name: str


def place_of(code: CodeType) -> Place | None:
    """Where a function stands; None outside of wfsobs, and for the façade itself."""
    try:
        inside = Path(code.co_filename).relative_to(PACKAGE)
    except ValueError:
        return None
    room = inside.parts[0].removesuffix(".py")
    return None if room == "__init__" else Place(room, f"{inside.as_posix()}:{code.co_qualname}")


def traced(what: Callable[[], object]) -> Counter[tuple[Place, Place]]:
    """How often which function of wfsobs calls which other, other packages between them passed over."""
    calls: Counter[tuple[Place, Place]] = Counter()

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and (callee := place_of(frame.f_code)):
            above = frame.f_back
            while above and not (caller := place_of(above.f_code)):
                above = above.f_back
            if above and caller.room != callee.room:
                calls[caller, callee] += 1

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        what()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return calls


@cache
def floors_of_rooms() -> dict[str, int]:
    """The floor of every room, from the imports of all modules."""
    return rooms.floors(rooms.plan().imports)


def jumps(calls: Counter[tuple[Place, Place]]) -> list[tuple[Place, Place, int]]:
    """Those calls that go up."""
    floors = floors_of_rooms()
    return sorted((a, b, n) for (a, b), n in calls.items() if floors[a.room] < floors[b.room])


def main() -> None:
    """Trace both and print what goes up."""
    scenario = wfsobs.PRESETS["paper"]().replace(QUICK)
    record = wfsobs.run(scenario).record
    worst = 0
    for name, what in (("run", lambda: wfsobs.run(scenario)), ("observe", lambda: wfsobs.observe(record, scenario))):
        found = jumps(traced(what))
        worst = max(worst, len(found))
        print(f"{name}: {len(found)} jumps to a higher room")
        for a, b, n in found:
            print(f"  {a.room} -> {b.room}: {a.name} calls {b.name}, {n} times")
    sys.exit(worst > MOST)


if __name__ == "__main__":
    main()
