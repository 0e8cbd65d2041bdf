"""Building blocks of settings: kinds of values, groups of them, and their error."""

from wfsobs.settings.errors import SettingError
from wfsobs.settings.group import Group, Section
from wfsobs.settings.parameters import Real, Reals, Whole

__all__ = ["Group", "Real", "Reals", "Section", "SettingError", "Whole"]
