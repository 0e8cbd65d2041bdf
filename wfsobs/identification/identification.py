"""Identification of a record: noise, turbulence, then peaks one at a time until the residual is white.

What is found goes on as a dictionary, rows and lines of text, a TOML file of settings, and spectra to draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, isnan, sqrt
from typing import Any

import numpy as np
from scipy.special import chdtrc, gammainccinv

from wfsobs.identification.one_mode import OneMode
from wfsobs.identification.process import IdentifiedProcess, Number
from wfsobs.identification.process import format_number as format_number
from wfsobs.identification.result import (
    NO_NOISE,
    WHITE_LEVEL,
    Identification,
    IdentifiedMode,
    Whiteness,
    autocorrelation_test,
    cumulated_test,
    innovations,
    read_difference,
    read_mode,
    seen_z,
    sensor_differences,
)
from wfsobs.identification.result import mode_rows as mode_rows
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import add_comments, to_toml
from wfsobs.sensors.zernike import MODE_NAMES
from wfsobs.settings.values import SettingError, check_kind
from wfsobs.signal.autoregressive import Ar3
from wfsobs.signal.gains import RiccatiError
from wfsobs.spectral.search import LOWEST, PAD, Candidate, SearchResult, search_peaks
from wfsobs.spectral.whittle import fast_length, find_outlying, periodogram, periodogram_frequencies, taper
from wfsobs.typing import Array

PARTS = 10
"""Parts of a record whose innovations should have the same variance."""
REMARK_LEVEL = 1e-3
"""Probability that noise would be called not stationary."""
BANDS = (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, np.inf)
"""Edges of the bands in which the spectrum is compared [Hz]."""
LAGS = 100
"""Maximum lag of a correlation."""
CLEAR, MATTERS = 4.0, 0.05
"""Minimum standard deviations of a mean over a band, and minimum difference from one, of a remark."""


def _bands(f: Array, ratio: Array) -> list[str]:
    """Return the bands [Hz] in which I / S, (bins,), is not one on average."""
    out = []
    for low, high in pairwise(BANDS):
        inside = ratio[(f >= low) & (f < high)]
        if not len(inside):
            continue
        mean = float(inside.mean())
        if abs(mean - 1.0) > max(CLEAR / np.sqrt(len(inside)), MATTERS):
            upper = f"{min(high, f[-1]):.3g} Hz"
            out.append(f"from {low:g} to {upper} the record has {mean:.2g} times what the model has")
    return out


def _memory(e: Array, dt: float) -> list[str]:
    """Return the lag of the largest correlation, if noise has none as large."""
    e = e - e.mean()
    rho = np.array([e[lag:] @ e[:-lag] for lag in range(1, LAGS + 1)]) / (e @ e)
    lag = int(np.argmax(np.abs(rho)))
    if abs(rho[lag]) * np.sqrt(len(e)) < CLEAR:
        return []
    return [f"what is left correlates most with itself {1e3 * (lag + 1) * dt:.3g} ms before, {rho[lag]:+.3f}"]


def in_time(e: Array, dt: float) -> list[str]:
    """Check innovations for changes of their variance, which no test of whiteness sees."""
    parts = np.array([np.var(part) for part in np.array_split(e, PARTS)])
    statistic = 0.5 * len(e) / PARTS * np.sum((parts / parts.mean() - 1.0) ** 2)
    if chdtrc(PARTS - 1, statistic) >= REMARK_LEVEL:
        return []
    low, high = np.sqrt(np.array([parts.min(), parts.max()]) / parts.mean())
    return [f"it is not stationary: over tenths of the record the rms of the noise is {low:.2f} to {high:.2f} of its mean"]


LEVEL = 0.05
"""Probability of any false peak in a record."""
HIGHEST_LEVEL = 0.5
"""Maximum of that probability."""
EVERY_SWEEP, SELDOM = 8, 4
"""All parameters are fitted anew after every peak; with many peaks, only after several: each has been fitted alone."""
MOST_PEAKS = 40
"""Maximum number of peaks per mode."""
SHORTEST = 1000
"""Minimum samples of a record."""
ALONE = 0.8
"""Share of the level for single modes, where there are several: a line in one of them is weaker than one in all."""
LEAST = 0.5
"""Minimum share of measured samples."""
RESTING = 1e-9
"""Rms over maximum of a measurement that is constant but for rounding errors."""
JOINT = 1e-3
"""A candidate of all modes together belongs to those in which white noise would be as high with this probability."""


def identify(record: Record, *, level: float = LEVEL, lowest: float = LOWEST, watch: Watch = QUIET) -> Identification:
    """Identify the model of every mode of a record, from its pseudo-open-loop measurement z.

    White noise, turbulence and vibration peaks, each number with its standard deviation; missing samples are accounted for.
    Samples far from what those around them predict are counted, and then missing.
    With enough NGS frames the noise of the NGS and the slow error of the LGS as well.

    Parameters
    ----------
    record : Record
        Measurements and commands.
    level : float
        Probability of finding any peak where there is none, above 0 and up to HIGHEST_LEVEL.
    lowest : float
        Minimum frequency of a peak [Hz], above 0.
    watch : Watch, optional
        Receives the progress, and is asked at every block of work whether to stop.

    Returns
    -------
    Identification
        One model per mode.

    Raises
    ------
    SettingError
        There is no such level or frequency, or `record` is none.
    RecordError
        The record is too short, has too few samples or is constant.
    Cancelled
        `watch` asks to stop.

    See Also
    --------
    wfsobs.observe : Run observers on a record.
    """
    check_kind("identify", record, Record)
    for name, value, most in (("level", level, HIGHEST_LEVEL), ("lowest", lowest, inf)):
        if not 0.0 < value <= most:
            raise SettingError(f"{name} = {value:g}: takes a number above 0{f' and up to {most:g}' if most < inf else ''}")
    z = seen_z(record)
    z = z[: fast_length(len(z))]
    if len(z) < SHORTEST:
        raise RecordError(f"the record has {record.n_steps} samples, identification needs {SHORTEST + record.delay} or more")
    if not lowest < 0.25 / record.dt:
        raise RecordError(f"lowest peak frequency = {lowest:g} Hz: must be below a quarter of the rate, {0.25 / record.dt:g} Hz")
    if record.n_modes > len(MODE_NAMES):
        raise RecordError(f"the record has {record.n_modes} modes, at most {len(MODE_NAMES)} can be identified")
    for name, column in zip(MODE_NAMES, z.T, strict=False):
        if (count := np.count_nonzero(np.isfinite(column))) < max(SHORTEST, LEAST * len(z)):
            raise RecordError(
                f"{name}: {count} of {len(z)} samples are measured, identification needs {SHORTEST}, and {100.0 * LEAST:.0f} %"
            )
        if not np.nanstd(column) > RESTING * np.nanmax(np.abs(column)):
            raise RecordError(f"{name}: z is constant, there is nothing to identify")
    outlying = np.column_stack([find_outlying(column) for column in z.T])
    z = np.where(outlying, np.nan, z)
    modes = []
    for column in z.T:
        watch.check()
        modes.append(OneMode(column, record.dt, lowest))
    add_peaks(modes, level, watch)
    left = count_unexplained(modes, level)
    tests = map(check_whiteness, modes, left)
    found = (read_mode(name, mode, test) for name, mode, test in zip(MODE_NAMES, modes, tests, strict=False))
    found = tuple(replace(mode, outlying=int(count)) for mode, count in zip(found, outlying.sum(axis=0), strict=True))
    y_lgs = record.y_lgs.copy()
    y_lgs[record.delay :][: len(z)][outlying] = np.nan
    if (differences := sensor_differences(replace(record, y_lgs=y_lgs))) is not None and record.ratio is not None:
        if (np.nanmax(np.abs(differences), axis=0) <= NO_NOISE * np.nanstd(z, axis=0)).any():
            raise RecordError("y_ngs has no noise of its own beside y_lgs")
        found = tuple(
            replace(mode, difference=read_difference(column, record.dt, record.ratio, mode.noise))
            for mode, column in zip(found, differences.T, strict=True)
        )
    watch.step(1.0)
    return Identification(found, record.dt, len(z), level)


def add_peaks(modes: Sequence[OneMode], level: float, watch: Watch) -> None:
    """Add peaks to the modes, one to each at a time, until no test finds more; then polish, and search once more."""
    for again in (False, True):  # the first spectra are rough: they say what not to fit, not what is a peak
        find_candidates(modes, level)
        for mode in modes:
            mode.refit(reshape=again)
    polished = False
    for sweep in range(3 * MOST_PEAKS):
        watch.step(1.0 - 1.0 / (1.0 + 0.1 * sweep))
        seen = False
        for mode, best in zip(modes, find_candidates(modes, level), strict=True):
            if best is None or mode.peaks >= MOST_PEAKS:
                continue
            seen = True
            if mode.explain(best) and (sweep < EVERY_SWEEP or sweep % SELDOM == 0):
                mode.refit()
        if not seen:
            if polished and not sum(mode.prune() for mode in modes):
                return
            third = any(isinstance(mode.spectrum.turbulence, Ar3) for mode in modes)
            for mode in modes:
                mode.polish(third)
        polished = not seen


def find_candidates(modes: Sequence[OneMode], level: float) -> list[Candidate | None]:
    """Return the strongest candidate of every mode, if any; bins that would spoil the next fit are excluded from it."""
    out = []
    for mode, found in zip(modes, search_modes(modes, level), strict=True):
        mode.strong = np.logical_or.reduce([one.strong for one in found])
        out.append(max((one.best for one in found if one.best), key=lambda c: c.strength, default=None))
    return out


def search_modes(modes: Sequence[OneMode], level: float) -> list[list[SearchResult]]:
    """Return the search results of every mode, alone and with all the others."""
    whitened = [mode.whiten() for mode in modes]
    n, dt, lowest = modes[0].n, modes[0].dt, modes[0].lowest
    alone = ALONE * level if len(modes) > 1 else level
    out = [[search_peaks(fine, n, dt, 1, alone / len(modes), lowest)] for fine in whitened]
    if len(modes) > 1:
        together = search_peaks(sum(whitened, np.zeros_like(whitened[0])), n, dt, len(modes), level - alone, lowest)
        for own, fine in zip(out, whitened, strict=True):
            if together.best is not None and _has_part(fine, n * dt, together.best.frequency, together.best.width):
                own.append(together)
    return out


def _has_part(fine: Array, T: float, frequency: float, width: int) -> bool:
    """Return whether a mode is high itself where all of them together are."""
    if width == 1:
        return bool(fine[max(round(frequency * PAD * T) - 1, 0)] > -np.log(JOINT))
    centre = round(frequency * T)
    bins = fine[PAD - 1 :: PAD][max(centre - width // 2 - 1, 0) : centre + width // 2]
    return bool(bins.sum() > gammainccinv(width, JOINT))


def count_unexplained(modes: Sequence[OneMode], level: float) -> list[int]:
    """Return per mode the number of refused candidates that the search still finds."""
    refused = [mode.rejections for mode in modes]
    for mode in modes:
        mode.rejections = []
    out = []
    for mode, were, found in zip(modes, refused, search_modes(modes, level), strict=True):
        flagged = mode.f[np.logical_or.reduce([one.above_limit for one in found])]
        out.append(sum(bool(np.any(np.abs(flagged - c.frequency) <= (c.width + 1) * mode.f[0])) for c in were))
        mode.rejections = were
    return out


def check_whiteness(mode: OneMode, left: int) -> Whiteness:
    """Test the residual of a mode's model; left : candidates that no peak explains."""
    ratio = periodogram(mode.complete, mode.dt) / mode.spectrum.psd(mode.f)
    cumulated = cumulated_test(ratio, mode.n)
    try:
        e = innovations(mode.complete, mode.spectrum)
    except RiccatiError as error:  # of what is no noise at all
        return Whiteness(cumulated, 0.0, left, (str(error),))
    result, found = Whiteness(cumulated, autocorrelation_test(e, mode.spectrum.starts[-1]), left), in_time(e, mode.dt)
    if not result.white:
        found = [*_bands(mode.f, ratio), *found, *_memory(e, mode.dt)]
        found = found or ["no band, lag or time stands out: it is a little of everything"]
    return replace(result, remarks=tuple(found))


