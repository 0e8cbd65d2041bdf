"""The loop against the step-by-step equations of the paper, and the record it makes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wfsobs.record import Record, RecordError, pseudo_open_loop
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError
from wfsobs.simulation.loop import TRAINING_MARGIN, integrate_commands, simulate

NOISELESS = {"sensors.lgs_noise": 0.0, "sensors.ngs_noise": 0.0, "sensors.lgs_low_frequency_rms": 0.0}


def scenario(changes: dict[str, Any] | None = None) -> Scenario:
    base = Scenario()
    base.update({"run": {"duration": 1.5, "warm_up": 0.2}, "gpr_offline": {"training_size": 50, "depth": 20}})
    return base.replace(changes or {})


def at(x: np.ndarray, k: int) -> np.ndarray:
    """x[k], nothing before the start."""
    return x[k] if k >= 0 else np.zeros_like(x[0])


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.floats(0.0, 0.999), st.floats(0.0, 1.0), st.integers(1, 400), st.integers(0, 2**31))
def test_integrator_is_the_plain_recursion(gain: float, leak: float, n: int, seed: int) -> None:
    y_open = np.random.default_rng(seed).standard_normal((n, 2))
    u = np.zeros((n, 2))
    for k in range(n):
        y = y_open[k] + at(u, k - 2)
        u[k] = leak * at(u, k - 1) - gain * y
    # the same operations in another order; a loop of gain 0.999 rings for 1000 steps, summing n rounding errors
    assert np.allclose(integrate_commands(y_open, gain, leak), u, rtol=1e-12, atol=1e-14 * n)


@pytest.mark.parametrize(("gain", "leak"), [(0.999, 1.0), (0.999, 0.0), (0.5, 1.0), (0.0, 1.0), (0.3, 0.999)])
def test_every_gain_that_can_be_set_is_stable(gain: float, leak: float) -> None:
    """Poles of q^2 - leak q + g; without gain the pole at leak is not driven."""
    radius = np.abs(np.roots([1.0, -leak, gain])).max()
    assert radius < 1.0 or gain == 0.0
    assert np.isfinite(integrate_commands(np.ones((5000, 1)), gain, leak)).all()


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("ratio", [1, 5, 8])
def test_a_record_without_noise_obeys_the_equations(closed: bool, ratio: int) -> None:
    """Paper, eq. 3 to 5: y_lgs[k] = phi_dist[k-1] + u[k-2]; an NGS frame is the mean of exactly n residual steps."""
    s = scenario(NOISELESS | {"loop.closed": closed, "sensors.exposure_ratio": ratio, "loop.leak": 0.99})
    r = simulate(s)
    assert r.turbulence is not None and r.vibration is not None and r.y_ngs is not None
    phi = r.turbulence + r.vibration
    assert r.u.any() == closed and r.ratio == ratio and r.dt == 1e-3 and r.n_steps == 1500 and r.n_modes == 2
    residual = np.array([phi[k] + at(r.u, k - 1) for k in range(r.n_steps)])
    for k in range(1, r.n_steps):
        assert np.array_equal(r.y_lgs[k], phi[k - 1] + at(r.u, k - 2))
        if closed:
            assert np.allclose(r.u[k], 0.99 * r.u[k - 1] - 0.3 * r.y_lgs[k], rtol=1e-12, atol=1e-14)
    assert not r.y_lgs[0].any()
    frames = np.flatnonzero(~np.isnan(r.y_ngs[:, 0]))
    assert np.array_equal(frames, np.arange(ratio, r.n_steps, ratio))
    for k in frames:
        assert np.abs(r.y_ngs[k] - residual[k - ratio : k].mean(axis=0)).max() < 1e-14
    assert np.isnan(r.y_ngs[np.setdiff1d(np.arange(r.n_steps), frames)]).all()


def test_pseudo_open_loop_takes_the_mirror_off_both_sensors() -> None:
    """z[k] = phi_dist[k-1]; an NGS frame loses the mean of u[k-2] ... u[k-n-1], what the mirror did during it."""
    r = simulate(scenario(NOISELESS))
    assert r.turbulence is not None and r.vibration is not None and r.open_loop_y is not None
    phi = r.turbulence + r.vibration
    assert np.abs(r.z[1:] - phi[:-1]).max() < 1e-14 and np.abs(r.z - r.open_loop_y).max() < 1e-14
    frames = np.arange(5, r.n_steps, 5)
    means = np.array([phi[k - 5 : k].mean(axis=0) for k in frames])
    assert np.abs(r.z_ngs[frames] - means).max() < 1e-14
    assert np.isnan(np.delete(r.z_ngs, frames, axis=0)).all()
    explicit = np.array([r.y_lgs[k] - at(r.u, k - 2) for k in range(r.n_steps)])
    assert np.array_equal(pseudo_open_loop(r.y_lgs, r.u), explicit)


def test_a_record_without_ngs_says_so() -> None:
    r = simulate(scenario())
    bare = Record(r.y_lgs, r.u, r.dt)
    with pytest.raises(RecordError, match="no NGS"):
        _ = bare.z_ngs
    assert bare.truth("turbulence") is None and np.array_equal(bare.z, r.z)


def test_the_loop_reduces_what_it_sees() -> None:
    """A pure integrator cancels a slow disturbance to the residual that its slope leaves: slope / g per step."""
    ramp = np.arange(2000.0)[:, None] * 1e-3
    u = integrate_commands(ramp, 0.3, 1.0)
    residual = ramp[-1] + u[-3]
    assert residual == pytest.approx(1e-3 / 0.3, rel=1e-9)


# ---------------------------------------------------------------------- seeds, streams, training


def test_same_seed_same_record_other_seed_other_record() -> None:
    one, same, other = simulate(scenario()), simulate(scenario()), simulate(scenario({"run.seed": 2}))
    for name in ("y_lgs", "y_ngs", "u", "turbulence", "vibration", "open_loop_y"):
        assert np.array_equal(getattr(one, name), getattr(same, name), equal_nan=True)
        assert not np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True)
    by_hand = simulate(scenario(), rng=np.random.default_rng(1))
    assert np.array_equal(by_hand.y_lgs, one.y_lgs)


UNTOUCHED: dict[str, tuple[Any, tuple[str, ...]]] = {
    "loop.gain": (0.1, ("turbulence", "vibration", "open_loop_y")),
    "loop.closed": (False, ("turbulence", "vibration", "open_loop_y")),
    "sensors.ngs_noise": (0.5, ("turbulence", "vibration", "open_loop_y", "y_lgs", "u")),
    "sensors.lgs_noise": (0.5, ("turbulence", "vibration")),
    "sensors.exposure_ratio": (3, ("turbulence", "vibration", "open_loop_y", "y_lgs", "u")),
    "turbulence.source": ("none", ("vibration",)),
    "vibration.source": ("none", ("turbulence",)),
    "gpr_offline.training_size": (80, ("turbulence", "vibration", "open_loop_y", "y_lgs", "u", "y_ngs")),
    "run.warm_up": (0.5, ("turbulence", "vibration", "open_loop_y", "y_lgs", "u", "y_ngs")),
    "kalman.frequency": (30.0, ("turbulence", "vibration", "open_loop_y", "y_lgs", "u", "y_ngs")),
}


@pytest.mark.parametrize("path", UNTOUCHED)
def test_one_setting_does_not_reshuffle_the_rest(path: str) -> None:
    value, same = UNTOUCHED[path]
    before, after = simulate(scenario()), simulate(scenario({path: value}))
    for name in same:
        assert np.array_equal(getattr(before, name), getattr(after, name), equal_nan=True), name


@pytest.mark.parametrize("closed", [True, False])
def test_training_is_a_record_of_its_own_with_a_twin(closed: bool) -> None:
    s = scenario({"loop.closed": closed})
    r = simulate(s)
    t = r.training
    assert t is not None and t.open_loop_y is not None
    assert t.y_lgs.shape == t.u.shape == t.open_loop_y.shape == (50 + 20 + round(TRAINING_MARGIN / r.dt), 2)
    # the twin is the same measurement without the mirror, the first two steps' commands lying before the cut
    assert np.abs(t.y_lgs[2:] - t.u[:-2] - t.open_loop_y[2:]).max() < 1e-14
    # no copy and no shift of the record itself: the second differences, mostly noise, are not correlated at any lag
    assert r.open_loop_y is not None
    own, other = np.diff(t.open_loop_y[:, 0], 2), np.diff(r.open_loop_y[:, 0], 2)
    products = np.correlate(other, own, "valid") / (own.std() * other.std() * own.size)
    # 900 lags, each of spread sqrt(35 / 18 / n) for twice differenced white noise; 5 of it
    assert products.size > 900 and np.abs(products).max() < 5 * np.sqrt(35 / 18 / own.size)


def test_the_training_record_starts_with_the_loop_settled() -> None:
    """Cut at the warm-up: the start-up transient, the whole disturbance uncorrected, is not in it."""
    strong = {"turbulence.rms": 10.0, "gpr_offline.training_size": 100}
    y = [simulate(scenario(strong | {"run.seed": seed})).training.y_lgs[:20] for seed in range(10)]  # type: ignore[union-attr]
    # in closed loop the residual of 10 um turbulence is below 0.5 um, the first steps of a loop at rest see 10 um
    assert np.sqrt(np.mean(np.square(y))) < 0.5


@pytest.mark.parametrize("warm_up", [1.5, 1.4996, 1.4995])
def test_an_impossible_scenario_is_refused_before_any_work(warm_up: float) -> None:
    """At 1 kHz the last two round to all 1500 steps."""
    scenario({"run.warm_up": 1.4994}).validate()
    with pytest.raises(SettingError, match=rf"^run\.warm_up = {warm_up:g}: must be below run\.duration = 1\.5 s by a step"):
        simulate(scenario({"run.warm_up": warm_up}))
