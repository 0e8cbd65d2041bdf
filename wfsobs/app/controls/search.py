"""A box that finds settings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import param

from wfsobs.app.component import Component
from wfsobs.app.display import label_of
from wfsobs.app.style import script, sheets
from wfsobs.scenario import Scenario


class Search(Component):
    """The box in the browser; it gets the settings when it is first used, and says which one has been chosen."""

    items = param.List([], doc="{path, name} of every setting.")

    _esm = script("listen", "search")
    _stylesheets = sheets("base", "search")

    def __init__(self, reveal: Callable[[str], None], **params: Any):
        """Make the box. reveal : opens the topic of the setting of a path."""
        self._reveal = reveal
        super().__init__(self._take, **params)

    def _take(self, data: dict[str, Any]) -> None:
        if data.get("open"):
            self.items = settings_found()
        elif (path := str(data.get("path", ""))) in {item["path"] for item in self.items}:
            self._reveal(path)


def settings_found() -> list[dict[str, str]]:
    """List every setting and every list of settings, by its name and its topic."""
    scenario, topics = Scenario(), Scenario.settings()
    lists = dict(scenario.lists())
    inner = tuple(f"{path}." for path in lists)
    known = [*lists.items(), *((path, p) for path, _, p in scenario.walk() if not path.startswith(inner))]
    return [{"path": path, "name": f"{label_of(p)} · {topics[path.split('.')[0]].label}"} for path, p in known]
