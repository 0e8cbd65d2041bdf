"""Observers frame by frame: the run over the record again, in every preset, with gaps and events."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.units import Unit

import wfsobs
from tests.records import ON_PAPER, kalman_model, short, third_of_pairs
from wfsobs import PRESETS
from wfsobs.control.controllers import CONTROLLERS, gpr_offline_ahead, gpr_online_ahead
from wfsobs.control.mirror import Mirror, Plant
from wfsobs.control.supervisor import SupervisedController
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import Observer
from wfsobs.observers.gpr.offline import training_targets
from wfsobs.observers.kalman.step import matrix_power
from wfsobs.observers.missing import fill_missing
from wfsobs.observers.step import StepError
from wfsobs.prior import Bands, Lines, Model, Prior, Training
from wfsobs.priors_from.controllers import own_settings
from wfsobs.priors_from.scenario import arguments, has_prior, measurement_noise, observer_settings, prior_of
from wfsobs.progress import QUIET
from wfsobs.record import Record, Sampling, hold_last, pseudo_open_loop
from wfsobs.scenario import Scenario
from wfsobs.signal.gains import steady_state
from wfsobs.signal.joint_states import RIDGE
from wfsobs.testing import run_steps, step_difference

STEPS = [name for name, observer in OBSERVERS.items() if observer.step is not None]

ROUNDING, GPR = 1e-12, 1e-9
"""Differences over the std of an estimate: sums in another order; the kernel's condition number makes more of them in a GPR."""
JOINT = float(np.finfo(float).eps) / RIDGE**0.5
"""Where states of all modes are weighed together: they have much in common, and the ridge alone keeps weights from cancelling."""


def tolerance(observer: Observer) -> float:
    """Return that of differences between steps and record."""
    return GPR if observer.id.startswith("gpr") else JOINT if observer.couples_modes else ROUNDING


@cache
def with_gaps(preset: str) -> tuple[Record, Scenario]:
    """A record with missing measurements of all and of single modes, commands and NGS frames, some at the start."""
    record, scenario = short(preset)
    y, u, ngs = record.y_lgs.copy(), record.u.copy(), record.y_ngs.copy()
    n = record.ratio
    lost = np.unique(np.concatenate([[0, 1], np.arange(400, 412), np.random.default_rng(5).integers(500, 800, 30)]))
    y[lost], y[600, 0], u[[0, 500, 501]] = np.nan, np.nan, np.nan
    ngs[[n, 90 * n, 91 * n]] = ngs[100 * n, 0] = np.nan
    return replace(record, y_lgs=y, u=u, y_ngs=ngs), scenario.before_events


def whole(preset: str) -> tuple[Record, Scenario]:
    """A record in which nothing is missing: filters run over it at once."""
    record, scenario = short(preset)
    return record, scenario.before_events


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPS)
def test_steps_are_the_run_over_the_record(name: str, subtests: pytest.Subtests) -> None:
    """On a third of the presets, in turn with gaps and without; every observer has some of either."""
    kinds, compared = (with_gaps, whole), 0
    given_to = [preset for preset, make in PRESETS.items() if is_told(name, make())]
    presets = [preset for one, preset in third_of_pairs(STEPS, PRESETS) if one == name and preset in given_to] or given_to[:1]
    for i, preset in enumerate(presets):
        for record_of in kinds if len(presets) == 1 else (kinds[i % 2],):
            with subtests.test(preset, record=record_of.__name__):
                record, scenario = record_of(preset)
                given = arguments(OBSERVERS[name], record, scenario)
                assert step_difference(OBSERVERS[name], *given) <= tolerance(OBSERVERS[name])
                compared += 1
    assert compared >= 2


def is_told(name: str, scenario: Scenario) -> bool:
    """Whether a scenario has something for an observer."""
    try:
        return has_prior(OBSERVERS[name], scenario)
    except ValueError:  # a vibration that is a table has no lines
        return False


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPS)
def test_without_a_prior_there_is_no_design_and_one_line_says_why(name: str, subtests: pytest.Subtests) -> None:
    for preset, make in PRESETS.items():
        if not is_told(name, make()):
            with (
                subtests.test(preset),
                pytest.raises(ValueError, match=r"table, not lines|modes tell nothing|all LGS see the same"),
            ):
                wfsobs.design(name, make().before_events)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in STEPS if name in ON_PAPER])
