"""The group of all commands, and the one line that a user's error becomes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import click
from threadpoolctl import threadpool_limits

from wfsobs.version import __version__

COMMANDS = {
    "attach": ("attach", "Run an observer or a controller on the streams of a running loop, in shared memory or by ZeroMQ."),
    "bench": ("bench", "Time the observers beside textbook versions."),
    "campaign": ("campaign", "Run many scenarios and seeds, on many processes or machines."),
    "check": ("telemetry", "Check a record: what was read, and what of it can be relied on."),
    "convert": ("telemetry", "Write a record in another format: .npz, .aot.fits, .fits, .h5, .mat, .csv or .parquet."),
    "design": ("export", "Write a controller for a program elsewhere: C99 with a test, arrays, python-control."),
    "envelope": ("simulate", "Compute what every linear controller leaves of the disturbance over an uncertain plant."),
    "export": ("export", "Write a report: one HTML file with figures and numbers that opens without a network."),
    "figure": ("export", "Draw a figure of the paper as a file."),
    "gain": ("telemetry", "Find the integrator's optimal gain from closed-loop telemetry."),
    "identify": ("telemetry", "Find noise, turbulence and vibration peaks in a record."),
    "live": ("live", "Run a loop by the clock, every observer beside it, frame by frame, and show it on a page."),
    "loop": ("simulate", "Close the loop with every controller on the same disturbance and print what is left of it."),
    "observe": ("telemetry", "Run the observers on a record of any format."),
    "plant": ("telemetry", "Identify what the commands of a closed loop do: delay, gain and rotation."),
    "presets": ("presets", "List the presets, or print one as TOML."),
    "probe": ("telemetry", "Design a probe: commands by which delay, gain and rotation of a loop are known better."),
    "promise": ("telemetry", "State what controllers will leave of a loop, before one of them is switched on."),
    "rt-check": ("bench", "Tell what this machine can hold: how late a loop at the LGS rate wakes, and what a step takes in it."),
    "run": ("simulate", "Simulate the loop, run every observer and print the RMS table."),
    "serve": ("serve", "Serve the dashboard."),
    "sweep": ("campaign", "Run a scenario over the values of one or two settings and print the best observer in each."),
    "tune": ("tuning", "Search for the best settings of an observer on a record, or of a controller on uncertain plants."),
}
"""Command -> the module of this package where it is, and its line in `wfsobs --help`."""

ENTRY_POINTS = "wfsobs.commands"
"""Group of entry points by which installed packages bring commands of their own."""

PACKAGES = {"arena": "wfsobs-arena"}
"""Commands that come with a package of this repository, and which."""


class Text(click.types.StringParamType):
    """Type of options that take a text which is not empty."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the text. Raises BadParameter."""
        return super().convert(value or self.fail("takes a text that is not empty", param, ctx), param, ctx)


def _without_empty(command: click.Command) -> click.Command:
    """Return a command whose options refuse the empty text, unless it is their default."""
    for one in command.params:
        if one.type is click.STRING and one.default != "":
            one.type = Text()
    for inner in getattr(command, "commands", {}).values():
        _without_empty(inner)
    return command


class Commands(click.Group):
    """Imports a command when it is called, and turns the errors a user can cause into one line and exit status 2."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return sorted({*COMMANDS, *_entries()})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of this name."""
        if cmd_name in COMMANDS:
            module = import_module(f"wfsobs.cli.{COMMANDS[cmd_name][0]}")
            return _without_empty(getattr(module, cmd_name.replace("-", "_")))
        if (point := _entries().get(cmd_name)) is not None:
            try:
                return point.load()
            except Exception as error:
                ctx.fail(f"{cmd_name}: {point.value} cannot be imported: {type(error).__name__}: {error}")
        if cmd_name in PACKAGES:
            ctx.fail(f"{cmd_name} is a package of its own: pip install {PACKAGES[cmd_name]}")
        return None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands, without importing them."""
        lines = {name: _package_line(point) for name, point in _entries().items()}
        with formatter.section("Commands"):
            formatter.write_dl(sorted((lines | {name: text for name, (_, text) in COMMANDS.items()}).items()))

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command."""
        with _one_line(ctx):
            return super().invoke(ctx)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the options, or print the help."""
        with _one_line(ctx):
            return super().parse_args(ctx, args)


@contextmanager
def _one_line(ctx: click.Context) -> Iterator[None]:
    """Turn an error that a user can cause into one line, and end."""
    try:
        yield
        return
    except ValueError as error:
        from wfsobs.observers.step import StepError
        from wfsobs.record import RecordError
        from wfsobs.settings.values import SettingError

        if not isinstance(error, (SettingError, RecordError, StepError)):
            raise
        click.echo(f"wfsobs: {error}", err=True)
    except OSError as error:
        if isinstance(error, BrokenPipeError) and error.filename is None:
            raise  # whoever reads the output has enough of it: click ends without a word
        click.echo(": ".join(str(word) for word in ("wfsobs", error.filename, error.strerror or error) if word), err=True)
    ctx.exit(2)


def _entries() -> dict[str, EntryPoint]:
    """Return the commands of installed packages by name."""
    return {point.name: point for point in entry_points(group=ENTRY_POINTS)}


def _package_line(point: EntryPoint) -> str:
    """Return what the package of a command says of itself, or else its name."""
    about = point.dist and point.dist.metadata["Summary"]
    return f"{about}." if about else f"Of the package {point.module.partition('.')[0]}."


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "show_default": True})
@click.version_option(__version__, prog_name="wfsobs")
def main() -> None:
    """Disturbance observers for adaptive optics: turbulence and vibration from wavefront-sensor data."""
    # One BLAS thread: at these sizes two are slower, and modes run side by side. The command and with it every library has
    # been imported by now, as the limit needs.
    threadpool_limits(1, user_api="blas")
