"""Commands that work on a record: check, convert, gain, identify, observe, plant; and `wfsobs probe`, which makes none."""

from __future__ import annotations

import shlex
from dataclasses import asdict, replace

import click
import numpy as np
from rich.table import Column, Table
from rich.text import Text

from wfsobs.cli.options import (
    POSITIVE,
    DeclaredFile,
    FiniteRange,
    check_output,
    controller_option,
    json_option,
    load_declared,
    load_with_delay,
    observer_option,
    record_command,
    record_options,
    scenario_options,
    scenario_words,
    told_scenario,
    training,
    training_options,
)
from wfsobs.cli.show import new_table, print_json, print_note, progress_bar, show, show_table, show_verdicts, warn
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.promise import make_promise
from wfsobs.closed_loop.run import label
from wfsobs.control.laws import gain_from_telemetry
from wfsobs.evaluation.result import score_rows
from wfsobs.files import write_text
from wfsobs.identification import identify as identify_record
from wfsobs.identification.identification import (
    HIGHEST_LEVEL,
    LEVEL,
    format_number,
    identification_dict,
    identification_toml,
    mode_rows,
    whiteness_lines,
)
from wfsobs.identification.plant import identify_plant, plant_dict, plant_lines
from wfsobs.identification.probe import design_probe
from wfsobs.identification.process import Number
from wfsobs.identification.result import Identification
from wfsobs.pipeline import as_stated
from wfsobs.pipeline import observe as observe_record
from wfsobs.priors_from.controllers import plant_of
from wfsobs.record import RecordError
from wfsobs.scenario import Scenario
from wfsobs.sensors.zernike import HIGHEST_ORDER, modes_up_to
from wfsobs.settings.values import errors_of
from wfsobs.spectral.search import LOWEST
from wfsobs.telemetry.check import Check, check_record
from wfsobs.telemetry.intake import DeclaredFormat, to_record
from wfsobs.telemetry.preview import read_off
from wfsobs.telemetry.records import (
    line_of_lost,
    load_record,
    name_differences,
    open_record,
    read_contents,
    save_arrays,
    save_record,
)


@click.command()
@click.argument("record_file", metavar="IN")
@click.argument("out", metavar="OUT")
@scenario_options
@record_options
def convert(record_file: str, out: str, scenario: Scenario, declaration: DeclaredFile) -> None:
    """Write a record in another format: .npz, .aot.fits, .fits, .h5, .mat, .csv or .parquet.

    What is written is read back and compared; parts that the format has no place for are named.
    """
    check_output(out)
    record = load_with_delay(record_file, scenario, declaration)[0]
    save_record(out, record)
    if lost := line_of_lost(out, name_differences(record, load_record(out, scenario, DeclaredFormat(trust=True)))):
        print_note(lost)


def identification_table(result: Identification) -> Table:
    """Noise, turbulence and peaks of every mode."""
    title = f"Identified from {result.duration:.1f} s, with standard deviations"
    out = new_table(
        ("Mode", "What"),
        ("frequency, Hz", "damping", "rms, nm"),
        title=title,
        caption="rms of lines and resonances: within this record",
    )
    for m in result.modes:
        out.add_section()
        for what, frequency, damping, rms in mode_rows(m):
            numbers = (frequency, damping, None if rms is None else Number(rms.value * 1e3, rms.std * 1e3))
            out.add_row(m.name, what, *("" if n is None else format_number(n) for n in numbers))
    return out


@record_command
@training_options
@observer_option
@click.option("--prior", metavar="FOUND.toml", help="Prior of the observers: the file of `wfsobs identify --out`.")
@click.option("--out", metavar="ESTIMATES.npz", help="Save every estimate under the key observer/target.")
@json_option("Print a list of rows instead of a table.")
def observe(
    record_file: str,
    scenario: Scenario,
    declaration: DeclaredFile,
    train: str | None,
    train_until: float | None,
    observers: tuple[str, ...],
    prior: str | None,
    out: str | None,
    as_json: bool,
) -> None:
    """Run the observers on a record of any format (by default preset paper)."""
    if out:
        check_output(out, (".npz",))
    scenario = told_scenario(prior, scenario)
    record = load_declared(record_file, scenario, declaration)
    learnt = training(train, train_until, record, scenario, declaration)
    with progress_bar() as watch:
        told = None if prior is None else scenario
        result = observe_record(record, scenario, observers=observers or None, prior=told, train=learnt, watch=watch)
    warn(result)
    if not result.scores and not as_json:
        print_note(f"{record_file}: {len(result.estimates)} estimates, no scores: nothing after the warm-up")
    else:
        show(score_rows(result.scores, None, source=result.prior_source), as_json)
        if not as_json:
            show_verdicts(result, is_simulated=False)
    if out:
        save_arrays(out, {f"{e.observer}/{e.target}": e.values for e in result.estimates})


