"""The H2 design: within its limits, near what is possible without them, and stable for every plant that it is to bear."""

from __future__ import annotations

import numpy as np
import pytest

from wfsobs import PRESETS, plant_envelope
from wfsobs.closed_loop.design import design
from wfsobs.control import laws
from wfsobs.control.mirror import Mirror
from wfsobs.evaluation.scores import BOUND
from wfsobs.prior import Spectra


@pytest.mark.parametrize("a", [0.0, 0.5, -0.4])
def test_an_ar1_without_noise_is_predicted_by_its_law(a: float) -> None:
    """Two steps ahead that is a^2 times the last value; at this size no limit acts."""
    omega = np.linspace(0.0, np.pi, 257)
    S = (1.0 - a**2) / np.abs(1.0 - a * np.exp(-1j * omega)) ** 2
    assert laws.taps_of(Spectra(S, S, S), Mirror(2.0), 1.0) == pytest.approx(a**2 * np.eye(laws.TAPS)[0], abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "ut4", "galacsi-nfm"])
def test_limits_hold_between_the_frequencies_where_they_are_set(preset: str) -> None:
    """Multipliers meet them to some 2 % after the rounds that they have; more than four points per tap leave no room between."""
    s = PRESETS[preset]()
    omega = np.linspace(1e-3, np.pi, 1500)
    for caution in (1.0, 2.0):
        plan = design(s.replace({"control.caution": caution}), ["h2-fir"])
        for mode in range(2):
            T = plan.loop("h2-fir", mode)(omega)
            assert np.abs(1.0 - T).max() < 1.05 * laws.PEAK
            assert (np.abs(T) * laws.uncertainty(plan.mirror, omega)).max() < 1.05 * laws.ROBUST / caution


def test_uncertainty_is_that_of_the_plant() -> None:
    """A delay of half a frame, gain and rotation move P where nothing is fractional by |1.2 exp(i (w / 2 + 10 deg)) - 1|."""
    omega = np.array([1e-6, 0.05])
    expected = np.abs(1.2 * np.exp(1j * (0.5 * omega + np.radians(10.0))) - 1.0)
    assert laws.uncertainty(Mirror(3.0), omega) == pytest.approx(expected, rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "strong-turbulence", "ut4", "galacsi-nfm"])
def test_every_plant_is_borne_at_little_loss(preset: str) -> None:
    """A tenth is the most that robustness may cost against the LQG of every peak; the integrator is worse at worst."""
    s = PRESETS[preset]()
    robust, lqg = plant_envelope(s, controllers=["h2-fir", "lqg-kf-multi"], points=64).spreads[::-1]
    assert np.isfinite(robust.points).all() and np.isfinite(robust.corners).all()
    assert (robust.nominal < 1.1 * lqg.nominal).all()
    assert (robust.nominal > 0.99 * np.array(design(s, ["none"]).bounds[BOUND])).all(), "to the error of fewer frequencies"
    for caution in (1.0, 1.4, 2.0):
        integrator = plant_envelope(s.replace({"control.caution": caution}), controllers=["integrator"], points=64).spreads[0]
        assert (robust.worst < integrator.worst).all()