def test_a_design_goes_on_in_another_process(name: str) -> None:
    """As it is sent there: what shares memory here is apart when it arrives."""
    record, scenario = with_gaps("paper")
    seen, part = record.measurements(), slice(0, 150)
    here = wfsobs.design(name, scenario, sampling=record.sampling)
    for stretch in (part, slice(150, 300)):
        there = pickle.loads(pickle.dumps(here))
        for k in range(*stretch.indices(record.n_steps)):
            ngs = None if np.isnan(seen.z_ngs[k]).all() else seen.z_ngs[k]
            for one in (here, there):
                one.update(seen.z[k], ngs if one.frame else None, np.nan_to_num(seen.u[k]))
                one.settle()
            for target in here.targets:
                np.testing.assert_array_equal(here.predict(0, target), there.predict(0, target))


@pytest.mark.parametrize("name", [name for name in STEPS if name in ON_PAPER])
def test_predictions_that_are_kept_stay_what_they_were(name: str) -> None:
    """Every one is an array of its own, unless the caller gives some: then it is written there."""
    record, scenario = with_gaps("paper")
    observer = wfsobs.design(name, scenario, sampling=record.sampling)
    given, target = (np.empty(2), np.empty(2)), observer.targets[-1]
    kept, copies = [], []
    for k in range(60):
        observer.update(record.z[k], u=np.nan_to_num(record.u[k]))
        kept.append(observer.predict(0, target))
        copies.append(np.array(kept[-1]))
        assert observer.predict(0, target, out=given) is given
        np.testing.assert_array_equal(given, copies[-1])
        given[0][:] = given[1][:] = kept[-1][1][:] = 7.0  # what a caller does to its arrays is nothing to the observer
        np.testing.assert_array_equal(observer.predict(0, target), copies[-1])
        kept[-1][1][:] = copies[-1][1]
    np.testing.assert_array_equal(kept, copies)


@pytest.mark.parametrize(
    "make", [lambda one: one("kf-multi"), lambda one: one("lqg-kf-multi"), lambda one: SupervisedController(one("lqg-kf-multi"))]
)
def test_a_copy_has_a_state_of_its_own(make: Any) -> None:
    """What the one takes, the other does not."""

    def state(design: Any) -> str:
        return str({name: np.asarray(x).tolist() for name, x in design.state_dict().items()})

    here = make(lambda name: wfsobs.design(name, PRESETS["paper"]()))
    here.update([0.1, 0.2])
    there, before = copy.copy(here), state(here)
    there.update([0.3, 0.4])
    assert state(here) == before != state(there)
    here.update([0.3, 0.4])
    assert state(here) == state(there)


def test_every_causal_observer_has_steps() -> None:
    assert [name for name, observer in OBSERVERS.items() if observer.step is None] == ["butterworth-ol"]


def test_the_public_door_gives_the_same() -> None:
    record, scenario = with_gaps("paper")
    for prior in (scenario, prior_of(scenario, record, (Model, Lines))):
        got = run_steps(wfsobs.design("kf-lgs", prior, scenario=scenario), record.measurements())
        batch = OBSERVERS["kf-lgs"].estimate(*arguments(OBSERVERS["kf-lgs"], record, scenario))
        np.testing.assert_allclose(got["vibration"], batch["vibration"], rtol=0, atol=ROUNDING * np.std(batch["vibration"]))


@pytest.mark.parametrize("frames", [1, 3, 0.5, 2.25])
def test_predictions_and_their_sd(frames: float) -> None:
    """Oracle: the textbook filter, its state moved on by the exponential of its poles."""
    record, scenario = short("paper")
    observer = wfsobs.design("kf-lgs", scenario)
    run_steps(observer, record.measurements())
    model, noise = kalman_model(scenario, 0, record.dt), measurement_noise(scenario, 0)[0]
    steady, x = steady_state(model.A, model.C, model.Q, np.array(noise**2)), np.zeros(4)
    for z in record.z[:, 0]:
        x = model.A @ x
        x = x + steady.L[:, 0] * (z - model.C @ x)
    values, vectors = np.linalg.eig(model.A)
    power = np.real(vectors @ np.diag(np.exp(frames * np.log(values))) @ np.linalg.inv(vectors))
    for target in ("turbulence", "vibration"):
        mean, sd = observer.predict(frames, target)
        row = model.outputs[target] @ power
        np.testing.assert_allclose(mean[0], row @ x, rtol=1e-9)
        if frames == int(frames):
            P = steady.posterior
            for _ in range(int(frames)):
                P = model.A @ P @ model.A.T + model.Q
            np.testing.assert_allclose(sd[0], np.sqrt(model.outputs[target] @ P @ model.outputs[target]), rtol=1e-9)


