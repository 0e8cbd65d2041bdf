"""The bound of a fractional delay: against the best filter of many taps, and whole frames on either side."""

from __future__ import annotations

import numpy as np
import pytest

from wfsobs import PRESETS
from wfsobs.closed_loop.design import design
from wfsobs.control.mirror import Mirror
from wfsobs.evaluation.bound import least_residual
from wfsobs.simulation.true_spectra import TrueSpectra, true_spectra
from wfsobs.typing import Array

SCENARIO = PRESETS["paper"]().replace({"turbulence.wind_speed": 40.0})


def residual_of_taps(spectra: TrueSpectra, delay: float, taps: int, jitter: float = 0.0) -> float:
    """Rms of phi[k] + phi_corr[k] where u[k] is the best filter of z[k], ..., z[k - taps + 1], by least squares.

    With jitter u[k-i-1] gives way to u[k-i] for a share of the frame that is random, and independent of the others.
    """
    late = delay - 1.0 + jitter * np.linspace(-0.999, 0.999, 1000)
    share = np.clip(np.arange(1.0, int(delay + jitter) + 2)[:, None] - late, 0.0, 1.0)
    known, mirror = spectra.without_lines, np.diff(share.mean(axis=1), prepend=0.0)
    signal, cross = known.total
    n = known.n
    z, s, zs = (np.fft.irfft(x, n) for x in (known.measurement, signal, cross))
    lags = np.arange(taps)[:, None] - np.arange(taps)
    # phi_corr[k] is the filter of sum_i mirror_i z[k-i]; z[k] is of step k - 1.
    measured = sum(a * b * z[(lags + i - j) % n] for i, a in enumerate(mirror) for j, b in enumerate(mirror))
    measured += share.var(axis=1).sum() * (2.0 * z[lags % n] - z[(lags + 1) % n] - z[(lags - 1) % n])
    shared = sum(a * zs[(np.arange(taps) + 1 + i) % n] for i, a in enumerate(mirror))
    return float(np.sqrt(s[0] - shared @ np.linalg.solve(measured, shared)))


@pytest.mark.slow
@pytest.mark.parametrize("delay", [1.0, 1.3, 2.0, 2.2, 2.7, 2.95])
def test_no_filter_of_many_taps_leaves_less_and_some_leave_hardly_more(delay: float) -> None:
    """Of 1500 taps, which miss 1e-5; what the fraction costs is 2 and 5 % for delays of 2.7 and 2.95."""
    spectra = true_spectra(SCENARIO, 0)
    bound, taps = least_residual(spectra, delay, "lgs"), residual_of_taps(spectra, delay, 1500)
    assert bound * (1.0 - 1e-5) < taps < bound * (1.0 + 1e-4)


def test_with_jitter_there_is_no_bound_as_that_of_the_mean_delay_is_none() -> None:
    spectra = true_spectra(SCENARIO, 0)
    assert least_residual(spectra, 1.5, "lgs") < residual_of_taps(spectra, 2.0, 600, 0.5) < least_residual(spectra, 2.0, "lgs")
    assert not design(SCENARIO.replace({"plant.delay_jitter": 0.5}), ["integrator"]).bounds
    assert design(SCENARIO.replace({"plant.delay_error": 0.5}), ["integrator"]).bounds


SHORT = SCENARIO.replace(
    {
        "sensors.lgs_rate": 250.0,
        "sensors.exposure_ratio": 2,
        "turbulence.wind_speed": 60.0,
        "turbulence.damping": 0.7,
        "vibration.source": "ar2",
        "vibration.peaks": [{"frequency": 31.0, "damping": 0.1, "rms": [0.1]}],
        "gpr_offline.training_size": 10,
        "gpr_offline.depth": 10,
    }
)
"""What happened more than a second ago tells nothing."""


def residual_of_both(spectra: TrueSpectra, delay: float, taps: int) -> float:
    """Rms of phi[k] + phi_corr[k], mean over a cycle, where u[k] is the best filter of z and the NGS frames of the last steps.

    The filter is another one at every place in the cycle. All are found together by least squares, from covariances of single
    steps. A frame is the mean of the steps before it.
    """
    known, mirror, ratio = spectra.without_lines, Mirror(delay).taps[1:], spectra.ngs.ratio
    ngs, (signal, cross) = known.ngs, known.total

    def covariance(spectrum: Array, lag: Array) -> Array:
        return np.fft.irfft(spectrum, known.n)[lag]

    last = taps + ratio + mirror.size  # the last cycle of commands ends here
    z, frames = np.arange(last + 1), np.arange(ratio, last + 1, ratio)
    steps = frames[:, None] - np.arange(1, ratio + 1)
    among = covariance(ngs.signal, steps[:, :, None, None] - steps).mean(axis=(1, 3)) + ngs.noise * np.eye(frames.size)
    with_z = covariance(ngs.measurement_cross, steps[:, :, None] + 1 - z).mean(axis=1)
    measured = np.block([[covariance(known.measurement, np.subtract.outer(z, z)), with_z.T], [with_z, among]])
    of_frames = sum(ngs.cross.values(), np.zeros(1))

    read = [[*(k - np.arange(taps)), *(z.size + np.flatnonzero((frames <= k) & (frames > k - taps)))] for k in z]
    sizes = [len(read[last - (last - place) % ratio]) for place in range(ratio)]  # of commands late enough to have all taps
    starts = np.cumsum([0, *sizes])
    together, shared = np.zeros((starts[-1], starts[-1])), np.zeros(starts[-1])
    for k in range(last - ratio + 1, last + 1):
        uses = np.zeros((starts[-1], len(measured)))
        for i, weight in enumerate(mirror):
            rows = starts[(k - i) % ratio] + np.arange(sizes[(k - i) % ratio])
            uses[rows, read[k - i]] += weight
        told = np.concatenate([covariance(cross, k + 1 - z), covariance(of_frames, k - steps).mean(axis=1)])
        together += uses @ measured @ uses.T
        shared += uses @ told
    return float(np.sqrt(covariance(signal, np.array(0)) - shared @ np.linalg.solve(together, shared) / ratio))


@pytest.mark.parametrize("delay", [1.3, 1.7, 2.9])
def test_no_filter_of_both_sensors_leaves_less_and_some_leave_hardly_more(delay: float) -> None:
    """Of 160 steps; beyond half a frame the fraction costs 40 %."""
    spectra = true_spectra(SHORT, 0)
    # 1e-7 for what wraps around the DFT, and for conjugate gradients that stop at 1e-4, whose square counts
    assert least_residual(spectra, delay, "both") == pytest.approx(residual_of_both(spectra, delay, 160), rel=1e-6)


@pytest.mark.parametrize("information", ["lgs", "both"])
def test_up_to_half_a_frame_costs_nothing_and_more_leads_to_one_frame_more(information: str) -> None:
    spectra = true_spectra(SCENARIO, 0)
    two, half, more, most, three = (least_residual(spectra, delay, information) for delay in (2.0, 2.5, 2.75, 2.9999, 3.0))
    assert two == half < more < most
    assert most == pytest.approx(three, rel=1e-4)
