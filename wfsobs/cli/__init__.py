"""The command line: a group of commands, a module per topic."""

from wfsobs.cli.group import main
from wfsobs.cli.make import bench, export, presets, serve
from wfsobs.cli.simulate import loop, run
from wfsobs.cli.telemetry import identify, observe
from wfsobs.cli.tuning import tune

__all__ = ["main"]

for command in (run, observe, identify, tune, loop, export, presets, bench, serve):
    main.add_command(command)
