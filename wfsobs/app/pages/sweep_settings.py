"""Settings that a sweep can be over: their names, usual values, and values as they were typed."""

from __future__ import annotations

from typing import Any

import param

from wfsobs.app.controls.fields import number_text
from wfsobs.app.controls.names import name_settings
from wfsobs.app.pages.sweep_views import axis_title
from wfsobs.campaign.sweep import SEED, parse_axis
from wfsobs.scenario import Scenario
from wfsobs.scenario.grid import Variation
from wfsobs.settings.errors import SettingError


def line_of(error: SettingError) -> str:
    """Return the first line of an error, with the names of settings as the page has them."""
    return name_settings(str(error).removeprefix("--over ").partition("\n")[0])


def read_axis(path: str, values: str) -> Variation:
    """Read the values of a setting as they were typed. Raises SettingError."""
    if not values.strip():
        raise SettingError(f"{path}: takes values, such as 5:20:4 or 5,10,20")
    return parse_axis(f"{path}={values.replace('−', '-').strip()}")


def sweep_settings(scenario: Scenario) -> dict[str, str]:
    """Name -> path of every setting that a sweep can be over; those of lists, and those with one choice, are left out."""
    lists = tuple(f"{path}." for path, _ in scenario.lists())
    kinds = (param.Number, param.Selector, param.Boolean)
    topics = Scenario.settings()
    out = {}
    for path, _, p in scenario.walk():
        several = not isinstance(p, param.Selector) or len(p.objects) > 1
        if path != SEED and isinstance(p, kinds) and several and not path.startswith(lists):
            topic, name = str(topics[path.split(".")[0]].label), axis_title(scenario, path)
            out[name if name.startswith(f"{topic}:") else f"{topic}: {name}"] = path
    return out


def usual_values(scenario: Scenario, path: str) -> str:
    """Suggest values of a setting: over its usual range, or around its present value."""
    p: Any = {known: p for known, _, p in scenario.walk()}[path]
    if isinstance(p, param.Boolean):
        return "false,true"
    if isinstance(p, param.Selector):
        return ",".join(map(str, p.objects))
    least, most = p.bounds
    now = float(scenario.lookup(path))
    low, high = p.softbounds or ((0.5 * now, 2.0 * now) if now else (least, least + 1.0))
    low, high = max(low, least), min(high, most)
    if isinstance(p, param.Integer):
        count = min(5, int(high) - int(low) + 1)
        return ",".join(str(v) for v in dict.fromkeys(round(low + (high - low) * i / (count - 1)) for i in range(count)))
    return f"{number_text(low)}:{number_text(high)}:5"
