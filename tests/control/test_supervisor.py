"""A supervised controller: nothing lost while all is well, an integrator where it is not, and back without a bump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import gamma

import wfsobs
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.step import KalmanLaws
from wfsobs.control.supervisor import STRICT, WINDOW, SupervisedController, Supervision, _Level
from wfsobs.observers.step import StepError
from wfsobs.typing import Array

STEPWISE = [name for name, c in CONTROLLERS.items() if c.law is not None and (c.predict is None or c.step_predict is not None)]
SCENARIO = wfsobs.PRESETS["paper"]().replace(
    {"run.duration": 3.0, "run.warm_up": 0.5, "gpr_online.training_size": 40, "gpr_offline.training_size": 40}
)
PLAN = Supervision(calm=300)


@pytest.fixture(scope="module")
def record() -> wfsobs.Record:
    return wfsobs.simulate(SCENARIO)


def close(
    controller: SupervisedController, record: wfsobs.Record, gain: float = 1.0, when: slice = slice(0)
) -> tuple[Array, Array]:
    """Return true residual and commands (n_steps, n_modes) of a loop whose mirror has another gain for a while."""
    assert record.turbulence is not None and record.vibration is not None
    disturbance, n = record.turbulence + record.vibration, record.ratio or 1
    noise = record.z - np.vstack([np.zeros(record.n_modes), disturbance[:-1]])
    gains = np.ones(record.n_steps)
    gains[when] = gain
    residual, mirror, u = np.zeros_like(disturbance), np.zeros_like(disturbance), np.zeros_like(disturbance)
    for k in range(record.n_steps):
        y = noise[k] + (residual[k - 1] if k else 0.0)
        mirror[k] = residual[k - 1] - disturbance[k - 1] if k else 0.0
        frame = record.z_ngs[k] + mirror[k - n + 1 : k + 1].mean(axis=0) if k and k % n == 0 else None
        u[k] = controller.update(y, frame if controller.controller.uses_ngs else None)
        residual[k] = disturbance[k] + gains[k] * (u[k - 1] if k else 0.0)
    return residual, u


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPWISE)
def test_while_all_is_well_it_is_the_controller(name: str, record: wfsobs.Record) -> None:
    alone, supervised = wfsobs.design(name, SCENARIO), SupervisedController(wfsobs.design(name, SCENARIO), PLAN)
    _, u = close(supervised, record)
    assert supervised.alarms == [] and supervised.reason == ""
    expected = np.array([alone.update_open_loop(z, ngs if alone.uses_ngs and k and k % 5 == 0 else None)
                         for k, (z, ngs) in enumerate(zip(record.z, record.z_ngs, strict=True))])  # fmt: skip
    # an integrator of the controller goes on from what was sent, and forgets that as it does all: (1 - g)^k
    np.testing.assert_allclose(u[1500:], expected[1500:], rtol=0, atol=1e-6 * np.abs(expected).max())
    assert np.abs(np.diff(u[PLAN.calm - 5 : PLAN.calm + 5], axis=0)).max() < 3.0 * np.abs(np.diff(u[100:], axis=0)).max(), (
        "no bump"
    )


def test_the_integrator_leaves_the_slow_error_of_the_lgs_to_the_ngs(record: wfsobs.Record) -> None:
    """The sum written out, with missing measurements; in a loop it leaves less than the LGS alone."""
    rng, n = np.random.default_rng(5), 5
    y, slow = rng.normal(0.3, 0.1, (200, 2)), rng.normal(0.0, 0.1, (200, 2))
    y[47], slow[80, 1] = np.nan, np.nan
    supervised = SupervisedController(wfsobs.design("lqg-multirate", SCENARIO), Supervision(gain=0.3, leak=0.99, calm=10**6))
    u, error = np.zeros(2), np.zeros(2)
    for k in range(200):
        due = k and k % n == 0 and k != 60
        given = supervised.update(y[k], slow[k] if due else None)
        excess = y[k - n + 1 : k + 1].mean(axis=0) - slow[k] if due else np.full(2, np.nan)
        error = np.where(np.isnan(excess), error, 0.8 * error + 0.2 * excess)
        u = 0.99 * u - 0.3 * np.where(np.isnan(y[k]), 0.0, y[k] - error)
        np.testing.assert_allclose(given, u, rtol=0, atol=1e-12)

    def left(name: str) -> Array:
        residual, _ = close(SupervisedController(wfsobs.design(name, SCENARIO), Supervision(calm=10**6)), record)
        return np.asarray(residual[1000:].std(axis=0))

    assert (left("lqg-multirate") < 0.75 * left("lqg-kf-lgs")).all()


def test_an_unstable_loop_is_the_integrators_until_it_is_well_again(record: wfsobs.Record) -> None:
    when = slice(1200, 1400)
    supervised = SupervisedController(wfsobs.design("lqg-kf-lgs", SCENARIO), PLAN)
    residual, _ = close(supervised, record, 2.6, when)
    ((frame, reason),) = supervised.alarms
    assert when.start <= frame < when.start + 100 and "residual" in reason
    assert supervised.reason == "", "the controller is back"
    alone, _ = close(SupervisedController(wfsobs.design("lqg-kf-lgs", SCENARIO), PLAN), record)
    # what happened is forgotten by the filter's poles and the blend
    np.testing.assert_allclose(residual[2700:], alone[2700:], rtol=0, atol=0.02 * alone.std())


def test_a_loop_that_grows_slowly_is_no_more_usual_the_second_time() -> None:
    """0.3 % a frame, after an alarm: the threshold does not follow it, so that it is left where it was left before."""
    rng, level = np.random.default_rng(4), _Level(1, 1e-10)
    for _ in range(3000):
        level.exceeds(rng.standard_normal(1))
    level.begin(np.inf, STRICT * level.limit)
    grown = next(k for k in range(3000) if level.exceeds(1.003**k * rng.standard_normal(1)))
    assert 1.003**grown < 3.0, "0.5 of a threshold of 5.2 is 1.6 of its deviation, and 16 samples vary"
    free = _Level(1, 1e-10)
    for _ in range(3000):
        free.exceeds(rng.standard_normal(1))
    free.begin(np.inf)
    assert not any(free.exceeds(1.003**k * rng.standard_normal(1)) for k in range(3 * grown)), "without the cap it would be usual"


@pytest.mark.slow
def test_a_disturbance_that_stays_larger_becomes_usual() -> None:
    """Three times as much from 3 s on is no fault of the controller, which has the loop again for good."""
    calm = wfsobs.simulate(SCENARIO.replace({"run.duration": 20.0}))
    factor = np.where(np.arange(calm.n_steps) < 3000, 1.0, 3.0)[:, None]
    assert calm.turbulence is not None and calm.vibration is not None
    record = replace(
        calm,
        y_lgs=factor * calm.y_lgs,
        u=factor * calm.u,
        turbulence=factor * calm.turbulence,
        vibration=factor * calm.vibration,
    )
    supervised = SupervisedController(wfsobs.design("lqg-kf-lgs", SCENARIO), Supervision(calm=200))
    close(supervised, record)
    assert supervised.reason == "" and supervised.alarms[-1][0] < 17_000


def test_the_controller_has_the_loop_after_a_sensor_that_gave_zeros(record: wfsobs.Record) -> None:
    """A mean square of zero is no threshold; nor is a wait of hours, during which commands were not finite, too long."""
    supervised = SupervisedController(wfsobs.design("lqg-kf-lgs", SCENARIO), Supervision(calm=100))
    for k in range(record.n_steps):
        supervised.update(np.zeros(2) if k < 1000 else record.z[k] - record.z[k - 1])
        if k == 1005:
            assert supervised.reason, "the first that are not zero"
            supervised._since -= 10_000_000
    assert supervised.reason == ""


def test_one_that_limits_stop_and_one_that_is_not_finite_are_given_up(record: wfsobs.Record) -> None:
    tight = SCENARIO.replace({"control.stroke": 0.05})
    supervised = SupervisedController(wfsobs.design("lqg-kf-lgs", tight), PLAN)
    close(supervised, record)
    assert [reason for _, reason in supervised.alarms][:1] == ["the mirror is at its limits most of the time"]
    supervised = SupervisedController(wfsobs.design("lqg-kf-lgs", SCENARIO), PLAN)
    close(supervised, record)
    assert isinstance(supervised.controller.law, KalmanLaws)
    supervised.controller.law.filters.bank.x[:] = np.nan
    assert np.isfinite(supervised.update(np.zeros(2))).all()
    assert supervised.reason == "a command is not finite"


def test_numbers_that_are_none_are_missing(record: wfsobs.Record) -> None:
    one, other = (SupervisedController(wfsobs.design("lqg-kf-lgs", SCENARIO), PLAN) for _ in range(2))
    for k in range(50):
        gone = k % 7 == 3
        a = one.update(np.array([np.inf, -np.inf]) if gone else record.z[k])
        b = other.update(np.full(2, np.nan) if gone else record.z[k])
        np.testing.assert_array_equal(a, b)


def test_a_dropout_does_not_make_the_usual_residual_small(record: wfsobs.Record) -> None:
    """A third of the frames without measurements: the level stays that of the others, and nothing alarms afterwards."""
    supervised = SupervisedController(wfsobs.design("lqg-kf-lgs", SCENARIO), PLAN)
    lost = replace(record, y_lgs=np.where((np.arange(record.n_steps) // 500 == 3)[:, None], np.nan, record.y_lgs))
    close(supervised, lost)
    whole = SupervisedController(wfsobs.design("lqg-kf-lgs", SCENARIO), PLAN)
    close(whole, record)
    assert supervised.alarms == []
    # one half of a second in three: as many samples less
    assert supervised._level.mean == pytest.approx(whole._level.mean, rel=0.25)


@pytest.mark.parametrize("frames", [100, 700])
def test_a_state_goes_on_where_it_was(frames: int, record: wfsobs.Record) -> None:
    one, other = (SupervisedController(wfsobs.design("lqg-multirate", SCENARIO), PLAN) for _ in range(2))
    ngs = [z if k and k % 5 == 0 else None for k, z in enumerate(record.z_ngs)]
    for k in range(frames):
        one.update(record.z[k], ngs[k])
    other.load_state_dict(one.state_dict())
    for k in range(frames, frames + 300):
        np.testing.assert_array_equal(one.update(record.z[k], ngs[k]), other.update(record.z[k], ngs[k]))
    assert one.reason == other.reason
    with pytest.raises(StepError, match="another design"):
        other.load_state_dict(one.controller.state_dict())
    one.reset()
    fresh = SupervisedController(wfsobs.design("lqg-multirate", SCENARIO), PLAN)
    np.testing.assert_array_equal(one.update(record.z[0]), fresh.update(record.z[0]))


def test_the_level_is_the_quantile_of_white_measurements() -> None:
    """By the gamma distribution of a mean of 16 squares; the running mean takes a few hundredths of the power off."""
    rng = np.random.default_rng(2)
    alarm = 1e-3
    level = _Level(1, alarm)
    exceeded = [level.exceeds(y) for y in 0.7 * rng.standard_normal((60_000, 1))]
    quantile = 0.7**2 * gamma.isf(alarm, WINDOW / 2, scale=2.0 / WINDOW)
    assert level.limit[0] == pytest.approx(quantile, rel=0.06), "20,000 frames tell mean and spread to 1 and 2 %"
    # overlapping windows: about 60,000 / 16 independent ones, each of which exceeds it for some frames
    assert 0.3 * alarm < np.mean(exceeded[20_000:]) < 3.0 * alarm
