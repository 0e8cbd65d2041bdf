"""`wfsobs run`, `wfsobs loop` and `wfsobs envelope`: simulate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import mean

import click
import numpy as np
from rich.table import Table

from wfsobs.cli.options import (
    POSITIVE,
    RECORD_OPTIONS,
    DeclaredFile,
    check_output,
    controller_option,
    json_option,
    load_declared,
    observer_option,
    record_options,
    refuse_options,
    scenario_options,
    seeds_option,
    training,
    training_options,
    uncertainty_options,
)
from wfsobs.cli.show import (
    OverTime,
    budget_table,
    grouped_rows,
    median_text,
    new_table,
    print_json,
    print_note,
    progress_bar,
    show,
    show_table,
    show_verdicts,
    warn,
)
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.envelope import POINTS, PlantEnvelope, Uncertainty, plant_envelope
from wfsobs.closed_loop.run import LIMITED, closed_loop, label, linear, no_theory
from wfsobs.closed_loop.run import rows as loop_rows
from wfsobs.evaluation.budget import Budget, budget_row, error_budget
from wfsobs.evaluation.evidence import FEWEST, gather_evidence, seeds_interval
from wfsobs.evaluation.result import Result, Row, interval_text, score_rows
from wfsobs.observers import OBSERVERS
from wfsobs.pipeline import as_stated
from wfsobs.pipeline import observe as observe_record
from wfsobs.prior import GIVEN
from wfsobs.priors_from.telemetry import trained_until, with_training
from wfsobs.scenario import Scenario, configfile
from wfsobs.settings.values import SettingError
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.formats import WRITTEN
from wfsobs.telemetry.formats.psd import load_psd
from wfsobs.telemetry.records import save_record
from wfsobs.tuning import EnvelopeGoal, tuned_envelope
from wfsobs.units import UNITS


def loop_table(rows: Sequence[Row]) -> Table:
    """Return the residual table, best controller first; residuals are means over seeds with intervals, all else medians."""
    several = len({r["seed"] for r in rows}) > 1
    spread = ("95 %, nm",) if several else ()
    numbers = ("rms, nm", *spread, "mas", "Strehl", "theory, nm", "gain", "margins", "delay, ms", "at limit, %")
    out = new_table(
        ("Mode", "Controller", "Prior knowledge"),
        numbers,
        title="Residual in closed loop after warm-up" + (", mean over seeds" if several else ""),
    )
    modes = list(dict.fromkeys(r["mode"] for r in rows))

    def place(group: tuple[tuple[str, ...], list[Row]]) -> tuple:
        """Modes as they come, least residual first, what has none last."""
        (mode, _), same = group
        left = [r["residual_rms_nm"] for r in same]
        return modes.index(mode), mean(float("inf") if x is None else x for x in left)

    last = None
    for (mode, controller), same in sorted(grouped_rows(rows, "mode", "controller").items(), key=place):
        if last != mode:
            out.add_section()
        last = mode
        stable = all(r["stable"] for r in same)
        left = [r["residual_rms_nm"] for r in same if r["residual_rms_nm"] is not None]
        shown = f"{mean(left):.2f}" if left else "unstable" if not stable else "-"
        if all(r["stable"] is None for r in same):
            shown = "none"
        out.add_row(
            mode,
            label(controller),
            same[0]["needs"],
            shown,
            *((interval_text(float(np.mean(left)), seeds_interval(np.array(left)), 1.0),) if several else ()),
            median_text(same, "residual_rms_mas", 3),
            median_text(same, "strehl", 4),
            linear(same, median_text(same, "predicted_rms_nm", 2)),
            median_text(same, "gain", 3),
            linear(same, _margins(same[0])),
            linear(same, median_text(same, "delay_margin_ms", 2)),
            median_text(same, "limited", 2, 100.0),
        )
    out.caption = no_theory(rows) or None
    return out


def _margins(row: Row) -> str:
    gain, phase = row["gain_margin_db"], row["phase_margin_deg"]
    return "-" if phase is None else f"{'-' if gain is None else f'{gain:.1f}'} dB, {phase:.0f}°"


@click.command()
@scenario_options
@observer_option
@seeds_option
@json_option("Print a list of rows instead of a table.")
@click.option("--save", metavar="RECORD", help="Also save the record of the (one) run, in the format of its ending.")
@click.option("--vibration-psd", metavar="FILE", help="Vibration with the spectrum of a CSV or FITS file (docs/data.md).")
@click.option(
    "--over-time",
    type=POSITIVE,
    metavar="SECONDS",
    help="Print the running error over this time against time (docs/events.md).",
)
@click.option("--psd-unit", type=click.Choice(UNITS), help="Unit of the spectrum, squared per Hz, where the file has none.")
@click.option("--budget", is_flag=True, help="Also print the error budget of every linear observer (docs/error-budget.md).")
@click.option(
    "--budget-of", multiple=True, metavar="NAME", help="Print the error budget of this observer alone; can be repeated."
)
def run(
    scenario: Scenario,
    observers: tuple[str, ...],
    seeds: int,
    as_json: bool,
    save: str | None,
    vibration_psd: str | None,
    over_time: float | None,
    psd_unit: str | None,
    budget: bool,
    budget_of: tuple[str, ...],
) -> None:
    """Simulate the loop, run every observer and print the RMS table."""
    if save and seeds > 1:
        raise SettingError("--save: saves one record; leave --seeds at 1")
    if save:
        check_output(save, WRITTEN)
    if (budget or budget_of) and (seeds > 1 or over_time):
        raise SettingError("--budget: is of one record, without --over-time; leave --seeds at 1")
    if unknown := set(budget_of) - set(OBSERVERS):
        raise SettingError(f"--budget-of {min(unknown)}: no such observer; there are {', '.join(OBSERVERS)}")
    if vibration_psd is None:
        refuse_options(("psd_unit",), "only with --vibration-psd")
    else:
        table = load_psd(vibration_psd, psd_unit, scenario.telescope.diameter)
        scenario = scenario.replace({"vibration.source": "psd", "vibration.psd": table})
    results: list[Result] = []
    history = OverTime(scenario, over_time) if over_time else None
    with progress_bar() as watch:
        for i in range(seeds):
            one = scenario.replace({"run.seed": scenario.run.seed + i})
            record = simulate(one)
            if save and (lost := save_record(save, record, configfile.to_toml(one))):
                print_note(lost)
            inner = watch.part(i / seeds, 1.0 / seeds)
            result = observe_record(record, one, observers=observers or None, watch=inner, is_simulated=True)
            warn(result)
            if history:
                history.add(result, one.run.seed)
            # Of the others the scores are enough.
            results.append(replace(result, record=results[0].record, estimates=()) if results else result)
    if history:
        if as_json:
            print_json(history.rows)
        else:
            show_table(history.table())
        return
    for name in sorted(set(budget_of) - {e.observer for e in results[0].estimates}):
        print_note(f"--budget-of {name}: it did not run")
    budgets, all_rows = list[Budget](), [row for it in results for row in score_rows(it.scores, it.scenario.run.seed)]
    if budget or budget_of:
        with progress_bar("error budget") as watch:
            budgets = error_budget(results[0], observers=budget_of or None, watch=watch)
    if found := {(b.observer, b.target, b.mode): budget_row(b) for b in budgets}:
        all_rows = [row | {"budget": found.get((row["observer"], row["target"], row["mode"]))} for row in all_rows]
    show(all_rows, as_json)
    if not as_json and seeds not in range(2, FEWEST):
        show_verdicts(results[0], budgets, gather_evidence([it.scores for it in results]), is_simulated=True)
        if budgets:
            click.echo()
            show_table(budget_table(budgets))


@click.command()
@scenario_options
@controller_option()
@seeds_option
@click.option("--record", "record_file", metavar="RECORD", help="Use the disturbance and noise of a record with truth.")
@record_options
@training_options
@click.option("--envelope", "with_envelope", is_flag=True, help="Also print what an uncertain plant does (`wfsobs envelope`).")
@json_option("Print a list of rows instead of a table.")
def loop(
    scenario: Scenario,
    controllers: tuple[str, ...],
    seeds: int,
    record_file: str | None,
    declaration: DeclaredFile,
    train: str | None,
    train_until: float | None,
    with_envelope: bool,
    as_json: bool,
) -> None:
    """Close the loop with every controller on the same disturbance and print what is left of it (docs/closed_loop.md)."""
    record, start = None, 0.0
    if with_envelope and (as_json or record_file is not None):
        raise SettingError("--envelope: not with --json or --record; `wfsobs envelope --json` has the rows, of a scenario")
    if record_file is None:
        refuse_options((*RECORD_OPTIONS, "train", "train_until"), "only with --record")
    else:
        if seeds > 1:
            raise SettingError("--seeds: only for simulated records, not with --record")
        record = load_declared(record_file, scenario, declaration)
        scenario = as_stated(record, scenario)
        learnt = training(train, train_until, record, scenario, declaration)
        record, start = record if learnt is None else with_training(record, learnt, scenario), trained_until(learnt)
    all_rows: list[Row] = []
    with progress_bar("controllers") as watch:
        plan = design(scenario, controllers or None, start)
        for i in range(seeds):
            one = scenario.replace({"run.seed": scenario.run.seed + i})
            given = simulate(one) if record is None else record
            result = closed_loop(given, replace(plan, scenario=one), watch.part(i / seeds, 1.0 / seeds))
            all_rows += loop_rows(result, one.run.seed) if record is None else loop_rows(result, None, source=GIVEN)
    if as_json:
        print_json(all_rows)
    else:
        show_table(loop_table(all_rows))
        for line in dict.fromkeys(f"{label(r['controller'])}: {r['note']}" for r in all_rows if r["note"] not in ("", LIMITED)):
            click.echo(line)
    if with_envelope:
        with progress_bar("envelope") as watch:
            _show_envelope(plant_envelope(scenario, controllers=controllers or None, watch=watch))


def envelope_table(result: PlantEnvelope) -> Table:
    """Return the table of an envelope, least nominal residual first in each mode."""
    out = new_table(
        ("Mode", "Controller"),
        ("caution", "nominal, nm", "mean", "95 %", "worst", "unstable, %", "corners"),
        title=f"Residual over {len(result.errors['delay'])} plants: {result.ranges}",
    )
    rows = result.rows()
    for (mode,), same in grouped_rows(rows, "mode").items():
        out.add_section()
        for r in sorted(same, key=lambda r: r["nominal_rms_nm"] or float("inf")):
            left = [r[f"{name}_rms_nm"] for name in ("nominal", "mean", "p95", "worst")]
            share = "{:.1f} ({:.1f} to {:.1f})".format(*(100.0 * r[f"unstable_{k}"] for k in ("share", "low", "high")))
            shown = ["unstable" if x is None else f"{x:.2f}" for x in left]
            out.add_row(
                mode,
                label(r["controller"]) + (f" ({r['points']} simulated)" if r["simulated"] else ""),
                f"{r['caution']:.3g}",
                *shown,
                share,
                f"{r['unstable_corners']} of {r['corners']}",
            )
    out.caption = "mean and 95 % of the stable plants; worst of all and of the corners; share with its 95 % interval"
    if any(r["simulated"] for r in rows):
        out.caption += "; simulated: of one record, to be compared with its own nominal"
    return out


@click.command()
@scenario_options
@controller_option("Of this controller alone; can be repeated.")
@click.option("--points", type=click.IntRange(1, 100_000), default=POINTS, metavar="N", help="Plants.")
@click.option(
    "--simulate",
    "simulation_points",
    type=click.IntRange(1, POINTS),
    metavar="N",
    help="Others too, at N plants and corners.",
)
@uncertainty_options
@click.option("--tune", "is_tuned", is_flag=True, help="Of each controller after `wfsobs tune --envelope`.")
@json_option("Print a list of rows instead of a table.")
def envelope(
    scenario: Scenario,
    controllers: tuple[str, ...],
    points: int,
    simulation_points: int | None,
    uncertainty: Uncertainty,
    is_tuned: bool,
    as_json: bool,
) -> None:
    """Compute what every linear controller leaves of the disturbance over an uncertain plant (docs/trust.md)."""
    names = controllers or None
    if simulation_points and is_tuned:
        raise SettingError("--simulate: not with --tune, which is by theory")
    with progress_bar("controllers") as watch:
        if is_tuned:
            result = tuned_envelope(scenario, controllers=names, goal=EnvelopeGoal(uncertainty), points=points, watch=watch)
        else:
            result = plant_envelope(
                scenario,
                controllers=names,
                uncertainty=uncertainty,
                points=points,
                simulation_points=simulation_points or 0,
                watch=watch,
            )
    if as_json:
        print_json(result.rows())
        return
    _show_envelope(result)


def _show_envelope(result: PlantEnvelope) -> None:
    show_table(envelope_table(result))
    for name, reason in result.notes.items():
        click.echo(f"{label(name)}: {reason}")
    if result.spreads:
        click.echo(f"All modes together. {' '.join(result.sentences())}")
