"""From settings to layers, beams and covariances; turbulence as the sensors see it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.special import jv

from tests.noll import noll_covariance
from wfsobs.atmosphere import von_karman_density
from wfsobs.priors_from.scenario import modelled_processes
from wfsobs.scenario import Scenario
from wfsobs.simulation import layers as atmosphere
from wfsobs.simulation.disturbance import make_disturbance, turbulence_process, turbulence_rms
from wfsobs.simulation.sensing import lgs_error_process, lgs_error_variance, low_frequency_process, measure_open_loop

FLOW: dict[str, Any] = {"turbulence.source": "frozen-flow", "sensors.kind": "zernike"}
QUIET_SENSORS: dict[str, Any] = {"sensors.lgs_noise": 0.0, "sensors.ngs_noise": 0.0, "vibration.source": "none"}
TWO_LAYERS: dict[str, Any] = {
    "turbulence.layers": [
        {"height": 500.0, "fraction": 3.0, "wind_factor": 0.5, "wind_direction": 90.0},
        {"height": 10_000.0, "fraction": 1.0, "wind_factor": 2.0},
    ]
}


def scenario(changes: dict[str, Any] | None = None) -> Scenario:
    return Scenario().replace({**FLOW, **(changes or {})})


# ---------------------------------------------------------------------- geometry


def test_layers_share_the_turbulence() -> None:
    near, far = atmosphere.layers(scenario(TWO_LAYERS))
    whole = 0.157 ** (-5 / 3)
    assert (near.strength, far.strength) == pytest.approx((0.75 * whole, 0.25 * whole))
    assert (near.speed, far.speed, near.angle, far.angle) == pytest.approx((7.5, 30.0, np.pi / 2, 0.0))


def test_wind_speed_moves_every_layer() -> None:
    slow, fast = (atmosphere.layers(scenario(TWO_LAYERS | {"turbulence.wind_speed": v})) for v in (10.0, 20.0))
    assert [b.speed / a.speed for a, b in zip(slow, fast, strict=True)] == [2.0, 2.0]


@pytest.mark.parametrize("angle", [0.0, 30.0, 60.0])
def test_airmass(angle: float) -> None:
    """r0 as airmass^(-3/5), layers and guide stars as far as airmass, so the cone is what it was."""
    s = scenario({"telescope.zenith_angle": angle, "sensors.lgs_radius": 60.0})
    way = 1 / np.cos(np.radians(angle))
    (layer,) = atmosphere.layers(s)
    assert layer.strength ** (-3 / 5) == pytest.approx(0.157 * way ** (-3 / 5)) and layer.height == pytest.approx(8000 * way)
    footprint = atmosphere.footprint(atmosphere.laser_stars(s)[0], layer)
    assert footprint.scale == pytest.approx(1 - 8 / 90)
    assert footprint.shift == pytest.approx((8000 * way * np.radians(60 / 3600), 0.0))


def test_asterism() -> None:
    stars = atmosphere.laser_stars(scenario({"sensors.lgs_count": 4, "sensors.lgs_radius": 10.0, "sensors.lgs_angle": 45.0}))
    found = np.array([star.direction for star in stars]) / np.radians(1 / 3600)
    assert found == pytest.approx(10 / np.sqrt(2) * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]))
    ngs = atmosphere.natural_star(scenario({"sensors.ngs_direction": [3.0, -4.0]}))
    assert np.hypot(*ngs.direction) == pytest.approx(np.radians(5 / 3600)) and np.isinf(ngs.distance)


def test_effective_wind() -> None:
    assert atmosphere.effective_wind(scenario()) == pytest.approx(15.0)
    mean = 0.75 * 7.5 ** (5 / 3) + 0.25 * 30 ** (5 / 3)
    assert atmosphere.effective_wind(scenario(TWO_LAYERS)) == pytest.approx(mean**0.6)
    assert atmosphere.effective_wind(Scenario().replace(TWO_LAYERS)) == 15.0


# ---------------------------------------------------------------------- variances


def test_rms_of_the_models() -> None:
    """529 nm and 49.4 nm, the figures of docs/scripts/cone_effect.py, are what the filters are told."""
    s = scenario()
    turbulence, _ = modelled_processes(s, 0, 1e-3)
    assert 1e3 * turbulence.rms == pytest.approx(529.3, abs=0.1)
    assert turbulence.omega == pytest.approx(turbulence_process(Scenario(), 0, 1e-3).omega)
    assert 1e3 * lgs_error_process(s, 0, 1e-3).rms == pytest.approx(49.4, abs=0.1)
    assert low_frequency_process(s, 0).rms == 0.0
    assert low_frequency_process(Scenario(), 1).rms == 0.049
    assert lgs_error_process(Scenario(), 1, 1e-3).rms == pytest.approx(0.049 / np.sqrt(2))


def test_higher_orders_of_the_ar2_have_noll_s_ratio() -> None:
    """With an outer scale far beyond the aperture, but for the tip's own loss to it, 1.42 (D / L0)^(1/3)."""
    s = Scenario().replace({"telescope.radial_order": 6, "turbulence.outer_scale": 1e6})
    tip = noll_covariance(2, 2) * (1 - 1.42 * (8 / 1e6) ** (1 / 3))
    for i, mode in enumerate(s.modes):
        wanted = 1.0 if mode.radial_order == 1 else np.sqrt(noll_covariance(mode.noll, mode.noll) / tip)
        assert turbulence_rms(s, i) == pytest.approx(0.5 * wanted, rel=2e-3)
        assert turbulence_process(s, i, 1e-3).omega == pytest.approx(0.6 * np.pi * (mode.radial_order + 1) * 15 / 8)
    assert turbulence_rms(s, 0) == turbulence_rms(s, 1) == 0.5