def identification_dict(result: Identification) -> dict[str, Any]:
    """Return the output of `wfsobs identify --json`.

    Every number has its standard deviation as `_std`, null where there is none; rms in um, frequencies in Hz. The rms of a
    peak is that within the record, `ensemble_rms` that of the process, which filters receive.
    """

    def numbers(**values: Number) -> dict[str, float | None]:
        std = {f"{name}_std": None if isnan(n.std) else n.std for name, n in values.items()}
        return {key: (n.value if key == name else std[key]) for name, n in values.items() for key in (name, f"{name}_std")}

    def of(p: IdentifiedProcess) -> dict[str, float | None]:
        return numbers(**{name: n for name, n in vars(p).items() if n is not None})

    return {
        "duration": result.duration,
        "level": result.level,
        "white": result.white,
        "modes": [
            {
                "mode": m.name,
                **numbers(noise=m.noise),
                "outlying": m.outlying,
                "turbulence": None if m.turbulence is None else of(m.turbulence),
                "background": None if m.background is None else of(m.background),
                "ngs_noise": None if m.difference is None else numbers(rms=m.difference.noise),
                "lgs_error": None if m.difference is None or m.difference.error is None else of(m.difference.error),
                "broad": [of(p) for p in m.broad],
                "peaks": [{**of(p), "pure": p.pure} for p in m.peaks],
                "whiteness": {
                    "cumulated_p": m.whiteness.periodogram,
                    "innovations_p": m.whiteness.innovations,
                    "unexplained": m.whiteness.left,
                    "white": m.whiteness.white,
                    "remarks": list(m.whiteness.remarks),
                },
            }
            for m in result.modes
        ],
    }


