"""The group of all commands, and what becomes of the errors that a user can cause."""

from __future__ import annotations

from typing import Any

import click
from threadpoolctl import threadpool_limits

from wfsobs import __version__
from wfsobs.record import RecordError
from wfsobs.scenario.settings import SettingError


class Commands(click.Group):
    """Turns the errors a user can cause into one line and exit status 2."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run a command."""
        try:
            return super().invoke(ctx)
        except (SettingError, RecordError) as error:
            click.echo(f"wfsobs: {error}", err=True)
        except OSError as error:
            click.echo(f"wfsobs: {error.filename or 'file'}: {error.strerror or error}", err=True)
        ctx.exit(2)


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="wfsobs")
def main() -> None:
    """Disturbance observers for adaptive optics: turbulence and vibration from wavefront-sensor data."""
    # One BLAS thread: at these sizes two are slower, and modes run side by side.
    threadpool_limits(1, user_api="blas")
