"""The Shack-Hartmann sensor against sums over its slopes in space, integrals over the spectrum, and simulated spots."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import j1, jv

from wfsobs.atmosphere import Footprint, FrequencyGrid, TurbulenceLayer, View, Wave, frozen_flow, von_karman_density, waves
from wfsobs.sensors import zernike
from wfsobs.sensors.lenslets import Lenslets, interaction, polynomials, reconstructor
from wfsobs.sensors.shack_hartmann import ARCSEC, Aliasing, ShackHartmann, SpotModel, TrigonometricSum, lagrange_weights
from wfsobs.sensors.zernike import ZernikeProjection, up_to_order

pytestmark = pytest.mark.slow

D, R0, L0 = 8.0, 0.157, 25.0
STRENGTH = R0 ** (-5 / 3)
COARSE = Lenslets(D, across=6)

Gradient = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def slopes_in_space(lenslets: Lenslets, gradient: Gradient, points: int = 4) -> np.ndarray:
    """Mean gradients by Gauss-Legendre over every cell, the subapertures one by one."""
    nodes, weights = np.polynomial.legendre.leggauss(points)
    h, c = lenslets.pitch, lenslets.per_side
    offset, weight = 0.5 * h * nodes, 0.5 * weights
    x = lenslets.centres[None, :, None, None] + offset[None, None, None, :]
    y = lenslets.centres[:, None, None, None] + offset[None, None, :, None]
    cells = [np.einsum("yxab,a,b->yx", np.broadcast_arrays(g, x + y)[0], weight, weight) for g in gradient(x, y)]
    out = []
    for g in cells:
        for row in range(lenslets.across):
            for column in range(lenslets.across):
                block = (slice(row * c, (row + 1) * c), slice(column * c, (column + 1) * c))
                if lenslets.lit[block].mean() >= lenslets.illumination:
                    out.append(g[block][lenslets.lit[block]].mean())
    return np.array(out)


def wave_gradient(kx: float, ky: float) -> Gradient:
    return lambda x, y: (1j * kx * np.exp(1j * (kx * x + ky * y)), 1j * ky * np.exp(1j * (kx * x + ky * y)))


# ---------------------------------------------------------------------- geometry


@pytest.mark.parametrize("obscuration", [0.0, 0.14])
@pytest.mark.parametrize("across", [1, 2, 3, 7, 40, 100])
def test_the_lit_area_is_the_pupil_s(across: int, obscuration: float) -> None:
    lenslets = Lenslets(D, across, obscuration=obscuration)
    wanted = np.pi / 4 * (1 - obscuration**2) * D**2
    assert lenslets.fraction.sum() * (D / across) ** 2 == pytest.approx(wanted, rel=3e-3)
    assert (lenslets.fraction == lenslets.fraction.T).all() and (lenslets.fraction == lenslets.fraction[::-1]).all()


def test_valid_subapertures() -> None:
    """Four quarters of a disc are lit to pi / 4; of an array of 40 about pi / 4 of 1600 count."""
    assert Lenslets(D, 2).fraction == pytest.approx(np.full((2, 2), np.pi / 4), rel=2e-3)
    assert Lenslets(D, 40).count == pytest.approx(np.pi / 4 * 1600, rel=0.02)
    assert Lenslets(D, 2, illumination=0.9).count == 0
    assert Lenslets(D, 40, illumination=0.9).count < Lenslets(D, 40).count < Lenslets(D, 40, illumination=0.1).count


def test_spread_is_the_transpose_of_mean() -> None:
    rng = np.random.default_rng(1)
    cells, weights = rng.standard_normal((160, 160)), rng.standard_normal(Lenslets(D, 8).count)
    lenslets = Lenslets(D, 8)
    assert np.sum(lenslets.spread(weights) * cells) == pytest.approx(weights @ lenslets.mean(cells), rel=1e-12)


# ---------------------------------------------------------------------- reconstructor


def test_polynomials_are_orthonormal_and_noll_s() -> None:
    """Over the disc, by a rule that is exact for their degree; and as printed by Noll: 2 x, sqrt(3) (2 r^2 - 1) and so on."""
    r2, w = np.polynomial.legendre.leggauss(12)
    angle = 2 * np.pi * np.arange(24) / 24
    r = np.sqrt(0.5 * (r2 + 1))[:, None]
    z = polynomials(8, r * np.cos(angle), r * np.sin(angle)).reshape(44, -1)
    gram = np.einsum("ip,jp,p->ij", z, z, np.repeat(0.5 * w, 24) / 24)
    assert gram == pytest.approx(np.eye(44), abs=1e-12)
    x, y = np.array([0.3, 1.02]), np.array([-0.5, 0.4])
    s = x**2 + y**2
    printed = [
        2 * x,
        2 * y,
        np.sqrt(3) * (2 * s - 1),
        np.sqrt(6) * 2 * x * y,
        np.sqrt(6) * (x**2 - y**2),
        np.sqrt(8) * (3 * s - 2) * y,
        np.sqrt(8) * (3 * s - 2) * x,
    ]
    assert polynomials(3, x, y)[:7] == pytest.approx(np.array(printed), rel=1e-12)


@pytest.mark.parametrize("across", [2, 6, 40])
def test_interaction_against_gradients_in_space(across: int) -> None:
    """Tip, defocus and coma from their printed gradients: exact, for the rule on a cell's edges is, up to cubics."""
    lenslets, a = Lenslets(D, across), D / 2
    printed: dict[int, Gradient] = {
        2: lambda x, y: (2 / a + 0 * x, 0 * y),
        4: lambda x, y: (np.sqrt(3) * 4 * x / a**2, np.sqrt(3) * 4 * y / a**2),
        8: lambda x, y: (np.sqrt(8) * ((9 * x**2 + 3 * y**2) / a**3 - 2 / a), np.sqrt(8) * 6 * x * y / a**3),
    }
    found = interaction(lenslets, 3)
    for j, gradient in printed.items():
        assert found[:, j - 2] == pytest.approx(slopes_in_space(lenslets, gradient), abs=1e-12)


