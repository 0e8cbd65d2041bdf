"""Figures of what the library returns, for notebooks and papers."""