def whiteness_lines(result: Identification) -> list[str]:
    """Return one line per mode on the residual."""
    out = []
    for m in result.modes:
        w = m.whiteness
        tests = f"cumulative spectrum p = {w.periodogram:.2g}, innovations p = {w.innovations:.2g}"
        rest = f"; {w.left} candidates that no peak explains" if w.left else ""
        outlying = {"samples": m.outlying, "NGS frames": m.difference.outlying if m.difference else 0}
        rest += "".join(f"; outlying {what} taken for missing: {count}" for what, count in outlying.items() if count)
        why = "".join(f"; {remark}" for remark in w.remarks)
        form = "white" if w.white else "NOT white"
        out.append(f"{m.name}: residual is {form} at {100.0 * WHITE_LEVEL:.0f} % ({tests}{rest}){why}")
    return out


def identification_toml(result: Identification, scenario: Scenario) -> str:
    """Return the scenario of the result as TOML, with a standard deviation beside every identified number."""
    count = sqrt(scenario.sensors.lgs_count)
    notes = {path: f"+- {_std(number.std)}" for path, number in result.shared_settings(scenario).items()}
    notes["sensors.lgs_noise_per_mode"] = "+- " + ", ".join(_std(count * m.noise.std) for m in result.modes)
    smooth = [(m.name, what, p) for m in result.modes for what, p in _smooth(m)]
    for i, (mode, what, p) in enumerate(smooth):
        notes |= _notes(f"turbulence.processes.{i}", p, f"{mode}, {what}, ")
    for i, (mode, p) in enumerate(result.all_peaks):
        notes |= _notes(f"vibration.peaks.{i}", p, f"{mode}, ")
    head = [f"Identified from {result.duration:.1f} s; +- is one standard deviation.", *whiteness_lines(result)]
    return "\n".join(f"# {line}" for line in head) + "\n\n" + add_comments(to_toml(scenario), notes)


