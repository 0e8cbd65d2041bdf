"""Identification with lost frames: what is filled, what every bin loses, and intervals that hold."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from scipy.linalg import circulant
from scipy.stats import binom, norm

from wfsobs.identification import identify
from wfsobs.identification.identification import whiteness_lines
from wfsobs.record import Record, RecordError
from wfsobs.signal.autoregressive import Ar2
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.whittle import (
    FAR,
    LEAST,
    MOST_OUTLYING,
    Cells,
    MissingSamples,
    find_outlying,
    periodogram_frequencies,
    spectrum_information,
)
from wfsobs.typing import Array

pytestmark = pytest.mark.slow

DT = 1e-3
N = 600
PROCESSES = Ar2(30.0, 0.9, 0.05, DT), Ar2(2 * pi * 120.0, 0.02, 0.01, DT)
MODEL = Spectrum(0.014, DT, PROCESSES[0], PROCESSES[1:])
"""Of few samples: turbulence and a resonance that are not narrower than a bin."""


def gaps(share: float, n: int = N, seed: int = 1) -> Array:
    return np.random.default_rng(seed).random(n) < share


def bursts(share: float, n: int = N, seed: int = 1, length: int = 15) -> Array:
    rng, gone = np.random.default_rng(seed), np.zeros(n, bool)
    while gone.mean() < share:
        at = rng.integers(0, n - length)
        gone[at : at + length] = True
    return gone


def covariance(spectrum: Spectrum, n: int = N) -> Array:
    """Of n samples, circulant: what `MissingSamples` takes for the record's."""
    S = spectrum.psd(periodogram_frequencies(n, DT))
    return circulant(np.fft.irfft(np.concatenate([S[:1], S, S[-1:]]), n) / (2.0 * DT))


def precision(spectrum: Spectrum, gone: Array) -> Array:
    """Inverse covariance of what is measured, zero where nothing is, (n, n)."""
    out, seen = np.zeros((len(gone), len(gone))), np.ix_(~gone, ~gone)
    out[seen] = np.linalg.inv(covariance(spectrum, len(gone))[seen])
    return out


def record(gone: float, rng: np.random.Generator, n: int) -> Record:
    z = 0.014 * rng.standard_normal(n) + sum(p.sample(n, rng) for p in PROCESSES)
    z[rng.random(n) < gone] = np.nan
    return Record(z[:, None], np.zeros((n, 1)), DT)


@pytest.mark.parametrize("gone", [gaps(0.3), bursts(0.3)], ids=["single", "bursts"])
def test_gaps_are_filled_with_the_conditional_mean(gone: Array) -> None:
    """C_mo C_oo^-1 z_o by dense algebra; conjugate gradients stop at 1e-4 of the noise, times the root of a condition number of
    a few hundred."""
    z = np.random.default_rng(2).multivariate_normal(np.zeros(N), covariance(MODEL))
    exact = covariance(MODEL) @ precision(MODEL, gone) @ np.where(gone, 0.0, z)
    lost = np.where(gone, np.nan, z)
    filled = MissingSamples(gone, DT, np.random.default_rng(3)).fill(lost, MODEL.psd(periodogram_frequencies(N, DT)))
    assert np.array_equal(filled[~gone], z[~gone])
    assert np.max(np.abs(filled - exact)[gone]) < 0.02 * MODEL.noise


