"""The gate: outliers are missing, what lasts passes, a clean record stays as it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.lib.stride_tricks import sliding_window_view
from scipy.stats import norm

import wfsobs
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.scores import rms
from wfsobs.observers import OBSERVERS
from wfsobs.priors_from.controllers import controller_arguments, own_settings, plant_of, prior_for
from wfsobs.priors_from.scenario import arguments
from wfsobs.record import Record
from wfsobs.signal.gate import BLOCK, MEMORY, OPEN, ORDER, RAREST, RARITY, RUN, USUAL, GateSettings, OutlierGate
from wfsobs.testing import run_loop, run_steps
from wfsobs.typing import Array

REJECT, CLIP = GateSettings(), GateSettings(action="clip")
UT4 = wfsobs.PRESETS["ut4"]().replace({"run.duration": 20.0, "run.warm_up": 2.0})
NOISE = 0.02 / sqrt(2.0)
"""Of the mean of two LGS [um]."""


def noise_with_outliers(seed: int, n: int = 1000, share: float = 0.03) -> Array:
    """Return an AR(1) of two modes with outliers, gaps and a jump."""
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((n, 2)).cumsum(axis=0) * 0.1 + rng.standard_normal((n, 2))
    z[rng.random((n, 2)) < share] += rng.choice([-30.0, 30.0])
    z[rng.random((n, 2)) < share] = np.nan
    z[n // 2 :] += 10.0 * rng.integers(0, 2)
    return z


@pytest.mark.slow
@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from((REJECT, CLIP, GateSettings(2.5))))
def test_all_samples_at_once_are_as_one_by_one(seed: int, what: GateSettings) -> None:
    """Rounding differs, as sums have another order; and a state goes on where it was saved."""
    z = noise_with_outliers(seed)
    at_once, by_one, gone_on = OutlierGate(2, what), OutlierGate(2, what), OutlierGate(2, what)
    expected = np.array([by_one.check(row) for row in z])
    np.testing.assert_allclose(at_once.check_all(z), expected, rtol=1e-9, atol=1e-9)
    first = gone_on.check_all(z[:333])
    later = OutlierGate(2, what)
    later.load(gone_on.save())
    np.testing.assert_allclose(np.vstack([first, later.check_all(z[333:])]), expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(at_once.outliers, by_one.outliers)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_the_past_alone_decides(seed: int) -> None:
    z = noise_with_outliers(seed)
    changed = z.copy()
    changed[700:] = 1e3
    np.testing.assert_array_equal(OutlierGate(2, REJECT).check_all(z)[:700], OutlierGate(2, REJECT).check_all(changed)[:700])


def test_the_prediction_is_that_of_least_squares() -> None:
    """Samples without outliers, weighted by exp(-age in blocks / MEMORY): the solution by a QR decomposition of the rows."""
    z = np.random.default_rng(3).standard_normal(12 * BLOCK).cumsum() * 0.1 + np.random.default_rng(4).standard_normal(12 * BLOCK)
    gate = OutlierGate(1, GateSettings(50.0))
    gate.check_all(z[:, None])
    rows = sliding_window_view(np.concatenate([np.zeros(ORDER), z - z[0]]), ORDER + 1)
    weights = np.sqrt((1.0 - 1.0 / MEMORY) ** (11 - np.arange(len(z)) // BLOCK))[:, None]
    solution, *_ = np.linalg.lstsq(weights * rows[:, :-1], (weights * rows[:, -1:])[:, 0], rcond=None)
    np.testing.assert_allclose(gate.save()["weights"][0], solution, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("level", [2.5, 2.7, 3.0, 3.5])
def test_of_gaussian_noise_as_many_are_rejected_as_lie_beyond_the_level(level: float) -> None:
    """Within 15 %: the deviation is a median of 128 samples, smoothed over some eight blocks, and the fit has 64 weights.

    The level is that of the part that lies beyond it, from 1 % down to 1 in 20 000.
    """
    z = np.random.default_rng(5).standard_normal((100_000, 4))
    gate = OutlierGate(4, GateSettings(level))
    gate.check_all(z)
    part = USUAL
    for _ in range(1000):
        part = 2.0 * norm.sf(level * (USUAL / np.clip(part, RAREST, USUAL)) ** RARITY)
    expected = part * z.size
    assert abs(gate.outliers.sum() / expected - 1.0) < 0.15 + 4.0 / sqrt(expected)


@pytest.mark.parametrize(("share", "passes"), [(0.0, True), (0.02, False)])
def test_the_level_is_higher_where_outliers_are_rare(share: float, passes: bool) -> None:
    """4.3 sigma of 3.6, or of 5.0: whether it is an outlier depends on whether there are any."""
    rng = np.random.default_rng(7)
    z = rng.standard_normal((10_000, 4))
    gate = OutlierGate(4, REJECT)
    gate.check_all(z + 20.0 * (rng.random(z.shape) < share))
    assert (~np.isnan(gate.check(np.full(4, 4.3)))).tolist() == [passes] * 4


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.floats(-3.0, 3.0), st.floats(0.0, 1.0))
def test_no_filter_starves(seed: int, size: float, share: float) -> None:
    """Whatever comes: at most as many in a row are rejected as open the gate, which is open for a while after them."""
    rng = np.random.default_rng(seed)
    z = rng.standard_normal(3000)
    z += np.where(rng.random(3000) < share, 10.0**size, 0.0) * rng.standard_normal(3000)
    gone = np.isnan(OutlierGate(1, REJECT).check_all(z[:, None])[:, 0])
    in_a_row = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], gone, [0]]))))[::2]
    assert in_a_row.max(initial=0) <= RUN
    assert gone.mean() < 0.3


def test_a_clean_start_is_no_outlier() -> None:
    """Turbulence of 0.5 um, of which one block shows a slope: twice the level is beyond all noise, in 40 records."""
    for seed in range(40):
        record = wfsobs.simulate(wfsobs.PRESETS["paper"]().replace({"run.duration": 1.5, "run.seed": seed}))
        gate = OutlierGate(record.n_modes, REJECT)
        gate.check_all(record.z[record.delay :][: 2 * BLOCK])
        assert gate.outliers.tolist() == [0, 0], seed


@pytest.fixture(scope="module")
def paper() -> Sequence[Record]:
    settings = wfsobs.PRESETS["paper"]().replace({"run.duration": 3.0})
    return [wfsobs.simulate(settings.replace({"run.seed": seed})) for seed in range(6)]


@pytest.mark.slow
@pytest.mark.parametrize(("start", "stop"), [(0, 300), (20, 200), (60, 300), (100, 330), (128, 300), (180, 256)])
def test_a_clean_record_with_an_early_gap_loses_nothing(paper: Sequence[Record], start: int, stop: int) -> None:
    """Samples that are missing count for no fit; outliers of 40 sigma after it are found all the same."""
    for record in paper:
        z = record.z[record.delay :].copy()
        z[start:stop] = np.nan
        gate = OutlierGate(2, REJECT)
        gate.check_all(z)
        assert gate.outliers.tolist() == [0, 0]
        hit = np.arange(1000, 2900, 100)
        z[hit] += 40.0 * NOISE
        gate = OutlierGate(2, REJECT)
        assert np.isnan(gate.check_all(z)[hit]).all()
        assert (gate.outliers - len(hit)).max() <= 4, "of 1 % outliers the level is the lowest: 1 of noise is expected"


@pytest.fixture(scope="module", params=["paper", "ut4"])
def clean(request: pytest.FixtureRequest) -> tuple[Array, dict[int, dict[str, Array]]]:
    """Return z of a clean record, and the state of a gate before some of its samples."""
    record = wfsobs.simulate(wfsobs.PRESETS[request.param]().replace({"run.duration": 9.0, "run.warm_up": 1.0}))
    z, gate, states, last = record.z, OutlierGate(2, REJECT), {}, record.delay
    for start in range(2500, 4500, 400):
        gate.check_all(z[last:start])
        states[start], last = gate.save(), start
    return z, states


@pytest.mark.slow
@pytest.mark.parametrize("length", [RUN, ORDER, 300, 1000, 3000])
def test_a_clean_record_with_a_gap_loses_nothing_after_it(clean: tuple[Array, dict[int, dict[str, Array]]], length: int) -> None:
    """The prediction over it decays to the first sample, the disturbance does not: that is no step of what comes."""
    whole, states = clean
    for start, state in states.items():
        z, gate = whole[start : start + length + 1000].copy(), OutlierGate(2, REJECT)
        z[:length, 0] = np.nan
        gate.load(state)
        gate.check_all(z)
        assert gate.outliers.max() <= 1, (start, "as without the gap: one in 5,000 may be noise")


def test_samples_until_the_first_fit_are_counted_for_every_mode() -> None:
    """A gap delays the first fit of its mode alone, and one after that does not delay what has been."""
    z = np.random.default_rng(8).standard_normal((10 * BLOCK, 3))
    z[20:200, 0] = np.nan
    z[5 * BLOCK : 7 * BLOCK, 1] = np.nan
    gate, held = OutlierGate(3, REJECT), np.eye(ORDER)[-1]
    gate.check_all(z[: 2 * BLOCK])
    assert (gate.save()["weights"] == held).all(axis=1).tolist() == [True, False, False]
    gate.check_all(z[2 * BLOCK :])
    assert not (gate.save()["weights"] == held).all(axis=1).any()
    lacking, none, total = gate.save()["rows"]
    assert (none, total) == (10 * BLOCK, 10 * BLOCK)
    assert 180 <= 10 * BLOCK - lacking <= 180 + OPEN + 10, "those missing, those that settle, and a few outliers"


@pytest.mark.parametrize("size", [5.0, 20.0, 1000.0])
def test_a_jump_is_followed_within_twenty_samples(size: float) -> None:
    z = np.random.default_rng(6).standard_normal((4000, 3))
    z[3000:] += size
    gone = np.isnan(OutlierGate(3, REJECT).check_all(z))
    assert gone[3000:3020].sum(axis=0).max() <= 2 * RUN
    assert gone[3000 + OPEN :].sum() <= 3  # 0.2 are expected


def with_outliers(record: Record, sigmas: float, seed: int = 1) -> tuple[Record, Array]:
    """Return a record of which 1 % of frames are off by so many sigma of the noise of the mean, and which."""
    rng = np.random.default_rng(seed)
    hit = rng.random(record.n_steps) < 0.01
    y = record.y_lgs.copy()
    y[hit] += sigmas * NOISE * rng.choice([-1.0, 1.0], size=(hit.sum(), 1))
    return replace(record, y_lgs=y), hit


FILTERS = "kf-lgs kf-multi kf-coupled gp-lgs gp-both multirate multirate-optimal multirate-multi persistence".split()


@pytest.fixture(scope="module")
def ut4() -> Record:
    return wfsobs.simulate(UT4)


def first_steps(record: Record, n: int) -> Record:
    """Return the first steps of a record."""
    return replace(record, **{key: x[:n] for key, x in vars(record).items() if isinstance(x, np.ndarray)})


def with_ngs_outliers(record: Record, sigmas: float, seed: int = 1) -> tuple[Record, Array]:
    """Return a record of which 1 % of NGS frames are off by so many sigma of their noise, and in which steps."""
    rng = np.random.default_rng(seed)
    assert record.y_ngs is not None and record.ratio is not None
    y_ngs = record.y_ngs.copy()
    frames = np.arange(record.ratio, record.n_steps, record.ratio)
    hit = frames[rng.random(len(frames)) < 0.01]
    y_ngs[hit] += sigmas * UT4.sensors.ngs_noise * rng.choice([-1.0, 1.0], size=(len(hit), 1))
    return replace(record, y_ngs=y_ngs), hit


def errors(record: Record, observers: Sequence[str] = FILTERS, **settings: str) -> dict[tuple[str, str, str], float]:
    """Return the error of every filter, target and mode, and of both targets together [um]."""
    result = wfsobs.observe(
        record, UT4.replace({f"sensors.{name}": value for name, value in settings.items()}), observers=observers
    )
    return {(s.observer, s.target, s.mode): s.rms for s in result.scores if s.target != "residual"}


@pytest.mark.slow
def test_one_percent_of_outliers_costs_less_than_five_percent(ut4: Record) -> None:
    """Every filter, of 40, 10 and 6 sigma, both targets and their sum; a clean record loses less than 0.1 %.

    10 s have 100 outliers of the LGS and 20 of the NGS: enough to tell a cost of 5 %.
    """
    short = first_steps(ut4, 10_000)
    clean = errors(short, gate="off")
    assert max(abs(e / clean[key] - 1.0) for key, e in errors(short).items()) < 1e-3
    for sigmas in (40.0, 10.0, 6.0):
        for put_in in (with_outliers, with_ngs_outliers):
            found = errors(put_in(short, sigmas)[0])
            assert found.keys() == clean.keys()
            cost = {key: e / clean[key] - 1.0 for key, e in found.items()}
            # of 6 sigma of the NGS a third is within the level, and the model of this filter states twice the error it has
            excepted = "multirate-multi" if put_in is with_ngs_outliers and sigmas == 6.0 else None
            assert max(x for key, x in cost.items() if key[0] != excepted) < 0.05
    kf = "kf-multi", "vibration", "tilt"
    assert errors(with_outliers(short, 40.0)[0], ["kf-multi"], gate="off")[kf] > 2.0 * clean[kf], "without a gate they ruin it"


def test_short_records_without_outliers_lose_nothing(ut4: Record) -> None:
    """Half a second of each: an autoregression of 64 weights fitted to few samples predicts badly."""
    for start in range(0, 19_500, 125):
        gate = OutlierGate(ut4.n_modes, REJECT)
        gate.check_all(ut4.z[start : start + 500])
        assert gate.outliers.sum() == 0, start


def test_outliers_are_found_and_counted(ut4: Record) -> None:
    broken, hit = with_outliers(ut4, 40.0)
    frames = np.flatnonzero(hit)
    y_ngs = ut4.y_ngs.copy()  # type: ignore[union-attr]
    y_ngs[5000] += 1.0
    broken = replace(broken, y_ngs=y_ngs, gate=REJECT)
    gone = np.any(np.isnan(broken.without_outliers.y_lgs), axis=1)
    settled = frames[frames > 3 * BLOCK]
    assert gone[settled].all()
    assert abs(broken.outliers - hit.sum()) <= 12
    gated_ngs = broken.without_outliers.y_ngs
    assert gated_ngs is not None and np.isnan(gated_ngs[5000]).all()
    y_lgs = broken.without_outliers.y_lgs
    kept = np.logical_not(np.isnan(y_lgs))
    np.testing.assert_array_equal(broken.without_outliers.y_lgs[kept], broken.y_lgs[kept])  # to the last bit
    clipped = replace(broken, gate=CLIP).without_outliers.y_lgs
    assert not np.isnan(clipped).any()
    assert rms((clipped - ut4.y_lgs)[settled]) < 8.0 * NOISE < rms((broken.y_lgs - ut4.y_lgs)[settled])
    assert replace(broken, gate=None).outliers == 0


@pytest.mark.parametrize("sigmas", [10.0, 40.0])
def test_ngs_frames_are_tested_by_what_the_lgs_see_meanwhile(ut4: Record, sigmas: float) -> None:
    """Of the difference noise is all that moves within a frame: 10 sigma of the NGS are 8 of it. A frame without LGS passes."""
    broken, hit = with_ngs_outliers(replace(ut4, y_lgs=ut4.y_lgs.copy()), sigmas)
    alone = hit[len(hit) // 2]
    broken.y_lgs[alone - 4 : alone + 1] = np.nan
    passed = replace(broken, gate=REJECT).without_outliers.y_ngs
    assert passed is not None and broken.y_ngs is not None
    gone = np.any(np.isnan(passed[5::5]), axis=1)
    is_hit = np.isin(np.arange(5, broken.n_steps, 5), hit[hit != alone])
    settled = np.arange(len(gone)) >= 6 * BLOCK
    assert gone[settled & is_hit].all()
    assert gone[settled & ~is_hit].sum() <= 3, "0.4 are expected"
    np.testing.assert_array_equal(passed[alone], broken.y_ngs[alone])


def test_training_data_pass_the_gate(ut4: Record) -> None:
    """Taps that are learnt from 1 % of outliers: 5.5 % worse without a gate, within 2 % of those of clean data with it."""
    training = ut4.training
    assert training is not None and training.open_loop_y is not None
    y, y_open = training.y_lgs.copy(), training.open_loop_y.copy()
    rng = np.random.default_rng(1)
    hit = rng.random(len(y)) < 0.01
    steps = 40.0 * NOISE * rng.choice([-1.0, 1.0], size=(hit.sum(), 1))
    y[hit] += steps
    y_open[hit] += steps
    broken = replace(ut4, training=replace(training, y_lgs=y, open_loop_y=y_open))

    def error(record: Record, gate: bool) -> float:
        return max(
            s.rms for s in wfsobs.observe(record, UT4, observers=["ridge-30"], gate=gate).scores if s.target == "vibration"
        )

    clean = error(ut4, gate=False)
    assert error(ut4, gate=True) < 1.001 * clean
    assert error(broken, gate=True) < 1.02 * clean
    assert error(broken, gate=False) > 1.02 * clean


def test_the_gate_of_training_data_is_run_once(ut4: Record, monkeypatch: pytest.MonkeyPatch) -> None:
    """For all observers that learn from them: of y and of y in open loop."""
    record, lengths, check_all = replace(ut4, gate=REJECT), [], OutlierGate.check_all

    def counted(gate: OutlierGate, z: Array) -> Array:
        lengths.append(len(z))
        return check_all(gate, z)

    monkeypatch.setattr(OutlierGate, "check_all", counted)
    parts = [arguments(OBSERVERS[name], record, UT4)[1].training for name in ("ridge", "ridge-30", "gpr-offline")]
    assert record.training is not None and None not in parts
    n = len(record.training.y_lgs)
    assert sorted(length for length in lengths if length <= n) == [n - record.delay] * 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kf-multi", "multirate-multi", "gp-both", "persistence", "kf-ngs"])
def test_an_observer_with_a_gate_is_the_same_step_by_step(ut4: Record, name: str) -> None:
    broken = replace(with_ngs_outliers(with_outliers(first_steps(ut4, 2000), 30.0)[0], 30.0)[0], gate=REJECT)
    broken.y_lgs[700:720] = np.nan  # some NGS frames have no LGS beside them
    measurements, prior, own = arguments(OBSERVERS[name], broken, UT4)
    expected = OBSERVERS[name].estimate(measurements, prior, own)
    raw = replace(broken, gate=None).measurements()
    got = run_steps(OBSERVERS[name].design(prior, own, raw.sampling, gate=REJECT), raw)
    for target in OBSERVERS[name].targets:
        np.testing.assert_allclose(got[target], expected[target], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["integrator", "lqg-kf-multi"])
def test_a_controller_with_a_gate_is_the_same_step_by_step(ut4: Record, name: str) -> None:
    controller = CONTROLLERS[name]
    own, plant, prior = own_settings(controller, UT4), plant_of(UT4), prior_for(controller, UT4)
    short = Record(ut4.y_lgs[:2000] - 0.0, np.zeros((2000, 2)), ut4.dt)
    broken = replace(with_outliers(short, 30.0)[0], gate=REJECT)
    measured, told = controller_arguments(controller, broken, own, prior)
    expected, _ = controller.commands(controller.laws(told, plant, own, 2), measured, told, plant, own)
    step = controller.design(told, plant, own, measured.sampling, REJECT)
    np.testing.assert_allclose(run_loop(step, replace(broken, gate=None).measurements()), expected, rtol=0, atol=1e-9)


def test_the_state_of_a_gate_goes_on(ut4: Record) -> None:
    """Saved, loaded and taken over with the filter behind it."""
    z = with_outliers(ut4, 40.0)[0].z
    one, other, new = (wfsobs.design("kf-multi", UT4, gate=REJECT) for _ in range(3))
    for row in z[:500]:
        one.update(row)
    other.load_state_dict(one.state_dict())
    new.take_over(one)
    for row in z[500:900]:
        for observer in (one, other, new):
            observer.update(row)
    np.testing.assert_array_equal(one.predict(0, "vibration")[0], other.predict(0, "vibration")[0])
    np.testing.assert_array_equal(one.predict(0, "vibration")[0], new.predict(0, "vibration")[0])
    one.reset()
    assert not one.state_dict()["gate_lgs.outliers"].any()


def test_a_measurement_whose_command_is_lost_is_no_outlier() -> None:
    rng = np.random.default_rng(1)
    y, u = rng.standard_normal((2, 1000, 2))
    u[300:320] = np.nan
    record = Record(y, u, 1e-3, gate=GateSettings(level=8.0))
    assert record.outliers == 0 and np.isnan(record.without_outliers.y_lgs).any(axis=1).sum() == 20
