"""The command line: a group of commands, a module per topic."""

from wfsobs.cli.group import main

__all__ = ["main"]
