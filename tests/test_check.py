"""What `wfsobs check` finds in records whose faults are known."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterator
from dataclasses import replace
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import binom

from tests.test_plant import closed_loop, rotation
from wfsobs import PRESETS, load, simulate
from wfsobs.cli import main
from wfsobs.identification import identify
from wfsobs.identification.plant import GroupPlant, PlantNumber, identify_plant
from wfsobs.identification.result import Identification
from wfsobs.progress import Watch
from wfsobs.record import Record, RecordError, frame_mean
from wfsobs.signal.autoregressive import Ar2
from wfsobs.telemetry import check
from wfsobs.telemetry.check import LEVEL, find_changes
from wfsobs.telemetry.records import save_record
from wfsobs.typing import Array

DT = 1e-3


def disturbance(n: int, rng: np.random.Generator) -> Array:
    """Turbulence, a narrow and a broad resonance in white noise (n,)."""
    processes = (Ar2(2.0 * pi * 0.5, 0.9, 30.0, DT), Ar2(2.0 * pi * 47.0, 0.002, 10.0, DT), Ar2(2.0 * pi * 18.0, 0.05, 3.0, DT))
    return rng.standard_normal(n) + sum(p.sample(n, rng) for p in processes)


@pytest.mark.slow
def test_a_stationary_record_has_no_changes() -> None:
    """In no more records than the level says: at most as many as binomial chance allows once in 10^4."""
    rng, count = np.random.default_rng(5), 300
    found = sum(bool(find_changes(disturbance(8000, rng), DT)) for _ in range(count))
    assert found <= binom.isf(1e-4, count, LEVEL)


@pytest.mark.parametrize("section", [0, 3, 7])
def test_a_vibration_that_comes_for_a_while_is_found_where_it_is(section: int) -> None:
    rng = np.random.default_rng(section)
    z = disturbance(8000, rng)
    z[1000 * section : 1000 * (section + 1)] += 5.0 * np.sin(2.0 * pi * 150.0 * DT * np.arange(1000))
    # 12.5 of power beside that of white noise of one in 128 of 500 Hz
    ((low, high, where, ratio),) = find_changes(z, DT)
    assert (low, high, where) == (128.0, 256.0, section)
    assert ratio == pytest.approx(1.0 + 12.5 / 0.256, rel=0.15)  # 128 bins: 9 % and their mean


@pytest.mark.slow
@pytest.mark.parametrize("gone", [slice(4000, 4300), slice(3000, 6000), slice(0, 500)])
def test_missing_frames_are_no_change(gone: slice) -> None:
    """Sections in which many are missing are not compared; of 100 records one has a change by chance."""
    found = []
    for seed in range(100):
        z = disturbance(8000, np.random.default_rng(seed))
        z[gone] = np.nan
        found += find_changes(z, DT)
    assert len(found) <= binom.isf(1e-4, 100, LEVEL)


def test_a_change_beside_missing_frames_is_found_where_it_is() -> None:
    z = disturbance(8000, np.random.default_rng(1))
    z[:2500] = np.nan
    z[5000:6000] += 5.0 * np.sin(2.0 * pi * 150.0 * DT * np.arange(1000))
    ((_, _, where, _),) = find_changes(z, DT)
    assert where == 5


@pytest.fixture(scope="module")
def record() -> Record:
    return simulate(PRESETS["paper"]().replace({"run.duration": 5.0, "sensors.lgs_low_frequency_rms": 0.0}))


def begin(record: Record, n: int) -> Record:
    """The first frames of a record, for claims that need no more."""
    return Record(record.y_lgs[:n], record.u[:n], record.dt, delay=record.delay)


@pytest.fixture(autouse=True, scope="module")
def once() -> Iterator[None]:
    """Identify the plant of the same measurements and commands once, however they are read."""
    known: dict[tuple[bytes, bytes, float], tuple[GroupPlant, ...]] = {}

    def found(record: Record) -> tuple[GroupPlant, ...]:
        key = record.y_lgs.tobytes(), record.u.tobytes(), record.dt
        if key not in known:
            known[key] = identify_plant(record)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(check, "identify_plant", found)
        yield


@pytest.fixture
def commands_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Identify the disturbance, half of the work, from few frames where only the commands are looked at."""

    def of_few(record: Record, watch: Watch) -> Identification:
        return identify(begin(record, 1500), watch=watch)

    monkeypatch.setattr(check, "identify", of_few)


