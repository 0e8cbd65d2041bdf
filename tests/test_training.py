"""Training data from telemetry: another record, or the first part of the record; and a prior straight from an identification."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import wfsobs
from wfsobs.cli import main
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.run import closed_loop
from wfsobs.evaluation.result import Result
from wfsobs.identification import Identification, identify
from wfsobs.identification.identification import identification_toml
from wfsobs.observers import OBSERVERS
from wfsobs.pipeline import observe
from wfsobs.prior import Bands, Lines, Model
from wfsobs.priors_from import scenario as from_scenario
from wfsobs.priors_from.telemetry import told_by, training_of, with_training
from wfsobs.record import Record, RecordError, Training
from wfsobs.scenario import Scenario, configfile
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.records import save_record
from wfsobs.testing import run_steps

LEARN = ("gpr-offline", "ridge", "ridge-30")
SMALL: dict[str, Any] = {
    "run.duration": 2.0,
    "run.warm_up": 0.2,
    "gpr_offline.training_size": 200,
    "gpr_offline.depth": 25,
}
S = PRESETS["paper"]().replace(SMALL)
SET = [word for name, value in SMALL.items() for word in ("--set", f"{name}={value}")]


def telemetry(seed: int) -> Record:
    """A record without training data of its own."""
    return replace(simulate(S.replace({"run.seed": seed})), training=None)


@pytest.fixture(scope="module", name="night")
def _night() -> Record:
    return telemetry(1)


@pytest.fixture(scope="module", name="other")
def _other() -> Record:
    return telemetry(2)


def values(result: Result) -> dict[str, np.ndarray]:
    assert not result.failures
    return {f"{e.observer}/{e.target}": e.values for e in result.estimates}


def test_another_record_is_what_a_record_brings_as_its_training_data(night: Record, other: Record) -> None:
    """To the bit: the same numbers by another way."""
    brought = replace(night, training=Training(other.y_lgs, other.u, other.open_loop_y))
    expected, got = values(observe(brought, S, observers=LEARN)), values(observe(night, S, observers=LEARN, train=other))
    assert expected.keys() == got.keys() and len(got) == 3
    for name in expected:
        np.testing.assert_array_equal(got[name], expected[name])
    assert {f.observer for f in observe(night, S, observers=LEARN).failures} == set(LEARN), "without it none of them can run"


def test_the_first_seconds_train_and_the_rest_is_scored(night: Record) -> None:
    assert night.open_loop_y is not None
    brought = replace(night, training=Training(night.y_lgs[:800], night.u[:800], night.open_loop_y[:800]))
    whole = values(observe(brought, S, observers=(*LEARN, "kf-lgs")))
    result = observe(night, S, observers=(*LEARN, "kf-lgs"), train=0.8)
    for name, got in values(result).items():
        assert np.isnan(got[:800]).all(), name
        np.testing.assert_array_equal(got[800:], whole[name][800:])
    assert len(result.scores) == 12 and {s.start for s in result.scores} == {0.8}
    assert night.vibration is not None
    for s in result.scores:
        if s.observer == "ridge":
            column = ("tip", "tilt").index(s.mode)
            error = (whole["ridge/vibration"] - night.vibration)[800:, column]
            known = ~np.isnan(whole["gpr-offline/vibration"][800:, column]) & ~np.isnan(error)
            # a mean of squares in another order: rounding
            assert s.rms == pytest.approx(np.sqrt(np.mean(error[known] ** 2)), rel=1e-12)


def test_what_comes_after_is_not_learnt_from(night: Record) -> None:
    y = night.y_lgs.copy()
    y[800:] += 1.0
    for record in (night, replace(night, y_lgs=y)):
        training = with_training(record, 0.8, S).training
        assert training is not None and training.y_lgs.base is None
        np.testing.assert_array_equal(training.y_lgs, night.y_lgs[:800])


def test_missing_samples_of_training_data_are_held(night: Record, other: Record) -> None:
    """z keeps its last value: y = z + u[k - delay]."""
    y = other.y_lgs.copy()
    y[100:103, 0] = np.nan
    training = training_of(with_training(night, replace(other, y_lgs=y), S))
    assert training is not None
    expected = other.z[99, 0] + other.u[98:101, 0]
    np.testing.assert_allclose(training.y_lgs[100:103, 0], expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(training.y_lgs[103:], other.y_lgs[103:])


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARN)
def test_a_design_is_trained_without_gaps_by_either_kind_of_data(name: str, night: Record, other: Record) -> None:
    """Oracle: a record as training data, whose gaps are held."""
    y = other.y_lgs.copy()
    y[20] = np.nan
    raw = Training(y, other.u, other.open_loop_y)
    bands = from_scenario.prior_of(S, night, (Bands,))
    designs = [
        wfsobs.design(name, prior, scenario=S, sampling=night.sampling, train=train)
        for prior, train in ((S, replace(other, y_lgs=y)), (S, raw), (replace(bands, training=raw), None))
    ]
    got = [run_steps(observer, night.measurements())["vibration"] for observer in designs]
    assert np.isfinite(got[0][-500:]).all()
    for other_way in got[1:]:
        np.testing.assert_array_equal(other_way, got[0])


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda x: x[:, :1], "the training data has 1 modes, the record 2"),
        (lambda x: np.hstack([x, x[:, :1]]), "the training data has 3 modes, the record 2"),
        (lambda x: x * [np.nan, 1.0], "the training data holds no measurement of mode 0"),
    ],
    ids=["fewer", "more", "missing"],
)
def test_training_data_that_do_not_fit_are_one_line_whoever_brings_them(
    change: Any, reason: str, night: Record, other: Record
) -> None:
    raw = Training(*(change(x) for x in (other.y_lgs, other.u, other.open_loop_y)))
    wrong = Record(raw.y_lgs, np.nan_to_num(raw.u), night.dt, open_loop_y=raw.open_loop_y)
    result = observe(replace(night, training=raw), S, observers=(*LEARN, "zero"))
    assert {f.reason for f in result.failures} == {f"{name} left out: {reason}" for name in LEARN}
    assert {e.observer for e in result.estimates} == {"zero"}
    with pytest.raises(RecordError, match=f"^{reason}$"):
        observe(night, S, observers=LEARN, train=wrong)
    with pytest.raises(RecordError, match=f"^{reason}$"):
        training_of(replace(night, training=raw))


@pytest.mark.slow
@pytest.mark.parametrize("first", [True, False], ids=["first seconds", "another record"])
def test_a_mode_that_the_record_never_measures_needs_no_training_data(first: bool, night: Record, other: Record) -> None:
    """The other mode is estimated as without it; one that is lost in the training data alone is refused."""
    dead = replace(night, y_lgs=night.y_lgs * [1.0, np.nan])
    train = 0.8 if first else replace(other, y_lgs=other.y_lgs * [1.0, np.nan])
    expected, got = (values(observe(r, S, observers=("ridge", "kf-lgs"), train=0.8 if first else other)) for r in (night, dead))
    for name, estimate in got.items():
        np.testing.assert_allclose(estimate[:, 0], expected[name][:, 0], rtol=0, atol=1e-12)
    assert values(observe(dead, S, observers=("ridge",), train=train)).keys() == {"ridge/vibration"}
    lost = replace(night, y_lgs=np.where(np.arange(night.n_steps)[:, None] < 900, night.y_lgs * [1.0, np.nan], night.y_lgs))
    with pytest.raises(RecordError, match=r"^the training data holds no measurement of mode 1$"):
        observe(lost if first else night, S, observers=("ridge",), train=train)


@pytest.mark.parametrize("train", [True, np.True_, "0.8", [0.8]], ids=str)
def test_what_is_no_duration_is_one_line(train: Any, night: Record) -> None:
    with pytest.raises(RecordError, match=r"^train takes a record, or a duration \[s\], not .*$"):
        observe(night, S, observers=("zero",), train=train)


def call(*arguments: object) -> Any:
    return CliRunner().invoke(main, [str(x) for x in arguments])


@pytest.fixture(scope="module", name="files")
def _files(night: Record, other: Record, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    save_record(folder / "night.npz", night)
    save_record(folder / "other.npz", other)
    save_record(folder / "slow.npz", replace(other, dt=2e-3))
    save_record(folder / "late.npz", replace(other, delay=3))
    tip = {name: getattr(other, name)[:, :1] for name in ("y_lgs", "u", "y_ngs", "open_loop_y", "turbulence", "vibration")}
    save_record(folder / "tip.npz", replace(other, **tip))  # type: ignore[arg-type]
    cut = {name: getattr(other, name)[:100] for name in ("y_lgs", "u", "y_ngs", "open_loop_y", "turbulence", "vibration")}
    save_record(folder / "short.npz", replace(other, **cut))  # type: ignore[arg-type]
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--train", "none.npz"), "none.npz: cannot be read"),
        (("--train", "slow.npz"), "the training data has a rate of 500 Hz, the record 1000 Hz"),
        (("--train", "tip.npz"), "the training data has 1 modes, the record 2"),
        (("--train", "late.npz", "--trust"), "the training data has 3 steps of delay, the record 2"),
        (("--train", "short.npz"), "the training data has 100 steps; gpr_offline.depth + training_size need 225"),
        (("--train", "night.npz"), "the training data is the record itself"),
        (("--train-until", "2"), "takes more than 0 and less than the record's 2 s"),
        (("--train-until", "0.1"), "the training data has 100 steps"),
        (("--train", "other.npz", "--train-until", "1"), "give one of them"),
    ],
)
@pytest.mark.parametrize("command", [("observe",), ("loop", "--record")], ids=["observe", "loop"])
def test_what_cannot_be_trained_on_is_refused_with_a_line(
    command: tuple[str, ...], options: tuple[str, ...], reason: str, files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(files)
    done = call(*command, "night.npz", *options, *SET)
    assert done.exit_code == 2 and reason in done.stderr.splitlines()[-1]
    assert "wfsobs: training data:" not in done.stderr


@pytest.mark.slow
def test_observe_says_what_it_was_trained_on(night: Record, files: Path) -> None:
    done = call("observe", files / "night.npz", "--train-until", "0.8", "--json", *SET)
    assert done.exit_code == 0 and "training data: the first 0.8 s of 2 s; estimates and scores begin after" in done.stderr
    rows = [r for r in json.loads(done.stdout) if r["observer"] == "ridge"]
    expected = {s.mode: s.rms for s in observe(night, S, train=0.8).scores if s.observer == "ridge"}
    assert {r["mode"]: r["rms_um"] for r in rows} == pytest.approx(expected, rel=1e-12)


def test_loop_counts_what_follows_the_training_data(night: Record, files: Path) -> None:
    names = ("integrator", "integrator+gpr-offline")
    chosen = [word for name in names for word in ("--controller", name)]
    done = call("loop", "--record", files / "night.npz", "--train-until", "0.8", "--json", *chosen, *SET)
    assert done.exit_code == 0 and "training data: the first 0.8 s" in done.stderr
    rows = json.loads(done.stdout)
    assert {r["needs"] for r in rows if r["controller"] == "integrator"} == {"given spectra"}
    got = {(r["controller"], r["mode"]): r["residual_rms_nm"] for r in rows}
    brought = replace(night, training=Training(night.y_lgs[:800], night.u[:800], night.open_loop_y[:800]))  # type: ignore[index]
    for outcome in closed_loop(brought, design(S, names)).outcomes:
        assert outcome.residual is not None
        for column, mode in enumerate(("tip", "tilt")):
            expected = 1e3 * np.sqrt(np.mean(outcome.residual[800:, column] ** 2))
            assert got[outcome.controller, mode] == pytest.approx(expected, rel=1e-9)


# ---------------------------------------------------------------------- a prior without a file


@pytest.fixture(scope="module", name="found")
def _found(night: Record) -> Identification:
    return identify(night)


def test_an_identification_is_a_prior_without_a_file(night: Record, found: Identification) -> None:
    """As by the file that it writes, to the digits that a file has: all of them."""
    saved = configfile.from_toml(identification_toml(found, found.scenario(S)))
    by_file = observe(night, told_by(saved, S), observers=("kf-lgs", "kf-multi", "multirate"))
    direct = observe(night, S, observers=("kf-lgs", "kf-multi", "multirate"), prior=found)
    for name, got in values(direct).items():
        np.testing.assert_allclose(got, values(by_file)[name], rtol=0, atol=1e-9 * float(np.nanstd(got)))
    plain = values(observe(night, S, observers=("kf-lgs",)))
    assert np.nanstd(plain["kf-lgs/turbulence"] - values(direct)["kf-lgs/turbulence"]) > 0, "it is not the scenario's model"


def test_no_scenario_is_needed(night: Record, found: Identification) -> None:
    by_default = values(observe(night, Scenario(), observers=("kf-multi",), prior=found))
    for name, got in values(observe(night, observers=("kf-multi",), prior=found)).items():
        np.testing.assert_array_equal(got, by_default[name])


def numbers_in(part: Any) -> Any:
    return part if isinstance(part, tuple) else vars(part).values()


def test_the_parts_are_those_that_were_found(night: Record, found: Identification) -> None:
    prior = from_scenario.prior_of(told_by(found, Scenario()), None, (Model, Lines, Bands))
    assert prior.training is None and prior.spectra == ()
    assert len(prior.model) == 2 and prior.bands is not None
    for lines, mode in zip(prior.lines, found.modes, strict=True):
        for part in ("turbulence", "lines", "continuum"):
            for got, want in zip(getattr(lines, part), getattr(mode.prior, part), strict=True):
                assert [*numbers_in(got)] == pytest.approx([*numbers_in(want)], rel=1e-9)
    for model, mode in zip(prior.model, found.modes, strict=True):
        strongest = max(mode.peaks, key=lambda p: p.rms.value)
        assert model.lgs_noise == pytest.approx(mode.noise.value, rel=1e-12)
        assert model.vibration.omega == pytest.approx(2 * np.pi * strongest.frequency.value, rel=1e-12)
    direct = OBSERVERS["kf-multi"].estimate(night.measurements(), replace(prior, model=(), bands=None), Scenario().multipeak)
    expected = values(observe(night, observers=("kf-multi",), prior=found))
    for target, got in direct.items():
        np.testing.assert_allclose(got, expected[f"kf-multi/{target}"], rtol=0, atol=1e-9 * float(np.std(got)))
