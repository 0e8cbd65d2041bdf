"""Preview of an uploaded record or spectrum: rate, unit, gaps and rms, or one line of error.

The bytes may be anything. Nothing is unpickled, no path is opened, and the memory of the contents is known before
it is used.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass

import numpy as np

from wfsobs.record import Record, RecordError, hold_last
from wfsobs.scenario import Scenario
from wfsobs.signal.welch import rms, welch_psd
from wfsobs.telemetry.formats.psd import NoSpectrumError, read_psd
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.records import read_record
from wfsobs.typing import Array

MOST_FILE = 64_000_000
"""Maximum bytes of an uploaded file."""

MOST_NUMBERS = 256_000_000
"""Maximum bytes of numbers in it."""

LONGEST_NAME = 80


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
            lost = int(np.isnan(r.y_ngs[r.ratio :: r.ratio]).any(axis=1).sum())
            ngs = f"{self.rate / r.ratio:.6g} Hz, {lost} frames missing"
        truth = [name for name in ("turbulence", "vibration") if getattr(r, name) is not None]
        return [
            f"{r.n_steps} steps at {self.rate:.6g} Hz, {self.duration:.4g} s, {r.missing} missing",
            f"{r.n_modes} modes, read as um rms" + (f" ({r.origin})" if r.origin else ""),
            f"a command is seen {r.delay} steps later",
            f"NGS: {ngs}",
            f"truth: {' and '.join(truth) or 'none, scored by prediction of the next measurement'}",
        ]


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
    data: bytes, name: str, scenario: Scenario | None = None, declaration: DeclaredFormat | None = None
) -> Preview | SpectrumPreview:
    """Preview the bytes of a record, or of a vibration spectrum. Raises RecordError with one clear line."""
    try:
        return preview(data, name, scenario, declaration)
    except RecordError as error:
        if "has no y_lgs" not in str(error):
            raise
        no_record = error
    shown, diameter = safe_name(name), (scenario or Scenario()).telescope.diameter
    try:
        table = read_psd(io.BytesIO(data), shown, declaration.unit if declaration else None, diameter)
    except NoSpectrumError:
        raise no_record from None
    return SpectrumPreview(table, shown, np.array(table["frequency"]), np.column_stack([table["tip"], table["tilt"]]))


def preview(data: bytes, name: str, scenario: Scenario | None = None, declaration: DeclaredFormat | None = None) -> Preview:
    """Preview the bytes of a record; its name gives the format. Raises RecordError with one clear line."""
    shown = safe_name(name)
    if len(data) > MOST_FILE:
        raise RecordError(f"{shown}: has {len(data) / 1e6:.0f} MB, at most {MOST_FILE / 1e6:.0f} MB are taken")
    record = read_record(io.BytesIO(data), shown, scenario, declaration, MOST_NUMBERS)
    z = record.z
    signals = {"y_lgs": record.y_lgs, "u": record.u, "z": z}
    values = {key: tuple(rms(column[~np.isnan(column)]) for column in signal.T) for key, signal in signals.items()}
    frequency, spectrum = welch_psd(hold_last(z), record.dt)
    return Preview(record, shown, values, frequency, spectrum)


def safe_name(name: str) -> str:
    r"""Return the last part of a file name, with unusual characters replaced.

    >>> safe_name("../../etc/pass\x00wd<b>.csv")
    'pass_wd_b_.csv'
    """
    return re.sub(r"[^\w.+ -]", "_", re.split(r"[/\\]", name)[-1])[-LONGEST_NAME:] or "unnamed"
