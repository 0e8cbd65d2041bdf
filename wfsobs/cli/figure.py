"""`wfsobs figure`."""

from __future__ import annotations

import click

from wfsobs.cli.options import load_declared, record_options, scenario_options, training, training_options
from wfsobs.cli.show import progress_bar, warn
from wfsobs.pipeline import observe, run
from wfsobs.plot.paper import NUMBERS, draw_paper_figure, observers_in
from wfsobs.progress import Watch
from wfsobs.scenario import Scenario
from wfsobs.settings.errors import SettingError
from wfsobs.telemetry.intake import DeclaredFormat


@click.command()
@click.argument("name", type=click.Choice(tuple(NUMBERS)))
@scenario_options
@record_options
@training_options
@click.option("--out", required=True, metavar="FILE", help="File to write: .pdf, .svg, .pgf, .png or .html.")
@click.option("--record", "record_file", metavar="RECORD", help="Draw from a record of your own, not from a simulation.")
@click.option(
    "--width", type=click.FloatRange(40, 400), default=88.0, show_default=True, metavar="MM", help="One column; 180 are two."
)
@click.option("--height", type=click.FloatRange(20, 1000), metavar="MM", help="By default 40 for each plot, and legends.")
def figure(
    name: str,
    scenario: Scenario,
    declaration: DeclaredFormat,
    sha256: str | None,
    train: str | None,
    train_until: float | None,
    out: str,
    record_file: str | None,
    width: float,
    height: float | None,
) -> None:
    """Draw a figure of the paper as a file (docs/figures.md)."""
    try:
        from wfsobs.plot.elements import check_suffix, save_figure
    except ModuleNotFoundError as error:
        raise SettingError(f"figure: needs {error.name}; install wfsobs with its extra: wfsobs[plot]") from None
    check_suffix(out)
    names = observers_in(name)
    record = load_declared(record_file, scenario, declaration, sha256) if record_file else None
    with progress_bar() as update:
        watch = Watch(progress=update)
        if record is None:
            result = run(scenario, observers=names, watch=watch)
        else:
            learnt = training(train, train_until, record, scenario, declaration)
            result = observe(record, scenario, observers=names, train=learnt, watch=watch)
    warn(result)
    save_figure(draw_paper_figure(name, result), out, width=width, height=height or 0.0)
