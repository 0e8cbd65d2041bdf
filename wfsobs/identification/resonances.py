"""Resonances of a spectrum: where one is tried, how it is fitted, whether it is resolved, and when it is two."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np

from wfsobs.signal.ar2 import Ar2
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.periodogram import Cells
from wfsobs.spectral.search import Candidate
from wfsobs.spectral.whittle import fit_spectrum, spectrum_negative_log_likelihood
from wfsobs.typing import Array

NEIGHBOURS = 4.0
"""Bins, beside half its width, within which a candidate is not a new peak: two peaks that near are one."""
WIDEST = 0.5
"""Maximum damping of a resonance."""
SPLIT = 8.0
"""Minimum gain of log-likelihood by two resonances in place of one, which is tried for every wide one."""


def reach_of(candidate: Candidate, bin_width: float) -> float:
    """Return the distance [Hz] within which a peak is the candidate."""
    return (NEIGHBOURS + candidate.width / 2.0) * bin_width


def window_about(candidate: Candidate, f: Array) -> Array:
    """Return the bins over which explanations of a candidate are compared, bool (len(f),)."""
    half = max(3.0 * reach_of(candidate, f[0]), 0.03 * candidate.frequency)
    return np.abs(f - candidate.frequency) < half


def misfit_of(spectrum: Spectrum, f: Array, I: Array) -> float:  # noqa: E741
    """Return - log L of a periodogram (len(f),) [um^2/Hz], without a constant."""
    S = spectrum.psd(f)
    return float(np.sum(np.log(S) + I / S))


def strongest_bin(candidate: Candidate, f: Array, ratio: Array) -> float:
    """Return the frequency [Hz] within a candidate at which the ratio of periodogram and spectrum is largest."""
    if candidate.width == 1:
        return candidate.frequency
    near = np.abs(f - candidate.frequency) <= candidate.width / 2.0 * f[0]
    return float(f[near][np.argmax(ratio[near])])


def is_peak(p: Ar2, bin_width: float) -> bool:
    """Return whether a resonance is narrower than turbulence, not slower than the record, and below half the rate."""
    return p.damping < WIDEST and 2.0 * bin_width < p.omega / (2 * pi) < 0.5 / p.dt - bin_width


def add_resonance(spectrum: Spectrum, f: Array, I: Array, candidate: Candidate) -> Spectrum:  # noqa: E741
    """Return the spectrum with a resonance of the candidate's width, it alone fitted to the bins about it."""
    f0, half = candidate.frequency, 0.5 * candidate.width * f[0]
    near = np.abs(f - f0) <= max(half, f[0])
    excess = np.maximum(I[near] - spectrum.psd(f[near]), 0.0)
    power, f0 = float(excess.sum() * f[0]), float(excess @ f[near] / excess.sum()) if excess.any() else f0
    keep = np.where(window_about(candidate, f), 1.0, 0.0)
    best: tuple[float, Spectrum] | None = None
    for share in (0.15, 0.5):
        damping = min(max(share * half / f0, 1e-6), 0.5)
        new = Ar2(2.0 * pi * f0, damping, np.sqrt(max(power, 1e-16)), spectrum.dt)
        wider = replace(spectrum, resonances=(*spectrum.resonances, new))
        cells = Cells(f, I, keep, [p.omega / (2 * pi) for p in wider.resonances])
        count = len(wider.vector)
        shape = fit_spectrum(wider, cells, range(count - 3, count))
        value = spectrum_negative_log_likelihood(shape, cells)
        if best is None or value < best[0]:
            best = value, shape
    assert best is not None
    return best[1]


def split_resonance(spectrum: Spectrum, f: Array, I: Array, p: Ar2) -> Spectrum | None:  # noqa: E741
    """Return the spectrum with two resonances in place of one; None where it is narrow or they are not worth it.

    Neighbours look like one resonance of several bins.
    """
    f0 = p.omega / (2 * pi)
    half = p.damping * f0
    if half < 2.0 * NEIGHBOURS * f[0]:
        return None
    two = [Ar2(2 * pi * (f0 + sign * 0.7 * half), 0.4 * p.damping, p.rms / np.sqrt(2.0), spectrum.dt) for sign in (-1, 1)]
    start = replace(spectrum, resonances=(*spectrum.without(p).resonances, *two))
    keep = np.where(window_about(Candidate(f0, int(4.0 * half / f[0]), 0.0), f), 1.0, 0.0)
    cells = Cells(f, I, keep, [q.omega / (2 * pi) for q in (*start.resonances, p)])
    count = len(start.vector)
    shape = fit_spectrum(start, cells, range(count - 6, count))
    gain = spectrum_negative_log_likelihood(spectrum, cells) - spectrum_negative_log_likelihood(shape, cells)
    return shape if gain > SPLIT and all(is_peak(q, f[0]) for q in shape.resonances[-2:]) else None