@pytest.mark.parametrize(("across", "order"), [(1, 1), (2, 2), (3, 3), (5, 5), (8, 8), (40, 8)])
def test_fitted_modes_do_not_leak_into_each_other(across: int, order: int) -> None:
    lenslets = Lenslets(D, across)
    fitted = reconstructor(lenslets, order) @ interaction(lenslets, order)
    assert fitted == pytest.approx(np.eye(len(up_to_order(order))), abs=1e-10)


def test_tip_through_the_sensor() -> None:
    """100 nm of Noll's tip are 10.3133 mas on 8 m: 4 a / D, on every subaperture and out of the reconstructor."""
    lenslets = Lenslets(D, 40)
    slopes = lenslets.slopes(lambda x, y: 0.1 * 2 * x / (D / 2) + 0 * y)  # [um/m]
    angle = 1e-6 * slopes / ARCSEC * 1e3  # [mas]
    assert angle[: lenslets.count] == pytest.approx(10.3133, rel=1e-5)
    assert angle[lenslets.count :] == pytest.approx(0.0, abs=1e-9)
    modes = ShackHartmann(lenslets, up_to_order(3), 8).reconstructor @ slopes
    assert modes[0] * 4e-6 / D / ARCSEC * 1e3 == pytest.approx(10.3133, rel=1e-5)
    assert modes[1:] == pytest.approx(0.0, abs=1e-10)


@pytest.mark.parametrize(
    ("across", "order", "illumination", "told"),
    [
        (2, 3, 0.5, "hardly tell|cannot tell"),
        (1, 2, 0.5, "1 subapertures cannot tell the 5 modes"),
        (4, 5, 0.5, "condition"),
        (2, 1, 0.9, "no subaperture of 2 x 2 is lit to 0.9"),
    ],
)
def test_slopes_that_do_not_determine_the_modes(across: int, order: int, illumination: float, told: str) -> None:
    with pytest.raises(ValueError, match=told) as error:
        reconstructor(Lenslets(D, across, illumination), order)
    assert "\n" not in str(error.value)


# ---------------------------------------------------------------------- transforms


