"""Fields for what a file does not say itself: unit, sign and delay of commands, rate."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import panel_material_ui as pmui

from wfsobs.record import RecordError
from wfsobs.settings.parameters import hint
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.preview import Preview
from wfsobs.units import UNITS

SILENT = "from the file"


class UploadFields:
    """The fields. An empty one, or one at its first choice, leaves the question to the file."""

    def __init__(self, on_change: Callable[[], None]):
        """Make the fields. on_change : called after every change of one."""
        self.unit = _select("Unit", [SILENT, *UNITS])
        self.sign = _select("Commands", {SILENT: 0, "are added to the measurement (+1)": 1, "are subtracted (-1)": -1})
        self.delay, self.rate = _text("Delay of commands [steps]", 240), _text("Rate [Hz]")
        self.trust = pmui.Checkbox(label="Trust sign and delay as stated", value=False, size="small", margin=(4, 0))
        self.widgets = (self.unit, self.sign, self.delay, self.rate, self.trust)
        for widget in self.widgets:
            widget.param.watch(lambda _event: on_change(), "value")

    def read(self, roles: dict[str, str]) -> DeclaredFormat:
        """Read the fields; roles : of columns that have been chosen. Raises RecordError where a field holds no number."""
        unit = None if self.unit.value == SILENT else self.unit.value
        delay, rate = _number(self.delay, int, 1), _number(self.rate, float, 1e-3)
        return DeclaredFormat(unit, self.sign.value or None, delay, rate, roles, self.trust.value)

    def take_proposals(self, preview: Preview) -> None:
        """Fill in the sign and the delay that the data propose."""
        if (found := preview.reading.response) is not None:
            self.sign.value = found.sign or self.sign.value
            self.delay.value = str(found.delay) if found.delay else self.delay.value


def differs_from_proposals(preview: Preview) -> bool:
    """Return whether the data propose another sign or delay than those with which the record was read."""
    found = preview.reading.response
    read = preview.reading.sign, preview.record.delay
    return found is not None and any(
        new is not None and new != old for new, old in zip((found.sign, found.delay), read, strict=True)
    )


def _number(field: Any, kind: type, least: float) -> Any:
    """Return the number in a field, None for an empty one."""
    text = str(field.value or "").strip()
    if not text:
        return None
    try:
        value = kind(text)
    except ValueError:
        value = -1
    if not least <= value < 1e6:
        raise RecordError(f"{field.label}: takes a number from {least:g}, not {text[:40]!r}{hint(text)}")
    return value


def _select(label: str, options: Any) -> pmui.Select:
    first = options[0] if isinstance(options, list) else next(iter(options.values()))
    return pmui.Select(label=label, options=options, value=first, size="small", width=190, margin=(4, 0))


def _text(label: str, width: int = 190) -> pmui.TextInput:
    return pmui.TextInput(label=label, value="", placeholder=SILENT, size="small", width=width, margin=(4, 0))
