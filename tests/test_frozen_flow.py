"""Frozen flow: its covariances against integrals of the spectrum, its samples against both."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.signal import welch
from scipy.special import j0, jv

from tests.noll import noll_covariance
from wfsobs.atmosphere import Footprint, FrequencyGrid, TurbulenceLayer, View, fft_length, frozen_flow, von_karman_density, waves
from wfsobs.sensors.zernike import ZernikeProjection, bessel_ratio, noll

D, R0, L0 = 8.0, 0.157, 25.0
STRENGTH = R0 ** (-5 / 3)
TIP_TILT = ZernikeProjection(D, (2, 3))
NGS = Footprint()


def lgs(height: float, altitude: float = 90e3) -> Footprint:
    return Footprint(1.0 - height / altitude)


class Ones:
    """A generator whose every draw is one, so that an amplitude is its own standard deviation times 1 + i."""

    def spawn(self, n: int) -> list[Ones]:
        return [self] * n

    def standard_normal(self, shape: Any) -> np.ndarray:
        return np.ones(shape)


def covariance(
    layer: TurbulenceLayer,
    outer_scale: float,
    sensor: ZernikeProjection,
    footprints: list[Footprint],
    n_steps: int,
    dt: float,
    lag: float = 0.0,
) -> np.ndarray:
    """Covariance [um^2] of every output of every footprint at `lag` [s], as the sums over the waves have it."""
    grid = FrequencyGrid.of(layer, outer_scale, sensor.diameter, n_steps, dt)
    total = 0.0
    for part, wave in waves(grid, layer, outer_scale, sensor.diameter, Ones()):  # type: ignore[arg-type]
        m = np.concatenate([sensor.transform(*wave.in_pupil(), f) for f in footprints])
        seen = np.einsum("ayx,yx,byx->abx", m, wave.amplitude.real**2, m.conj())
        total = total + (seen * np.exp(2j * np.pi * grid.f[part] * lag)).sum(axis=-1).real
    return np.asarray(total)


def along_log_k(density: Any, strength: float, outer_scale: float) -> float:
    """integral of Phi(k) density(k) k dk [um^2]: the trapezoidal rule in log k, 4000 points over eight decades."""
    k = np.exp(np.linspace(np.log(1e-5), np.log(1e3), 4000))
    return float(np.trapezoid(von_karman_density(k**2, strength, outer_scale) * density(k) * k**2, np.log(k)))


def tip_of(k: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """|M| of tip without the cosine of the angle."""
    x = 0.5 * D * scale * k
    return 4.0 * jv(2, x) / x


# ---------------------------------------------------------------------- covariances, exact


@pytest.mark.slow
@pytest.mark.parametrize("duration", [0.05, 3.0])
@pytest.mark.parametrize("speed", [0.1, 15.0, 90.0])
@pytest.mark.parametrize("outer_scale", [2.0, 25.0, 3000.0])
def test_variance_of_tip_and_tilt(outer_scale: float, speed: float, duration: float) -> None:
    """Whatever the wind, the outer scale and the record: pi integral Phi |M|^2 k dk, to 0.1 %."""
    layer = TurbulenceLayer(STRENGTH, 8000.0, speed, 0.4)
    found = covariance(layer, outer_scale, TIP_TILT, [NGS], round(duration * 250), 0.004)
    wanted = np.pi * along_log_k(lambda k: tip_of(k) ** 2, STRENGTH, outer_scale)
    assert np.diag(found) == pytest.approx(wanted, rel=1e-3)
    assert abs(found[0, 1]) < 1e-4 * wanted


def test_the_size_that_everyone_quotes() -> None:
    found = covariance(TurbulenceLayer(STRENGTH, 0.0, 15.0, 0.0), L0, TIP_TILT, [NGS], 1000, 1e-3)
    assert 1e3 * np.sqrt(np.diag(found)) == pytest.approx(529.3, abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("outer_scale", "speed", "duration"), [(25.0, 15.0, 4.0), (25.0, 2.0, 1.0), (1000.0, 15.0, 4.0), (5.0, 40.0, 2.0)]
)
@pytest.mark.parametrize("fraction", [0.01, 0.2, 0.6, 1.0])
def test_autocovariance_along_and_across_the_wind(outer_scale: float, speed: float, duration: float, fraction: float) -> None:
    """At lags up to the whole record: pi integral Phi |M|^2 (J0 -+ J2)(k v tau) k dk, to 1e-3 of the variance."""
    layer = TurbulenceLayer(STRENGTH, 8000.0, speed, 0.0)
    lag = fraction * duration
    found = covariance(layer, outer_scale, TIP_TILT, [NGS], round(duration * 250), 0.004, lag)
    variance = np.pi * along_log_k(lambda k: tip_of(k) ** 2, STRENGTH, outer_scale)
    for i, sign in ((0, -1.0), (1, 1.0)):
        wanted = np.pi * along_log_k(
            lambda k, s=sign: tip_of(k) ** 2 * (j0(k * speed * lag) + s * jv(2, k * speed * lag)), STRENGTH, outer_scale
        )
        assert abs(found[i, i] - wanted) < 1e-3 * variance


@pytest.mark.parametrize(("height", "wanted_nm"), [(4e3, 24.5), (8e3, 49.4), (10e3, 62.0), (12e3, 74.6)])
def test_cone_effect(height: float, wanted_nm: float) -> None:
    """NGS - LGS on either axis: the figures of docs/scripts/cone_effect.py, by integration over k alone, to 0.5 %."""
    found = covariance(TurbulenceLayer(STRENGTH, height, 15.0, 1.0), L0, TIP_TILT, [NGS, lgs(height)], 2000, 1e-3)
    difference = found[:2, :2] + found[2:, 2:] - found[:2, 2:] - found[2:, :2]
    assert 1e3 * np.sqrt(np.diag(difference)) == pytest.approx(wanted_nm, rel=5e-3)


@pytest.mark.parametrize("shift", [(0.3, 0.0), (0.0, 4.0), (-5.0, 7.0)])
@pytest.mark.parametrize("angle", [0.0, 1.1])
def test_covariance_of_beams_beside_each_other(shift: tuple[float, float], angle: float) -> None:
    """Tip of two discs at a distance d in the direction b: pi integral Phi |M|^2 (J0 - cos(2 b) J2)(k d) k dk."""
    found = covariance(TurbulenceLayer(STRENGTH, 10e3, 15.0, angle), L0, TIP_TILT, [NGS, Footprint(1.0, shift)], 1000, 1e-3)
    d, b = np.hypot(*shift), np.arctan2(shift[1], shift[0])
    for i, sign in ((0, -1.0), (1, 1.0)):
        wanted = np.pi * along_log_k(
            lambda k, s=sign: tip_of(k) ** 2 * (j0(k * d) + s * np.cos(2 * b) * jv(2, k * d)), STRENGTH, L0
        )
        assert found[i, 2 + i] == pytest.approx(wanted, abs=1e-3 * found[0, 0])


def test_covariances_of_the_first_ten_modes_are_noll_s() -> None:
    """To 1e-3 with an outer scale of 10 000 km, but for tip and tilt: of them it takes 1.42 (D / L0)^(1/3), 1.3 %."""
    modes = tuple(range(2, 12))
    found = covariance(TurbulenceLayer(STRENGTH, 0.0, 15.0, 0.3), 1e7, ZernikeProjection(D, modes), [NGS], 1000, 1e-3)
    unit = (D / R0) ** (5 / 3) * (0.5 / (2 * np.pi)) ** 2
    wanted = unit * np.array([[noll_covariance(j, i) for i in modes] for j in modes])
    wanted[[0, 1], [0, 1]] *= 1.0 - 1.42 * (D / 1e7) ** (1 / 3)
    assert (np.abs(found - wanted) < 1e-3 * np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))).all()


def test_variances_up_to_radial_order_six() -> None:
    for j in (4, 11, 21, 28):
        n = noll(j)[0]
        found = covariance(TurbulenceLayer(STRENGTH, 0.0, 15.0, 0.3), L0, ZernikeProjection(D, (j,)), [NGS], 1000, 1e-3)
        size = along_log_k(lambda k, n=n: (n + 1) * 4 * bessel_ratio(n + 1, 0.5 * D * k) ** 2, STRENGTH, L0)
        assert found[0, 0] == pytest.approx(2 * np.pi * size, rel=2e-3)


# ---------------------------------------------------------------------- samples


def sampled(
    seed: int,
    n_steps: int,
    layers: list[TurbulenceLayer] | None = None,
    views: list[View] | None = None,
    dt: float = 1e-3,
    outer_scale: float = L0,
) -> list[np.ndarray]:
    layers = layers or [TurbulenceLayer(STRENGTH, 8000.0, 15.0, 0.0)]
    views = views or [View(TIP_TILT, tuple(NGS for _ in layers))]
    return frozen_flow(layers, outer_scale, D, views, n_steps, dt, np.random.default_rng(seed))


@pytest.mark.slow
def test_size_and_cone_effect_of_samples_from_the_first_step() -> None:
    """First and last of 500 records of 1 s: 529 nm to 5 %, and NGS - LGS 49.4 nm to 10 %, both without a mean."""
    views = [View(TIP_TILT, (NGS,)), View(TIP_TILT, (lgs(8000.0),))]
    slow = [TurbulenceLayer(STRENGTH, 8000.0, 3.0, 0.0)]
    found = np.array([sampled(seed, 5, slow, views, dt=0.2) for seed in range(500)])  # (seed, view, step, axis)
    for step in (0, -1):
        tip, seen = found[:, 0, step], found[:, 1, step]
        assert 1e3 * np.sqrt(np.mean(tip**2)) == pytest.approx(529.3, rel=0.05)
        assert 1e3 * np.sqrt(np.mean((tip - seen) ** 2)) == pytest.approx(49.4, rel=0.10)
        assert (np.abs(tip.mean(axis=0)) < 4.5 * 0.529 / np.sqrt(500)).all()
        assert abs(np.mean(tip[:, 0] * tip[:, 1])) < 4.5 * 0.529**2 / np.sqrt(500)


@pytest.mark.slow
@pytest.mark.parametrize("height", [8e3, 10e3])
def test_cone_effect_of_samples_on_each_axis(height: float) -> None:
    layers = [TurbulenceLayer(STRENGTH, height, 15.0, 0.0)]
    views = [View(TIP_TILT, (NGS,)), View(TIP_TILT, (lgs(height),))]
    pairs = [sampled(seed, 20, layers, views, dt=0.1) for seed in range(60)]
    rms = 1e3 * np.sqrt(np.mean([(ngs - lgs) ** 2 for ngs, lgs in pairs], axis=(0, 1)))
    assert rms == pytest.approx({8e3: 49.4, 10e3: 62.0}[height], rel=0.10)


@pytest.mark.parametrize(("speed", "band"), [(15.0, (10.0, 200.0)), (5.0, (4.0, 80.0)), (40.0, (20.0, 300.0))])
def test_temporal_slope_beyond_the_knee(speed: float, band: tuple[float, float]) -> None:
    """-17/3 to 0.3 (Conan et al. 1995), up to hundreds of Hz; a window that falls fast keeps the low frequencies out."""
    x = np.concatenate([sampled(seed, 8192, [TurbulenceLayer(STRENGTH, 8000.0, speed, 0.5)])[0] for seed in range(3)], axis=1)
    f, density = welch(x, 1000.0, "blackmanharris", 4096, axis=0)
    use = (f > band[0]) & (f < band[1])
    slope = np.polyfit(np.log(f[use]), np.log(density[use].mean(axis=1)), 1)[0]
    assert slope == pytest.approx(-17 / 3, abs=0.3)


@pytest.mark.slow
def test_a_record_does_not_repeat() -> None:
    """The two ends of a record are as far apart as the structure function says, 1.4 times the rms: an FFT's are not."""
    ends = np.array([sampled(seed, 500, dt=0.02)[0][[0, -1]] for seed in range(60)])
    apart = np.sqrt(np.mean((ends[:, 1] - ends[:, 0]) ** 2)) / np.sqrt(np.mean(ends**2))
    assert apart == pytest.approx(np.sqrt(2.0), rel=0.15)