def test_sd_of_a_fraction_is_between_those_of_whole_frames() -> None:
    """To 1e-3: an AR(2) process is not exactly a sampled oscillator."""
    observer = wfsobs.design("kf-multi", PRESETS["paper"]())
    observer.update([0.0, 0.0])
    before, between, after = (observer.predict(f, "vibration")[1][0] for f in (4, 4.5, 5))
    assert before * (1 - 1e-3) < between < after * (1 + 1e-3)
    assert before < after


def test_a_power_composes() -> None:
    A = kalman_model(PRESETS["paper"](), 0, 1e-3).A
    np.testing.assert_allclose(matrix_power(A, 0.25) @ matrix_power(A, 0.75), A, atol=1e-12)


@pytest.mark.slow
def test_a_design_takes_over_without_a_bump() -> None:
    """The same processes, other strengths: each goes on where it was. Fewer lines: the sums do."""
    record, scenario = with_gaps("ut4")
    for name, change in (
        ("kf-multi", {"kalman.lgs_noise": 0.05, "kalman.measurement_noise": "manual"}),
        ("kf-lgs", {"kalman.vibration_rms": 0.1, "kalman.process_noise": "manual"}),
    ):
        old = wfsobs.design(name, scenario, sampling=record.sampling)
        run_steps(old, record.measurements())
        new = wfsobs.design(name, scenario.replace(change), sampling=record.sampling)
        new.take_over(old)
        for target in old.targets:
            was = old.predict(0, target)[0]
            np.testing.assert_allclose(new.predict(0, target)[0], was, rtol=0, atol=1e-9 * np.std(record.vibration))
        new.update(record.z[-1])  # goes on


def refused(match: str):
    return pytest.raises(StepError, match=match)


def test_what_is_masked_is_missing() -> None:
    masked, missing = (wfsobs.design("multirate", PRESETS["paper"]()) for _ in range(2))
    for _ in range(7):
        z, ngs = [1.0, 2.0], [3.0, 4.0] if masked.frame == 5 else None
        masked.update(np.ma.array(z, mask=[0, 1]), None if ngs is None else np.ma.array(ngs, mask=[1, 0]))
        missing.update([z[0], np.nan], None if ngs is None else [np.nan, ngs[1]])
        np.testing.assert_array_equal(masked.predict(1, "turbulence"), missing.predict(1, "turbulence"))


