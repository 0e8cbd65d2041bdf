"""The Whittle fit: minima known in closed form, inside and at a bound; and its fits of a third-order process."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from scipy.special import expit, logit

from wfsobs.priors_from.scenario import measurement_noise, modelled_processes
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.autoregressive import TOLERANCE, Ar3, Ar3Fits
from wfsobs.signal.whittle import information, whittle_fit
from wfsobs.simulation.true_spectra import lgs_turbulence_spectrum, turbulence_spectra
from wfsobs.typing import Array

F = np.geomspace(1.0, 100.0, 200)
COUNT = np.linspace(1.0, 50.0, 200)
SLOW = Ar3(7.9, 0.33, 15.0, 0.5, 1e-3)


def power_law(mean: Array, start: Array, bounds: list[tuple[float, float]]) -> Array:
    """The fit of S = exp(x_0) f^x_1."""
    slopes = np.array([np.ones_like(F), np.log(F)])
    return whittle_fit(lambda x: np.exp(x @ slopes), lambda x, S: slopes, start, np.array(bounds), mean, COUNT, 1e-8, 60)


def test_a_power_law_is_found_from_far_away() -> None:
    rng = np.random.default_rng(1)
    for _ in range(5):
        start = np.array([rng.uniform(-9.0, 9.0), rng.uniform(-7.0, 7.0)])
        found = power_law(2.0 * F**-3.0, start, [(-10.0, 10.0), (-8.0, 8.0)])
        # 200 frequencies of 25 bins make 0.02 of one standard deviation at most; to 1e-8 of it, and the digits of a sum of 5000.
        assert found == pytest.approx([np.log(2.0), -3.0], abs=1e-8)


def test_at_a_bound_the_rest_is_at_its_minimum() -> None:
    """With the exponent held at -2 the best level is the mean of I / f^-2: d/dx_0 of sum m (x_0 + exp(-x_0) I f^2) is zero."""
    mean = F**-3.0 * np.random.default_rng(2).exponential(size=F.size)
    level = np.log(COUNT @ (mean * F**2) / COUNT.sum())
    for exponent in (-1.9, 0.0, 7.0):
        found = power_law(mean, np.array([0.0, exponent]), [(-10.0, 10.0), (-2.0, 8.0)])
        assert found == pytest.approx([level, -2.0], abs=1e-6)  # near the bound x moves as t^2


NO_THIRD = Ar3(900.0, 0.5, 9e5, 1.0, 1e-3)
"""Corners as far apart as settings allow: exp(900) is no double."""


@pytest.mark.parametrize("p", [SLOW, Ar3(3.0, 0.9975, 3.0, 2.0, 1e-3), Ar3(900.0, 0.02, 3000.0, 1.0, 1e-3), NO_THIRD], ids=str)
def test_variance_of_the_drive_in_long_arithmetic(p: Ar3) -> None:
    """By partial fractions of the impulse response, in fifty digits: the fit's density has no rounding to climb over."""
    with mp.workdps(50):
        poles = [mp.exp(-mp.mpc(a.real, a.imag)) for a in p.decays]
        weight = [q**2 / mp.fprod(q - other for other in poles if other is not q) for q in poles]
        variance = mp.fsum(
            v * w / (1 - q * r) for v, q in zip(weight, poles, strict=True) for w, r in zip(weight, poles, strict=True)
        )
        assert p.unit_drive_variance == pytest.approx(float(1 / variance.real), rel=1e-13)  # some fifty roundings
        f = np.array([0.01, 1.0, 30.0, 450.0])
        turns = [mp.expjpi(-2 * mp.mpf(x) * p.dt) for x in f]
        density = [2 * p.dt * p.rms**2 / variance.real / abs(mp.fprod(1 - q * turn for q in poles)) ** 2 for turn in turns]
        assert p.psd(f) == pytest.approx([float(x) for x in density], rel=1e-13)


NO_THIRD = Ar3(900.0, 0.5, 9e5, 1.0, 1e-3)
"""Corners as far apart as settings allow: exp(900) is no double."""


