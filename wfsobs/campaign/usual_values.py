"""Values of a setting that a sweep can begin with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import param

from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import format_value
from wfsobs.settings.values import Reals, SettingError


def usual_values(scenario: Scenario, path: str) -> str:
    """Suggest values of a setting that it takes beside the others: over its usual range, or around its present value.

    Parameters
    ----------
    scenario : Scenario
        The other settings.
    path : str
        Of the setting; of a number in a list with its place at the end.

    Returns
    -------
    str
        As `wfsobs sweep --over` takes them; empty where there is nothing to go by.
    """
    p = scenario.parameter(path)
    if isinstance(p, param.Boolean):
        return "false,true"
    if isinstance(p, param.Selector):
        return ",".join(map(str, _values_that_fit(scenario, path, p.objects)))
    if isinstance(p, Reals) and path.rpartition(".")[2].isdecimal():
        return _numbers(scenario, path, p.item_bounds, None, whole=False)
    if isinstance(p, Reals):
        now = scenario.lookup(path)
        scaled = [[factor * x for x in now] for factor in (0.5, 1.0, 2.0)] if any(now) else []
        return ",".join(map(format_value, _values_that_fit(scenario, path, scaled)))
    assert isinstance(p, param.Number)
    return _numbers(scenario, path, p.bounds, p.softbounds, whole=isinstance(p, param.Integer))


def _numbers(scenario: Scenario, path: str, bounds: Any, usual: Any, *, whole: bool) -> str:
    """Suggest numbers, evenly spaced: over the usual range, around the present value where that range has few that are taken."""
    now, (least, most) = _number_at(scenario, path), bounds
    around = (0.5 * now, 2.0 * now) if now else (least, least + 1.0)
    low, high = 0.0, 0.0
    values: list[Any] = []
    for low, high in (usual or around, around):
        low, high = max(low, least), min(high, most)
        count = min(5, int(high) - int(low) + 1) if whole else 5
        spaced = [low + (high - low) * i / max(count - 1, 1) for i in range(count)]
        values = list(dict.fromkeys(map(round, spaced))) if whole else [float(_text(v)) for v in spaced]
        taken = _values_that_fit(scenario, path, values)
        if len(taken) > 2:
            break
    if whole or len(taken) < len(values):
        return ",".join(map(_text, taken))
    return f"{_text(low)}:{_text(high)}:5"


def _number_at(scenario: Scenario, path: str) -> float:
    """Return the present value; of one in a list of numbers that is 0 or missing, the largest of the list."""
    above, _, number = path.rpartition(".")
    if not number.isdecimal():
        return float(scenario.lookup(path))
    numbers = scenario.lookup(above)
    return (numbers[int(number)] if int(number) < len(numbers) else 0.0) or max(numbers, default=0.0)


def _values_that_fit(scenario: Scenario, path: str, values: Sequence[Any]) -> list[Any]:
    """Return those of some values that a setting takes beside the others; all where that are fewer than two."""
    taken = [value for value in values if _fits(scenario, path, value)]
    return taken if len(taken) > 1 else list(values)


def _fits(scenario: Scenario, path: str, value: Any) -> bool:
    try:
        scenario.replace({path: value}).validate()
    except SettingError:
        return False
    return True


def _text(value: float) -> str:
    """Write a number as a person would type it."""
    return f"{value:.10g}"