def test_wrong_input_is_one_line_and_takes_no_frame() -> None:
    observer = wfsobs.design("multirate", PRESETS["paper"]())
    with refused(r"z takes the shape \(2,\)"):
        observer.update([0.0])
    with refused("infinite in frame 0"):
        observer.update([0.0, np.inf])
    with refused("one is due in every 5th"):
        observer.update([0.0, 0.0], [0.0, 0.0])
    for z in ("ab", ["1", "2"], [1j, 0.0], np.array([1.0 + 0j, 0.0]), [[1.0], [1.0, 2.0]], {}, np.array([0, 0], "datetime64[s]")):
        with refused("^multirate: z takes real numbers, not .+$"):
            observer.update(z)  # type: ignore[arg-type]
    with refused("^multirate: ngs takes real numbers, not text$"):
        observer.update([0.0, 0.0], "ab")
    with refused("^multirate: stars takes a whole number, 0 or more, not 'x'$"):
        observer.update([0.0, 0.0], stars="x")  # type: ignore[arg-type]
    with refused("^multirate: z has the unit nm; takes plain numbers in um, .+$"):
        observer.update([1.0, 2.0] * Unit("nm"))
    assert observer.frame == 0
    for z in ([0.0, np.nan], np.float32([1.0, 2.0]), [1, 2], [True, False], [None, 1.0], [1e300, -1e300]):
        observer.update(z)
    observer.reset()
    observer.update([0.0, np.nan])
    with refused("it estimates turbulence"):
        observer.predict(0, "vibration")
    for frames in (-1, np.nan, "x", None):
        with refused("takes 0 or more"):
            observer.predict(frames, "turbulence")
    with refused("predict takes a target"):
        wfsobs.design("kf-lgs", PRESETS["paper"]()).predict(0)
    with refused("cannot run frame by frame"):
        wfsobs.design("butterworth-ol", PRESETS["paper"]())
    with refused("state is that of another design"):
        observer.load_state_dict(wfsobs.design("kf-lgs", PRESETS["paper"]()).state_dict())
    with refused("not from kf-lgs"):
        observer.take_over(wfsobs.design("kf-lgs", PRESETS["paper"]()))


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPS)
def test_a_state_without_numbers_is_refused_and_leaves_the_old_one(name: str) -> None:
    scenario = next(made for make in PRESETS.values() if has_prior(OBSERVERS[name], made := make()))
    observer = wfsobs.design(name, scenario.replace({"run.duration": 2.0}))
    state = observer.state_dict()
    observer.load_state_dict(state)  # NaN where nothing is known yet
    filled = {name: np.full(np.shape(x), np.nan) for name, x in state.items()}
    own = {name for name in state if name.rpartition(".")[2] in ("x", "states", "covariance", "last", "commands")}
    for wrong in (
        filled,
        *({**state, one: filled[one]} for one in own),
        {**state, "frame": "x"},
        {**state, "frame": np.array(1j)},
        {**state, "frame": -1},
        {**state, "frame": 1.5},
        "x",
        None,
    ):
        with refused(f"^{name}: load_state_dict: .*$"):
            observer.load_state_dict(wrong)  # type: ignore[arg-type]
    for one, x in observer.state_dict().items():
        np.testing.assert_array_equal(x, state[one])


def refusal(*arguments: Any, **named: Any) -> str:
    """Return why there is no design, empty where there is one."""
    try:
        wfsobs.design(*arguments, **named)
    except StepError as error:
        return str(error)
    return ""


@pytest.mark.slow
@pytest.mark.parametrize("name", [*(n for n in STEPS if has_prior(OBSERVERS[n], PRESETS["paper"]())), *CONTROLLERS])
def test_a_prior_that_lacks_something_is_one_line(name: str) -> None:
    scenario = PRESETS["paper"]().replace({"run.duration": 2.0})
    known = wfsobs.design(name, scenario).sampling
    if name in OBSERVERS:
        parts = OBSERVERS[name].parts(observer_settings(OBSERVERS[name], scenario))
    else:
        parts = CONTROLLERS[name].parts(own_settings(CONTROLLERS[name], scenario))
    assert refusal(name, Prior(), scenario=scenario).startswith(f"{name}: the prior has no ") == bool(parts)
    of_modes = {part for part in parts if not issubclass(part, Bands)}
    assert ("modes, the loop has 5" in refusal(name, scenario, sampling=known._replace(n_modes=5))) == bool(of_modes)
    for wrong in (
        {"n_modes": 0},
        {"n_modes": 1.5},
        {"dt": 0.0},
        {"dt": np.nan},
        {"ratio": 0},
        {"ratio": 2.5},
        {"delay": 0},
        {"delay": 1.5},
        {"delay": "2"},
    ):
        assert "takes whole numbers of modes, ratio and delay from 1" in refusal(name, scenario, sampling=known._replace(**wrong))
    whole = wfsobs.design(name, scenario, sampling=known._replace(delay=2.0)).sampling  # type: ignore[arg-type]
    assert whole == known and type(whole.delay) is int


@pytest.mark.parametrize("name", ["kf-multi", "lqg-kf-multi"])
def test_an_identification_of_fewer_modes_is_one_line(name: str) -> None:
    found = wfsobs.identify(Record(np.random.default_rng(1).standard_normal((2000, 1)), np.zeros((2000, 1)), 1e-3))
    assert refusal(name, found, sampling=Sampling(2, 1e-3, 5)) == f"{name}: the identification has 1 modes, the loop has 2"
    assert not refusal(name, found)