def _smooth(mode: IdentifiedMode) -> list[tuple[str, IdentifiedProcess]]:
    """Return the processes of a mode in `turbulence.processes`, in its order."""
    named = [("turbulence", mode.turbulence), ("background", mode.background), *(("broad", p) for p in mode.broad)]
    return [(what, p) for what, p in named if p is not None]


def _std(std: float) -> str:
    return "-" if isnan(std) else f"{std:.2g}"


def _notes(path: str, p: IdentifiedProcess, whose: str) -> dict[str, str]:
    """Return comments on the settings of one process or peak."""
    numbers = {"frequency": p.frequency, "damping": p.damping, "rms": p.ensemble_rms or p.rms, "third_corner": p.third_corner}
    notes = {f"{path}.{name}": f"+- {_std(n.std)}" for name, n in numbers.items() if n is not None and n.std}
    if p.pure:
        notes[f"{path}.damping"] = "a pure line"
    return notes | {f"{path}.frequency": f"{whose}+- {_std(p.frequency.std)}"}


BINS = 900
"""Of the measured spectrum over the whole axis, all equally wide on it."""

FEWEST = 100
"""Samples that a spectrum takes."""


@dataclass(frozen=True)
class Fit:
    """The model of one mode on a grid of frequencies [Hz] that has every resonance in it: densities [um^2/Hz].

    parts : noise, turbulence and background where there are any, and the resonances, each by itself
    lines : per pure line, frequency, density under it, and how high the periodogram stands at it
    """

    frequency: Array
    total: Array
    parts: tuple[Array, ...]
    lines: tuple[tuple[float, float, float], ...]