def checked(tmp_path: Path, record: Record, *options: str) -> dict[str, Any]:
    file = tmp_path / "r.npz"
    save_record(file, record)
    done = CliRunner().invoke(main, ["check", str(file), "--json", *options])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def verdicts(found: dict[str, Any]) -> dict[str, str]:
    return {f["subject"]: f["verdict"] for f in found["findings"]}


@pytest.mark.slow
def test_a_right_record_can_be_relied_on(tmp_path: Path, record: Record) -> None:
    found = checked(tmp_path, record)
    assert found["reliable"]
    assert not {"note", "excluded"} & set(verdicts(found).values())
    assert (found["steps"], found["rate"], found["missing"]) == (record.n_steps, pytest.approx(1000.0), 0)
    assert found["next"] == f"wfsobs identify {tmp_path / 'r.npz'}"


def test_a_rate_of_no_loop_and_a_mode_without_noise_are_excluded(tmp_path: Path, record: Record) -> None:
    """The first file states 1000 Hz as if it were the time between two rows."""
    record = begin(record, 2000)
    slow = Record(record.y_lgs, record.u, 1000.0)
    assert verdicts(checked(tmp_path, slow))["rate"] == "excluded"
    still = Record(0.0 * record.y_lgs + [0.0, 0.25], 0.0 * record.u, 1e-3)
    texts = [f["text"] for f in checked(tmp_path, still)["findings"] if f["verdict"] == "excluded"]
    assert texts[:2] == [f"y_lgs/{what} all the time; a measurement has noise" for what in ("tip is 0", "tilt is 0.25")]
    once = np.where(np.arange(2000)[:, None] == 0, record.u, np.nan)
    for none in (Record(record.y_lgs, once, 1e-3), Record(record.y_lgs[:2], record.u[:2], 1e-3)):
        assert verdicts(checked(tmp_path, none))["identification"] == "excluded"


@pytest.mark.slow
def test_a_wrong_sign_is_excluded_and_put_right_by_the_next_command(tmp_path: Path, record: Record) -> None:
    file, data = tmp_path / "r.npz", {"y_lgs": record.y_lgs, "u": -record.u, "dt": np.array(record.dt), "unit": np.array("um")}
    np.savez(file, allow_pickle=False, **data)
    done = CliRunner().invoke(main, ["check", str(file), "--json", "--preset", "ut4", "--set", "telescope.diameter=10"])
    found = json.loads(done.stdout)
    assert not found["reliable"]
    assert " --preset ut4 --set telescope.diameter=10 " in found["next"]
    assert verdicts(found)["commands"] == "excluded"
    assert found["next"].endswith("--command-sign -1")
    again = json.loads(CliRunner().invoke(main, ["check", *found["next"].split()[2:], "--json"]).stdout)
    assert again["reliable"]


@pytest.mark.slow
@pytest.mark.usefixtures("commands_alone")
def test_delay_and_gain_are_put_right_by_the_next_command(tmp_path: Path) -> None:
    """Half a frame and a mirror that does 1.2 times what it is told; a rotation has no option."""
    file, done = tmp_path / "r.npz", closed_loop(10_000, 1.5, 1.2 * np.eye(2), gain=0.4)
    save_record(file, replace(done, delay=2))
    found = json.loads(CliRunner().invoke(main, ["check", str(file), "--json"]).stdout)
    seen = verdicts(found)
    assert (seen["command sign"], seen["command rotation"], seen["command delay"]) == ("ok", "ok", "note")
    words = found["next"].split()
    assert float(words[words.index("--command-delay") + 1]) == pytest.approx(1.5, abs=0.1)
    if seen["command gain"] == "note":
        assert float(words[words.index("--command-gain") + 1]) == pytest.approx(1.2, abs=0.1)
    assert "--trust" in words, "the file states another delay"
    stated = ["check", str(file), "--json", "--command-delay", "1.5", "--command-gain", "1.2", "--trust"]
    again = verdicts(json.loads(CliRunner().invoke(main, stated).stdout))
    assert again["command delay"] == "ok" and again["command gain"] in ("ok", "undecided")


