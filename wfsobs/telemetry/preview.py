"""Preview of an uploaded record or spectrum: rate, unit, gaps and rms, or one line of error.

The bytes may be anything. Nothing is unpickled, no path is opened, and the memory of the contents is known before
it is used.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from wfsobs.identification.plant import Contradiction
from wfsobs.progress import QUIET, Watch
from wfsobs.record import DELAY, Record, RecordError, hold_last
from wfsobs.scenario import Scenario
from wfsobs.signal.spectrum import psd, rms
from wfsobs.telemetry.columns import describe_values, suggest_clock, suggest_roles
from wfsobs.telemetry.command_response import CommandResponse, command_response, saturation_lines
from wfsobs.telemetry.formats.contents import TIME, TRAINING, Contents
from wfsobs.telemetry.formats.psd import NoSpectrumError, read_psd
from wfsobs.telemetry.intake import DeclaredFormat, stated_delay, stated_sign, to_record
from wfsobs.telemetry.records import contradiction_of, plausible_units, read_columns, read_contents
from wfsobs.typing import Array

MOST_FILE = 64_000_000
"""Maximum bytes of an uploaded file."""

MOST_NUMBERS = 256_000_000
"""Maximum bytes of numbers in it."""

LONGEST_NAME = 80
MOST_OFFERED = 100
"""Maximum columns that are offered to be said what they are."""


@dataclass(frozen=True)
class Reading:
    """How a record was read, and what the data say of it.

    Attributes
    ----------
    sign : int
        Sign of the commands, as the file or the user states it, 1 where neither does.
    response : CommandResponse or None
        What the data say of sign and delay, of the commands as they are in the file.
    units : dict of str to float
        Units under which the size of z is plausible -> its rms [um]; empty where the file or the user states the unit.
    limits : list of str
        What the data say of commands at the limit of the mirror, a line per mode.
    contradiction : Contradiction or None
        Why the data exclude its commands or its unit, unless that is trusted.
    delay : float
        Delay of the commands as the file or the user states it, with its fraction [steps].
    gain : tuple of float or None
        What the mirror does of a command as the user states it, one number or one per mode.
    is_stated : bool
        Whether the file states the sign or the delay.
    """

    sign: int = 1
    response: CommandResponse | None = None
    units: dict[str, float] = field(default_factory=dict)
    limits: list[str] = field(default_factory=list)
    contradiction: Contradiction | None = None
    delay: float = DELAY
    gain: tuple[float, ...] | None = None
    is_stated: bool = False

    @property
    def proposal(self) -> dict[str, float]:
        """What the data propose in place of the sign and the delay as they were read, by the names of `DeclaredFormat`."""
        if self.contradiction is not None:  # of whole frames and of no rotation, the response is less
            return self.contradiction.proposal
        if self.response is None or self.delay % 1:
            return {}
        found = (("command_sign", self.response.sign, self.sign), ("command_delay", self.response.delay, self.delay))
        return {name: value for name, value, read in found if value not in (None, read)}

    def lines(self) -> list[str]:
        """Return the evidence, a line each."""
        lines = self.response.lines() if self.response else ["sign and delay: too few steps, or commands that do not move"]
        if self.contradiction is not None and self.contradiction.text.startswith("command"):
            lines = [self.contradiction.text]
        elif self.delay % 1:  # the response is of whole frames
            lines = lines[:1]
        lines += self.limits
        if self.units:
            ways = " or ".join(f"{unit} ({float(f'{1e3 * rms:.3g}'):g} nm rms of z)" for unit, rms in self.units.items())
            lines.append(f"unit {'undecided' if len(self.units) > 1 else 'proposed'}: the numbers are plausible as {ways}")
        return lines

    @property
    def missing(self) -> str:
        """What to say before the record can be used, in a line; empty where nothing is."""
        if set(self.units) <= {"um"}:
            return "State what the data say, or trust what is stated." if self.contradiction else ""
        return f"Choose the unit first: the file does not say it, and the numbers are plausible as {' or '.join(self.units)}."


@dataclass(frozen=True)
class Preview:
    """Preview of a record.

    Attributes
    ----------
    record : Record
        The record in um, with our sign of commands.
    name : str
        Name of the file, safe to show.
    rms : dict of str to tuple
        Signal (y_lgs, u, z) -> rms of every mode, without missing samples [um].
    frequency : Array
        Frequencies, (n,) [Hz].
    spectrum : Array
        Power spectral density of z, gaps held, (n, n_modes) [um^2/Hz].
    """

    record: Record
    name: str
    rms: dict[str, tuple[float, ...]]
    frequency: Array
    spectrum: Array
    reading: Reading

    @property
    def rate(self) -> float:
        """Fast steps per second [Hz]."""
        return 1.0 / self.record.dt

    @property
    def duration(self) -> float:
        """Length of the record [s]."""
        return self.record.n_steps * self.record.dt

    def lines(self) -> list[str]:
        """Return the lines to confirm."""
        r = self.record
        ngs = "none"
        if r.y_ngs is not None and r.ratio is not None:
            ngs = f"{self.rate / r.ratio:.6g} Hz, {r.ngs_gaps.sum()} frames missing"
        truth = [name for name in ("turbulence", "vibration") if getattr(r, name) is not None]
        return [
            f"{r.n_steps} steps at {self.rate:.6g} Hz, {self.duration:.4g} s, {r.missing} missing"
            + (f", {r.outliers} outlying" if r.outliers else ""),
            f"{r.n_modes} mode{'s' * (r.n_modes > 1)}, in um rms" + (f", read as {r.origin}" if r.origin else ""),
            f"a command is seen {self.reading.delay:g} step{'s' * (self.reading.delay != 1)} later",
            f"NGS: {ngs}",
            f"truth: {' and '.join(truth) or 'none, scored by prediction of the next measurement'}",
        ]


@dataclass(frozen=True)
class ColumnsPreview:
    """Preview of a file whose columns have other names than those of a record.

    Attributes
    ----------
    name : str
        Name of the file, safe to show.
    why : str
        Why it is no record as it stands.
    columns : dict of str to str
        Name of a column -> its values in a few words.
    roles : dict of str to str
        Roles that the names suggest, {role: name}.
    """

    name: str
    why: str
    columns: dict[str, str]
    roles: dict[str, str]

    def lines(self) -> list[str]:
        """Return the line to act on."""
        return [self.why]


@dataclass(frozen=True)
class SpectrumPreview:
    """Preview of a vibration spectrum; table : the setting vibration.psd, the rest as in `Preview`."""

    table: dict[str, list[float]]
    name: str
    frequency: Array
    spectrum: Array

    def lines(self) -> list[str]:
        """Return the lines to confirm."""
        tip, tilt = np.sqrt(np.trapezoid(self.spectrum, self.frequency, axis=0)) * 1e3
        low, high = self.frequency[[0, -1]]
        return [
            f"a vibration spectrum: {self.frequency.size} frequencies from {low:.4g} to {high:.4g} Hz",
            f"{tip:.4g} nm rms of tip, {tilt:.4g} nm of tilt",
        ]


def preview_any(
    data: bytes,
    name: str,
    scenario: Scenario | None = None,
    declaration: DeclaredFormat | None = None,
    check_steps: Callable[[int], None] | None = None,
    watch: Watch = QUIET,
) -> Preview | SpectrumPreview | ColumnsPreview:
    """Preview the bytes of a record, of a vibration spectrum, or of columns that have to be said what they are.

    check_steps : raises ValueError for a number of steps that is too large

    Raises RecordError with one clear line, Cancelled.
    """
    try:
        return preview(data, name, scenario, declaration, check_steps, watch)
    except RecordError as error:
        if not re.search(r": has no (y_lgs|u);", str(error)) or (declaration and declaration.columns):
            raise
        no_record = error
    watch.check()
    shown, diameter = safe_name(name), (scenario or Scenario()).telescope.diameter
    if not shown.lower().endswith((".csv", ".txt", ".fits", ".fit", ".fts")):  # which no spectrum comes in
        return _preview_columns(data, shown, no_record)
    try:
        table = read_psd(io.BytesIO(data), shown, declaration.unit if declaration else None, diameter)
    except NoSpectrumError:
        watch.check()
        return _preview_columns(data, shown, no_record)
    return SpectrumPreview(table, shown, np.array(table["frequency"]), np.column_stack([table["tip"], table["tilt"]]))


def _preview_columns(data: bytes, name: str, no_record: RecordError) -> ColumnsPreview:
    """Return the columns of a file that is no record as it stands. Raises why it is none where it has no two columns."""
    try:
        columns = read_columns(io.BytesIO(data), name, MOST_NUMBERS).columns
    except RecordError:
        columns = {}
    long = {key: values for key, values in columns.items() if values.size > 1}
    if len(long) < 2:
        raise no_record from None
    offered = dict(list(long.items())[:MOST_OFFERED])
    roles = suggest_roles(offered)
    clock = suggest_clock({key: values for key, values in offered.items() if key not in roles.values()})
    if TIME not in roles and clock is not None:
        roles[TIME] = clock
    needless = "a record needs", "as its names suggest", "which of its columns"  # beside lists of the columns
    why = "; ".join(part for part in str(no_record).split("; ") if not part.startswith(needless))
    return ColumnsPreview(name, why, {k: describe_values(v) for k, v in offered.items()}, roles)


def preview(
    data: bytes,
    name: str,
    scenario: Scenario | None = None,
    declaration: DeclaredFormat | None = None,
    check_steps: Callable[[int], None] | None = None,
    watch: Watch = QUIET,
) -> Preview:
    """Preview the bytes of a record, as `preview_any`; its name gives the format."""
    shown, scenario, stated = safe_name(name), scenario or Scenario(), declaration or DeclaredFormat()
    if len(data) > MOST_FILE:
        raise RecordError(f"{shown}: has {len(data) / 1e6:.0f} MB, at most {MOST_FILE / 1e6:.0f} MB are taken")
    try:
        contents = read_contents(io.BytesIO(data), shown, stated.columns, MOST_NUMBERS)
        watch.check()
        if check_steps is not None:
            longest = (max(x.shape, default=0) for name, x in contents.arrays.items() if name not in TRAINING)
            check_steps(max(longest, default=0))
        record = to_record(contents, scenario, stated)
    except RecordError as error:
        raise RecordError(f"{shown}: {error}") from None
    watch.check()
    signals = {"y_lgs": record.y_lgs, "u": record.u, "z": (z := record.z[record.delay :])}.items()
    values = {key: tuple(rms(column[~np.isnan(column)]) for column in signal.T) for key, signal in signals}
    frequency, spectrum = psd(hold_last(z), record.dt)
    watch.check()
    return Preview(record, shown, values, frequency, spectrum, read_off(record, contents, stated, scenario))


def read_off(record: Record, contents: Contents, declaration: DeclaredFormat, scenario: Scenario) -> Reading:
    """Return what the data say of sign, delay and unit of a record and the contents of its file."""
    sign, units = stated_sign(contents, declaration), plausible_units(record, contents, declaration, scenario)
    response = command_response(replace(record, u=sign * record.u))
    excluded = contradiction_of(record, contents, declaration, scenario)
    stated = stated_delay(contents, declaration), declaration.command_gain
    is_stated = not contents.arrays.keys().isdisjoint({"command_sign", "delay"})
    return Reading(sign, response, units, saturation_lines(record, declaration.rail), excluded, *stated, is_stated)


def safe_name(name: str) -> str:
    r"""Return the last part of a file name, with unusual characters replaced.

    >>> safe_name("../../etc/pass\x00wd<b>.csv")
    'pass_wd_b_.csv'
    """
    return re.sub(r"[^\w.+ -]", "_", re.split(r"[/\\]", name)[-1])[-LONGEST_NAME:] or "unnamed"
