"""`wfsobs export`."""

from __future__ import annotations

import click

from wfsobs.campaign.sweep import MOST_SEEDS
from wfsobs.cli.options import observer_option, preset_of_command, scenario_options
from wfsobs.cli.show import progress_bar, warn
from wfsobs.progress import Watch
from wfsobs.scenario import Scenario
from wfsobs.scenario.grid import MOST, parse_variation
from wfsobs.settings.errors import SettingError


@click.command()
@click.argument("out", metavar="OUT.html")
@scenario_options
@observer_option
@click.option(
    "--vary",
    multiple=True,
    metavar="NAME=VALUE,VALUE,...",
    help=f"Run for each of these values as well; several make every combination, at most {MOST}.",
)
@click.option(
    "--seeds",
    type=click.IntRange(1, MOST_SEEDS),
    default=1,
    metavar="N",
    help="Also run the N - 1 seeds after run.seed, and give intervals of the errors.",
)
def export(
    out: str,
    scenario: Scenario,
    observers: tuple[str, ...],
    vary: tuple[str, ...],
    seeds: int,
) -> None:
    """Write a report: one HTML file with figures and numbers that opens without a network."""
    variations = [parse_variation(text) for text in vary]
    try:
        from wfsobs.app.report.export import export as write
    except ModuleNotFoundError as error:
        raise SettingError(f"export: a report needs {error.name}; install wfsobs with its extra: wfsobs[app]") from None
    with progress_bar("runs") as update:
        write(
            out,
            scenario,
            observers=observers or None,
            vary=variations,
            seeds=seeds,
            preset=preset_of_command(),
            watch=Watch(progress=update),
            on_result=warn,
        )