@record_command
@click.option(
    "--level",
    type=FiniteRange(0, HIGHEST_LEVEL, min_open=True),
    default=LEVEL,
    metavar="P",
    help="Probability of finding any peak where there is none.",
)
@click.option(
    "--lowest",
    type=POSITIVE,
    default=LOWEST,
    metavar="HZ",
    help="Minimum frequency of a peak.",
)
@click.option("--out", metavar="F.toml", help="Save the model as settings, on top of the preset.")
@json_option()
def identify(
    record_file: str,
    scenario: Scenario,
    declaration: DeclaredFile,
    level: float,
    lowest: float,
    out: str | None,
    as_json: bool,
) -> None:
    """Find noise, turbulence and vibration peaks in a record (docs/identification.md)."""
    if out:
        check_output(out)
    record = load_declared(record_file, scenario, declaration)
    with errors_of(record_file, RecordError), progress_bar("sweeps") as watch:
        result = identify_record(record, level=level, lowest=lowest, watch=watch)
    if as_json:
        print_json(identification_dict(result))
    else:
        show_table(identification_table(result))
        for line in whiteness_lines(result):
            click.echo(line)
    if out:
        write_text(out, identification_toml(result, result.scenario(as_stated(record, scenario))))


@record_command
@json_option()
def plant(record_file: str, scenario: Scenario, declaration: DeclaredFile, as_json: bool) -> None:
    """Identify what the commands of a closed loop do: delay, gain and rotation."""
    record = load_declared(record_file, scenario, declaration.as_commanded)
    with errors_of(record_file, RecordError), progress_bar("groups of modes") as watch:
        groups = identify_plant(record, watch)
    if as_json:
        print_json(plant_dict(groups))
        return
    table = new_table(("Modes", "delay, frames", "gain", "rotation, degrees"), title="The plant, with standard deviations")
    for group in groups:
        for name, delay, gain in zip(group.modes, group.delay, group.gain, strict=True):
            table.add_row(name, delay.text(), gain.text(), "")
        if group.rotation is not None:
            table.add_row(" and ".join(group.modes), group.common_delay.text(), group.common_gain.text(), group.degrees.text())
    show_table(table)
    for line in plant_lines(groups):
        click.echo(line)


@record_command
@click.option("--prior", metavar="FOUND.toml", help="Also the gain by these spectra: the file of `wfsobs identify --out`.")
@json_option()
def gain(record_file: str, scenario: Scenario, declaration: DeclaredFile, prior: str | None, as_json: bool) -> None:
    """Find the integrator's optimal gain from closed-loop telemetry (docs/closed_loop.md)."""
    whole, delay = load_with_delay(record_file, scenario, declaration)
    record = whole.without_outliers
    scenario = as_stated(record, told_scenario(prior, scenario)).replace({"control.delay": delay})
    mirror, leak = plant_of(scenario).mirror, scenario.control.leak
    laws = design(scenario, ["integrator"]).laws["integrator"] if prior else ()
    rows = []
    for mode, name in enumerate(m.name for m in modes_up_to(HIGHEST_ORDER)[: record.n_modes]):
        with errors_of(f"{record_file}: {name}", RecordError):
            found = gain_from_telemetry(record.z[record.delay :, mode], mirror, leak)
        left = float(np.sqrt(np.nanmean(np.square(record.y_lgs[:, mode]))))
        law = laws[mode].law if laws else None
        rows.append({"mode": name, **asdict(found), "recorded_rms": left, "from_spectra": law.gain if law else None})
    if as_json:
        print_json(rows)
        return
    table = new_table(
        ("Mode", "gain", "stable below", "rms, nm", "in the record, nm", *(["by the spectra"] if laws else [])),
        title=f"Gain of the integrator, delay {delay:g} frames",
        caption="rms: of the measurement, noise and all",
    )
    for row in rows:
        best = format_number(Number(row["gain"], row["deviation"]))
        numbers = [best, f"{row['limit']:.3g}", *(f"{1e3 * row[name]:.3g}" for name in ("measured_rms", "recorded_rms"))]
        table.add_row(row["mode"], *numbers, *([f"{row['from_spectra']:.3g}"] if row["from_spectra"] else []))
    show_table(table)


@record_command
@controller_option("Of this controller alone; can be repeated.")
@click.option("--after", metavar="NEXT", help="Compare with the record of the loop after one controller was switched on.")
@json_option()
def promise(
    record_file: str,
    scenario: Scenario,
    declaration: DeclaredFile,
    controllers: tuple[str, ...],
    after: str | None,
    as_json: bool,
) -> None:
    """State what controllers will leave of a loop, before one of them is switched on (docs/trust.md)."""
    record = load_declared(record_file, scenario, declaration.as_commanded)
    later = None if after is None else load_declared(after, scenario, replace(declaration.as_commanded, sha256=None))
    with errors_of(record_file, RecordError), progress_bar("controllers") as watch:
        result = make_promise(record, scenario, controllers=controllers or None, watch=watch)
    found = None if later is None else result.left_in(later)
    if as_json:
        print_json(result.to_dict() | {"after": found})
        return
    table = new_table(
        ("Controller", "mode", "rms, nm", "stable, %", "better, %", "Switch on?"),
        title="Residual promised, with 95 % intervals",
        caption="better: than the integrator with its optimal gain",
    )
    for one in result.residuals:
        table.add_section()
        shares = (f"{100.0 * share:.0f}" for share in (one.stable_share, one.better_share))
        ends = [*shares, "yes" if one.switch_on else f"no{one.note and ': '}{one.note}"]
        for mode, name in enumerate(m.name for m in result.scenario.modes):
            numbers = [1e3 * rms[mode] for rms in (one.rms, one.low, one.high) if rms]
            text = "{:.2f} ({:.2f} to {:.2f})".format(*numbers) if numbers else ""
            table.add_row(*((label(one.controller), name, text, *ends) if not mode else ("", name, text)))
    show_table(table)
    if found is not None:
        click.echo(
            f"{after}: " + ", ".join(f"{m.name} {1e3 * x:.2f} nm" for m, x in zip(result.scenario.modes, found, strict=True))
        )


