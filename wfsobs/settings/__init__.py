"""What settings are made of: kinds of values, groups of them, and the error that says what is allowed."""

from wfsobs.settings.group import Group, Section, SettingError
from wfsobs.settings.parameters import Real, Reals, Whole

__all__ = ["Group", "Real", "Reals", "Section", "SettingError", "Whole"]