def test_trigonometric_sums() -> None:
    """Against the sums themselves, far beyond one period."""
    rng = np.random.default_rng(2)
    weights, p = rng.standard_normal((3, 14, 14)), np.arange(14) - 6.5
    x, y = rng.uniform(-20, 20, (2, 5, 30))
    wanted = np.einsum("mqp,abp,abq->mab", weights, np.exp(1j * x[..., None] * p), np.exp(1j * y[..., None] * p))
    assert np.abs(TrigonometricSum(weights)(x, y) - wanted).max() < 3e-5 * np.abs(weights).sum(axis=(1, 2)).max()


def test_interpolation_is_exact_for_polynomials() -> None:
    t = np.linspace(0, 1, 7)
    for degree in range(8):
        assert lagrange_weights(t, 8).T @ (np.arange(-3, 5.0) ** degree) == pytest.approx(t**degree, abs=1e-10)


@pytest.mark.parametrize("lenslets", [COARSE, Lenslets(6.5, 5, obscuration=0.3)])
def test_transform_against_slopes_in_space(lenslets: Lenslets) -> None:
    sensor = ShackHartmann(lenslets, up_to_order(3), 4)
    for kx, ky in [(1e-3, 2e-3), (0.4, -0.3), (-3.0, 7.0), (0.0, 11.0), (31.4, -31.4), (70.0, 5.0)]:
        wanted = sensor.reconstructor @ slopes_in_space(lenslets, wave_gradient(kx, ky))
        found = sensor.transform(np.array([kx]), np.array([ky]))[:, 0]
        assert np.abs(found - wanted).max() < 5e-5 * max(1.0, np.hypot(kx, ky) / 10)


@pytest.mark.parametrize("footprint", [Footprint(), Footprint(0.9, (1.5, -0.4)), Footprint(0.3, (0.0, 20.0))])
@pytest.mark.parametrize("angle", [0.0, 0.7, 4.0])
@pytest.mark.parametrize("columns", [5, 400])
def test_measure_against_plane_waves_on_the_layer(columns: int, angle: float, footprint: Footprint) -> None:
    """A few waves on the layer, in its frame along the wind, seen at scale r + shift; alone, and where k_x is so dense that
    the sensor interpolates."""
    rng = np.random.default_rng(3)
    kx = np.sort(rng.uniform(0.01, 12.0, columns))
    ky = np.array([-9.0, -0.5, 0.5, 9.0])
    amplitude = rng.standard_normal((4, columns)) + 1j * rng.standard_normal((4, columns))
    sensor = ShackHartmann(COARSE, up_to_order(2), 4)
    found = sensor.measure(Wave(kx, ky, angle, amplitude), footprint)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for column in (0, columns - 2):
        wanted = np.zeros(5, complex)
        for row, across in enumerate(ky):
            k = turn @ [kx[column], across]
            slopes = slopes_in_space(COARSE, wave_gradient(*(footprint.scale * k)), 2)
            wanted += amplitude[row, column] * np.exp(1j * k @ footprint.shift) * (sensor.reconstructor @ slopes)
        assert np.abs(found[:, column] - wanted).max() < 2e-3


def test_beams_of_one_scale_share_what_they_share() -> None:
    """The transform kept from the last beam serves no other scale and no other wave."""
    rng = np.random.default_rng(4)
    kx, ky = np.linspace(0.02, 9.0, 300), np.linspace(-5.0, 5.0, 12)
    first, second = (Wave(kx, ky, angle, rng.standard_normal((12, 300)) + 0j) for angle in (0.0, 1.0))
    beams = [(first, Footprint(0.9)), (first, Footprint(0.9, (1.0, 2.0))), (first, Footprint()), (second, Footprint())]
    sensor = ShackHartmann(COARSE, (2, 3), 4)
    for beam in beams:
        assert np.array_equal(sensor.measure(*beam), ShackHartmann(COARSE, (2, 3), 4).measure(*beam))


# ---------------------------------------------------------------------- aliasing


