"""Cross spectra between the modes of frozen flow, against those of single modes, symmetry, covariances and simulated records."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import csd, welch

from wfsobs.scenario import Scenario
from wfsobs.simulation import layers as atmosphere
from wfsobs.simulation.flow_spectra import flow_spectra
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.mode_spectra import are_coupled, frequency_rule, mode_spectra

FLOW = Scenario().replace(
    {
        "turbulence.source": "frozen-flow",
        "turbulence.wind_speed": 20.0,
        "telescope.radial_order": 2,
        "sensors.kind": "zernike",
        "sensors.lgs_rate": 250.0,
        "vibration.source": "none",
        "gpr_offline.training_size": 10,
        "gpr_offline.depth": 10,
        "gpr_online.training_size": 10,
    }
)
TIP, TILT, DEFOCUS = 0, 1, 2
FREQUENCY = np.fft.rfftfreq(1024, 1 / 250)

ASTERISM = {"sensors.lgs_count": 3, "sensors.lgs_radius": 30.0, "sensors.lgs_combination": "minimum-variance"}


@pytest.mark.parametrize("changes", [{}, ASTERISM, {**ASTERISM, "sensors.tip_tilt_indetermination": True}])
def test_on_the_diagonal_are_the_spectra_of_single_modes(changes: dict[str, object]) -> None:
    scenario = FLOW.replace(changes)
    found = mode_spectra(scenario, FREQUENCY)
    for mode in range(5):
        one = flow_spectra(scenario, mode, FREQUENCY)
        pairs = (found.own[mode], one.own), (found.measurement[mode, mode], one.measurement), (found.cross[mode, mode], one.cross)
        for got, expected in pairs:
            np.testing.assert_allclose(got, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def test_they_are_those_of_a_process() -> None:
    """Hermitian, and positive semidefinite but for rounding, where they are interpolated too."""
    found = np.moveaxis(mode_spectra(FLOW, FREQUENCY).measurement, 2, 0)
    np.testing.assert_array_equal(found, found.conj().swapaxes(1, 2))
    values = np.linalg.eigvalsh(found)
    assert (values[:, 0] > -1e-12 * values[:, -1]).all() and values[1, 0] > 0


def test_symmetry_along_the_wind() -> None:
    """The wind blows along the axis of tip: modes of other parity across it have nothing in common, of other parity along it
    are a quarter of a period apart.
    """
    found = mode_spectra(FLOW, FREQUENCY).measurement
    scale = np.sqrt(np.real(np.einsum("iif->if", found)))
    share = found / (scale[:, None] * scale)
    assert np.abs(share[TIP, TILT]).max() < 1e-10 and np.abs(share[TILT, DEFOCUS]).max() < 1e-10
    assert np.abs(share[TIP, DEFOCUS].real).max() < 1e-10 and 0.4 < np.abs(share[TIP, DEFOCUS].imag).max() < 1.0


def test_their_integral_is_the_covariance() -> None:
    """To 2e-3: it ends at half the rate, and the mean over a step takes something off."""
    scenario = FLOW.replace({"telescope.radial_order": 4, "turbulence.layers.0.wind_direction": 30.0})
    frequency, weight = frequency_rule(scenario)
    found, expected = mode_spectra(scenario, frequency), atmosphere.star_covariance(scenario)
    star = expected[1:].mean(axis=0)[:, 1:].mean(axis=1)  # of the mean of the stars
    scale = 2e-3 * np.sqrt(np.outer(np.diag(star), np.diag(star)))
    assert (np.abs(np.real(found.measurement @ weight) - star) < scale).all()
    assert (np.abs(np.real(found.cross @ weight) - expected[0][:, 1:].mean(axis=1)) < scale).all()
    assert np.abs(star - np.diag(np.diag(star))).max() > 0.05 * star[0, 0] ** 0.5 * star[-1, -1] ** 0.5


@pytest.mark.slow
def test_phase_and_coherence_of_a_simulated_record() -> None:
    """Of tip and defocus, of which the one leads: over 0.5 to 6 Hz, from 300 s in pieces of 4 s, to four standard deviations."""
    scenario = FLOW.replace({"run.duration": 300.0, "sensors.lgs_noise": 0.0})
    record = simulate(scenario)
    assert record.turbulence is not None
    pieces = {"fs": 250.0, "nperseg": 1000, "noverlap": 0}
    f, shared = csd(record.turbulence[:, TIP], record.turbulence[:, DEFOCUS], **pieces)
    own = [welch(record.turbulence[:, mode], **pieces)[1] for mode in (TIP, DEFOCUS)]
    rule = mode_spectra(scenario.replace({"sensors.lgs_altitude": 1e6}), f)  # from so high that the LGS see what is there
    expected = rule.cross[TIP, DEFOCUS] / np.sqrt(rule.own[TIP] * rule.own[DEFOCUS])
    band = (f >= 0.5) & (f <= 6.0)
    share = (shared / np.sqrt(own[0] * own[1]))[band]
    # SciPy has conj(X) Y, the transform over j of E x[k] y[k+j]; here it is that of E x[k] y[k-j]
    off = np.abs(share.conj() - expected[band])
    assert np.sqrt(np.mean(off**2)) < 4.0 / np.sqrt(75)
    assert np.mean(share.conj() * expected[band].conj()).real > 0.1  # the other sign would be below zero


def test_who_is_coupled() -> None:
    assert are_coupled(FLOW) and not are_coupled(FLOW.replace({"turbulence.source": "ar2"}))
