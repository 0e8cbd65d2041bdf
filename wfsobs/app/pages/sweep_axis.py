"""The two fields of one setting of a sweep: which one, and its values."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import panel_material_ui as pmui
import param

from wfsobs.app.pages.sweep_settings import usual_values
from wfsobs.app.pages.sweep_views import axis_title, parameter_of
from wfsobs.app.store import Store

NONE = ""
"""No setting."""

LONG: Mapping[str, Any] = MappingProxyType({"sizing_mode": "stretch_width", "max_width": 440, "margin": 0})
"""As wide as the longest words, or as a phone."""


class AxisFields:
    """The fields; a setting that is chosen brings its usual values."""

    def __init__(self, store: Store, labels: tuple[str, str], options: dict[str, str], path: str, values: str):
        """Make the fields. labels : of the setting and of its values; options : name -> path of those to choose from."""
        self.store = store
        self.select = pmui.Select(label=labels[0], options=options, value=path, size="small", searchable=True, **LONG)
        self.values = pmui.TextInput(label=labels[1], value=values, size="small", width=150, margin=0)
        self.select.param.watch(self._suggest, "value")

    @property
    def path(self) -> str:
        """The setting that is chosen; NONE for none."""
        return self.select.value

    def offer(self, path: str) -> bool:
        """Have a setting among those to choose from; return whether there is one of that path."""
        if path not in self.select.options.values() and parameter_of(self.store.scenario, path) is not None:
            self.select.options = {**self.select.options, axis_title(self.store.scenario, path): path}
        return path in self.select.options.values()

    def choose(self, path: str) -> None:
        """Choose a setting, and its usual values though it was chosen before."""
        if self.path == path != NONE:
            self.values.value = usual_values(self.store.scenario, path)
        self.select.value = path

    def _suggest(self, event: param.parameterized.Event) -> None:
        if event.new != NONE:
            self.values.value = usual_values(self.store.scenario, event.new)
        self.values.disabled = event.new == NONE
