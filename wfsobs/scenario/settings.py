"""Names that moved to `wfsobs.settings`."""

from wfsobs.settings.group import Group, Plain, SettingError, holds_groups, leaves, section, settings_of

__all__ = ["Group", "Plain", "SettingError", "holds_groups", "leaves", "section", "settings_of"]
