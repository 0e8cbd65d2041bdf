"""Options that several commands share, and the record that they name."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import wraps
from math import erfc, isfinite, sqrt
from typing import Any

import click
import numpy as np
from click.core import ParameterSource

from wfsobs.cli.show import print_note
from wfsobs.closed_loop.envelope import Uncertainty
from wfsobs.files import check_writable, is_device
from wfsobs.priors_from.telemetry import told_by, training_part
from wfsobs.record import DELAY, Record, RecordError
from wfsobs.scenario import Scenario, configfile
from wfsobs.scenario.presets import PRESETS
from wfsobs.sensors.zernike import MODE_NAMES
from wfsobs.settings.values import SettingError
from wfsobs.streams.wiring import STUCK, NgsWiring
from wfsobs.telemetry.columns import split_source
from wfsobs.telemetry.command_response import saturation_lines
from wfsobs.telemetry.intake import LONGEST_DELAY, DeclaredFormat
from wfsobs.telemetry.records import open_record, read_loop_matrix, read_with_delay
from wfsobs.units import UNITS, micrometres_per


class FiniteRange(click.FloatRange):
    """Type of options that take a finite number within a range; a `click.FloatRange` lets `nan` pass."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number. Raises BadParameter."""
        if not isfinite(number := super().convert(value, param, ctx)):
            self.fail(f"{number} is no finite number", param, ctx)
        return number


POSITIVE = FiniteRange(0, min_open=True)
"""Type of options that take a number above 0."""


def check_output(path: str, endings: tuple[str, ...] = ()) -> None:
    """Raise OSError where an output file cannot be written, or is also given for another parameter of the command.

    endings : as of `check_writable`
    """
    check_writable(path, endings)
    if is_device(path):
        return
    given = click.get_current_context().params.values()
    texts = [text for value in given for text in (value if isinstance(value, tuple) else (value,)) if isinstance(text, str)]
    names = [name for text in texts for name in {text, split_source(text)[0]}]
    if [os.path.realpath(name) for name in names].count(os.path.realpath(path)) > 1:
        raise OSError(errno.EEXIST, "is also named as another file of this command; write to another", path)


@dataclass(frozen=True)
class DeclaredFile(DeclaredFormat):
    """What the user says of a record file; sha256 : its SHA-256, where it is to have a certain one."""

    sha256: str | None = None


RECORD_OPTIONS = tuple(field.name for field in fields(DeclaredFile))
"""Parameters of the options of `record_options`."""


def refuse_options(names: Container[str], reason: str) -> None:
    """Raise SettingError where one of these parameters of the command is given on the command line."""
    context = click.get_current_context()
    for parameter in context.command.params:
        if parameter.name in names and context.get_parameter_source(parameter.name) is ParameterSource.COMMANDLINE:
            raise SettingError(f"{parameter.opts[0]}: {reason}")


def add_options(command: Callable, *options: Callable) -> Callable:
    """Return a command with options, the last one first in its help."""
    for option in options:
        command = option(command)
    return command


def scenario_options(command: Callable) -> Callable:
    """Add --preset, --config and --set; the command receives the `scenario`."""

    @wraps(command)
    def with_scenario(*, preset: str | None, config: str | None, assignments: tuple[str, ...], **values: Any) -> Any:
        return command(scenario=configfile.scenario_from(preset, config, assignments), **values)

    return add_options(
        with_scenario,
        click.option(
            "--set",
            "assignments",
            multiple=True,
            metavar="NAME=VALUE",
            help="Change one setting, such as turbulence.wind_speed=20; can be repeated.",
        ),
        click.option("--config", metavar="F.toml", help="Settings from a TOML file, on top of the preset."),
        click.option("--preset", metavar="NAME", help=f"Start from {', '.join(PRESETS)}; by default paper."),
    )


def uncertainty_options(command: Callable) -> Callable:
    """Add the largest errors of the plant; the command receives the `uncertainty`."""

    @wraps(command)
    def with_uncertainty(*, delay: float, gain: float, rotation: float, resonance: float, **values: Any) -> Any:
        return command(uncertainty=Uncertainty(delay, gain, rotation, resonance), **values)

    below_1 = FiniteRange(0, 1, max_open=True)
    return add_options(
        with_uncertainty,
        click.option("--resonance", type=below_1, default=0.1, help="Of `plant.resonance`."),
        click.option("--rotation", type=FiniteRange(0, 180), default=10.0, help="Of the rotation [deg]."),
        click.option("--gain", type=below_1, default=0.2, help="Of the gain."),
        click.option("--delay", type=FiniteRange(0), default=0.5, help="Largest error of the delay [frames]."),
    )


observer_option = click.option(
    "--observer", "observers", multiple=True, metavar="NAME", help="Run this observer alone; can be repeated."
)


def json_option(text: str = "Print JSON instead of a table.") -> Callable:
    """Return the option --json, received as `as_json`; text : its help."""
    return click.option("--json", "as_json", is_flag=True, help=text)