def bin_periodogram(z: Array, dt: float) -> tuple[Array, Array, Array]:
    """Estimate the spectrum of measurements, with the taper that the identification uses, in bins of a logarithmic axis.

    Parameters
    ----------
    z : Array
        Measurements without gaps, (n_steps, n_modes) [um].
    dt : float
        Time step [s].

    Returns
    -------
    frequency : Array
        Of the bins, (bins,) [Hz].
    mean, highest : Array
        Of the periodogram in each, (bins, n_modes) [um^2/Hz].

    Raises
    ------
    RecordError
        There are too few samples.
    """
    z = z[: fast_length(len(z))]
    if len(z) < FEWEST:
        raise RecordError(f"the record has {len(z)} samples, too few for a spectrum")
    f = periodogram_frequencies(len(z), dt)
    start = np.flatnonzero(np.diff(np.floor(np.log(f / f[0]) / np.log(f[-1] / f[0]) * BINS), prepend=-1.0))
    count = np.diff(start, append=len(f))
    density = np.column_stack([periodogram(column - column.mean(), dt) for column in z.T])
    return (
        np.add.reduceat(f, start) / count,
        np.add.reduceat(density, start) / count[:, None],
        np.maximum.reduceat(density, start),
    )


def fitted_spectrum(mode: IdentifiedMode, result: Identification) -> Fit:
    """Compute the spectrum of the model identified in a mode."""
    s, T = mode.spectrum, result.duration
    centres = [(p.frequency, p.damping) for p in s.processes]
    near = [c * (1.0 + max(damping, 1e-5) * np.linspace(-8.0, 8.0, 65)) for c, damping in centres]
    f = np.unique(np.concatenate([np.geomspace(1.0 / T, 0.5 / result.dt, 600), *near]))
    f = f[(f >= 1.0 / T) & (f <= 0.5 / result.dt)]
    parts = (np.full_like(f, 2.0 * s.dt * s.noise**2), *(p.psd(f) for p in s.processes))
    gain = T * float(np.mean(taper(result.n_steps))) ** 2
    lines = []
    for peak in (p for p in mode.peaks if p.pure):
        floor = float(s.psd(np.array([peak.frequency.value]))[0])
        lines.append((peak.frequency.value, floor, floor + gain * peak.rms.value**2))
    return Fit(f, s.psd(f), parts, tuple(lines))