def test_mean_gradient_is_166_nm_away_from_the_tip() -> None:
    """Of 529 nm: by integration over k, the mean gradient of the disc as 2 J1(x) times half the cosine."""

    def integral(weight: Callable[[float], Any]) -> float:
        def integrand(log_k: float) -> float:
            k = np.exp(log_k)
            return np.pi * k**2 * weight(k * D / 2) * float(von_karman_density(np.array(k**2), STRENGTH, L0))

        return 1e3 * math.sqrt(quad(integrand, np.log(1e-4), np.log(500.0), limit=3000)[0])

    assert integral(lambda x: (4 * jv(2, x) / x) ** 2) == pytest.approx(529.3, abs=0.5)
    wanted = integral(lambda x: (j1(x) - 4 * jv(2, x) / x) ** 2)
    assert wanted == pytest.approx(166.0, abs=1.0)
    for across in (1, 2):  # together the quarters see the whole disc; two numbers each of gradient tell tip from no coma
        error = Aliasing(ShackHartmann(Lenslets(D, across), (2, 3), across)).covariance(STRENGTH, L0)
        assert 1e3 * np.sqrt(np.diag(error)) == pytest.approx(wanted, rel=5e-3)
    alone = Aliasing(ShackHartmann(Lenslets(D, 40), (2, 3), 1)).covariance(STRENGTH, L0)
    assert 1e3 * np.sqrt(np.diag(alone)) == pytest.approx(wanted, rel=0.03)  # the lenslets on the edge weigh more than they see
    many = Aliasing(ShackHartmann(Lenslets(D, 40), (2, 3), 8)).covariance(STRENGTH, L0)
    assert (1e3 * np.sqrt(np.diag(many)) < 3.0).all()


def test_aliasing_against_another_quadrature() -> None:
    """A square grid in k in place of rings, for a beam narrowed to 0.8, tip to vertical astigmatism."""
    sensor = ShackHartmann(Lenslets(D, 8), (2, 4, 6), 8)
    step, scale = 0.15, 0.8
    k = (np.arange(-400, 400) + 0.5) * step
    kx, ky = k[None, 400:], k[:, None]
    wrong = sensor.transform(*np.broadcast_arrays(scale * kx, scale * ky))
    wrong -= [zernike.transform(j, scale * kx * D / 2, scale * ky * D / 2) for j in sensor.nolls]
    wanted = np.einsum("iyx,jyx,yx->ij", wrong, wrong.conj(), 2 * step**2 * von_karman_density(kx**2 + ky**2, STRENGTH, L0)).real
    assert Aliasing(sensor).covariance(STRENGTH, L0, scale) == pytest.approx(wanted, rel=0.01, abs=1e-6)


class Ones:
    """A generator whose every draw is one, so that an amplitude is its own standard deviation times 1 + i."""

    def spawn(self, n: int) -> list[Ones]:
        return [self] * n

    def standard_normal(self, shape: Any) -> np.ndarray:
        return np.ones(shape)


@pytest.mark.parametrize("across", [10, 40])
def test_frozen_flow_holds_the_waves_that_alias(across: int) -> None:
    """The variance of the error summed over the waves that the flow makes for this sensor, in a wind aslant, to 3 %."""
    sensor, ideal = ShackHartmann(Lenslets(D, across), (2, 3), 8), ZernikeProjection(D, (2, 3))
    beam, layer = Footprint(0.94), TurbulenceLayer(STRENGTH, 5000.0, 15.0, 0.5)
    grid, total = FrequencyGrid.of(layer, L0, D, 20, 0.05), np.zeros(2)
    for _, wave in waves(grid, layer, L0, D, Ones(), sensor.reach / beam.scale):  # type: ignore[arg-type]
        kx, ky = wave.in_pupil()
        wrong = sensor.transform(beam.scale * kx, beam.scale * ky) - ideal.transform(kx, ky, beam)
        total += np.einsum("jyx,yx->j", np.abs(wrong) ** 2, np.real(wave.amplitude) ** 2)
    assert total == pytest.approx(np.diag(Aliasing(sensor).covariance(STRENGTH, L0, 0.94)), rel=0.03)


def test_cone_effect_through_the_sensor() -> None:
    """NGS less LGS on the axis, one layer at 8 km: 49.4 nm in tip and in tilt, to 1 %, as of the ideal projection."""
    sensor, layer = ShackHartmann(Lenslets(D, 40), (2, 3), 8), TurbulenceLayer(STRENGTH, 8000.0, 15.0, 1.0)
    total = np.zeros(2)
    for _, wave in waves(FrequencyGrid.of(layer, L0, D, 20, 0.05), layer, L0, D, Ones(), sensor.reach):  # type: ignore[arg-type]
        kx, ky = wave.in_pupil()
        cone = 1.0 - 8.0 / 90.0
        apart = sensor.transform(kx, ky) - sensor.transform(cone * kx, cone * ky)
        total += np.einsum("jyx,yx->j", np.abs(apart) ** 2, np.real(wave.amplitude) ** 2)
    assert 1e3 * np.sqrt(total) == pytest.approx(49.4, rel=0.01)


