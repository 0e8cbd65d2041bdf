"""Margins and stability against closed forms and against poles."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.closed_loop.design import design
from wfsobs.control.laws import highest_stable_gain, integrator_law
from wfsobs.control.margins import Margins, crossings, frequencies, margins
from wfsobs.control.mirror import Law, Mirror
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.periodic import PeriodicFilter

DT = 1e-3


def of(law: Law, mirror: Mirror) -> Margins:
    return margins(lambda w: mirror.response(w) * law.response(w), frequencies(law.poles), DT)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.floats(0.02, 0.98), st.integers(1, 6))
def test_the_integrator_has_the_margins_of_its_closed_form(share: float, n: int) -> None:
    """L = g q^-n / (1 - q^-1): |L| = g / (2 sin(w/2)), angle L = -pi/2 - (n - 1/2) w."""
    mirror = Mirror(float(n))
    limit = 2.0 * np.sin(np.pi / (2.0 * (2 * n - 1)))  # the angle is -pi at w = pi / (2 n - 1)
    assert highest_stable_gain(mirror, 1.0) == pytest.approx(limit, rel=1e-9)
    gain = share * limit
    m = of(integrator_law(mirror, gain, 1.0), mirror)
    crossover = 2.0 * np.arcsin(gain / 2.0)
    phase = np.pi / 2.0 - (n - 0.5) * crossover
    assert m.gain == pytest.approx(1.0 / share, rel=1e-6)
    assert m.phase == pytest.approx(phase, rel=1e-6)
    assert m.delay == pytest.approx(phase / crossover * DT, rel=1e-6)


def test_two_frames_are_stable_below_a_gain_of_one() -> None:
    assert highest_stable_gain(Mirror(2.0), 1.0) == pytest.approx(1.0, rel=1e-9)
    assert integrator_law(Mirror(2.0), 0.999, 1.0).stable and not integrator_law(Mirror(2.0), 1.001, 1.0).stable


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.floats(1.0, 5.0), st.floats(0.5, 1.0), st.floats(0.1, 0.9))
def test_the_gain_margin_leads_to_instability_and_no_further(delay: float, leak: float, share: float) -> None:
    mirror = Mirror(delay)
    gain = share * highest_stable_gain(mirror, leak)
    m = of(integrator_law(mirror, gain, leak), mirror)
    assert m.gain is not None
    assert integrator_law(mirror, gain * m.gain * 0.9999, leak).stable
    assert not integrator_law(mirror, gain * m.gain * 1.0001, leak).stable


def polynomials(law: Law, mirror: Mirror) -> tuple[Any, Any]:
    """Numerator and denominator of T = P F in z, of equal length."""
    F, G, H, J = law.cycle.steps[0]
    denominator = np.poly(F)
    numerator = -(np.poly(F - G @ H) + (J[0, 0] - 1.0) * denominator)
    taps = mirror.taps
    return np.polymul(numerator, taps), np.concatenate([denominator, np.zeros(taps.size - 1)])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "delay"), [("paper", 2.0), ("paper", 2.5), ("ut4", 2.0), ("ut4", 3.0)])
def test_the_gain_margin_of_lqg_is_where_a_pole_reaches_the_circle(name: str, delay: float) -> None:
    """With the loop gain times kappa the poles are the roots of (den - num) + kappa num."""
    plan = design(PRESETS[name]().replace({"control.delay": delay}), ("lqg-kf-lgs",))
    mirror, law = plan.mirror, plan.laws["lqg-kf-lgs"][0].law
    assert law is not None
    m = of(law, mirror)
    numerator, denominator = polynomials(law, mirror)

    def radius(kappa: float) -> float:
        return float(np.abs(np.roots(np.polyadd(denominator, (kappa - 1.0) * numerator))).max())

    assert m.gain is not None and m.phase is not None and m.delay is not None
    assert radius(1.0) < 1.0 and radius(m.gain * 0.999) < 1.0 < radius(m.gain * 1.001)
    if m.least_gain:
        assert radius(m.least_gain * 1.001) < 1.0 < radius(m.least_gain * 0.999)
    # Turning L by the phase margin, one way or the other, or delaying it, brings it to -1 somewhere and not before.
    omega = frequencies(law.poles, 20_000)
    T = mirror.response(omega) * law.response(omega)
    L = T / (1.0 - T)
    nearest = min(np.abs(1.0 + L * np.exp(1j * sign * m.phase)).min() for sign in (1, -1))
    less = min(np.abs(1.0 + L * np.exp(1j * sign * 0.98 * m.phase)).min() for sign in (1, -1))
    assert nearest < 2e-3 < less
    assert np.abs(1.0 + L * np.exp(-1j * omega * m.delay / DT)).min() < 2e-3
    assert np.abs(1.0 + L * np.exp(-1j * omega * 0.98 * m.delay / DT)).min() > 2e-3


def test_crossings_are_found_to_rounding() -> None:
    x = np.linspace(0.0, 10.0, 37)
    assert crossings(np.cos, x, np.cos(x)) == pytest.approx(np.pi * np.array([0.5, 1.5, 2.5]), rel=1e-14)
    assert crossings(np.cosh, x, np.cosh(x)).size == 0


def test_a_transfer_function_of_equal_poles() -> None:
    """A Jordan block has no basis of eigenvectors: 1 / (z - p)^3."""
    F = 0.7 * np.eye(3) + np.eye(3, k=1)
    omega = np.linspace(0.0, np.pi, 9)
    law = Law(PeriodicFilter([(F, np.eye(3)[:, 2:], np.eye(3)[:1], np.array([[0.25]]))]))
    assert np.allclose(-law.response(omega), 0.25 + (np.exp(1j * omega) - 0.7) ** -3, rtol=1e-13)
