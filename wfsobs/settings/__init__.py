"""Building blocks of settings: kinds of values, groups of them, and their error."""

from wfsobs.settings.group import Group, Section
from wfsobs.settings.values import Real, Reals, SettingError, Whole

__all__ = ["Group", "Real", "Reals", "Section", "SettingError", "Whole"]