@pytest.mark.slow
@pytest.mark.usefixtures("commands_alone")
def test_a_rotation_and_a_flipped_axis_are_excluded(tmp_path: Path) -> None:
    turned = closed_loop(3000, 2.0, rotation(np.radians(96.0)))
    found = checked(tmp_path, turned)
    assert (verdicts(found)["command sign"], verdicts(found)["command rotation"]) == ("ok", "excluded")
    file = tmp_path / "r.npz"
    assert found["next"] == f"wfsobs identify {file} --trust", "without that it is refused"
    assert load(file, trust=True).n_steps == turned.n_steps
    with pytest.raises(RecordError, match="rotation 0 is excluded"):
        load(file)
    seen = verdicts(checked(tmp_path, closed_loop(3000, 2.0, np.diag([1.0, -1.0]))))
    assert (seen["command sign"], seen["command rotation"]) == ("excluded", "ok")


@pytest.mark.slow
@pytest.mark.usefixtures("commands_alone")
def test_a_delay_in_which_the_halves_differ_is_not_decided(tmp_path: Path) -> None:
    """No one plant made both; the whole record has one number for it, with a small deviation."""
    one, two = closed_loop(10_000, 1.4, np.eye(2), gain=0.4), closed_loop(10_000, 2.5, np.eye(2), seed=2, gain=0.4)
    parts = (np.concatenate([getattr(one, name), getattr(two, name)]) for name in ("y_lgs", "u"))
    found = checked(tmp_path, Record(*parts, 1e-3, delay=3), "--trust")
    (text,) = (f["text"] for f in found["findings"] if f["subject"] == "command delay")
    assert verdicts(found)["command delay"] == "undecided"
    first, second = (float(n) for n in re.findall(r"(\d\.\d+) \+-", text))
    assert (first, second) == (pytest.approx(1.4, abs=0.1), pytest.approx(2.5, abs=0.1)), "five deviations of 10 s"
    assert "--command-delay" not in found["next"]


@pytest.mark.slow
def test_halves_are_compared_by_what_their_modes_have_in_common(monkeypatch: pytest.MonkeyPatch) -> None:
    """The delays of both modes together may be known where that of neither is."""
    record = closed_loop(4000, 2.0, np.eye(2), gain=0.4)
    (whole,) = identify_plant(record)
    none = (PlantNumber(), PlantNumber())
    early = replace(whole, delay=none, common_delay=PlantNumber(2.5, 0.2))
    late = replace(whole, delay=(PlantNumber(1.4, 0.05),) * 2, common_delay=PlantNumber(1.4, 0.05))
    halves = iter([(early,), (late,)])
    monkeypatch.setattr(check, "identify_plant", lambda _: next(halves))
    (group,), (remark,) = check._in_halves((whole,), record)
    assert remark.subject == "command delay" and remark.text.startswith("2.50 +- 0.20 and 1.400 +- 0.050 in the halves")
    assert group.delay == none and group.common_delay == PlantNumber() and group.common_gain == whole.common_gain


@pytest.mark.slow
def test_an_offset_and_a_few_outliers_are_no_fault(tmp_path: Path, record: Record) -> None:
    """One frame in 200 off by 40 times the noise in one part of the record, two of the first ones, which pass a gate, far off;
    and commands about another place than zero.
    """
    y, rng = record.y_lgs.copy(), np.random.default_rng(3)
    y[300 + rng.choice(2000, 10, replace=False)] += 40.0 * PRESETS["paper"]().sensors.lgs_noise
    y[[20, 60]] = -9.999
    found = checked(tmp_path, Record(y, record.u + 200.0, record.dt, delay=record.delay))
    assert found["reliable"] and verdicts(found)["stationarity"] == "ok"


