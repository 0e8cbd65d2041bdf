"""The scenario's sensors: what they see, their noise, and that the filters know of it."""

from __future__ import annotations

import numpy as np
import pytest

from wfsobs import simulate
from wfsobs.priors_from.scenario import measurement_noise
from wfsobs.progress import QUIET
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.sensors.zernike import ZernikeProjection
from wfsobs.settings.values import SettingError
from wfsobs.simulation.disturbance import SOURCES
from wfsobs.simulation.sensor_noise import aliasing_rms, noise_covariance, noise_rms, sensor, shack_hartmann

SHORT = {"run.duration": 0.4, "run.warm_up": 0.1, "gpr_offline.training_size": 2, "gpr_offline.depth": 2}


def scenario(changes: dict | None = None) -> Scenario:
    return PRESETS["paper"]().replace({**SHORT, "turbulence.source": "frozen-flow", **(changes or {})})


def test_kinds() -> None:
    assert isinstance(sensor(scenario({"sensors.kind": "zernike"}), "lgs"), ZernikeProjection)
    s = scenario({"sensors.lenslets.ngs_subapertures": 2, "sensors.lenslets.obscuration": 0.14})
    assert shack_hartmann(s, "lgs").lenslets.across == 40 and shack_hartmann(s, "ngs").lenslets.across == 2
    assert (shack_hartmann(s, "lgs").order, shack_hartmann(s, "ngs").order) == (8, 2)
    assert sensor(s, "lgs") is sensor(s.replace({"run.seed": 7}), "lgs")


def test_modes_made_one_by_one_are_seen_as_they_are() -> None:
    records = [simulate(scenario({"turbulence.source": "ar2", "sensors.kind": kind})) for kind in ("shack-hartmann", "zernike")]
    assert np.array_equal(records[0].y_lgs, records[1].y_lgs)


@pytest.mark.slow
def test_the_truth_is_nearly_the_same_whatever_looks_at_it() -> None:
    """Waves that only a Shack-Hartmann sensor asks for differ: 2e-3 of the variance of order 6, 1e-6 of tip's."""
    truth = [simulate(scenario({"sensors.kind": kind})).turbulence for kind in ("shack-hartmann", "zernike")]
    assert truth[0] is not None and truth[1] is not None
    assert np.sqrt(np.mean((truth[0] - truth[1]) ** 2)) < 3e-3 * 0.529


@pytest.mark.slow
def test_coarse_ngs_measures_the_mean_gradient() -> None:
    """NGS of 2 x 2 less truth on the axis: 166 nm of rms to 40 % in eight seeds of two axes, each but one draw."""
    s = scenario({"sensors.lenslets.ngs_subapertures": 2, "sensors.lenslets.lgs_subapertures": 2})
    off = []
    for seed in range(8):
        on_axis, ngs, _ = SOURCES["frozen-flow"](s, 10, np.random.default_rng(seed), QUIET)
        assert ngs is not None
        off.append((ngs - on_axis)[5])
    assert 1e3 * aliasing_rms(s, "ngs") == pytest.approx(165.7, abs=1.0)
    assert 1e3 * np.sqrt(np.mean(np.square(off))) == pytest.approx(165.7, rel=0.4)


def test_aliasing_needs_layers_and_lenslets() -> None:
    for changes in ({"sensors.kind": "zernike"}, {"turbulence.source": "ar2"}):
        assert (aliasing_rms(scenario(changes), "lgs") == 0.0).all()
    whole, halves = scenario(), scenario({"turbulence.layers.0.fraction": 3.0})
    assert aliasing_rms(whole, "lgs") == pytest.approx(aliasing_rms(halves, "lgs"))
    assert (aliasing_rms(whole, "lgs") < aliasing_rms(whole, "ngs")).all()  # the cone is narrower, and passes less


@pytest.mark.parametrize(
    "changes",
    [
        {"sensors.lgs_noise": 0.03, "sensors.ngs_noise": 0.05},
        {"sensors.noise_from": "photons", "sensors.spots.read_noise": 2.0, "sensors.spots.ngs_photons": 30.0},
    ],
)
def test_noise_of_a_record_is_what_the_filters_reckon_with(changes: dict) -> None:
    """Nothing but noise, 8 s of 1 kHz: covariances of the LGS' mean to 5 %, of 1600 NGS frames to 12 %."""
    s = scenario(
        {
            **changes,
            "turbulence.source": "none",
            "vibration.source": "none",
            "loop.closed": False,
            "run.duration": 8.0,
            "sensors.lgs_low_frequency_rms": 0.0,
            "telescope.radial_order": 3,
            "sensors.lenslets.ngs_subapertures": 5,
        }
    )
    record = simulate(s)
    assert record.y_ngs is not None
    seen = {"lgs": record.y_lgs[1:] * np.sqrt(s.sensors.lgs_count), "ngs": record.y_ngs[5::5]}
    for kind, tolerance in (("lgs", 0.05), ("ngs", 0.12)):
        wanted = noise_covariance(s, kind)  # type: ignore[arg-type]
        size = noise_rms(s, kind)  # type: ignore[arg-type]
        assert np.abs((np.cov(seen[kind], rowvar=False) - wanted) / np.outer(size, size)).max() < tolerance
    for mode in (0, 2, 6):
        lgs, ngs = measurement_noise(s, mode)
        assert lgs == pytest.approx(noise_rms(s, "lgs")[mode] / np.sqrt(2)) and ngs == pytest.approx(noise_rms(s, "ngs")[mode])


def test_more_light_less_noise() -> None:
    photons = {"sensors.noise_from": "photons", "sensors.spots.read_noise": 0.0}
    few, many = (scenario({**photons, "sensors.spots.lgs_photons": n}) for n in (25.0, 100.0))
    assert noise_rms(few, "lgs") == pytest.approx(2 * noise_rms(many, "lgs"))
    assert noise_rms(few, "ngs") == pytest.approx(noise_rms(many, "ngs"))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"sensors.lenslets.ngs_subapertures": 2, "telescope.radial_order": 3},
            "sensors.lenslets.ngs_subapertures = 2: .* up to radial order 2, fewer than telescope.radial_order = 3",
        ),
        ({"sensors.lenslets.fitted_order": 1, "telescope.radial_order": 2}, "fitted_order = 1 .* radial order 1"),
        (
            {"sensors.lenslets.lgs_subapertures": 2, "sensors.lenslets.illumination": 0.9},
            "sensors.lenslets.lgs_subapertures = 2: no subaperture of 2 x 2 is lit to 0.9",
        ),
    ],
)
def test_settings_that_do_not_go_together(changes: dict, told: str) -> None:
    with pytest.raises(SettingError, match=told) as error:
        scenario(changes).validate()
    assert "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize("obscuration", [0.0, 0.3, 0.5])
def test_every_number_of_subapertures_has_a_fit(obscuration: float) -> None:
    for across in (1, 2, 3, 4, 5, 6, 7, 8, 9, 13, 50):
        changes = {"sensors.lenslets.ngs_subapertures": across, "sensors.lenslets.obscuration": obscuration}
        found = shack_hartmann(scenario(changes), "ngs")
        assert 1 <= found.order <= min(across, 8)
        tip = found.lenslets.slopes(lambda x, y: 2 * x / 4 + 0 * y)
        assert found.reconstructor @ tip == pytest.approx([1.0, 0.0], abs=1e-10)