def test_covariance_of_the_stars() -> None:
    """Of tip and of tilt between any two beams: pi integral Phi |M_1 M_2| (J0 -+ cos(2 b) J2)(k d) k dk in every layer, with d
    and b the length and the direction of the way from one centre to the other."""
    s = scenario(TWO_LAYERS | {"sensors.lgs_count": 3, "sensors.lgs_radius": 60.0, "sensors.lgs_angle": 10.0})
    found = atmosphere.star_covariance(s)
    k = np.exp(np.linspace(np.log(1e-6), np.log(1e3), 6000))
    stars = [atmosphere.on_axis(), *atmosphere.laser_stars(s)]
    for a, one in enumerate(stars):
        for b, other in enumerate(stars):
            wanted = np.zeros(2)
            for layer in atmosphere.layers(s):
                scales = [1 - layer.height / star.distance for star in (one, other)]
                x, y = layer.height * (np.array(one.direction) - other.direction)
                d, turn = np.hypot(x, y), 2 * np.arctan2(y, x)
                density = np.pi * k**2 * von_karman_density(k**2, layer.strength, 25.0)
                for scale in scales:
                    density = density * 4 * jv(2, 4 * scale * k) / (4 * scale * k)
                for i, sign in enumerate((-1, 1)):
                    wanted[i] += np.trapezoid(density * (jv(0, k * d) + sign * np.cos(turn) * jv(2, k * d)), np.log(k))
            assert np.diag(found[a, :, b]) == pytest.approx(wanted, abs=3e-4 * 0.28)


def test_variances_of_the_stars_in_higher_modes() -> None:
    """On the diagonal, what the integral over the radius alone gives: to 2e-4."""
    s = scenario(TWO_LAYERS | {"telescope.radial_order": 6, "sensors.lgs_radius": 60.0})
    found = atmosphere.star_covariance(s)
    assert np.allclose(found.reshape(81, 81), found.reshape(81, 81).T)
    for i in range(len(s.modes)):
        assert found[0, i, 0, i] == pytest.approx(atmosphere.frozen_flow_variance(s, i), rel=2e-4)


@pytest.mark.parametrize("height", [2000.0, 8000.0, 20_000.0])
def test_error_of_the_mean_over_lgs_on_the_axis_is_the_cone_effect(height: float) -> None:
    s = scenario({"turbulence.layers": [{"height": height}], "telescope.radial_order": 4})
    for i, mode in enumerate(s.modes):
        alone = atmosphere.mode_variance(mode.radial_order, 8.0, 0.157 ** (-5 / 3), 25.0, 1 - height / 90e3)
        assert lgs_error_variance(s, i) == pytest.approx(alone, rel=5e-3)


# ---------------------------------------------------------------------- what the sensors see


def seen(changes: dict[str, Any], seed: int = 1, n: int = 2000) -> tuple[Any, Any]:
    s = scenario(QUIET_SENSORS | changes)
    disturbance = make_disturbance(s, n, np.random.default_rng(seed))
    return disturbance, measure_open_loop(s, disturbance, np.random.default_rng(seed + 1))


