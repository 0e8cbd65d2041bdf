"""A form that says which column of a file is what, where their names are not those of a record."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import param

from wfsobs.app.component import Component
from wfsobs.app.style import asset
from wfsobs.telemetry.columns import ROLES

HINT = (
    "Assign the columns. Likely matches are preselected. A record needs a measurement and a command of the same modes, and a "
    "time or a rate."
)


class ColumnForm(Component):
    """The form in the browser: columns and roles down, messages {column, role} up."""

    columns = param.Dict({}, doc="Name of a column -> its values in a few words.")
    roles = param.Dict({}, doc="Role -> name of the column that has it.")
    labels = param.Dict(ROLES, doc="Role -> what it is called.")
    hint = param.String(HINT, doc="What to do.")

    _esm = asset("columns.js")
    _stylesheets = [asset("columns.css")]

    def __init__(self, on_change: Callable[[], None], **params: Any):
        self.on_change = on_change
        super().__init__(self._take, **params)

    def show(self, columns: Mapping[str, str], roles: Mapping[str, str]) -> None:
        """Show the columns of another file."""
        self.param.update(columns=dict(columns), roles=dict(roles))

    def _take(self, data: dict[str, Any]) -> None:
        column, role = (str(data.get(key, "")) for key in ("column", "role"))
        if column not in self.columns or (role and role not in self.labels):
            return
        roles = {r: name for r, name in self.roles.items() if name != column and r != role}
        self.roles = {**roles, **({role: column} if role else {})}
        self.on_change()
