"""Names that moved to `wfsobs.settings`."""

from wfsobs.settings.parameters import Real, Reals, Whole, allowed, hint, unit_of

__all__ = ["Real", "Reals", "Whole", "allowed", "hint", "unit_of"]