def test_sensor_and_projection_see_the_same_turbulence() -> None:
    """They differ by the aliasing and no more, in a record of ten frames of a millisecond: between 0.4 and 2 of its rms."""
    sensor, ideal = ShackHartmann(Lenslets(D, 40), (2, 3), 8), ZernikeProjection(D, (2, 3))
    layers, beam = [TurbulenceLayer(STRENGTH, 5000.0, 15.0, 0.5)], (Footprint(0.94),)
    runs = [
        frozen_flow(layers, L0, D, [View(sensor, beam), View(ideal, beam)], 10, 1e-3, np.random.default_rng(seed))
        for seed in range(5)
    ]
    off = np.sqrt(np.mean([(seen - true) ** 2 for seen, true in runs]))
    wanted = np.sqrt(Aliasing(sensor).covariance(STRENGTH, L0, 0.94)[0, 0])
    assert 0.4 * wanted < off < 2 * wanted


# ---------------------------------------------------------------------- noise


@pytest.mark.parametrize(
    "spots",
    [
        SpotModel(photons=200.0, read_noise=0.0, fwhm=1.5, pixel_scale=0.6, pixels=12),
        SpotModel(photons=200.0, read_noise=3.0, fwhm=1.5, pixel_scale=0.6, pixels=8),
    ],
)
def test_slope_noise_against_simulated_spots(spots: SpotModel) -> None:
    """4000 spots, photon by photon, on a noisy detector: 4 % is two standard errors of a variance; the mean is taken with
    the number of photons known, as the formula does."""
    rng = np.random.default_rng(5)
    sigma = spots.fwhm / np.sqrt(8 * np.log(2))
    edges = (np.arange(spots.pixels + 1) - spots.pixels / 2) * spots.pixel_scale
    centres = 0.5 * (edges[1:] + edges[:-1])
    found = []
    for _ in range(4000):
        place = rng.normal(0.0, sigma, rng.poisson(spots.photons))
        noise = spots.read_noise * rng.standard_normal((spots.pixels, spots.pixels)).sum(axis=0)
        found.append(place.sum() / spots.photons + centres @ noise / spots.photons)
    wanted = spots.slope_variance(np.ones(1))[0] / (1e6 * ARCSEC) ** 2
    assert np.var(found) == pytest.approx(wanted, rel=0.08)


def test_half_the_light_doubles_the_photon_noise() -> None:
    photon, read = SpotModel(100.0, 0.0, 1.0, 0.5, 6), SpotModel(100.0, 3.0, 1e-9, 0.5, 6)
    lit = np.array([1.0, 0.5])
    assert photon.slope_variance(lit)[1] == pytest.approx(2 * photon.slope_variance(lit)[0])
    assert read.slope_variance(lit)[1] == pytest.approx(4 * read.slope_variance(lit)[0])


def test_noise_of_the_modes() -> None:
    """The covariance of what the reconstructor makes of 20 000 draws of noisy slopes, to 5 % of the variances."""
    sensor, spots = ShackHartmann(COARSE, (2, 3, 4, 8), 4), SpotModel(50.0, 1.0, 1.0, 0.8, 6)
    std = np.sqrt(spots.slope_variance(COARSE.fraction[COARSE.valid]))
    draws = np.random.default_rng(6).standard_normal((20_000, 2 * COARSE.count)) * np.tile(std, 2)
    found, covariance = np.cov(draws @ sensor.reconstructor.T, rowvar=False), sensor.noise_covariance(spots)
    size = np.sqrt(np.diag(covariance))
    assert np.abs((found - covariance) / np.outer(size, size)).max() < 0.05
    assert abs(covariance[0, 3]) > 0.1 * size[0] * size[3]  # tip and coma share their slopes
