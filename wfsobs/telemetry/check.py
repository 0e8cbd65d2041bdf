"""What a record is, and what of it can be relied on: frames, unit, commands, stationarity, identification.

Nothing is concluded that the data do not decide: a finding is `ok`, `note` (look at it), `undecided` or `excluded` (by the data).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import hypot
from typing import Literal

import numpy as np
import scipy
from scipy.fft import rfft
from scipy.special import fdtr, fdtrc

from wfsobs.identification.identification import identify
from wfsobs.identification.plant import EXCITED, GroupPlant, PlantNumber, identify_plant
from wfsobs.identification.result import Identification
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError, hold_last
from wfsobs.scenario.groups.sensors import Sensors
from wfsobs.sensors.zernike import MODE_NAMES
from wfsobs.signal.gate import BLOCK
from wfsobs.telemetry.preview import Reading
from wfsobs.telemetry.records import PLAUSIBLE, z_rms
from wfsobs.typing import Array

SECTIONS = 8
"""Parts of a record whose spectra are compared."""

FEWEST_BINS = 16
"""Minimum bins of a band, and minimum bin of the lowest: below it trends and turbulence fluctuate."""

CORRELATED = 35.0 / 18.0
"""Bins of a Hann window that count as one: the sum of their squared correlations, 1 + 2 (2/3)^2 + 2 (1/6)^2."""

LEVEL = 0.01
"""Probability of a change found anywhere where there is none."""

UNEVEN = 0.05
"""How much more of a section than of the best one may be missing where they are compared, as a share of it."""

OUTLYING = 0.01
"""Share of outlying or missing samples that is worth a look."""

Verdict = Literal["ok", "note", "undecided", "excluded"]


@dataclass(frozen=True)
class Remark:
    """One thing that was looked at.

    Attributes
    ----------
    subject : str
        What it was.
    verdict : {"ok", "note", "undecided", "excluded"}
        Whether it is as it should be, worth a look, not decided by the data, or excluded by them.
    text : str
        The evidence.
    """

    subject: str
    verdict: Verdict
    text: str


@dataclass(frozen=True)
class Check:
    """Findings on a record.

    Attributes
    ----------
    findings : tuple of Remark
        In the order in which they matter: what comes first decides on what follows.
    identification : Identification or None
        Model of the record, None where it could not be identified.
    corrections : mapping of str to str
        Option of the command line -> value with which to read it again; empty where it is read as the data say.
    plant : tuple of GroupPlant
        Delay, gain and rotation of the commands; empty where they were not looked for.
    """

    findings: tuple[Remark, ...]
    identification: Identification | None
    corrections: Mapping[str, str]
    plant: tuple[GroupPlant, ...]

    @property
    def is_reliable(self) -> bool:
        """Whether an identification of the record can be relied on, if what the data do not decide is as stated."""
        return self.identification is not None and not any(f.verdict in ("note", "excluded") for f in self.findings)

    @property
    def summary(self) -> str:
        """What `is_reliable` says, as a sentence."""
        if self.identification is None:
            return "It cannot be identified."
        if not self.is_reliable:
            return "An identification of it is to be taken with care."
        undecided = [f.subject for f in self.findings if f.verdict == "undecided"]
        but = f"; not decided by the data: {', '.join(undecided)}" if undecided else ""
        return f"An identification of it can be relied on{but}."


def check_record(record: Record, reading: Reading, raw: Record, watch: Watch = QUIET) -> Check:
    """Look at all that has to be right before an identification of a record can be relied on.

    Parameters
    ----------
    record : Record
        Measurements and commands.
    reading : Reading
        How it was read, and what the data say of the unit and of limits of the commands.
    raw : Record
        The record with the commands as they were given, without delay and gain.
    watch : Watch, optional
        Receives the progress of the identification, and is asked whether to stop.

    Returns
    -------
    Check
        Findings, identification, and what to read otherwise.

    Raises
    ------
    Cancelled
        `watch` asks to stop.
    """
    plant, commands = _plant(raw, reading)
    findings = [*_frames(record), *_unit(record, reading), *commands, *_stationarity(record)]
    result = None
    try:
        result = identify(record, watch=watch)
    except RecordError as error:
        findings.append(Remark("identification", "excluded", str(error)))
    else:
        findings += _residual(result)
    return Check(tuple(findings), result, _corrections(reading, plant), plant)


def _frames(record: Record) -> Iterator[Remark]:
    n = record.n_steps
    share = record.missing / n
    text = f"{n} at {1.0 / record.dt:.6g} Hz, {n * record.dt:.4g} s; {record.missing} missing ({100.0 * share:.3g} %)"
    yield Remark("frames", "note" if share > OUTLYING else "ok", text)
    if (gone := record.ngs_gaps).size:
        text = f"{gone.size}; {gone.sum()} missing ({100.0 * gone.mean():.3g} %)"
        yield Remark("NGS frames", "note" if gone.mean() > OUTLYING else "ok", text)
    low, high = Sensors.settings()["lgs_rate"].bounds
    if not low <= 1.0 / record.dt <= high:
        yield Remark("rate", "excluded", f"that of a loop is {low:g} to {high:g} Hz: check dt, or the unit of the time")
    for name, y in (("y_lgs", record.y_lgs), ("y_ngs", record.y_ngs)):
        for mode, values in zip(MODE_NAMES, () if y is None else y.T, strict=False):
            known = values[~np.isnan(values)]
            if known.size > 1 and np.ptp(known) == 0.0:
                yield Remark("frames", "excluded", f"{name}/{mode} is {known[0]:g} all the time; a measurement has noise")
    if record.origin:
        yield Remark("read as", "ok", record.origin)


def _unit(record: Record, reading: Reading) -> Iterator[Remark]:
    size, (least, most) = z_rms(record), PLAUSIBLE
    if not least <= size <= most:
        usual = f"turbulence and vibration have {1e3 * least:g} to {1e3 * most:g} nm: check the unit"
        yield Remark("unit", "note", f"z has {1e3 * size:.3g} nm rms, where {usual}")
    elif reading.units:
        ways = " or ".join(f"{unit} ({1e3 * rms:.3g} nm rms of z)" for unit, rms in reading.units.items())
        verdict = "ok" if set(reading.units) == {"um"} else "undecided"
        yield Remark("unit", verdict, f"not in the file, taken for um; plausible are {ways}")


def _plant(record: Record, reading: Reading) -> tuple[tuple[GroupPlant, ...], list[Remark]]:
    """Return the plant, as far as it can be looked for, and the findings on the commands."""
    found = [Remark("commands", "excluded", reading.contradiction.text)] if reading.contradiction else []
    found += [Remark("mirror", "note", line) for line in reading.limits]
    if not record.u.any():
        what = "not used, as stated" if "u not used" in record.origin else "none"
        return (), [*found, Remark("commands", "ok", f"{what}: the mirror is at rest")]
    if reading.limits:
        return (), [*found, Remark(PLANT, "undecided", "not looked at while commands are beyond what the mirror follows")]
    try:
        plant = identify_plant(record)
    except RecordError as error:
        return (), [*found, Remark(PLANT, "undecided", f"not identifiable: {error}")]
    remarks = [remark for group in plant for remark in _commands(group, reading, len(plant) > 1)]
    if any(remark.verdict == "note" for remark in remarks):  # before the user is sent after another plant
        plant, differences = _in_halves(plant, record)
        known = {remark.subject for remark in differences}
        again = [remark for group in plant for remark in _commands(group, reading, len(plant) > 1)]
        remarks = [*(remark for remark in again if remark.subject not in known), *differences]
    return plant, [*remarks, *found]


def _in_halves(plant: tuple[GroupPlant, ...], record: Record) -> tuple[tuple[GroupPlant, ...], list[Remark]]:
    """Return a plant without the delays and gains in which the halves of a record differ, and what they are there.

    One plant made both; a disturbance of another form than that which is fitted does not.
    """
    middle, out, remarks = record.n_steps // 2, [], []
    parts = (slice(0, middle), slice(middle, None))
    try:
        halves = [identify_plant(Record(y, u, record.dt)) for y, u in ((record.y_lgs[part], record.u[part]) for part in parts)]
    except RecordError:
        return plant, []
    for group, *found in zip(plant, *halves, strict=True):
        of = f" of {' and '.join(group.modes)}" * (len(plant) > 1)
        for name in OFF:
            pairs = list(zip(*(_each(part, part.numbers(name)) for part in found), strict=True))
            if any(n.sd and m.sd and abs(abs(n.value) - abs(m.value)) > SURE * hypot(n.sd, m.sd) for n, m in pairs):
                group = replace(group, **{name: (PlantNumber(),) * len(group.modes), f"common_{name}": PlantNumber()})
                each = " and ".join(n.text() for n in pairs[0])
                text = f"{each} in the halves of the record: the disturbance has not the form that is fitted"
                remarks.append(Remark(f"command {name}{of}", "undecided", text))
        out.append(group)
    return tuple(out), remarks


PLANT = "command sign, delay, gain, rotation"
"""What is looked for together."""


def _commands(group: GroupPlant, reading: Reading, several: bool) -> Iterator[Remark]:
    """Yield what the data say of the commands of a group of modes."""
    of = f" of {' and '.join(group.modes)}" if several else ""
    degrees, sign = group.degrees, sign_of(group)
    if group.flipped_mode:
        yield Remark(f"command sign{of}", "excluded", f"that of {group.flipped_mode} is reversed, and no other")
    elif sign is None:
        yield Remark(f"command sign{of}", "undecided", "not identifiable")
    else:
        other = f"; {reading.sign:+d} is stated" if sign < 0 else ""
        yield Remark(f"command sign{of}", "note" if other else "ok", f"{sign * reading.sign:+d}{other}")
    if degrees.value is not None and degrees.sd is not None:
        off = abs(degrees.value) if sign != -1 else 180.0 - abs(degrees.value)
        verdict = "ok" if off < max(SURE * degrees.sd, TURNED) else "excluded" if off > 45.0 else "note"
        turn = "; a matrix of --command-modes, R^-1, turns them" * (verdict == "excluded")
        yield Remark(f"command rotation{of}", verdict, f"{degrees.text(' degrees')}, y = R u{turn}")
    elif group.rotation is not None:
        yield Remark(f"command rotation{of}", "undecided", "not identifiable")
    for subject, stated in (("delay", (reading.delay,)), ("gain", reading.gain or (1.0,))):
        numbers = known_numbers(group, subject)
        text = " and ".join(dict.fromkeys(n.text() for n in group.numbers(subject)))
        if numbers is None:
            yield Remark(f"command {subject}{of}", "undecided", f"{text}: not decided by the data")
            continue
        wrong = any(_is_off(n, s, subject) for n in numbers for s in stated)
        told = f"; {', '.join(f'{s:g}' for s in stated)} is stated"
        yield Remark(f"command {subject}{of}", "note" if wrong else "ok", text + told * wrong)


SURE, TURNED = 3.0, 2.0
"""Standard deviations by which a number has to be off what is stated; and minimum angle that matters [degrees]."""

OFF = {"delay": 0.1, "gain": 0.06}
"""Minimum distance of a delay [frames] and of a gain from what is stated; a number is decided that is known to half of it."""


def sign_of(group: GroupPlant) -> int | None:
    """Return the sign of the commands, -1 where they are turned beyond 135 degrees; None where it is not identifiable."""
    turn = group.degrees.value if group.rotation is not None else group.gain[0].value
    if turn is None or group.flipped_mode:
        return None
    return -1 if (abs(turn) > 135.0 if group.rotation is not None else turn < 0) else 1


def known_numbers(group: GroupPlant, subject: str) -> tuple[PlantNumber, ...] | None:
    """Return the delay or the gain of a group, one number where its modes have one, if known well enough; else None.

    Beside a coloured background they are as good as its form is, unless there is a probe.
    """
    numbers, sure = group.numbers(subject), not group.has_background or group.own_share > EXCITED
    return numbers if sure and all(n.sd is not None and n.sd < 0.5 * OFF[subject] for n in numbers) else None


def _each(group: GroupPlant, numbers: tuple[PlantNumber, ...]) -> tuple[PlantNumber, ...]:
    """Return a number per mode, also where the modes have one."""
    return (numbers * len(group.modes))[: len(group.modes)]


def _is_off(n: PlantNumber, right: float, subject: str) -> bool:
    return n.value is not None and n.sd is not None and abs(abs(n.value) - right) > max(SURE * n.sd, OFF[subject])


def _stationarity(record: Record) -> Iterator[Remark]:
    begin = record.delay + (BLOCK if record.gate else 0)  # the first ones all pass a gate
    z = record.without_outliers.z[begin:]
    length = len(z) // SECTIONS
    if length < 8 * FEWEST_BINS:
        yield Remark("stationarity", "undecided", f"{record.n_steps} frames are too few to compare {SECTIONS} sections")
        return
    columns = [(name, x) for name, x in zip(MODE_NAMES, z.T, strict=False) if np.fmax.reduce(x) > np.fmin.reduce(x)]
    least = min((sections_compared(x).size for _, x in columns), default=0)
    if least < 2:
        yield Remark("stationarity", "undecided", "too much is missing to compare sections")
        return
    changes = [(name, *change) for name, column in columns for change in find_changes(column, record.dt)]
    for name, low, high, section, ratio in changes:
        start, end = ((begin + part * length) * record.dt for part in (section, section + 1))
        where = f"{name}, {low:.3g} to {high:.3g} Hz: from {start:.3g} to {end:.3g} s {ratio:.2g} times the power of the rest"
        yield Remark("stationarity", "note", where)
    if not changes:
        text = f"the spectra of {least} sections differ no more than those of one process"
        yield Remark("stationarity", "ok", text + "; the others miss too many frames" * (least < SECTIONS))


def sections_compared(z: Array) -> Array:
    """Return the sections of z (n,) that miss about as little as the one that misses least: what is held has less power."""
    gone = np.isnan(z[: len(z) // SECTIONS * SECTIONS]).reshape(SECTIONS, -1).mean(axis=1)
    return np.flatnonzero((gone <= gone.min() + UNEVEN) & (gone < 1.0))


def find_changes(z: Array, dt: float) -> list[tuple[float, float, int, float]]:
    """Return the bands of z (n,) whose power in a section differs from that of the others, the least likely section of each.

    Only `sections_compared` are. The power of a band is a sum of exponential variates, one per independent bin, and counts as
    chi-squared of as many degrees of freedom as its mean and its variance give; that of a section over that of the others then
    has Fisher's law.

    Returns
    -------
    list of tuple
        (low [Hz], high [Hz], section, power over the mean power of the other sections).
    """
    length, compared = len(z) // SECTIONS, sections_compared(z)
    n = compared.size
    parts = scipy.signal.detrend(hold_last(z[:, None])[: SECTIONS * length].reshape(SECTIONS, length)[compared], axis=1)
    power = np.abs(rfft(parts * np.hanning(length + 2)[1:-1], axis=1)) ** 2
    half = length // 2
    edges = [FEWEST_BINS << i for i in range(half.bit_length()) if FEWEST_BINS << i <= half - FEWEST_BINS] + [half]
    out = []
    for low, high in pairwise(edges):
        band = power[:, low:high]
        mean = band.mean(axis=0)
        freedom = max(mean.sum() ** 2 / (mean**2).sum() / CORRELATED, 1.0)
        total = band.sum(axis=1)
        others = (total.sum() - total) / (n - 1)
        if not others.min() > 0.0:  # numbers without noise
            continue
        ratio = total / others
        law = 2.0 * freedom, 2.0 * (n - 1) * freedom
        tails = 2.0 * np.minimum(fdtrc(*law, ratio), fdtr(*law, ratio))
        worst = int(np.argmin(tails))
        if tails[worst] < LEVEL / (n * (len(edges) - 1)):
            out.append((low / (length * dt), high / (length * dt), int(compared[worst]), float(ratio[worst])))
    return out


def _residual(result: Identification) -> Iterator[Remark]:
    for mode in result.modes:
        w = mode.whiteness
        share = mode.outlying / result.n_steps
        if mode.outlying:
            text = f"{mode.name}: {mode.outlying} far from what those around them predict ({100.0 * share:.2g} %)"
            yield Remark("outlying samples", "note" if share > OUTLYING else "ok", text)
        left = f", {w.left} candidates that no peak explains" if w.left else ""
        text = f"{mode.name}: residual is {'' if w.white else 'not '}white{left}{''.join(f'; {x}' for x in w.remarks)}"
        yield Remark("identification", "ok" if w.white else "note", text)


def _corrections(reading: Reading, plant: Sequence[GroupPlant]) -> dict[str, str]:
    out = {}
    if len(reading.units) == 1 and "um" not in reading.units:  # of several the user has to choose
        (out["unit"],) = reading.units
    if any(sign_of(group) == -1 for group in plant):
        out["command-sign"] = f"{-reading.sign:+d}"
    delays = [known_numbers(group, "delay") for group in plant]
    known = [n for numbers in delays if numbers is not None and len(numbers) == 1 for n in numbers]
    if known and _is_off(best := min(known, key=lambda n: n.sd or 0.0), reading.delay, "delay"):
        out["command-delay"] = f"{best.value:.3g}"
    gains = [known_numbers(group, "gain") for group in plant]
    each = [n for g, group in zip(gains, plant, strict=True) if g is not None for n in _each(group, g)]
    if each and None not in gains and any(_is_off(n, s, "gain") for n in each for s in reading.gain or (1.0,)):
        text = [f"{abs(n.value or 1.0):.3g}" for n in each]
        out["command-gain"] = text[0] if len(set(text)) == 1 else ",".join(text)
    return out
