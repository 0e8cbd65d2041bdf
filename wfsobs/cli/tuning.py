"""`wfsobs tune`: search for the settings of an observer or a controller."""

from __future__ import annotations

from typing import Any, Literal

import click
import numpy as np
from rich.table import Table

from wfsobs.cli.options import (
    POSITIVE,
    RECORD_OPTIONS,
    DeclaredFile,
    FiniteRange,
    check_output,
    json_option,
    load_declared,
    record_options,
    refuse_options,
    scenario_options,
    uncertainty_options,
)
from wfsobs.cli.show import new_table, print_json, progress_bar, show_table
from wfsobs.closed_loop.envelope import Uncertainty
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.scores import PREDICTION
from wfsobs.files import write_text
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError
from wfsobs.tuning import EnvelopeGoal
from wfsobs.tuning import tune as search
from wfsobs.tuning.records import judged_by
from wfsobs.tuning.tuning import (
    EVALUATIONS,
    OTHER,
    TEST,
    TOGETHER,
    VALIDATION,
    TuningResult,
    nm,
    settings,
    tuning_dict,
    tuning_remarks,
    tuning_rows,
    tuning_toml,
)


def settings_table(result: TuningResult) -> Table:
    """Return the table of searched settings, and of those set by hand for the search, before and after."""
    out = new_table(("Setting",), ("before", "after"), title=f"{result.label}: settings after {len(result.history)} evaluations")
    for path, before, after in settings(result):
        out.add_row(path, before, after)
    return out


def errors_table(result: TuningResult) -> Table:
    """Errors, or what takes their place, on validation and test record, mode by mode and together."""
    out = new_table(
        ("",),
        ("validation, before", "after", "test, before", "after"),
        title=f"{result.measure}{'' if result.target == PREDICTION else f' in {result.target}'}, nm",
    )
    rows = tuning_rows(result)
    validation, test, other = ([row[1:] for row in rows if row[0] == section] for section in (VALIDATION, TEST, OTHER))
    for (name, *searched), (_, *tested) in zip(validation, test, strict=True):
        if name == TOGETHER:
            out.add_section()
        out.add_row(name, *map(_error, (*searched, *tested)))
    for _, *tested in other:
        out.add_row("in the other target", "", "", *map(_error, tested))
    return out


def _error(rms: Any) -> str:
    return "fails" if rms is None else nm(rms)


def spreads_table(result: TuningResult) -> Table:
    """Residual of a controller over the plants of the search and over others, modes together."""
    out = new_table(("",), ("search, before", "after", "other plants, before", "after"), title="Residual, rms over modes, nm")
    stages = [s.spreads for s in (result.before, result.after) if s.spreads]
    spreads = [one for both in zip(*stages, strict=True) for one in both]
    for name, key in (("nominal", "nominal"), ("95 %", "p95"), ("worst", "worst")):
        left = [float(np.sqrt(np.mean(getattr(one, key) ** 2))) for one in spreads]
        out.add_row(name, *("unstable" if np.isinf(x) else nm(x) for x in left))
    out.add_row("unstable plants", *(f"{one.unstable} of {len(one.points)}" for one in spreads))
    return out


NAMES = [o.id for o in OBSERVERS.values() if o.tunable.usual]
LINEAR = [c.id for c in CONTROLLERS.values() if c.tunable.usual]


@click.command()
@click.option("--observer", type=click.Choice(NAMES), help="Observer to tune.")
@click.option("--controller", type=click.Choice(LINEAR), help="Controller to tune, with --envelope.")
@click.option("--envelope", "on_envelope", is_flag=True, help="Tune a controller for an uncertain plant (docs/trust.md).")
@uncertainty_options
@click.option(
    "--by",
    type=click.Choice(["worst", "p95"]),
    default="worst",
    help="Residual that --envelope minimises.",
)
@click.option(
    "--loss",
    type=FiniteRange(0),
    default=EnvelopeGoal.loss,
    help="How much more --envelope may leave at the nominal plant.",
)
@scenario_options
@click.option(
    "--setting",
    "settings",
    multiple=True,
    metavar="NAME",
    help="Tune this setting instead of the usual ones; can be repeated.",
)
@click.option(
    "--target", type=click.Choice(TARGETS), help="Target of the error; by default vibration where the observer estimates it."
)
@click.option(
    "--evaluations",
    type=click.IntRange(1, 10_000),
    default=EVALUATIONS,
    metavar="N",
    help="Maximum runs of the observer.",
)
@click.option(
    "--validation",
    type=POSITIVE,
    metavar="S",
    help="Length of the validation record; by default that of the scenario.",
)
@click.option("--record", "record_file", metavar="RECORD", help="Tune on telemetry, cut in three, instead of simulated records.")
@record_options
@click.option("--out", metavar="F.toml", help="Save all settings, the tuned ones with a comment.")
@json_option("Print JSON instead of tables.")
def tune(
    observer: str | None,
    controller: str | None,
    on_envelope: bool,
    uncertainty: Uncertainty,
    by: Literal["worst", "p95"],
    loss: float,
    scenario: Scenario,
    settings: tuple[str, ...],
    target: str | None,
    evaluations: int,
    validation: float | None,
    record_file: str | None,
    declaration: DeclaredFile,
    out: str | None,
    as_json: bool,
) -> None:
    """Search for the best settings of an observer on a record, or of a controller on uncertain plants (docs/tuning.md)."""
    goal, record = EnvelopeGoal(uncertainty, by, loss), None
    name, other = (controller, observer) if on_envelope else (observer, controller)
    if name is None or other is not None:
        raise SettingError("give --observer, or --envelope and --controller")
    if not on_envelope and goal != EnvelopeGoal():
        raise SettingError("--delay, --gain, --rotation, --resonance, --by, --loss: only with --envelope")
    if out:
        check_output(out)
    if record_file is None:
        refuse_options(RECORD_OPTIONS, "only with --record")
    else:
        if validation is not None:
            raise SettingError("--validation: only for simulated records, not with --record")
        record = load_declared(record_file, scenario, declaration)
        is_known = target and not on_envelope and name in OBSERVERS and target in OBSERVERS[name].targets
        if target and is_known and (judged := judged_by(record, name, target)[0]) != target:
            raise SettingError(f"--target {target}: the record has no truth; {name} is tuned by its {judged}")
    with progress_bar("evaluations") as watch:
        tuned = search(
            scenario,
            name,
            settings or None,
            evaluations=evaluations,
            record=record,
            target=target,
            validation=validation,
            envelope=goal if on_envelope else None,
            watch=watch,
        )
    if as_json:
        print_json(tuning_dict(tuned))
    else:
        show_table(settings_table(tuned))
        show_table(errors_table(tuned) if tuned.after.spreads is None else spreads_table(tuned))
        for line in tuning_remarks(tuned):
            click.echo(line)
    if out:
        write_text(out, tuning_toml(tuned))