def controller_option(text: str = "Run this controller alone; can be repeated.") -> Callable:
    """Return the option --controller, received as `controllers`; text : its help."""
    return click.option("--controller", "controllers", multiple=True, metavar="NAME", help=text)


@contextmanager
def needing(what: str, extra: str) -> Iterator[None]:
    """Turn a missing library into a SettingError: what needs it, and the extra of wfsobs that brings it."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise SettingError(f"{what} {error.name}; install wfsobs with its extra: wfsobs[{extra}]") from None


def told_scenario(prior: str | None, scenario: Scenario) -> Scenario:
    """Return a scenario with the prior of a file, if there is one, and what --set says of it."""
    if prior is not None:
        scenario = told_by(configfile.load_scenario(prior), scenario)
        for path, value in map(configfile.parse_assignment, click.get_current_context().params["assignments"]):
            scenario.set(path, value)
    return scenario


def preset_of_command() -> str:
    """Return the preset that the command starts from."""
    given = click.get_current_context().params
    return configfile.preset_name(given["preset"], given["config"])


def scenario_words() -> list[str]:
    """Return the options of the command that its scenario is from."""
    given = click.get_current_context().params
    named = [(f"--{name}", given[name]) for name in ("preset", "config")]
    return [word for pair in [*named, *(("--set", one) for one in given["assignments"])] for word in pair if pair[1]]


def ngs_options(command: Callable) -> Callable:
    """Add --ngs, --ngs-modes and --ngs-lag, the stream of a second sensor."""
    return add_options(
        command,
        click.option(
            "--ngs-lag",
            type=click.IntRange(0, 999),
            default=0,
            metavar="L",
            help="LGS frames between the end of an NGS exposure and the NGS frame.",
        ),
        click.option("--ngs-modes", metavar="I,J,...", help="Elements of a frame of the NGS that are its modes."),
        click.option("--ngs", metavar="STREAM", help="Pseudo-open-loop modes of the NGS, for observers of both sensors."),
    )


def record_options(command: Callable) -> Callable:
    """Add what is stated of a record file, from --unit to --trust, and --sha256, received as `declaration`."""

    @wraps(command)
    def with_declaration(**values: Any) -> Any:
        stated = {field.name: values.pop(field.name) for field in fields(DeclaredFile)}
        config = click.get_current_context().params.get("config")
        roles = dict[str, str]()
        for text in stated["columns"]:
            role, equals, name = text.partition("=")
            if not equals:
                raise SettingError(f"--column {text}: takes ROLE=NAME, such as y_lgs/tip=slope_x")
            if role.strip() in roles:
                raise SettingError(f"--column {text}: {role.strip()} is stated twice")
            roles[role.strip()] = name
        roles = ({} if config is None else configfile.load_columns(config)) | roles
        sign, gain = stated["command_sign"], stated["command_gain"]
        try:
            gains = tuple(map(float, gain.split(","))) if gain else None
        except ValueError:
            raise SettingError(f"--command-gain {gain}: takes a number, or one per mode with commas") from None
        stated |= {name: read_loop_matrix(stated[name]) for name in ("reconstructor", "command_modes")}
        stated |= {"columns": roles, "command_sign": int(sign) if sign else None, "command_gain": gains}
        return command(declaration=DeclaredFile(**stated), **values)

    return add_options(
        with_declaration,
        click.option("--trust", is_flag=True, help="Take commands and unit as stated, whatever the file or the data say."),
        click.option("--sha256", metavar="HEX", help="Refuse the record unless its file has this SHA-256."),
        click.option(
            "--column",
            "columns",
            multiple=True,
            metavar="ROLE=NAME",
            help="Which column or array of the file is what, such as y_lgs/tip=slope_x or u=commands; can be repeated.",
        ),
        click.option(
            "--command-modes",
            metavar="FILE[:NAME]",
            help="Matrix from modes to commands, where the commands are those of actuators.",
        ),
        click.option(
            "--reconstructor", metavar="FILE[:NAME]", help="Matrix from slopes to modes, where the measurements are slopes."
        ),
        click.option("--rate", type=POSITIVE, metavar="HZ", help="Rate of rows without time stamps."),
        click.option("--open-loop", is_flag=True, help="The mirror was at rest; commands are not needed, and not used."),
        click.option(
            "--rail",
            type=POSITIVE,
            metavar="U",
            help="Largest command that the mirror follows, in the unit of the commands.",
        ),
        click.option("--command-gain", metavar="G[,G]", help="What the mirror does of a command, one or per mode; by default 1."),
        click.option(
            "--command-delay",
            type=FiniteRange(1, LONGEST_DELAY),
            metavar="N",
            help=f"Steps from a command to the first measurement that sees it, such as 1.5; by default {DELAY}.",
        ),
        click.option(
            "--command-sign",
            type=click.Choice(["+1", "-1"]),
            help="+1 where y = disturbance + u (the default), -1 where y = disturbance - u.",
        ),
        click.option(
            "--unit",
            type=click.Choice(UNITS),
            help="Unit of the record where the file has none, or of the stream; um by default.",
        ),
    )


def record_command(command: Callable) -> click.Command:
    """Return the command on a RECORD: its argument, and the options of its scenario and of what is stated of it."""
    return click.command()(click.argument("record_file", metavar="RECORD")(scenario_options(record_options(command))))


seeds_option = click.option(
    "--seeds", type=click.IntRange(1, 100_000), default=1, metavar="N", help="Repeat with seeds run.seed ... run.seed + N - 1."
)


def training_options(command: Callable) -> Callable:
    """Add --train and --train-until."""
    return add_options(
        command,
        click.option(
            "--train-until",
            type=POSITIVE,
            metavar="S",
            help="Train on the first S seconds of the record; estimates and scores begin after them.",
        ),
        click.option("--train", metavar="RECORD", help="Train on another record of the same loop."),
    )


def training(
    train: str | None, train_until: float | None, record: Record, scenario: Scenario, declaration: DeclaredFile
) -> Record | float | None:
    """Read and check what --train and --train-until name, and say it on standard error. Raises SettingError, RecordError."""
    if train is not None and train_until is not None:
        raise SettingError("--train and --train-until: give one of them")
    if train is not None:
        other = training_part(record, load_declared(train, scenario, replace(declaration, sha256=None)), scenario)
        print_note(f"training data: {train}, {other.n_steps * other.dt:g} s; no score is of it")
        return other
    if train_until is not None:
        training_part(record, train_until, scenario)
        what = f"the first {train_until:g} s of {record.n_steps * record.dt:g} s"
        print_note(f"training data: {what}; estimates and scores begin after")
    return train_until


def load_declared(record_file: str, scenario: Scenario, declaration: DeclaredFile) -> Record:
    """Read the record of a file; print its interpretation on standard error. Raises RecordError, of constants as well."""
    record = load_with_delay(record_file, scenario, declaration)[0]
    if len(_still(record)) == record.n_modes:
        raise RecordError(f"{record_file}: y_lgs is one value all the time; a measurement has noise")
    return record


def _still(record: Record) -> list[str]:
    """Return the modes whose measurement does not change."""
    return [name for name, y in zip(MODE_NAMES, record.y_lgs.T, strict=False) if np.fmax.reduce(y) == np.fmin.reduce(y)]


def load_with_delay(record_file: str, scenario: Scenario, declaration: DeclaredFile) -> tuple[Record, float]:
    """As `load_declared`, and the delay of the commands with its fraction [steps]."""
    with open_record(record_file, declaration.sha256) as (file, name):
        record, delay = read_with_delay(file, name, scenario, declaration)
    if record.origin:
        print_note(f"{record_file}: read as {record.origin}")
    if still := _still(record):
        print_note(f"{record_file}: y_lgs of {' and '.join(still)} is one value all the time; a measurement has noise")
    if record.missing:
        print_note(f"{record_file}: {record.missing} of {record.n_steps} frames are missing")
    if (gone := record.ngs_gaps).any():
        print_note(f"{record_file}: {gone.sum()} of {gone.size} NGS frames are missing")
    expected = erfc(record.gate.level / sqrt(2.0)) * record.n_steps * record.n_modes if record.gate else 0.0
    if record.gate and record.outliers > expected + 3.0 * sqrt(expected):
        what = "missing" if record.gate.action == "reject" else "clipped"
        print_note(
            f"{record_file}: {record.outliers} of {record.n_steps} frames have outliers, which are {what} to observers "
            f"(sensors.gate); {expected:.1g} are expected of Gaussian noise"
        )
    for line in saturation_lines(record, declaration.rail):
        print_note(f"{record_file}: {line}")
    return record, delay


def stream_elements(text: str | None, n_modes: int, option: str = "--modes") -> tuple[int, ...]:
    """Return the elements of a frame that are the modes."""
    if text is None:
        return tuple(range(n_modes))
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() and len(part) < 10 for part in parts) or len(set(parts)) != len(parts):
        raise SettingError(f"{option} {text}: takes different whole numbers from 0 with commas, such as 0,1")
    if len(parts) > n_modes:
        raise SettingError(f"{option} {text}: the prior has {n_modes} modes")
    return tuple(map(int, parts))


def ngs_wiring(scenario: Scenario, n_modes: int, modes: str | None, unit: str, lag: int, stuck: float = STUCK) -> NgsWiring:
    """Return how the stream of an NGS is read: at the ratio of the scenario, and stuck after three of its frames at least."""
    elements = stream_elements(modes, n_modes, "--ngs-modes")
    if len(elements) != n_modes:
        raise SettingError(f"--ngs-modes {modes}: takes {n_modes} elements, one for each mode of the LGS")
    ratio = scenario.sensors.exposure_ratio
    if lag >= ratio:
        raise SettingError(f"--ngs-lag {lag}: takes 0 to {ratio - 1}, less than an NGS frame")
    return NgsWiring(
        elements, micrometres_per(unit, scenario.telescope.diameter), ratio, lag, max(stuck, 3 * ratio * scenario.dt)
    )