def test_samples_are_means_over_their_step() -> None:
    """A step of 20 ms holds the mean of twenty of 1 ms: with the same waves, sinc(f T) instead of sinc(f T / 20)."""
    layer = TurbulenceLayer(STRENGTH, 8000.0, 60.0, 0.0)
    assert fft_length(layer, D, 1000, 1e-3) == 1.0 * fft_length(layer, D, 50, 0.02) * 20
    fine, coarse = sampled(5, 1000, [layer])[0], sampled(5, 50, [layer], dt=0.02)[0]
    means = fine.reshape(50, 20, 2).mean(axis=1)
    # a step's number is of its start for both: the coarse one's middle lies 9.5 ms after the fine one's first
    shifted = np.array([np.interp(np.arange(50) * 20 - 9.5, np.arange(50) * 20, means[:, i]) for i in range(2)]).T
    assert np.sqrt(np.mean((coarse - shifted)[2:-2] ** 2)) < 0.1 * np.std(fine)


@pytest.mark.parametrize("angle", [0.0, 1.1, -2.0])
def test_what_is_downwind_sees_the_same_later(angle: float) -> None:
    """A beam 0.9 m towards where the wind of 15 m/s blows is 60 ms behind, to rounding; across the wind it is another signal."""
    layer, steps = TurbulenceLayer(STRENGTH, 8000.0, 15.0, angle), 60
    along = (0.9 * np.cos(angle), 0.9 * np.sin(angle))
    views = [View(TIP_TILT, (Footprint(1.0, shift),)) for shift in ((0.0, 0.0), along, (-along[1], along[0]))]
    here, downwind, beside = sampled(6, 1000, [layer], views)
    assert np.abs(downwind[steps:] - here[:-steps]).max() < 1e-9
    assert np.abs(beside[steps:] - here[:-steps]).max() > 0.01


