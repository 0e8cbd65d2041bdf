"""`wfsobs design`."""

from __future__ import annotations

import click

from wfsobs.cli.options import scenario_options
from wfsobs.handover.write import FORMATS, write_design
from wfsobs.priors_from.identification import told_by
from wfsobs.scenario import configfile
from wfsobs.settings.group import SettingError


@click.command()
@scenario_options
@click.option("--prior", metavar="FOUND.toml", help="Prior of the controller: the file of `wfsobs identify --out`.")
@click.option("--controller", "name", required=True, metavar="ID", help="Controller to write.")
@click.option("--to", "form", required=True, metavar="FORMAT", help=f"One of {', '.join(FORMATS)}.")
@click.option("--out", required=True, metavar="PATH", help="File to write; for c99 a new directory.")
def design(
    preset: str | None, config: str | None, assignments: tuple[str, ...], prior: str | None, name: str, form: str, out: str
) -> None:
    """Write a controller for a program elsewhere: C99 with a test, arrays, python-control."""
    scenario = configfile.scenario_from(preset, config, assignments)
    if prior is not None:
        scenario = told_by(configfile.load_scenario(prior), scenario)
        for path, value in map(configfile.parse_assignment, assignments):
            scenario.set(path, value)
    try:
        write_design(name, scenario, form, out)
    except ValueError as error:
        raise SettingError(f"design: {error}") from None
    click.echo(f"wfsobs: design: {name} written to {out}", err=True)
