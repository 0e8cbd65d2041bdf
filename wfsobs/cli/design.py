"""`wfsobs design`."""

from __future__ import annotations

import click

from wfsobs.cli.options import scenario_options, told_scenario
from wfsobs.cli.show import print_note
from wfsobs.handover.write import FORMATS, write_design
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError


@click.command()
@scenario_options
@click.option("--prior", metavar="FOUND.toml", help="Prior of the controller: the file of `wfsobs identify --out`.")
@click.option("--controller", "name", required=True, metavar="ID", help="Controller to write.")
@click.option("--to", "form", required=True, metavar="FORMAT", help=f"One of {', '.join(FORMATS)}.")
@click.option("--out", required=True, metavar="PATH", help="File to write; for c99 a new directory.")
def design(scenario: Scenario, prior: str | None, name: str, form: str, out: str) -> None:
    """Write a controller for a program elsewhere: C99 with a test, arrays, python-control."""
    scenario = told_scenario(prior, scenario)
    try:
        write_design(name, scenario, form, out)
    except ValueError as error:
        raise SettingError(f"design: {error}") from None
    print_note(f"design: {name} written to {out}")
