"""Identification of a record: noise, turbulence, then peaks one at a time until the residual is white."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.stats import chi2, gamma

from wfsobs.identification.one_mode import OneMode
from wfsobs.identification.result import (
    Identification,
    Whiteness,
    autocorrelation_test,
    cumulated_test,
    innovations,
    read_difference,
    read_mode,
    seen_z,
    sensor_differences,
)
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError
from wfsobs.sensors.modes import MODE_NAMES
from wfsobs.signal.ar3 import Ar3
from wfsobs.signal.riccati import RiccatiError
from wfsobs.spectral.missing import find_outlying
from wfsobs.spectral.periodogram import fast_length, periodogram
from wfsobs.spectral.search import LOWEST, PAD, Candidate, SearchResult, search_peaks
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


def remarks(f: Array, ratio: Array, e: Array, dt: float) -> tuple[str, ...]:
    """Return remarks on a residual that is not white, one clause each.

    f, ratio (bins,) : frequencies [Hz] and I / S; e (n,) : innovations of the Kalman filter of S, every dt [s]
    """
    found = [*_bands(f, ratio), *in_time(e, dt), *_memory(e, dt)]
    return tuple(found or ["no band, lag or time stands out: it is a little of everything"])


def _bands(f: Array, ratio: Array) -> list[str]:
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
    if chi2.sf(statistic, PARTS - 1) >= REMARK_LEVEL:
        return []
    low, high = np.sqrt(np.array([parts.min(), parts.max()]) / parts.mean())
    return [f"it is not stationary: over tenths of the record the rms of the noise is {low:.2f} to {high:.2f} of its mean"]


LEVEL = 0.05
"""Probability of any false peak in a record."""
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
        Probability of finding any peak where there is none.
    lowest : float
        Minimum frequency of a peak [Hz].
    watch : Watch, optional
        Receives the progress, and is asked at every block of work whether to stop.

    Returns
    -------
    Identification
        One model per mode.

    Raises
    ------
    RecordError
        The record is too short, has too few samples or is constant.
    Cancelled
        `watch` asks to stop.

    See Also
    --------
    wfsobs.observe : Run observers on a record.
    """
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
                f"{name}: {count} of {len(z)} samples are measured, identification needs {SHORTEST}, and {LEAST:.0%}"
            )
        if not np.nanstd(column) > RESTING * np.nanmax(np.abs(column)):
            raise RecordError(f"{name}: z is constant, there is nothing to identify")
    outlying = np.column_stack([find_outlying(column) for column in z.T])
    z = np.where(outlying, np.nan, z)
    modes = []
    for column in z.T:
        watch.check()
        modes.append(OneMode(column, record.dt, lowest))
    add_peaks(modes, level, lowest, watch)
    left = count_unexplained(modes, level, lowest)
    tests = map(check_whiteness, modes, left)
    found = (read_mode(name, mode, lowest, test) for name, mode, test in zip(MODE_NAMES, modes, tests, strict=False))
    found = tuple(replace(mode, outlying=int(count)) for mode, count in zip(found, outlying.sum(axis=0), strict=True))
    y_lgs = record.y_lgs.copy()
    y_lgs[record.delay :][: len(z)][outlying] = np.nan
    if (differences := sensor_differences(replace(record, y_lgs=y_lgs))) is not None and record.ratio is not None:
        found = tuple(
            replace(mode, difference=read_difference(column, record.dt, record.ratio, mode.noise))
            for mode, column in zip(found, differences.T, strict=True)
        )
    watch.step(1.0)
    return Identification(found, record.dt, len(z), level)


def add_peaks(modes: Sequence[OneMode], level: float, lowest: float, watch: Watch) -> None:
    """Add peaks to the modes, one to each at a time, until no test finds more; then polish, and search once more."""
    for again in (False, True):  # the first spectra are rough: they say what not to fit, not what is a peak
        find_candidates(modes, level, lowest)
        for mode in modes:
            mode.refit(reshape=again)
    polished = False
    for sweep in range(3 * MOST_PEAKS):
        watch.step(1.0 - 1.0 / (1.0 + 0.1 * sweep))
        seen = False
        for mode, best in zip(modes, find_candidates(modes, level, lowest), strict=True):
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


def find_candidates(modes: Sequence[OneMode], level: float, lowest: float) -> list[Candidate | None]:
    """Return the strongest candidate of every mode, if any; bins that would spoil the next fit are excluded from it."""
    out = []
    for mode, found in zip(modes, search_modes(modes, level, lowest), strict=True):
        mode.strong = np.logical_or.reduce([one.strong for one in found])
        out.append(max((one.best for one in found if one.best), key=lambda c: c.strength, default=None))
    return out


def search_modes(modes: Sequence[OneMode], level: float, lowest: float) -> list[list[SearchResult]]:
    """Return the search results of every mode, alone and with all the others."""
    whitened = [mode.whiten() for mode in modes]
    n, dt, several = modes[0].n, modes[0].dt, len(modes) > 1
    alone = ALONE * level if several else level
    out = [[search_peaks(fine, n, dt, 1, alone / len(modes), lowest)] for fine in whitened]
    if several:
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
    return bool(bins.sum() > gamma.isf(JOINT, width))


def count_unexplained(modes: Sequence[OneMode], level: float, lowest: float) -> list[int]:
    """Return per mode the number of refused candidates that the search still finds."""
    refused = [mode.rejections for mode in modes]
    for mode in modes:
        mode.rejections = []
    out = []
    for mode, were, found in zip(modes, refused, search_modes(modes, level, lowest), strict=True):
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
    result = Whiteness(cumulated, autocorrelation_test(e, len(mode.spectrum.vector)), left)
    return replace(result, remarks=tuple(in_time(e, mode.dt)) if result.white else remarks(mode.f, ratio, e, mode.dt))
