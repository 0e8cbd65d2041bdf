"""Missing samples: bridged by prediction, exactly so for the filter whose model it is, causally, and counted in no score."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.records import ON_PAPER, kalman_model
from wfsobs import PRESETS, observe, simulate
from wfsobs.evaluation.scores import PREDICTION, RESIDUAL
from wfsobs.execution import each_estimate, run_observer
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.observers.missing import fill_missing
from wfsobs.prior import Lines, Model, Prior
from wfsobs.priors_from.scenario import arguments, measurement_noise, prior_of
from wfsobs.record import Record, hold_last, pseudo_open_loop
from wfsobs.scenario import Scenario
from wfsobs.signal.gains import steady_state
from wfsobs.signal.spectrum import rms


def scenario() -> Scenario:
    s = PRESETS["paper"]()
    s.update(
        {
            "run": {"duration": 1.5, "warm_up": 0.3},
            "gpr_offline": {"training_size": 60, "depth": 25},
            "gpr_online": {"training_size": 60, "depth": 25},
            "adaptive": {"window": 0.25},
        }
    )
    return s


WHOLE = simulate(scenario())
LOST = np.unique(np.concatenate([[0, 1], np.arange(400, 412), [700, 1499], np.random.default_rng(5).integers(0, 1500, 60)]))
FRAMES = np.array([5, 405, 410, 1495])


def told(s: Scenario) -> Prior:
    """What the observer with one peak is told."""
    return prior_of(s, WHOLE, (Model,))


def gappy(record: Record = WHOLE) -> Record:
    y, u, ngs, twin = record.y_lgs.copy(), record.u.copy(), record.y_ngs.copy(), record.open_loop_y.copy()
    y[LOST], twin[LOST], u[[0, 300, 301]], ngs[FRAMES] = np.nan, np.nan, np.nan, np.nan
    y[900, 1] = np.nan  # of one mode alone
    return replace(record, y_lgs=y, u=u, y_ngs=ngs, open_loop_y=twin)


def test_nothing_missing_nothing_changed() -> None:
    again = fill_missing(WHOLE, told(scenario()))
    for name in ("y_lgs", "u", "y_ngs", "open_loop_y"):
        np.testing.assert_array_equal(getattr(again, name), getattr(WHOLE, name))


def test_all_is_bridged_and_the_rest_stays() -> None:
    record, n = gappy(), WHOLE.ratio
    out = fill_missing(record, told(scenario()))
    assert record.missing == LOST.size + 1
    for name in ("y_lgs", "u", "open_loop_y"):
        was, now = getattr(record, name), getattr(out, name)
        assert np.isfinite(now).all()
        np.testing.assert_allclose(now[~np.isnan(was)], was[~np.isnan(was)], rtol=1e-12)
    assert np.isfinite(out.y_ngs[n::n]).all() and np.isnan(np.delete(out.y_ngs, np.arange(n, 1500, n), axis=0)).all()


@pytest.mark.parametrize("part", [Model, Lines])
def test_a_gap_is_bridged_by_the_filter_of_what_is_told(part: type) -> None:
    """Oracle: the textbook filter that leaves out its correction where there is no measurement; of one peak, or of every line."""
    s, record = scenario(), replace(gappy(), u=WHOLE.u)
    prior = prior_of(s, record, (part,))
    filled = fill_missing(record, prior, s.multipeak.line_width).z
    for mode in range(2):
        if part is Model:
            model, noise = kalman_model(s, mode, record.dt), measurement_noise(s, mode)[0]
        else:
            model, noise = prior.lines[mode].disturbance(s.multipeak.line_width), prior.lines[mode].noise
        L = steady_state(model.A, model.C, model.Q, np.array(noise**2)).L[:, 0]
        x, want = np.zeros(len(model.A)), []
        for z in record.z[:, mode]:
            want.append(model.C @ x if np.isnan(z) else z)
            x = model.A @ (x + L * (want[-1] - model.C @ x))
        np.testing.assert_allclose(filled[:, mode], want, rtol=0, atol=1e-9 * np.abs(want).max())


def test_prediction_beats_holding() -> None:
    """Over single lost frames the true z is missed by little more than its noise, holding by the noise of two samples and
    more. The ratio would be sqrt(1/2) with a perfect prediction."""
    rng = np.random.default_rng(8)
    lost = 1 + np.sort(rng.permutation(1400)[:150])
    y = WHOLE.y_lgs.copy()
    y[lost] = np.nan
    record = replace(WHOLE, y_lgs=y)
    predicted, simple = fill_missing(record, told(scenario().replace({"kalman.process_noise": "matched"}))).z, hold_last(record.z)
    error, worse = rms((predicted - WHOLE.z)[lost]), rms((simple - WHOLE.z)[lost])
    noise = scenario().sensors.lgs_noise / np.sqrt(2)
    assert noise < error and np.sqrt(0.5) < error / worse < 0.95


@pytest.mark.parametrize("k", [399, 400, 405, 411, 700, 1000])
def test_bridging_is_causal(k: int) -> None:
    """What comes after step k, the ends of its gaps included, changes nothing up to k."""
    record, s = gappy(), scenario()
    rng = np.random.default_rng(k)

    def later(x: np.ndarray, start: int) -> np.ndarray:
        out = x.copy()
        out[start:] = rng.standard_normal(out[start:].shape)
        return out

    n = record.ratio
    ngs = record.y_ngs.copy()
    ngs[k + 1 :][np.arange(k + 1, 1500) % n == 0] = 0.1
    other = replace(record, y_lgs=later(record.y_lgs, k + 1), u=later(record.u, k), y_ngs=ngs)
    a, b = fill_missing(record, told(s)), fill_missing(other, told(s))
    np.testing.assert_array_equal(a.y_lgs[: k + 1], b.y_lgs[: k + 1])
    np.testing.assert_array_equal(a.u[:k], b.u[:k])
    np.testing.assert_array_equal(a.y_ngs[: k + 1], b.y_ngs[: k + 1])


@pytest.mark.slow
def test_no_observer_sees_behind_a_gap() -> None:
    """Within a gap of the LGS and of a frame: what comes later changes no causal estimate."""
    s, k = scenario(), 405
    whole, rng = gappy(), np.random.default_rng(2)
    later = {name: x[:800] for name, x in vars(whole).items() if isinstance(x, np.ndarray)}  # twice as far as it is compared
    record = replace(whole, **later)
    y, u, ngs = record.y_lgs.copy(), record.u.copy(), record.y_ngs.copy()
    for x, start in ((y, k + 1), (u, k + 1), (ngs, k + 1)):
        there = ~np.isnan(x[start:])
        x[start:][there] += rng.standard_normal(there.sum())
    other = replace(record, y_lgs=y, u=u, y_ngs=ngs, open_loop_y=None)
    causal = [name for name in ON_PAPER if OBSERVERS[name].causal]
    a, b = (list(each_estimate(r, s, observers=causal)) for r in (record, other))
    assert len(a) == len(b) >= 12
    for one, two in zip(a, b, strict=True):
        size = np.nanmax(np.abs(one.values), initial=1e-3)
        np.testing.assert_allclose(two.values[: k + 1], one.values[: k + 1], rtol=0, atol=1e-9 * size, err_msg=one.observer)


@pytest.mark.slow
def test_every_observer_runs_on_a_record_with_gaps_nearly_as_well() -> None:
    """5 % of the frames gone: the errors of causal observers grow by a few per cent, never by half."""
    s = scenario()
    full, gaps = (observe(r, s) for r in (WHOLE, gappy()))
    assert not gaps.failures and {x.observer for x in gaps.scores} == set(ON_PAPER)
    for a, b in zip(full.scores, gaps.scores, strict=True):
        assert (a.observer, a.target, a.mode) == (b.observer, b.target, b.mode)
        assert 0.8 * a.rms <= b.rms <= 1.5 * a.rms + 1e-12, a.observer


@pytest.mark.slow
def test_no_deviation_is_stated_where_a_measurement_was_filled() -> None:
    """Over a record and frame by frame; in other steps it is."""
    s, observer = scenario().replace({"turbulence.source": "frozen-flow"}), OBSERVERS["kf-coupled"]
    record = gappy(simulate(s))
    measurements, prior, settings = arguments(observer, replace(record, u=hold_last(record.u)), s)
    found, design = observer.estimate(measurements, prior, settings), observer.design(prior, settings, measurements.sampling)
    for k, (z, u) in enumerate(zip(measurements.z, measurements.u, strict=True)):
        design.update(z, u=u)
        for target in observer.targets:
            stated = found.sd[target][k]
            np.testing.assert_array_equal(np.isnan(stated), np.isnan(record.y_lgs[k]))
            np.testing.assert_array_equal(np.isnan(design.predict(0.0, target)[1]), np.isnan(stated))


def test_filled_samples_count_in_no_prediction_score() -> None:
    """Numbers in place of the gaps would change the scores; only what was measured counts."""
    s = scenario()
    record = replace(gappy(), turbulence=None, vibration=None, u=WHOLE.u, y_ngs=None, ratio=None)
    result = observe(record, s, observers=["kf-lgs", "zero"])
    start = round(s.run.warm_up / record.dt)
    for mode, name in enumerate(("tip", "tilt")):
        total = sum(result.estimate("kf-lgs", target).values[:, mode] for target in TARGETS)
        errors = [record.z[k + 1, mode] - total[k] for k in range(start, 1499) if not np.isnan(record.y_lgs[k + 1, mode])]
        left = [y for y in record.y_lgs[start + 1 :, mode] if not np.isnan(y)]
        found = {(x.observer, x.target): x.rms for x in result.scores if x.mode == name}
        assert found["kf-lgs", PREDICTION] == pytest.approx(rms(np.array(errors)), rel=1e-12)
        assert found["loop", RESIDUAL] == pytest.approx(rms(np.array(left)), rel=1e-12)


def test_holding() -> None:
    x = np.array([[np.nan], [1.0], [np.nan], [np.nan], [3.0]])
    np.testing.assert_array_equal(hold_last(x), [[0.0], [1.0], [1.0], [1.0], [3.0]])


def test_what_is_told_nothing_holds_the_last_value() -> None:
    """Of z, as the mirror's part is known; and of the mean over a frame. Estimates on a record held by hand are the same."""
    record = gappy()
    by_hand = fill_missing(record, Prior())
    u, n = hold_last(record.u), record.ratio
    np.testing.assert_allclose(by_hand.z, hold_last(pseudo_open_loop(record.y_lgs, u)), atol=1e-12)
    np.testing.assert_allclose(by_hand.z_ngs[n::n], hold_last(replace(record, u=u).z_ngs[n::n]), atol=1e-12)
    for name in ("persistence", "butterworth-cl", "gpr-online"):
        for target, values in run_observer(name, record, scenario()).items():
            np.testing.assert_array_equal(values, run_observer(name, by_hand, scenario())[target])


def test_a_model_of_nothing_predicts_nothing() -> None:
    s = scenario().replace({"turbulence.source": "none", "vibration.source": "none", "kalman.process_noise": "matched"})
    record = gappy()
    np.testing.assert_allclose(fill_missing(record, told(s)).z[LOST], 0.0, atol=1e-12)