@pytest.mark.parametrize(
    "gone", [gaps(0.1), gaps(0.3), bursts(0.2), bursts(0.4, length=240)], ids=["10 %", "30 %", "bursts", "one gap"]
)
def test_share_of_a_bin_that_is_measured(gone: Array) -> None:
    """S_j times the diagonal of the precision in the Fourier basis, which adds up to the samples measured; over octaves, since V
    is of records drawn: means of a hundred draws have errors of a percent or two."""
    S = MODEL.psd(periodogram_frequencies(N, DT))
    F = np.fft.fft(np.eye(N), norm="ortho")
    exact = S * np.diag(F @ precision(MODEL, gone) @ F.conj().T).real[1 : N // 2] / (2.0 * DT)
    shares = []
    for seed in range(40):
        missing = MissingSamples(gone, DT, np.random.default_rng(seed))
        shares.append(missing.measured_share(S, missing.draw_errors(S)))
    octaves = np.round(np.log2(np.arange(1, N // 2))).astype(int)
    for octave in range(3, octaves.max() + 1):
        inside = octaves == octave
        assert np.mean(shares, axis=0)[inside].mean() == pytest.approx(exact[inside].mean(), abs=0.03)
    is_raised = np.min(shares) <= LEAST  # a bin with little left is given LEAST
    assert np.mean(shares) == pytest.approx(1.0 - gone.mean(), abs=LEAST if is_raised else 1e-4)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_information_is_that_of_what_is_measured(share: float) -> None:
    """Fisher's information of Gaussian samples, tr(P dC P dC) / 2; V is known to a percent or two."""
    f = periodogram_frequencies(N, DT)
    x, wanted = MODEL.vector, [0, 4, 5, 6]  # noise and the resonance: turbulence has too few bins for any of its numbers
    exact, got = np.zeros((2, 4, 4))
    for seed in range(6):
        gone = gaps(share, seed=seed)
        P, slopes = precision(MODEL, gone), []
        for i in wanted:
            up, down = (covariance(MODEL.with_vector(x + sign * 1e-4 * np.eye(len(x))[i])) for sign in (1, -1))
            slopes.append(P @ (up - down) / 2e-4)
        exact += 0.5 * np.array([[np.sum(a * b.T) for a in slopes] for b in slopes])
        missing = MissingSamples(gone, DT, np.random.default_rng(seed))
        S = MODEL.psd(f)
        cells = Cells(f, S, np.ones(len(f)), [120.0], missing.measured_share(S, missing.draw_errors(S)))
        got += spectrum_information(MODEL, cells, wanted)
    complete = 6 * spectrum_information(MODEL, Cells(f, MODEL.psd(f), np.ones(len(f)), [120.0]), wanted)
    assert np.sqrt(np.diag(got)) == pytest.approx(np.sqrt(np.diag(exact)), rel=0.02)
    assert complete[0, 0] > (1.0 + share) * got[0, 0]  # and that differs from that of the complete record


def test_intervals_hold_where_a_third_is_lost() -> None:
    """Of 12 records the 95 % intervals hold the truth in so many that fewer have a probability of 1e-4, as have more false peaks
    at a level of 5 %. Samples that are filled and taken for measurements give 13.0 nm of 14, five errors off."""
    inside, false, count = [], 0, 12
    for seed in range(count):
        (mode,) = identify(record(0.3, np.random.default_rng(seed), 4000)).modes
        peak = min(mode.peaks, key=lambda p: abs(p.frequency.value - 120.0))
        false += len(mode.peaks) > 1
        pairs = [(mode.noise, 0.014), (peak.frequency, 120.0), (peak.rms, 0.01)]
        inside.append([abs(number.value - true) < 1.96 * number.std for number, true in pairs])
    assert np.all(np.sum(inside, axis=0) >= binom.ppf(1e-4, count, 0.95))
    assert false <= binom.isf(1e-4, count, 0.05)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_gap_of_many_periods_moves_no_line(seed: int) -> None:
    """A twentieth of the record, about as long as the line keeps its phase; against the whole record."""
    rng, n = np.random.default_rng(seed), 6000
    z = 0.02 * rng.standard_normal(n) + Ar2(4 * pi, 0.9, 0.3, DT).sample(n, rng) + Ar2(94 * pi, 0.01, 0.06, DT).sample(n, rng)
    lost = np.where(np.arange(n) // 300 == 7, np.nan, z)
    whole, left = (
        min(identify(Record(x[:, None], np.zeros((n, 1)), DT)).modes[0].peaks, key=lambda p: abs(p.frequency.value - 47.0))
        for x in (z, lost)
    )
    for a, b in ((whole.frequency, left.frequency), (whole.rms, left.rms)):
        assert abs(b.value - a.value) < 2.0 * a.std
        assert b.std == pytest.approx(a.std, rel=0.3)


def test_what_lacks_too_much_is_refused() -> None:
    with pytest.raises(RecordError, match=r"tip: \d+ of \d+ samples are measured, identification needs 1000, and 50 %"):
        identify(record(0.6, np.random.default_rng(1), 6000))


@pytest.mark.parametrize(("share", "size"), [(0.0, 0.0), (1.0 / 6000, 250.0), (0.01, 40.0), (0.01, 10.0), (0.01, 1e200)])
def test_outlying_samples_are_those_that_were_put_in(share: float, size: float) -> None:
    """Beside lost frames, at the ends, next to one another; another one, by Gaussian chance, in one of 40 such tests."""
    found = put = lost = 0
    for seed in range(5):
        rng = np.random.default_rng(seed)
        z = record(0.01, rng, 6000).y_lgs[:, 0]
        hit = (rng.random(6000) < share) & ~np.isnan(z)
        hit[[0, 1, -1]] |= share > 0.0
        z[hit] += 0.014 * size * rng.choice([-1, 1], hit.sum())
        out = find_outlying(z)
        found, put, lost = found + out.sum(), put + hit.sum(), lost + (hit & ~out).sum()
    assert found - (put - lost) <= 1
    # the deviation of a prediction is at most 1.3 of the noise, its median over a part 5 % off
    assert lost <= binom.isf(1e-3, put, norm.cdf(1.05 * FAR - size / 1.3)) if put else found <= 1


def test_what_is_no_outlier() -> None:
    """A louder half, few values, a drift, a jump of the level; and what a tenth of the samples would have to be."""
    rng = np.random.default_rng(3)
    white, k = rng.standard_normal(6000), np.arange(6000)
    for z in (white * np.where(k < 3000, 1.0, 10.0), np.round(0.4 * white), 0.01 * k + white, 5.0 * (k > 3000) + white):
        assert not find_outlying(z).any()
    assert not find_outlying(white + 100.0 * (rng.random(6000) < 1.3 * MOST_OUTLYING)).any()


def test_outlying_samples_are_counted_told_and_missing() -> None:
    """The model is that of the record without them; noise was four times as much with one in a hundred."""
    rng = np.random.default_rng(8)
    z = record(0.0, rng, 6000).y_lgs
    hit = rng.random(6000) < 0.01
    spoilt = z + 40.0 * 0.014 * rng.choice([-1, 1], (6000, 1)) * hit[:, None]
    clean, found = (identify(Record(y, np.zeros_like(y), DT)) for y in (z, spoilt))
    put = hit[2:][: found.n_steps].sum()
    assert (clean.modes[0].outlying, found.modes[0].outlying) == (0, put)
    assert f"; outlying samples taken for missing: {put}" in whiteness_lines(found)[0]
    # a hundredth of the samples less: a tenth of a standard deviation, times 5
    assert abs(found.modes[0].noise.value - clean.modes[0].noise.value) < 0.5 * clean.modes[0].noise.std
    assert len(found.modes[0].peaks) == len(clean.modes[0].peaks) == 1


def test_a_measurement_whose_command_is_lost_is_missing() -> None:
    """What the mirror did at that time is not known: a command that is held instead would be noise of the measurement."""
    rng = np.random.default_rng(5)
    z = record(0.0, rng, 3000).y_lgs
    u = rng.standard_normal((3000, 1)).cumsum(axis=0) * 0.01
    lost = gaps(0.05, 3000)
    y = np.concatenate([z[:2], z[2:] + u[:-2]])
    gone = np.concatenate([np.zeros(2, bool), lost[:-2]])
    found = identify(Record(y, np.where(lost[:, None], np.nan, u), DT))
    assert found == identify(Record(np.where(gone[:, None], np.nan, y), u, DT))
