"""The interval of the bound against the best causal estimate there is, that of all that was measured since the record began."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.linalg import cholesky, solve_triangular, toeplitz
from scipy.stats import binom

from wfsobs.evaluation.bound import INFORMATION, bound, least_errors
from wfsobs.observers.base import TARGETS
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.spectrum import rms
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.true_spectra import TrueSpectra, true_spectra
from wfsobs.typing import Array

RATE, SEEDS = 250.0, 100

BASE = Scenario().replace(
    {
        "sensors.lgs_rate": RATE,
        "sensors.exposure_ratio": 5,
        "run.duration": 4.0,
        "turbulence.source": "ar2",
        "sensors.lgs_low_frequency_rms": 0.0,
        "gpr_offline.training_size": 10,
        "gpr_offline.depth": 10,
        "loop.closed": False,
        "vibration.cutoff": 60.0,
    }
)

TABLE = {"frequency": [5.0, 9.9, 10.0, 10.1, 30.0, 40.0, 50.0], "tip": [0.0, 0.0, 4e-3, 0.0, 0.0, 2e-5, 0.0], "tilt": [0.0] * 7}

CASES: dict[str, dict[str, Any]] = {
    "peaks": {
        "vibration.peaks": [
            {"frequency": 17.0, "damping": 0.02, "rms": [0.05]},
            {"frequency": 31.0, "damping": 0.001, "rms": [0.02]},
        ]
    },
    "pure lines": {
        "vibration.peaks": [
            {"frequency": 21.3, "damping": 0.0, "rms": [0.05]},
            {"frequency": 47.5, "damping": 0.0, "rms": [0.03]},
        ]
    },
    "unlike pure lines": {
        "vibration.peaks": [
            {"frequency": f, "damping": 0.0, "rms": [rms]} for f, rms in ((6.0, 0.05), (40.0, 0.03), (60.0, 0.03), (80.0, 0.03))
        ]
    },
    "psd": {"vibration.source": "psd", "vibration.psd": TABLE},
    "ar2": {"vibration.source": "ar2", "vibration.peaks": [{"frequency": 17.0, "damping": 0.0, "rms": [0.05]}]},
    "turbulence of a table": {
        "turbulence.source": "psd",
        "turbulence.psd": {"frequency": [0.0, 2.0, 30.0], "tip": [0.05, 0.05, 0.0], "tilt": [0.0] * 3},
        "vibration.source": "none",
    },
}


def best_estimates(spectra: TrueSpectra, z: Array) -> dict[str, Array]:
    """Target -> the conditional mean of s[k] given z[1] ... z[k], (n_steps, n_records), of zero-mean Gaussian records z.

    z[0] has seen nothing.
    """
    n = len(z) - 1
    known, lines = spectra.without_lines, spectra.line_covariance(n + 1)

    def covariance(spectrum: Array) -> Array:
        return np.fft.irfft(spectrum, 2 * (spectrum.size - 1))

    factor = cholesky(toeplitz(covariance(known.measurement)[:n] + spectra.gain**2 * lines[:n]), lower=True)
    innovations = solve_triangular(factor, z[1:], lower=True)
    out = {}
    for target in TARGETS:
        shared = covariance(known.cross[target])  # at lag j: E s[k] z[k + 1 - j]
        later, earlier = shared[1 : n + 1], np.concatenate([shared[1:2], shared[0:1], shared[:-n:-1][: n - 2]])
        cross = toeplitz(later, earlier)  # E s[k] z[j], lag k - j + 1
        if target == "vibration":
            cross = cross + spectra.gain * toeplitz(lines[1:], lines[np.abs(1 - np.arange(n))])
        explaining = np.tril(solve_triangular(factor, cross.T, lower=True).T)
        out[target] = np.vstack([np.zeros(z.shape[1]), explaining @ innovations])
    return out


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_best_observer_there_is_scatters_as_the_interval_says(case: str) -> None:
    s = BASE.replace(CASES[case])
    start, spectra = round(s.run.warm_up / s.dt), true_spectra(s, 0)
    least = least_errors(spectra, n_steps=s.n_steps)
    records = [simulate(s.replace({"run.seed": seed})) for seed in range(SEEDS)]
    best = best_estimates(spectra, np.column_stack([record.z[:, 0] for record in records]))
    for target in TARGETS:
        truth = np.column_stack([record.truth(target)[:, 0] for record in records])  # type: ignore[index]
        found = np.sqrt(np.mean((best[target] - truth)[start:] ** 2, axis=0))
        if not truth.any():
            continue
        low, high = least[target].interval(start, s.n_steps)
        # 95 of 100 are inside, 0.1 % of all trials outside of either border.
        inside = np.sum((found > low) & (found < high))
        assert binom.ppf(0.001, SEEDS, 0.95) <= inside <= binom.ppf(0.999, SEEDS, 0.95), target
        assert low < rms(found) < high


@pytest.mark.slow
def test_more_information_leaves_less() -> None:
    """Every LGS by itself has all that their mean has, and a bound of some modes is that of all."""
    scenario = PRESETS["galacsi-nfm"]()
    lgs, both, stars = (bound(scenario, information=of, modes=[1])[0]["turbulence"].rms for of in ("lgs", "both", "stars"))
    assert stars < both < lgs
    assert bound(scenario)[1]["turbulence"].rms == lgs


def test_where_all_stars_see_the_same_their_bound_is_that_of_both() -> None:
    (found,), (both,) = (bound(BASE, information=of, modes=[0]) for of in ("stars", "both"))
    assert {name: error.phases for name, error in found.items()} == {name: error.phases for name, error in both.items()}
    assert both["total"].rms > 0.0 and len(both["total"].phases) == BASE.sensors.exposure_ratio


@pytest.mark.parametrize(
    ("information", "reason"), [("modes", "independent"), ("both-modes", "independent"), ("asterism", "see the same")]
)
def test_there_is_no_bound_of_modes_that_are_independent(information: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        bound(BASE, information=information)


def test_what_cannot_be_known_is_refused() -> None:
    with pytest.raises(ValueError, match=f"information = 'ngs': takes one of {', '.join(INFORMATION)}"):
        bound(BASE, information="ngs")
    with pytest.raises(ValueError, match="events change them"):
        bound(PRESETS["peak-jump"]())
    with pytest.raises(ValueError, match=r"ahead = 0\.5: takes whole steps"):
        bound(BASE, ahead=0.5)
    with pytest.raises(ValueError, match=r"ahead = nan: takes 0 steps or more"):
        bound(BASE, ahead=np.nan)
    with pytest.raises(ValueError, match=r"ahead = -3: takes 0 steps or more"):
        bound(BASE, ahead=-3)
    with pytest.raises(ValueError, match=r"modes: takes indices from 0 to 1, not 9"):
        bound(BASE, modes=[0, 9])