@pytest.mark.parametrize(("name", "ahead"), [("gpr-offline", gpr_offline_ahead), ("gpr-online", gpr_online_ahead)])
def test_a_gpr_for_one_frame_ahead_is_the_prediction_of_the_closed_loop(name: str, ahead: Any) -> None:
    """Oracle: what a controller commands against at a delay of two frames, computed over the record."""
    record, scenario = with_gaps("paper")
    scenario = scenario.replace({"gpr_offline.inputs": "z", "gpr_online.inputs": "z"})
    measurements = fill_missing(record.measurements(), Prior())
    prior = prior_of(scenario, record, (Bands, Training))
    settings = SimpleNamespace(gpr_offline=scenario.gpr_offline, gpr_online=scenario.gpr_online)
    want = ahead(measurements, prior, Plant(Mirror(2.0), record.dt, 5), settings, QUIET)
    observer = wfsobs.design(name, scenario, sampling=record.sampling, train=record.training, horizon=1)
    got = np.empty_like(want)
    for k, z in enumerate(replace(record, u=hold_last(record.u)).z):
        observer.update(z)
        got[k] = observer.predict(1)[0]
    np.testing.assert_allclose(got, want, rtol=0, atol=GPR * np.nanstd(want))
    with refused("designed for 1 frames ahead; design it with horizon = 0"):
        observer.predict(0)


def test_the_linear_predictor_for_two_frames_ahead() -> None:
    """Oracle: least squares of the reference two steps later on the last 30 measurements, by numpy's solver."""
    record, scenario = with_gaps("paper")
    observer = wfsobs.design("ridge-30", scenario, sampling=record.sampling, train=record.training, horizon=2)
    z, training = fill_missing(record.measurements(), Prior()).z, record.training
    known = pseudo_open_loop(training.y_lgs, training.u)
    target = training_targets(training, prior_of(scenario, record, (Bands,)).bands, record.dt)
    for mode in range(2):
        m = len(known) - 32
        X = np.lib.stride_tricks.sliding_window_view(known[:-3, mode], 30)[:m]
        f = target[31 : 31 + m, mode]
        lam = 1e-6 * m * np.mean(known[:, mode] ** 2)
        centred = np.vstack([X - X.mean(axis=0), np.sqrt(lam) * np.eye(30)])
        w = np.linalg.lstsq(centred, np.append(f - f.mean(), np.zeros(30)), rcond=None)[0]
        observer.reset()
        for row in z[:200]:
            observer.update(row)
        want = f.mean() + (z[170:200, mode] - X.mean(axis=0)) @ w
        np.testing.assert_allclose(observer.predict(2)[0][mode], want, rtol=1e-6)  # the condition number of the windows is 1e6


def test_a_horizon_that_cannot_be_is_refused() -> None:
    record, scenario = with_gaps("paper")
    with refused("takes a whole number of frames ahead"):
        wfsobs.design("ridge-30", scenario, train=record.training, horizon=0.5)
    with refused("band-passes predict nothing"):
        wfsobs.design("butterworth-cl", scenario, horizon=1)
    with refused("horizon = -1: takes 0 frames or more"):
        wfsobs.design("kf-lgs", scenario, horizon=-1)


@pytest.mark.parametrize(
    "name", ["ridge-30", "gpr-online", "kf-ngs", "butterworth-cl", "kf-adaptive", "multirate-adaptive", "persistence"]
)
def test_every_kind_takes_over_its_own_state(name: str) -> None:
    """A design with the same numbers goes on as if it were the old one."""
    record, scenario = with_gaps("paper")
    old, new = (wfsobs.design(name, scenario, sampling=record.sampling, train=record.training) for _ in range(2))
    base = run_steps(old, record.measurements(), range(500))
    new.take_over(old)
    later = range(500, 520)
    for target, values in run_steps(old, record.measurements(), later).items():
        assert np.isfinite(base[target][400:500]).all()
        np.testing.assert_allclose(
            run_steps(new, record.measurements(), later)[target][500:520],
            values[500:520],
            rtol=0,
            atol=1e-9 * np.std(record.vibration),
        )
        break
