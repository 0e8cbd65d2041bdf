"""Two views of one process: processes that are known, views that share nothing, and the filters of frozen flow."""

from __future__ import annotations

import numpy as np
import pytest

from wfsobs.evaluation.bound import bound_rms
from wfsobs.evaluation.exact_errors import exact_errors
from wfsobs.observers import OBSERVERS
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.autoregressive import Ar3, fit_shared_process
from wfsobs.typing import Array

DT, N, NOISE = 1e-3, 2**16, 1e-4
COMMON, ALONE = Ar3(6.0, 0.6, 25.0, 0.5, DT), Ar3(20.0, 0.4, 90.0, 0.08, DT)
START = Ar3(8.0, 0.8, 40.0, 0.3, DT)


def density(process: Ar3) -> Array:
    """Spectrum per sample."""
    return process.psd(np.fft.rfftfreq(N, DT)) / (2.0 * DT)


def numbers(process: Ar3) -> list[float]:
    return [process.omega, process.damping, process.corner, process.rms]


def test_known_processes_are_found() -> None:
    common, alone = density(COMMON), density(ALONE)
    found = fit_shared_process(common, 0.81 * common + alone, 0.9 * common, NOISE, START)
    assert found.gain == pytest.approx(0.9, rel=1e-12) and found.first == ()
    # The fit averages the spectrum over bins and takes it at their middle: a few 1e-3 where it is curved.
    assert numbers(found.common[0]) == pytest.approx(numbers(COMMON), rel=2e-2)
    assert numbers(found.second[0]) == pytest.approx(numbers(ALONE), rel=2e-2)


def test_spectra_are_met_whatever_the_gain() -> None:
    """What the target has alone moves the gain, not what the processes add up to."""
    common, first, second = density(COMMON), density(Ar3(20.0, 0.5, 60.0, 0.05, DT)), density(ALONE)
    found = fit_shared_process(common + first, common + second, common, NOISE, START)
    g = found.gain
    of_common, of_first, of_second = (density(part[0]) for part in found[1:])
    given = (common + first, common + second, common)
    for had, got in zip(given, (of_common + of_first, g**2 * of_common + of_second, g * of_common), strict=True):
        # What is left alone is no process of third order, as the gain is not one: a share of it, on the noise that it stands in.
        assert np.abs(np.log((got + NOISE) / (had + NOISE))).max() < 0.5
        assert np.sum(got) == pytest.approx(np.sum(had), rel=0.05)


def test_views_that_share_nothing_have_no_common_process() -> None:
    found = fit_shared_process(density(COMMON), density(ALONE), np.zeros(N // 2 + 1), NOISE, START)
    assert (found.gain, found.common) == (0.0, ())
    assert numbers(found.first[0]) == pytest.approx(numbers(COMMON), rel=2e-2)
    nothing = fit_shared_process(density(COMMON), np.zeros(N // 2 + 1), np.zeros(N // 2 + 1), NOISE, START)
    assert nothing.second == (), "a laser that sees no tip"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "turbulence", "vibration"), [("paper", 1.01, 1.01), ("ut4", 1.10, 1.20), ("galacsi-wfm", 1.25, 1.25)]
)
def test_the_filter_comes_near_the_bound(preset: str, turbulence: float, vibration: float) -> None:
    """Limits that were set before there was a filter."""
    scenario = PRESETS[preset]()
    for mode, errors in enumerate(exact_errors(OBSERVERS["multirate-multi"], scenario)):
        least = bound_rms(scenario, mode, information="both")
        assert 0.9999 < errors["turbulence"].rms / least["turbulence"] < turbulence, mode
        assert 0.9999 < errors["vibration"].rms / least["vibration"] < vibration, mode
