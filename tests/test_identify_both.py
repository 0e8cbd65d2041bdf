"""Identification from both sensors: the noise of the NGS and what the LGS alone see, and the filters that are told of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.records import recorded
from wfsobs import PRESETS, observe
from wfsobs.identification import Identification, identify
from wfsobs.identification.process import Number
from wfsobs.identification.result import FEWEST, read_difference, sensor_differences, without_error
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.signal.autoregressive import Ar2

SCENARIO = PRESETS["paper"]().replace({"run.duration": 20.0})
NOISE, ERROR = 0.010, 0.049 / np.sqrt(2.0)
"""Of an NGS frame, and of the mean of two LGS [um]."""
SURE = 4.0
"""Standard deviations that a number may be from the truth: beyond them once in 16 000."""


def of_seed(seed: int) -> Record:
    return recorded(SCENARIO.replace({"run.seed": seed}))


def without(record: Record, share: float) -> Record:
    """The record without this share of its LGS frames and of its NGS frames."""
    rng = np.random.default_rng(3)
    gone, gone_ngs = (rng.random((record.n_steps, 1)) < share for _ in range(2))
    assert record.y_ngs is not None
    return replace(record, y_lgs=np.where(gone, np.nan, record.y_lgs), y_ngs=np.where(gone_ngs, np.nan, record.y_ngs))


@pytest.fixture(scope="module")
def found() -> Identification:
    return identify(of_seed(5))


def assert_near(number: Number, truth: float, unsure: float) -> None:
    """Within SURE of what it says it is sure of, which is this much of the truth: a deviation of any size would hold else."""
    assert abs(number.value - truth) < SURE * number.std
    assert number.std == pytest.approx(unsure * truth, rel=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.05])
def test_the_numbers_are_those_of_the_simulation(found: Identification, share: float) -> None:
    """Noise of m frames is known to 1 / sqrt(2 m); the slow error to half of that of as many periods of its corner, 1.1 Hz."""
    result = found if share == 0.0 else identify(without(of_seed(5), share))
    for mode in result.modes:
        assert mode.difference is not None and mode.difference.error is not None
        # both noises have part in the difference, of which the NGS has 100 of 140 nm^2; a missing sample takes its frame with it
        frames = SCENARIO.run.duration * 200.0 * (1.0 - share) ** 6
        assert_near(mode.difference.noise, NOISE, 1.4 / np.sqrt(2.0 * frames))
        assert_near(mode.difference.error.rms, ERROR, 0.5 / np.sqrt(SCENARIO.run.duration * 1.1))


@pytest.mark.parametrize("ratio", [2, 5, 20])
@pytest.mark.parametrize("noise", [0.002, 0.02])
def test_of_a_difference_that_is_known(ratio: int, noise: float) -> None:
    rng, dt, n = np.random.default_rng(1), 1e-3, 8000
    slow = Ar2(2 * np.pi * 0.8, 0.9, 0.03, dt * ratio)
    of_lgs = 0.014 / np.sqrt(ratio)
    difference = slow.sample(n, rng) + rng.normal(0.0, np.hypot(noise, of_lgs), n)
    result = read_difference(difference, dt, ratio, Number(0.014, 1e-5))
    least = np.sqrt(0.1) * np.hypot(noise, of_lgs)
    assert abs(result.noise.value - max(noise, least)) < SURE * (
        result.noise.std if np.isfinite(result.noise.std) else 0.5 * least
    )
    assert result.error is not None and abs(result.error.rms.value - 0.03) < SURE * result.error.rms.std
    assert result.process is not None and result.process.dt == dt


@pytest.mark.slow
def test_filters_of_both_sensors_are_near_those_that_are_told_the_truth(found: Identification) -> None:
    """On another record. An identification of the LGS alone takes their slow error for turbulence: 35 nm are then left of it."""
    record, names = of_seed(6), ["multirate-multi", "gp-both"]
    of_lgs = identify(replace(of_seed(5), y_ngs=None, ratio=None))
    told, ours, alone = (errors(record, names, prior) for prior in (None, found, of_lgs))
    for key in told:
        assert 0.9 < ours[key] / told[key] < 1.1, key
        if key[1] == "turbulence":
            assert alone[key] / told[key] > 1.5, key


def errors(record: Record, names: list[str], prior: Identification | None) -> dict[tuple[str, str], float]:
    """(observer, target) -> rms error of both modes [um]."""
    squares: dict[tuple[str, str], list[float]] = {}
    for score in observe(record, SCENARIO, observers=names, prior=prior).scores:
        squares.setdefault((score.observer, score.target), []).append(score.rms**2)
    return {key: float(np.sqrt(np.mean(values))) for key, values in squares.items()}


def test_its_scenario_has_both_and_the_same_variance_of_z(found: Identification) -> None:
    scenario = found.scenario(SCENARIO)
    assert scenario.sensors.ngs_noise == pytest.approx(NOISE, rel=0.1)
    assert scenario.sensors.lgs_low_frequency_rms == pytest.approx(0.049, rel=0.35)
    for mode in found.modes:
        assert mode.lgs_error is not None
        parts = sum(p.rms**2 for p in mode.target.turbulence) + mode.lgs_error.rms**2
        assert parts == pytest.approx(sum(p.rms**2 for p in mode.prior.turbulence), rel=1e-12)


@pytest.mark.slow
def test_without_ngs_or_with_few_frames_nothing_is_said_of_it() -> None:
    record, base = of_seed(5), Scenario().replace({"sensors.ngs_noise": 0.033})
    assert record.ratio is not None
    alone = identify(replace(record, y_ngs=None, ratio=None))
    assert all(mode.difference is None for mode in alone.modes)
    assert alone.scenario(base).sensors.ngs_noise == 0.033 and alone.scenario(base).sensors.lgs_low_frequency_rms == 0.0
    n = (FEWEST - 1) * record.ratio
    assert sensor_differences(Record(record.y_lgs[:n], record.u[:n], record.dt, record.y_ngs[:n], record.ratio)) is None
    assert sensor_differences(without(record, 0.4)) is None


def test_the_difference_is_free_of_the_mirror_and_of_what_both_see() -> None:
    """Of a record without noise and slow error it is zero but for rounding, whatever the loop does."""
    quiet = {"sensors.lgs_noise": 0.0, "sensors.ngs_noise": 0.0, "sensors.lgs_low_frequency_rms": 0.0, "run.duration": 3.0}
    difference = sensor_differences(recorded(SCENARIO.replace(quiet)))
    assert difference is not None and np.abs(difference).max() < 1e-12


def test_what_is_left_of_turbulence_that_is_all_error() -> None:
    one = Ar2(3.0, 0.9, 0.03, 1e-3)
    (left,) = without_error((one,), replace(one, rms=0.1))
    assert left.rms == pytest.approx(0.003) and without_error((one,), None) == (one,) and without_error((), one) == ()