@pytest.mark.slow
def test_faults_are_named(tmp_path: Path, record: Record) -> None:
    """Lost frames, a level of outliers and noise that grows."""
    rng = np.random.default_rng(3)
    record = begin(record, 3000)
    y = record.y_lgs.copy()
    y[rng.choice(len(y), 60, replace=False)] = np.nan
    late = slice(len(y) // 2, None)
    y[late] += 0.02 * rng.standard_normal(y[late].shape)
    y[rng.choice(len(y), 36, replace=False), 0] += 1.5
    found = checked(tmp_path, Record(y, record.u, record.dt, delay=record.delay))
    assert not found["reliable"]
    seen = verdicts(found)
    assert (seen["frames"], seen["stationarity"], seen["outlying samples"]) == ("note", "note", "note")


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_a_size_that_no_telescope_has_is_named(tmp_path: Path, record: Record, scale: float) -> None:
    """As of nanometres read as micrometres, or the reverse."""
    y, u = (scale * x[:2000] for x in (record.y_lgs, record.u))
    found = checked(tmp_path, Record(y, u, record.dt, delay=record.delay))
    assert verdicts(found)["unit"] == "note"
    assert not found["reliable"]


def test_too_little_is_said(tmp_path: Path, record: Record) -> None:
    z = record.z[2:2000]
    at_rest = verdicts(checked(tmp_path, Record(z, np.zeros_like(z), record.dt)))
    assert at_rest["commands"] == "ok"
    texts = {f["subject"]: f["text"] for f in checked(tmp_path, begin(record, 300), "--open-loop")["findings"]}
    assert texts["commands"] == "not used, as stated: the mirror is at rest"
    few = checked(tmp_path, begin(record, 300))
    seen = verdicts(few)
    subjects = ("command sign, delay, gain, rotation", "stationarity", "identification")
    assert [seen[subject] for subject in subjects] == ["undecided", "undecided", "excluded"]
    assert few["next"] is None
    assert CliRunner().invoke(main, ["check", str(tmp_path / "r.npz")]).stdout.endswith("\nIt cannot be identified.\n")
    done = CliRunner().invoke(main, ["check", str(tmp_path / "no.npz")])
    assert (done.exit_code, done.output.count("\n")) == (2, 1)


def test_what_the_frames_of_the_ngs_lack_is_said(tmp_path: Path) -> None:
    """Those that are missing, by `observe` as well, and noise of their own where they are means of the LGS."""
    rng = np.random.default_rng(1)
    y, u = 0.05 * rng.standard_normal((2, 1500, 2))
    y[:, 1], frames = np.where(np.arange(1500) == 5, 0.1, np.nan), np.full((1500, 2), np.nan)
    frames[5::50] = rng.standard_normal((30, 2))
    record = Record(y, u, DT, y_ngs=frames, ratio=5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = checked(tmp_path, record)
    texts = [(f["subject"], f["text"]) for f in found["findings"] if "frames" in f["subject"]]
    assert texts == [("frames", "1500 at 1000 Hz, 1.5 s; 1499 missing (99.9 %)"), ("NGS frames", "299; 269 missing (90 %)")]
    told = CliRunner().invoke(main, ["observe", str(tmp_path / "r.npz"), "--observer", "zero"]).stderr
    assert "269 of 299 NGS frames are missing" in told.replace("\n", " ")
    y = rng.standard_normal((1500, 2)).cumsum(axis=0)
    for ratio in (1, 5):
        frames = np.where((np.arange(1500) % ratio == 0)[:, None], np.roll(frame_mean(y, ratio), -1, axis=0), np.nan)
        with pytest.raises(RecordError, match="y_ngs has no noise of its own beside y_lgs"):
            identify(Record(y, u, DT, y_ngs=frames, ratio=ratio))
