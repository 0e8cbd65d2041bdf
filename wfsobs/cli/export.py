"""`wfsobs export`, `wfsobs figure` and `wfsobs design`: results as files."""

from __future__ import annotations

import click

from wfsobs.campaign.sweep import MOST_SEEDS
from wfsobs.cli.options import (
    RECORD_OPTIONS,
    DeclaredFile,
    FiniteRange,
    check_output,
    load_declared,
    needing,
    observer_option,
    preset_of_command,
    record_options,
    refuse_options,
    scenario_options,
    told_scenario,
    training,
    training_options,
)
from wfsobs.cli.show import print_note, progress_bar, warn
from wfsobs.handover import FORMATS, write_design
from wfsobs.pipeline import observe, run
from wfsobs.plot.paper import NUMBERS, draw_paper_figure, observers_in
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import MOST, parse_variation
from wfsobs.settings.group import SettingError


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
    check_output(out)
    variations = [parse_variation(text) for text in vary]
    with needing("export: a report needs", "app"):
        from wfsobs.app.report.page import export as write
    with progress_bar("runs") as watch:
        write(
            out,
            scenario,
            observers=observers or None,
            vary=variations,
            seeds=seeds,
            preset=preset_of_command(),
            watch=watch,
            on_result=warn,
        )


@click.command()
@click.argument("name", type=click.Choice(tuple(NUMBERS)))
@scenario_options
@record_options
@training_options
@click.option("--out", required=True, metavar="FILE", help="File to write: .pdf, .svg, .pgf, .png or .html.")
@click.option("--record", "record_file", metavar="RECORD", help="Draw from a record of your own, not from a simulation.")
@click.option("--width", type=FiniteRange(40, 400), default=88.0, metavar="MM", help="One column; 180 are two.")
@click.option("--height", type=FiniteRange(20, 1000), metavar="MM", help="By default 40 for each plot, and legends.")
def figure(
    name: str,
    scenario: Scenario,
    declaration: DeclaredFile,
    train: str | None,
    train_until: float | None,
    out: str,
    record_file: str | None,
    width: float,
    height: float | None,
) -> None:
    """Draw a figure of the paper as a file (docs/figures.md)."""
    with needing("figure: needs", "plot"):
        from wfsobs.plot.elements import check_suffix, save_figure
    check_suffix(out)
    check_output(out)
    if record_file is None:
        refuse_options((*RECORD_OPTIONS, "train", "train_until"), "only with --record")
    names = observers_in(name)
    record = load_declared(record_file, scenario, declaration) if record_file else None
    with progress_bar() as watch:
        if record is None:
            result = run(scenario, observers=names, watch=watch)
        else:
            learnt = training(train, train_until, record, scenario, declaration)
            result = observe(record, scenario, observers=names, train=learnt, watch=watch)
    warn(result)
    save_figure(draw_paper_figure(name, result), out, width=width, height=height or 0.0)


@click.command()
@scenario_options
@click.option("--prior", metavar="FOUND.toml", help="Prior of the controller: the file of `wfsobs identify --out`.")
@click.option("--controller", "name", required=True, metavar="ID", help="Controller to write.")
@click.option("--to", "form", required=True, metavar="FORMAT", help=f"One of {', '.join(FORMATS)}.")
@click.option("--out", required=True, metavar="PATH", help="File to write; for c99 a new directory.")
def design(scenario: Scenario, prior: str | None, name: str, form: str, out: str) -> None:
    """Write a controller for a program elsewhere: C99 with a test, arrays, python-control."""
    if form != "c99":
        check_output(out)
    scenario = told_scenario(prior, scenario)
    try:
        write_design(name, scenario, form, out)
    except ValueError as error:
        raise SettingError(f"design: {error}") from None
    print_note(f"design: {name} written to {out}")