@pytest.mark.parametrize("p", [SLOW, Ar3(3.0, 0.9975, 3.0, 2.0, 1e-3), Ar3(900.0, 0.02, 3000.0, 1.0, 1e-3), NO_THIRD], ids=str)
def test_slopes_of_a_third_order_process(p: Ar3) -> None:
    step = 1e-5
    for i, slope in enumerate(p.log_slopes(F)):
        up, down = (np.log(process(vector(p) + sign * step * np.eye(4)[i], p.dt).psd(F)) for sign in (1.0, -1.0))
        # off by step^2 / 6 of the third derivative, some 1 / damping^3 at a sharp pole, and by 1e-14 / step
        assert slope == pytest.approx((up - down) / (2.0 * step), abs=1e-10 * (1.0 + 0.02 / p.damping**3) + 2e-9)


def vector(p: Ar3) -> Array:
    return np.array([np.log(p.omega), logit(p.damping), np.log(p.corner), np.log(p.rms)])


def process(x: Array, dt: float) -> Ar3:
    return Ar3(float(np.exp(x[0])), float(expit(x[1])), float(np.exp(x[2])), float(np.exp(x[3])), dt)


@pytest.mark.parametrize("mode", [0, 1])
def test_the_fit_to_frozen_flow_is_at_its_minimum_from_wherever_it_starts(mode: int) -> None:
    """Rounding, which differs from processor to processor, moves a converged fit no more than another start does."""
    s = PRESETS["ut4"]()
    spectrum, noise = lgs_turbulence_spectrum(s, mode), measurement_noise(s, mode)[0] ** 2
    turbulence, _ = modelled_processes(s, mode, s.dt)
    start = Ar3(turbulence.omega, turbulence.damping, 5.0 * turbulence.omega, turbulence.rms, s.dt)
    found = Ar3Fits().fit("", spectrum, noise, start)
    f = np.fft.rfftfreq(2 * (spectrum.size - 1), s.dt)[1:]
    S = found.psd(f) / (2.0 * s.dt) + noise
    slopes, ones = found.log_slopes(f) * (1.0 - noise / S), np.ones_like(f)
    std = 1.0 / np.sqrt(np.diag(information(slopes, ones)))
    gradient = std * (slopes @ (1.0 - (spectrum[1:] + noise) / S))
    # TOLERANCE, and what the spectra bend within each of the fit's 400 sets of frequencies, of which it has the middle
    assert np.abs(gradient).max() < 0.3
    rng = np.random.default_rng(3)
    for _ in range(6):
        other = Ar3Fits().fit("", spectrum, noise, process(vector(start) + rng.standard_normal(4), s.dt))
        # a gradient of TOLERANCE is a distance of that over the least curvature, 0.01 where corners can stand in for each other
        assert np.abs((vector(other) - vector(found)) / std).max() < 100.0 * TOLERANCE


@pytest.mark.slow
def test_fits_that_follow_a_corner_are_those_from_afar() -> None:
    """Twice the wind in steps of 12 %, more than between two frames of a drag: what both see, and what the LGS alone see."""
    s, fits, noise = PRESETS["ut4"](), Ar3Fits(), 4e-4
    start, f = Ar3(10.0, 0.5, 40.0, 0.5, s.dt), np.fft.rfftfreq(2**14, s.dt)
    for i in range(7):
        moved = s.replace({"turbulence.wind_speed": s.turbulence.wind_speed * 1.12**i})
        own, lgs, cross = turbulence_spectra(moved, 0, 2**14)[:3]
        for name, spectrum in (("both", lgs), ("alone", np.maximum(lgs - np.real(cross) ** 2 / own, 1e-16))):
            found = fits.fit(name, spectrum, noise, start), Ar3Fits().fit("", spectrum, noise, start)
            near, afar = (it.psd(f) / (2.0 * s.dt) + noise for it in found)
            # TOLERANCE is a standard deviation of parameters that 8192 frequencies determine: what can be seen is 1 %
            assert near == pytest.approx(afar, rel=2e-3), (i, name)
