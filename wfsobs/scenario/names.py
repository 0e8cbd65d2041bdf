"""What settings are called on pages and in reports, where messages have their paths."""

from __future__ import annotations

import re
from collections import Counter
from functools import cache
from typing import Any, cast

import param

from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import format_value
from wfsobs.scenario.presets import PRESETS
from wfsobs.sensors.zernike import TIP_TILT
from wfsobs.settings.group import Group, holds_groups
from wfsobs.units import unit_text

SHORT = {
    "frequency": "f",
    "damping": "ξ",
    "height": "h",
    "fraction": "share",
    "wind_factor": "V / V₀",
    "wind_direction": "wind to",
    "frequency_shift": "shift",
    "third_corner": "third / w₀",
}
"""Setting -> its name above a narrow column; any other has its own."""

PATH = re.compile(r"\b[a-z_]+(?:\.(?:[a-z_][a-z_0-9]*|\d+))+\b")


def name_settings(line: str) -> str:
    """Replace the paths in a message by the names of the page.

    >>> name_settings("vibration.peaks.0.rms.1 = -1.0: takes a number from 0")
    'Peak 1: tilt = -1.0: takes a number from 0'
    >>> name_settings("night.toml: turbulence.wind_speed = 200, turbulence.r0 = 0")
    'night.toml: Wind speed V₀ = 200, Fried parameter r₀ = 0'
    """
    return PATH.sub(lambda match: setting_name(match[0]), line)


def column_of(key: str) -> str:
    """Name a setting of a list's item; rms.0 is the first of a list of numbers, one per mode.

    >>> column_of("frequency"), column_of("rms.0"), column_of("start")
    ('f', 'tip', 'start')
    """
    setting, _, mode = key.partition(".")
    return TIP_TILT[int(mode)].name if mode.isdecimal() and int(mode) < len(TIP_TILT) else SHORT.get(setting, setting)


@cache
def setting_name(path: str) -> str:
    """Name a setting as the page does, its topic in front where several share a name; an unknown path stays as it is.

    >>> setting_name("gpr_online.depth"), setting_name("vibration.peaks.14"), setting_name("vibration.peaks.0.height")
    ('Online GPR: Depth d', 'Peak 15', 'vibration.peaks.0.height')
    """
    node: type[Group] = Scenario
    topic, *_ = keys = path.split(".")
    for i, key in enumerate(keys):
        p = node.settings().get(key)
        if p is None:
            return path
        rest = keys[i + 1 :]
        if isinstance(p, param.ClassSelector):
            node = cast(type[Group], p.class_)
        elif isinstance(p, param.List) and holds_groups(p) and rest:
            return _item(p, *rest) or path
        else:
            several = not rest and _labels()[str(p.label)] > 1
            return f"{Scenario.settings()[topic].label}: {p.label}" if several else str(p.label)
    return path


def _item(p: param.List, number: str, *keys: str) -> str:
    """Name an item of a list, or a setting of it."""
    kind = p.item_type
    assert isinstance(kind, type) and issubclass(kind, Group)
    if not number.isdecimal() or (keys and keys[0] not in kind.settings()):
        return ""
    item = f"{kind.__name__} {int(number) + 1}"
    return f"{item}: {column_of('.'.join(keys))}" if keys else item


@cache
def _labels() -> Counter[str]:
    """How many settings have a label."""
    return Counter(str(p.label) for _, _, p in Scenario().walk())


def setting_label(scenario: Scenario, path: str) -> str:
    """Name a setting, with its unit in [brackets]."""
    unit = unit_text(scenario.unit(path))
    return f"{setting_name(path)} [{unit}]" if unit else setting_name(path)


def value_of(value: Any) -> str:
    """Write a setting's value for people."""
    if isinstance(value, bool):
        return "on" if value else "off"
    text = f"{value:.6g}" if isinstance(value, (int, float)) else format_value(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


ACRONYMS = ("ut4", "galacsi", "nfm", "wfm")


def preset_title(preset: str) -> str:
    """Write a preset's name as the page does.

    >>> preset_title("ut4-floor"), preset_title("strong-turbulence")
    ('UT4 floor', 'Strong turbulence')
    """
    words = [word.upper() if word in ACRONYMS else word for word in preset.split("-")]
    return " ".join([words[0] if words[0].isupper() else words[0].capitalize(), *words[1:]])


def preset_line(name: str) -> str:
    """Say in a line what a preset is: the first of its documentation."""
    return str(PRESETS[name].__doc__).strip().partition("\n")[0]
