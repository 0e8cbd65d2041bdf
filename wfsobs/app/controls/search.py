"""A box that finds settings, and the button beside the setting in use that asks for the error over it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import param

from wfsobs.app.component import Component
from wfsobs.app.display import label_of
from wfsobs.app.style import script, sheets
from wfsobs.scenario import Scenario
from wfsobs.scenario.idle import why_idle_at
from wfsobs.units import unit_text


class Search(Component):
    """The box in the browser; it gets the settings when it is first used, and says which one has been chosen."""

    items = param.List([], doc="{path, label, topic, doc, unused} of every setting.")

    _esm = script("over", "search")
    _stylesheets = sheets("base", "search")

    def __init__(self, reveal: Callable[[str], None], idle: Callable[[], Mapping[str, str]], **params: Any):
        """Make the box.

        reveal : opens the topic of the setting of a path
        idle   : the settings without effect, and why
        """
        self._reveal, self._idle = reveal, idle
        self.on_sweep: Callable[[str], None] = lambda path: None
        super().__init__(self._take, **params)

    def _take(self, data: dict[str, Any]) -> None:
        if data.get("open"):
            self.items = settings_found(self._idle())
        elif (path := str(data.get("path", ""))) in {item["path"] for item in self.items}:
            self._reveal(path)
        elif isinstance(over := data.get("over"), str):
            self.on_sweep(over)


def settings_found(idle: Mapping[str, str]) -> list[dict[str, str]]:
    """List every setting and every list of settings, with its topic in words, and why it has no effect where it has none."""
    scenario, topics = Scenario(), Scenario.settings()
    lists = dict(scenario.lists())
    inner = tuple(f"{path}." for path in lists)
    known = [*lists.items(), *((path, p) for path, _, p in scenario.walk() if not path.startswith(inner))]
    return [
        {
            "path": path,
            "label": label_of(p),
            "topic": str(topics[path.split(".")[0]].label),
            "doc": unit_text(p.doc or ""),
            "unused": why_idle_at(path, idle),
        }
        for path, p in known
    ]