def test_the_lgs_see_their_own_beam_and_the_ngs_the_truth() -> None:
    d, found = seen({"sensors.exposure_ratio": 1})
    assert d.lgs_turbulence is not None and len(d.lgs_turbulence) == 2
    assert np.allclose(found.lgs[1:], np.mean(d.lgs_turbulence, axis=0)[:-1], atol=1e-15)
    assert np.allclose(found.ngs[1:], d.turbulence[:-1], atol=1e-15)
    assert np.array_equal(d.lgs_turbulence[0], d.lgs_turbulence[1])  # both on the axis: no mean helps
    assert 0.01 < np.std(found.lgs[1:] - d.turbulence[:-1]) < 0.1


def test_the_stand_in_for_the_cone_effect_is_not_added_to_it() -> None:
    _, with_setting = seen({"sensors.lgs_low_frequency_rms": 1.0})
    _, without = seen({"sensors.lgs_low_frequency_rms": 0.0})
    assert np.array_equal(with_setting.lgs, without.lgs)


def test_indetermination_hides_tip_and_tilt_only() -> None:
    for changes in ({}, {"turbulence.source": "ar2", "sensors.lgs_low_frequency_rms": 0.0}):
        more = {"telescope.radial_order": 2, **changes}
        d, blind = seen({"sensors.tip_tilt_indetermination": True, **more})
        _, sighted = seen(more)
        assert not blind.lgs[:, :2].any()
        assert np.array_equal(blind.lgs[:, 2:], sighted.lgs[:, 2:]) and blind.lgs[1:, 2:].all()
        assert np.array_equal(blind.ngs, sighted.ngs, equal_nan=True) and d.turbulence[:, :2].all()


@pytest.mark.parametrize("source", ["ar2", "frozen-flow"])
def test_higher_modes_leave_tip_and_tilt_alone(source: str) -> None:
    noisy = {"sensors.lgs_noise": 0.02, "sensors.ngs_noise": 0.01, "turbulence.source": source}
    (few, seen_few), (many, seen_many) = seen(noisy), seen(noisy | {"telescope.radial_order": 3})
    assert many.turbulence.shape == (2000, 9)
    assert np.allclose(many.turbulence[:, :2], few.turbulence, atol=1e-12)
    assert np.allclose(seen_many.lgs[:, :2], seen_few.lgs, atol=1e-12)
    assert np.allclose(seen_many.ngs[:, :2], seen_few.ngs, atol=1e-12, equal_nan=True)


CHANGES: dict[str, Any] = {
    "sensors.lgs_count": 5,
    "sensors.lgs_radius": 30.0,
    "sensors.ngs_direction": [10.0, 0.0],
    "sensors.lgs_noise": 0.3,
    "vibration.source": "peaks",
    "loop.gain": 0.1,
    "sensors.lgs_altitude": 85_000.0,
    "turbulence.rms": 2.0,
}


@pytest.mark.parametrize("path", CHANGES)
def test_the_truth_stays_when_something_else_changes(path: str) -> None:
    assert np.array_equal(seen({path: CHANGES[path]})[0].turbulence, seen({})[0].turbulence)


def test_turbulence_from_a_table() -> None:
    """A density of 1e-3 um^2/Hz up to 50 Hz on tip: 0.05 um^2, all of it below, nothing on tilt or beyond."""
    table = {"frequency": [0.0, 50.0], "tip": [1e-3, 1e-3], "tilt": [0.0, 0.0]}
    s = scenario({"turbulence.source": "psd", "turbulence.psd": table, "telescope.radial_order": 2})
    s.validate()
    x = make_disturbance(s, s.n_steps, np.random.default_rng(1)).turbulence
    # A Gaussian process of 50 Hz has 100 independent values a second: five standard deviations of their mean square
    assert np.var(x[:, 0]) == pytest.approx(0.05, rel=5 * np.sqrt(2 / (100 * s.run.duration))) and not x[:, 1:].any()
    assert turbulence_rms(s, 0) == pytest.approx(np.sqrt(0.05), rel=1e-4) and turbulence_rms(s, 3) == 0.0
    power = np.abs(np.fft.rfft(x[:, 0] * np.hanning(len(x)))) ** 2  # a piece of a longer record, whose ends do not meet
    # Lines w = 6 mHz wide have tails: w / (2 pi) times the mean of 1 / (60 - f) over 0 to 50 Hz, 4e-5
    assert power[np.fft.rfftfreq(len(x), s.dt) > 60.0].sum() < 1e-4 * power.sum()
