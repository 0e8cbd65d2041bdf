"""The vibration peaks: a table to add to, remove from and edit in place."""

from __future__ import annotations

from typing import Any

import panel as pn
import param
from panel.custom import JSComponent

from wfsobs.app.controls.fields import number_text, parsed, written_unit
from wfsobs.app.store import Store
from wfsobs.app.style import asset
from wfsobs.groups.vibration import Peak
from wfsobs.modes import TIP_TILT
from wfsobs.parameters import unit_of

PATH = "vibration.peaks"


class PeakTable(JSComponent):
    """The table in the browser: texts down, messages {action, row, key, text} up."""

    rows = param.List([], doc="One list of texts per peak.")
    columns = param.List([], doc="{key, name, doc} of every column.")
    errors = param.Dict({}, doc="'row.key' -> {text, reason} of refused cells.")

    _esm = asset("peaks.js")
    _stylesheets = [asset("peaks.css")]  # noqa: RUF012

    def __init__(self, **params: Any):
        self.on_edit: Any = None
        super().__init__(**params)

    def _handle_msg(self, msg: dict[str, Any]) -> None:
        if self.on_edit is not None:
            self.on_edit(msg)


class PeakEditor:
    """The table, kept in step with the store."""

    def __init__(self, store: Store):
        self.store = store
        self._texts: dict[str, str] = {}
        self.table = PeakTable(columns=_columns(), sizing_mode="stretch_width", margin=(0, 0, 8, 0))
        self.table.on_edit = self.handle
        self.view = pn.Column(self.table, sizing_mode="stretch_width", margin=0)
        self.refresh()
        store.param.watch(self.refresh, ["scenario", "errors"])

    def handle(self, msg: dict[str, Any]) -> None:
        """Do what a message of the table says."""
        action, row = msg.get("action"), int(msg.get("row", -1))
        if action == "add":
            self.add()
        elif action == "remove":
            self.remove(row)
        elif action == "edit":
            self.edit(row, str(msg["key"]), str(msg["text"]))

    def add(self) -> None:
        """One more peak, with the defaults."""
        self._replace([*self._plain(), Peak().to_dict()])

    def remove(self, row: int) -> None:
        """One peak less."""
        peaks = self._plain()
        del peaks[row]
        self._replace(peaks)

    def edit(self, row: int, key: str, text: str) -> None:
        """Set one cell; `key` is the setting within the peak, rms.0 for tip."""
        path = f"{PATH}.{row}.{key}"
        self._texts[path] = text
        self.store.change(path, parsed(text))

    def refresh(self, *_: object) -> None:
        """Show the accepted peaks and what was refused."""
        peaks = self.store.scenario.vibration.peaks
        rows = [[number_text(_cell(peak, column["key"])) for column in self.table.columns] for peak in peaks]
        errors: dict[str, dict[str, str]] = {}
        for path, reason in self.store.errors.items():
            if path.startswith(f"{PATH}."):
                errors[path.removeprefix(f"{PATH}.")] = {"text": self._texts.get(path, ""), "reason": reason}
        self.table.param.update(rows=rows, errors=errors)

    def _plain(self) -> list[dict[str, Any]]:
        return [peak.to_dict() for peak in self.store.scenario.vibration.peaks]

    def _replace(self, peaks: list[dict[str, Any]]) -> None:
        self.store.change(PATH, peaks)


def _columns() -> list[dict[str, str]]:
    """Frequency, damping, and the rms of every mode, named from the settings."""
    settings = Peak.settings()
    named = [("frequency", "f"), ("damping", "ξ"), *((f"rms.{i}", mode.name) for i, mode in enumerate(TIP_TILT))]
    out = []
    for key, name in named:
        p = settings[key.partition(".")[0]]
        unit = written_unit(unit_of(p))
        out.append({"key": key, "name": f"{name} [{unit}]" if unit else name, "doc": p.doc or ""})
    return out


def _cell(peak: Peak, key: str) -> float:
    name, _, mode = key.partition(".")
    value = getattr(peak, name)
    if not mode:
        return value
    return value[int(mode)] if int(mode) < len(value) else 0.0
