"""What a record is, and what of it can be relied on: frames, unit, commands, stationarity, identification.

Nothing is concluded that the data do not decide: a finding is `ok`, `note` (look at it), `undecided` or `excluded` (by the data).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.fft import rfft
from scipy.signal import detrend
from scipy.stats import f as fisher

from wfsobs.identification.identification import identify
from wfsobs.identification.result import Identification
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError, hold_last
from wfsobs.sensors.modes import HIGHEST_ORDER, modes_up_to
from wfsobs.telemetry.preview import PLAUSIBLE, Reading
from wfsobs.typing import Array

SECTIONS = 8
"""Parts of a record whose spectra are compared."""

FEWEST_BINS = 16
"""Minimum bins of a band, and minimum bin of the lowest: below it trends and turbulence fluctuate."""

CORRELATED = 35.0 / 18.0
"""Bins of a Hann window that count as one: the sum of their squared correlations, 1 + 2 (2/3)^2 + 2 (1/6)^2."""

LEVEL = 0.01
"""Probability of a change found anywhere where there is none."""

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
    """

    findings: tuple[Remark, ...]
    identification: Identification | None
    corrections: Mapping[str, str]

    @property
    def is_reliable(self) -> bool:
        """Whether an identification of the record can be relied on, if what the data do not decide is as stated."""
        return self.identification is not None and not any(f.verdict in ("note", "excluded") for f in self.findings)

    @property
    def summary(self) -> str:
        """What `is_reliable` says, as a sentence."""
        if not self.is_reliable:
            return "An identification of it is to be taken with care."
        undecided = [f.subject for f in self.findings if f.verdict == "undecided"]
        but = f"; not decided by the data: {', '.join(undecided)}" if undecided else ""
        return f"An identification of it can be relied on{but}."


def check_record(record: Record, reading: Reading, watch: Watch = QUIET) -> Check:
    """Look at all that has to be right before an identification of a record can be relied on.

    Parameters
    ----------
    record : Record
        Measurements and commands.
    reading : Reading
        What the data say of unit, sign, delay and limits of the commands.
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
    findings = [*_frames(record), *_unit(record, reading), *_commands(record, reading), *_stationarity(record)]
    result = None
    try:
        result = identify(record, watch=watch)
    except RecordError as error:
        findings.append(Remark("identification", "excluded", str(error)))
    else:
        findings += _residual(result)
    return Check(tuple(findings), result, _corrections(record, reading))


def _frames(record: Record) -> Iterator[Remark]:
    n = record.n_steps
    share = record.missing / n
    text = f"{n} at {1.0 / record.dt:.6g} Hz, {n * record.dt:.4g} s; {record.missing} missing ({100.0 * share:.2g} %)"
    yield Remark("frames", "note" if share > OUTLYING else "ok", text)
    if record.origin:
        yield Remark("read as", "ok", record.origin)


def _unit(record: Record, reading: Reading) -> Iterator[Remark]:
    size, (least, most) = float(np.sqrt(np.nanmean(record.z[record.delay :] ** 2, axis=0).max())), PLAUSIBLE
    if not least <= size <= most:
        usual = f"turbulence and vibration have {1e3 * least:g} to {1e3 * most:g} nm: check the unit"
        yield Remark("unit", "note", f"z has {1e3 * size:.3g} nm rms, where {usual}")
    elif reading.units:
        ways = " or ".join(f"{unit} ({1e3 * rms:.3g} nm rms of z)" for unit, rms in reading.units.items())
        verdict = "ok" if set(reading.units) == {"um"} else "undecided"
        yield Remark("unit", verdict, f"not in the file, taken for um; plausible are {ways}")


def _commands(record: Record, reading: Reading) -> Iterator[Remark]:
    response = reading.response
    if not record.u.any():
        yield Remark("commands", "ok", "none: the mirror is at rest")
    elif response is None:
        yield Remark("command sign and delay", "undecided", "not identifiable: too few steps, or commands that do not move")
    else:
        looked_at = (("sign", response.sign, reading.sign), ("delay", response.delay, record.delay))
        for (subject, found, stated), text in zip(looked_at, response.lines(), strict=False):
            other = f"; {stated} is stated" if found not in (None, stated) else ""
            verdict = "undecided" if found is None else "note" if other else "ok"
            yield Remark(f"command {subject}", verdict, text.removeprefix(f"{subject} ").removeprefix("undecided: ") + other)
    if reading.contradiction:
        yield Remark("commands", "excluded", reading.contradiction)
    for line in reading.limits:
        yield Remark("mirror", "note", line)


def _stationarity(record: Record) -> Iterator[Remark]:
    names = [mode.name for mode in modes_up_to(HIGHEST_ORDER)]
    z = hold_last(record.z[record.delay :])
    length = len(z) // SECTIONS
    if length < 8 * FEWEST_BINS:
        yield Remark("stationarity", "undecided", f"{record.n_steps} frames are too few to compare {SECTIONS} sections")
        return
    changes = [(name, *change) for name, column in zip(names, z.T, strict=False) for change in find_changes(column, record.dt)]
    for name, low, high, section, ratio in changes:
        start, end = section * length * record.dt, (section + 1) * length * record.dt
        where = f"{name}, {low:.3g} to {high:.3g} Hz: from {start:.3g} to {end:.3g} s {ratio:.2g} times the power of the rest"
        yield Remark("stationarity", "note", where)
    if not changes:
        yield Remark("stationarity", "ok", f"the spectra of {SECTIONS} sections differ no more than those of one process")


def find_changes(z: Array, dt: float) -> list[tuple[float, float, int, float]]:
    """Return the bands of z (n,) whose power in a section differs from that of the others, the least likely section of each.

    The power of a band is a sum of exponential variates, one per independent bin, and counts as chi-squared of as many degrees of
    freedom as its mean and its variance give; that of a section over that of the others then has Fisher's law.

    Returns
    -------
    list of tuple
        (low [Hz], high [Hz], section, power over the mean power of the other sections).
    """
    length = len(z) // SECTIONS
    parts = detrend(z[: SECTIONS * length].reshape(SECTIONS, length), axis=1)
    power = np.abs(rfft(parts * np.hanning(length + 2)[1:-1], axis=1)) ** 2
    half = length // 2
    edges = [FEWEST_BINS << i for i in range(half.bit_length()) if FEWEST_BINS << i <= half - FEWEST_BINS] + [half]
    out = []
    for low, high in pairwise(edges):
        band = power[:, low:high]
        mean = band.mean(axis=0)
        freedom = max(mean.sum() ** 2 / (mean**2).sum() / CORRELATED, 1.0)
        total = band.sum(axis=1)
        ratio = total / np.maximum((total.sum() - total) / (SECTIONS - 1), 1e-300)
        law = fisher(2.0 * freedom, 2.0 * (SECTIONS - 1) * freedom)
        tails = 2.0 * np.minimum(law.sf(ratio), law.cdf(ratio))
        worst = int(np.argmin(tails))
        if tails[worst] < LEVEL / (SECTIONS * (len(edges) - 1)):
            out.append((low / (length * dt), high / (length * dt), worst, float(ratio[worst])))
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


def _corrections(record: Record, reading: Reading) -> dict[str, str]:
    response, out = reading.response, {}
    if reading.units and set(reading.units) != {"um"}:
        out["unit"] = "|".join(reading.units)
    if reading.contradiction and response is not None:
        if response.sign == -1:
            out["command-sign"] = f"{-reading.sign:+d}"
        if response.delay is not None and response.delay != record.delay:
            out["command-delay"] = str(response.delay)
    return out
