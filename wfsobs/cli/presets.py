"""`wfsobs presets`."""

from __future__ import annotations

import click

from wfsobs.scenario import configfile
from wfsobs.scenario.presets import PRESETS


@click.command()
@click.argument("name", required=False)
def presets(name: str | None) -> None:
    """List the presets, or print one as TOML."""
    if name is not None:
        click.echo(configfile.to_toml(configfile.preset(name)), nl=False)
        return
    for key, make in PRESETS.items():
        click.echo(f"{key:{max(map(len, PRESETS))}} {(make.__doc__ or '').splitlines()[0]}")