@click.command()
@scenario_options
@click.option("--seconds", type=FiniteRange(1.0, 1e4), default=20.0, help="How long it lasts.")
@click.option("--delay", type=FiniteRange(1e-4, 1.0), default=0.03, help="Error of the delay, frames.")
@click.option("--gain", type=FiniteRange(1e-4, 1.0), default=0.02, help="Error of the gain.")
@click.option("--rotation", type=FiniteRange(1e-3, 90.0), default=1.0, help="Error of it, degrees.")
@click.option("--out", metavar="PROBE.npz", help="Save its commands, `probe` (steps, modes) [um], with `dt` [s].")
@json_option("Print JSON instead of a line.")
def probe(scenario: Scenario, seconds: float, delay: float, gain: float, rotation: float, out: str | None, as_json: bool) -> None:
    """Design a probe: commands by which delay, gain and rotation of a loop are known better (by default preset paper)."""
    if out:
        check_output(out, (".npz",))
    wanted = {"delay_frames": delay, "gain": gain, "rotation_deg": rotation}
    found = design_probe(scenario, seconds, wanted)
    if out:
        rng, n = np.random.default_rng(scenario.run.seed), round(seconds / scenario.dt)
        save_arrays(out, {"probe": found.commands(n, 2, scenario.dt, rng), "dt": np.array(scenario.dt)})
    if as_json:
        print_json(asdict(found))
        return
    bound = found.bound
    click.echo(
        f"{1e3 * found.rms:.3g} nm rms of tip and of tilt, white from {found.low:g} Hz to half the rate, {seconds:g} s\n"
        f"Cramer-Rao bound: delay {bound['delay_frames']:.2g} frames, gain {100.0 * bound['gain']:.2g} %, "
        f"rotation {bound['rotation_deg']:.2g} degrees\n"
        f"cost: the rms of the residual grows by {100.0 * found.cost:.2g} % while it lasts"
    )


COLOURS = {"ok": "green", "note": "yellow", "undecided": "yellow", "excluded": "red"}


@record_command
@json_option()
def check(record_file: str, scenario: Scenario, declaration: DeclaredFile, as_json: bool) -> None:
    """Check a record: what was read, and what of it can be relied on."""
    with open_record(record_file, declaration.sha256) as (file, name):
        with errors_of(record_file, RecordError):
            contents = read_contents(file, name, declaration.columns)
            record, raw = (to_record(contents, scenario, way) for way in (declaration, declaration.as_commanded))
    reading = read_off(record, contents, declaration, scenario)
    with progress_bar("sweeps") as watch:
        result = check_record(record, reading, raw, watch)
    own = {"command-delay": "delay", "command-sign": "command_sign"}  # which the file states otherwise
    is_refused = bool(reading.contradiction) and not result.corrections  # there is no option for a rotation
    trust = declaration.trust or is_refused or any(own.get(name) in contents.arrays for name in result.corrections)
    words = replace(declaration, trust=trust).options(result.corrections)
    command = shlex.join(["wfsobs", "identify", record_file, *scenario_words(), *words]) if result.identification else None
    if as_json:
        found = {
            "steps": record.n_steps,
            "rate": 1.0 / record.dt,
            "missing": record.missing,
            "read_as": record.origin,
            "plant": plant_dict(result.plant) if result.plant else None,
            "findings": [asdict(f) for f in result.findings],
            "identification": result.identification and identification_dict(result.identification),
            "reliable": result.is_reliable,
            "next": command,
        }
        print_json(found)
        return
    show_table(check_table(result, record_file))
    go_on = f" {'It is refused as it is; all the same' if is_refused else 'Go on with'}:\n  {command}" if command else ""
    click.echo(result.summary + go_on)


def check_table(result: Check, name: str) -> Table:
    """Return the findings of a check, a row each."""
    out = Table(Column(no_wrap=True), "What", "Found", title=name, title_justify="left", show_edge=False)
    for f in result.findings:
        out.add_row(Text(f.verdict, COLOURS[f.verdict]), f.subject, Text(f.text))
    return out
