"""Spectra as sums of a few processes, and the filters that are told of a vibration that is no line."""

from __future__ import annotations

import numpy as np
import pytest

from wfsobs import PRESETS
from wfsobs.evaluation.bound import bound_rms
from wfsobs.evaluation.exact_errors import exact_errors
from wfsobs.observers import OBSERVERS
from wfsobs.priors_from.scenario import continuum_power, lines_of
from wfsobs.signal.autoregressive import Ar2
from wfsobs.simulation.disturbance import vibration_power
from wfsobs.spectral.model import fit_processes

DT, N = 1e-3, 2**16
F = np.fft.rfftfreq(N, DT)


def per_sample(*processes: Ar2) -> np.ndarray:
    """Return the sum of the spectra of processes, two-sided per sample."""
    return sum((p.psd(F) / (2.0 * DT) for p in processes), np.zeros(F.size))


def test_a_sum_of_processes_is_found_again() -> None:
    """What is a sum of two processes is fitted by them: bins are averaged, which costs a resonance 1 % of its width."""
    truth = [Ar2(2.0 * np.pi * 4.0, 0.6, 0.05, DT), Ar2(2.0 * np.pi * 40.0, 0.1, 0.03, DT)]
    found = sorted(fit_processes(per_sample(*truth), np.full(F.size, 1e-4), DT, 2), key=lambda p: p.omega)
    for one, true in zip(found, truth, strict=True):
        assert one.omega == pytest.approx(true.omega, rel=2e-3)
        assert one.damping == pytest.approx(true.damping, rel=2e-2)
        assert one.rms == pytest.approx(true.rms, rel=5e-3)


def test_more_processes_come_nearer_to_a_power_law() -> None:
    """1 / f^2 between 5 and 100 Hz beside turbulence and noise: the error of its logarithm falls with the number of processes."""
    law = np.where((F >= 5.0) & (F <= 100.0), 1e-2 / np.maximum(F, 1.0) ** 2, 0.0) / (2.0 * DT)
    beside = 1e-4 + 10.0 / (1.0 + F**6)
    inside = (F > 6.0) & (F < 80.0)
    errors = []
    for count in (2, 4, 8):
        model = per_sample(*fit_processes(law, beside, DT, count))
        errors.append(float(np.std(np.log(model[inside] / law[inside]))))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.2 * np.std(np.log(law[inside]))


def test_a_spectrum_of_zero_has_no_processes() -> None:
    """Nothing is made of nothing."""
    assert fit_processes(np.zeros(F.size), np.full(F.size, 1e-4), DT, 3) == ()


@pytest.mark.parametrize("preset", ["paper", "ut4"])
def test_lines_have_no_continuum(preset: str) -> None:
    """A vibration of lines alone leaves nothing."""
    assert lines_of(PRESETS[preset](), 0).continuum == ()


def test_lines_and_continuum_are_all_of_the_vibration() -> None:
    """Nothing of the spectrum with a floor is dropped: the variance of the told processes is that of the vibration, to a tenth.

    Processes reach beyond the edges of the floor, at 5 and at 100 Hz.
    """
    s = PRESETS["ut4-floor"]()
    whole = vibration_power(s, 0, N)
    assert 0.0 < continuum_power(s, 0, N).sum() < whole.sum()
    told = lines_of(s, 0).vibration(s.multipeak.line_width)
    assert sum(p.rms**2 for p in told) == pytest.approx(whole.sum(), rel=0.1)


@pytest.mark.slow
def test_the_floor_brings_no_observer_far_from_its_bound() -> None:
    """`multirate-multi` on `ut4-floor`: within a quarter of the bound in all targets, and not below it."""
    s = PRESETS["ut4-floor"]()
    errors = exact_errors(OBSERVERS["multirate-multi"], s)
    for mode, of_mode in enumerate(errors):
        least = bound_rms(s, mode, information="both")
        assert all(1.0 < of_mode[target].rms / least[target] < 1.25 for target in least)