# ---------------------------------------------------------------------- random streams


def test_same_seed_same_numbers() -> None:
    assert np.array_equal(sampled(3, 500), sampled(3, 500))
    assert not np.allclose(sampled(3, 500), sampled(4, 500))


def test_layers_add_up_and_keep_their_numbers() -> None:
    near, far = TurbulenceLayer(0.7 * STRENGTH, 100.0, 8.0, 0.2), TurbulenceLayer(0.3 * STRENGTH, 9000.0, 25.0, 2.0)
    both = sampled(1, 800, [near, far])[0]
    silent = TurbulenceLayer(0.0, 9000.0, 25.0, 2.0)
    only_near = sampled(1, 800, [near, silent])[0]
    assert np.array_equal(only_near, sampled(1, 800, [near])[0])
    faster = sampled(1, 800, [near, TurbulenceLayer(0.3 * STRENGTH, 9000.0, 30.0, 2.0)])[0]
    only_far = both - only_near
    assert only_far.std() > 0.05 and not np.allclose(faster, both)
    stronger = sampled(1, 800, [near, TurbulenceLayer(1.2 * STRENGTH, 9000.0, 25.0, 2.0)])[0]
    assert np.allclose(stronger - only_near, 2.0 * only_far, atol=1e-12)


def test_sensors_leave_each_other_alone() -> None:
    """What one sees does not depend on who else looks, nor on where they look."""
    alone = sampled(2, 600)[0]
    more = ZernikeProjection(D, (2, 3, 11))
    others = [View(TIP_TILT, (NGS,)), View(TIP_TILT, (Footprint(0.9, (6.0, 2.0)),)), View(more, (NGS,))]
    seen = sampled(2, 600, views=others)
    assert np.array_equal(seen[0], alone) and np.allclose(seen[2][:, :2], alone, atol=1e-12)
    assert np.corrcoef(seen[1][:, 0], alone[:, 0])[0, 1] < 0.999
