"""Sign and delay from a record: simulated closed loops whose sign and delay are known."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.signal import lfilter

from tests.test_plant import closed_loop as loop_of_plant
from tests.test_plant import rotation
from wfsobs.cli import main
from wfsobs.cli.options import DeclaredFile, load_declared
from wfsobs.identification.plant import Contradiction, contradiction
from wfsobs.record import Record, RecordError
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry import records
from wfsobs.telemetry.command_response import DECIDED, command_response, saturation_lines
from wfsobs.telemetry.intake import DeclaredFormat
from wfsobs.telemetry.preview import Preview, Reading, preview
from wfsobs.telemetry.records import load, save_record
from wfsobs.typing import Array

GAIN, LEAK, NOISE = 0.4, 0.995, 0.05


def closed_loop(disturbance: Array, noise: Array, sign: int, delay: int) -> Record:
    """A leaky integrator, written out: y[k] = phi[k-1] + sign u[k-delay] + noise."""
    y, u = np.zeros_like(disturbance), np.zeros_like(disturbance)
    for k in range(1, len(y)):
        y[k] = disturbance[k - 1] + noise[k] + (sign * u[k - delay] if k >= delay else 0.0)
        u[k] = LEAK * u[k - 1] - sign * GAIN * y[k]
    return Record(y, u, 1e-3)


@pytest.fixture(scope="module", params=["paper", "ut4"])
def disturbance(request: pytest.FixtureRequest) -> Array:
    record = simulate(PRESETS[request.param]().replace({"run.duration": 20.0}))
    assert record.turbulence is not None and record.vibration is not None
    return record.turbulence + record.vibration


@pytest.mark.slow
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("delay", [1, 2, 3])
def test_of_a_loop_that_is_known(disturbance: Array, sign: int, delay: int) -> None:
    """The sign is found always; a delay is the right one, or left open where two steps explain nearly the same."""
    noise = NOISE * np.random.default_rng(3).standard_normal(disturbance.shape)
    found = command_response(closed_loop(disturbance, noise, sign, delay))
    assert found is not None and found.sign == sign
    assert found.reply == pytest.approx(-sign, abs=1e-6), "an integrator's command follows from its measurement alone"
    assert found.peak == delay and found.delay in ((delay,) if delay == 3 else (delay, None)), found.lines()
    if delay > 1:
        assert found.scale == pytest.approx(1.0, abs=0.15), "to the scatter of 20 s"
        assert found.shares[delay] == pytest.approx(1.0, abs=0.1), "nothing else jumps"


@pytest.mark.slow
def test_what_the_simulator_records(disturbance: Array) -> None:
    """The loop of the simulation has a delay of 2."""
    record = simulate(PRESETS["paper"]().replace({"run.duration": 20.0, "loop.gain": 0.5}))
    found = command_response(record)
    assert found is not None and (found.sign, found.delay) == (1, 2)
    assert found.lines()[0].startswith("sign +1: commands move against the measurement of their row, correlation -1.00")
    line = (
        r"delay 2: commands 2 steps earlier explain \d+ % \(correlation \+0\.9\d\) of the measurements' jumps, those \d steps? "
    )
    assert re.match(line, found.lines()[1]), found.lines()
    assert found.shares[2] == max(found.shares.values()) > 0.8, "of a disturbance that is smooth but not a polynomial"


def test_undecided_where_the_record_does_not_say() -> None:
    """Commands that follow nothing; a loop so slow that its commands are lost in the noise; one that is too short, or at rest."""
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((5000, 2))
    apart = command_response(Record(noise, rng.standard_normal((5000, 2)).cumsum(axis=0), 1e-3))
    assert apart is not None and apart.sign is None and apart.delay is None
    assert apart.lines()[0].startswith("sign and delay undecided: commands do not follow the measurements")
    y, u = noise.copy(), np.zeros_like(noise)
    for k in range(2, len(y)):
        y[k] += u[k - 2]
        u[k] = u[k - 1] - 0.001 * y[k]
    slow = command_response(Record(y, u, 1e-3))
    assert slow is not None and slow.sign == 1 and slow.delay is None and slow.margin < DECIDED
    assert "delay undecided" in slow.lines()[1] and slow.lines()[1].endswith("3 are needed")
    told = Reading(response=slow, contradiction=Contradiction("command delay 2 is excluded by the data"))
    assert told.lines() == [told.contradiction.text], "the likelihood decides it"
    assert command_response(Record(y[:300], u[:300], 1e-3)) is None
    assert command_response(Record(y, np.zeros_like(u), 1e-3)) is None


def test_commands_of_another_unit_are_said_to_be() -> None:
    record = simulate(PRESETS["paper"]().replace({"run.duration": 5.0}))
    found = command_response(replace(record, u=1e3 * record.u))
    assert found is not None and (found.sign, found.delay) == (1, None)
    expected = "delay undecided: at no delay do the commands explain the measurements' jumps, as if the two had different units"
    assert found.lines()[1] == expected


def limited_loop(disturbance: Array, rail: float, recorded: bool) -> Record:
    """An integrator that goes on beyond the rail of the mirror; recorded : whether what the mirror does is in the record."""
    noise = NOISE * np.random.default_rng(3).standard_normal(disturbance.shape)
    y, u = np.zeros_like(disturbance), np.zeros_like(disturbance)
    for k in range(2, len(y)):
        y[k] = disturbance[k - 1] + noise[k] + np.clip(u[k - 2], -rail, rail)
        u[k] = LEAK * u[k - 1] - GAIN * y[k]
    return Record(y, np.clip(u, -rail, rail) if recorded else u, 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.02, 0.1])
def test_commands_beyond_a_rail(rate: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Smooth disturbances of 0.4 um; the level is that of the rail, and without one nothing is said."""
    rng, n = np.random.default_rng(5), 8000
    kernel = np.exp(-rate * np.arange(600.0))
    white = rng.standard_normal((n + 600, 2))
    smooth = np.column_stack([np.convolve(np.convolve(x, kernel, "same"), kernel, "same")[:n] for x in white.T])
    disturbance = smooth * 0.4 / smooth.std(axis=0)
    rails = limited_loop(disturbance, 0.6, recorded=False)
    lines = saturation_lines(rails)
    assert [line.split(":")[0] for line in lines] == ["tip", "tilt"] and all("do nothing" in line for line in lines)
    for line in lines:
        levels = [float(level) for level in re.findall(r"[+-]\d+(?= nm)", line)]
        assert sorted(np.sign(levels)) == [-1, 1] and np.abs(levels) == pytest.approx(600.0, rel=0.05), (
            "to the steps of the search"
        )
    assert saturation_lines(limited_loop(disturbance, np.inf, recorded=False)) == []
    (stays, _) = saturation_lines(limited_loop(disturbance, 0.6, recorded=True))
    assert re.fullmatch(r"tip: commands stay at their largest value in \d+ frames, as at the limit of a mirror", stays)
    assert saturation_lines(replace(rails, u=0.0 * rails.u)) == []
    path = tmp_path / "rails.npz"
    save_record(path, rails)
    shown = preview(path.read_bytes(), path.name).reading.lines()
    assert [line for line in shown if "do nothing" in line] == lines, "on the page"
    assert preview(path.read_bytes(), path.name, declaration=DeclaredFormat(rail=0.6)).reading.limits == []
    load_declared(str(path), Scenario(), DeclaredFile())
    said = capsys.readouterr().err
    assert all(f"wfsobs: {path}: {line}\n" in said for line in lines), "on the command line"


@pytest.mark.slow
def test_no_rail_is_seen_in_loops_without(disturbance: Array) -> None:
    """Outlying samples, missing ones, an offset and commands that are held do not look like one."""
    noise = NOISE * np.random.default_rng(3).standard_normal(disturbance.shape)
    clean = closed_loop(disturbance, noise, 1, 2)
    y, u = clean.y_lgs.copy(), clean.u.copy()
    y[::97] += 2.0
    y[5000:5400], u[5000:5400] = np.nan, np.nan
    for record in (clean, replace(clean, y_lgs=y, u=u), replace(clean, u=clean.u + 200.0)):
        assert saturation_lines(record) == []


@pytest.mark.slow
@pytest.mark.parametrize(("delay", "steps"), [(1, 2000), (2, 2000), (3, 2000), (2, 20_000)])
def test_what_the_data_exclude(disturbance: Array, delay: int, steps: int) -> None:
    """The wrong sign always, the right one never; nor the right delay."""
    noise = NOISE * np.random.default_rng(3).standard_normal(disturbance.shape)
    record = closed_loop(disturbance, noise, 1, delay)
    record = replace(record, y_lgs=record.y_lgs[:steps], u=record.u[:steps] + 30.0, delay=delay)
    assert contradiction(record) is None
    reverse = contradiction(replace(record, u=-record.u), -1)
    assert reverse is not None and reverse.proposal == {"command_sign": 1}
    assert reverse.text.startswith("command sign -1 is excluded by the data") and reverse.text.endswith(" with +1")
    if delay < 3:
        late = contradiction(replace(record, delay=5))
        assert late is not None and late.text.startswith("command delay 5 is excluded by the data, which")
        assert late.proposal["command_delay"] == pytest.approx(delay, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("delay", "matrix", "line"),
    [
        (1.5, np.eye(2), r"command delay 2 is excluded by the data, .* with (1\.\d+) \+- .*"),
        (2.0, 1.25 * np.eye(2), r"command gain 1 of (?:tip|tilt) is excluded by the data, .* with (1\.\d+) \+- .*"),
        (
            2.0,
            rotation(np.radians(96.0)),
            r"command rotation 0 is excluded by the data, .* with \+(9\d\.\d) degrees, y = R u: state .*",
        ),
        (2.0, np.diag([1.0, -1.0]), r"command sign (\+1) of tilt is excluded by the data, .* with -1, .*"),
        (2.0, np.diag([-1.0, 1.0]), r"command sign (\+1) of tip is excluded by the data, .* with -1, .*"),
        (2.0, np.eye(2), ""),
    ],
)
def test_what_else_the_data_exclude(delay: float, matrix: Array, line: str) -> None:
    """Read as of two frames, gain 1, no rotation; numbers within five of the deviations that are usual in 20 s."""
    why = contradiction(replace(loop_of_plant(20_000, delay, matrix, gain=0.4), delay=2))
    found = re.fullmatch(line, why.text if why else "")
    assert found, line
    assert why is None or set(why.proposal) == ({"command_delay"} if "delay" in line else set()), "what a page has a field for"
    right = {1.5: 1.5}.get(delay, float(matrix[0, 0]) if line.startswith("command gain") else 96.0)
    if "+-" in line or "degrees" in line:
        assert float(found[1]) == pytest.approx(right, abs=5.0 * (0.3 if "degrees" in line else 0.03))


@pytest.mark.slow
@pytest.mark.parametrize("is_rounded", [True, False])
def test_an_error_of_the_recorded_commands_excludes_no_gain(is_rounded: bool) -> None:
    """2.9 nm rms, of steps of 10 nm or of the read-back, that the mirror does not follow: a gain of 0.55 was likelier by 100.

    The wrong sign is excluded all the same.
    """
    rng = np.random.default_rng(1)

    def process(f: float, damping: float, rms: float) -> Array:
        pole = np.exp(2e-3 * np.pi * f * (-damping + 1j * np.sqrt(1.0 - damping**2)))
        x = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.standard_normal((24_000, 2)), axis=0)[4000:]
        return np.asarray(rms * x / x.std(axis=0))

    record = closed_loop(process(2.0, 0.9, 0.3) + process(47.0, 0.01, 0.06), 0.02 * rng.standard_normal((20_000, 2)), 1, 2)
    u = 0.01 * np.round(record.u / 0.01) if is_rounded else record.u + 0.0029 * rng.standard_normal(record.u.shape)
    assert contradiction(replace(record, u=u)) is None
    reverse = contradiction(replace(record, y_lgs=record.y_lgs[:4000], u=-u[:4000]), -1)
    assert reverse is not None and reverse.text.startswith("command sign -1 is excluded by the data")


def test_a_unit_that_is_none_is_not_taken_for_micrometres(tmp_path: Path) -> None:
    """Nanometres without a unit; stated, or trusted, they are read."""
    record = simulate(PRESETS["paper"]().replace({"run.duration": 2.0}))
    np.savez(path := tmp_path / "r.npz", y_lgs=1e3 * record.y_lgs, u=1e3 * record.u, dt=record.dt)
    with pytest.raises(RecordError, match=r"no unit is stated, .* plausible as nm.*; --trust goes on"):
        load(path)
    np.testing.assert_allclose(load(path, unit="nm").y_lgs, record.y_lgs)
    np.testing.assert_allclose(load(path, trust=True).y_lgs, 1e3 * record.y_lgs)
    shown = preview(path.read_bytes(), path.name)
    assert isinstance(shown, Preview) and shown.reading.missing.startswith("Choose the unit first")


@pytest.mark.slow
def test_what_does_not_decide_is_not_excluded() -> None:
    """Commands that follow nothing, or do nothing, too few steps, a mirror at rest, a loop so slow that its commands are lost in
    the noise; numbers without noise."""
    rng = np.random.default_rng(5)
    noise, u = rng.standard_normal((5000, 2)), rng.standard_normal((5000, 2)).cumsum(axis=0)
    slow, half, ramp = 1e-3 * noise.cumsum(axis=0), noise[:, :1].repeat(2, axis=1), np.arange(5000.0)[:, None] * [1.0, -1.0]
    last = [(noise, half), (half, slow), (ramp, ramp), (noise, np.sign(ramp - 2500.5))]
    for y, commands in ((noise, u), (noise[:300], u[:300]), (noise, 0.0 * u), (noise, -slow), (u, u), *last):
        for sign in (1, -1):
            assert contradiction(Record(y, sign * commands, 1e-3)) is None
    assert command_response(Record(np.ones_like(noise), u, 1e-3)) is None


@pytest.mark.slow
@pytest.mark.parametrize("rows", [slice(1, None, 2), slice(2, None, 3)])
def test_missing_frames_exclude_no_delay(disturbance: Array, rows: slice) -> None:
    """Of a sensor that is slower than the commands, one row in two or three."""
    record = closed_loop(disturbance, NOISE * np.random.default_rng(1).standard_normal(disturbance.shape), 1, 2)
    record.y_lgs[rows] = np.nan
    assert contradiction(record) is None


@pytest.mark.slow
def test_every_way_in_refuses_a_wrong_sign_unless_it_is_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each asks for what the data exclude; of the same record that is found out once."""
    known: dict[tuple[object, ...], Contradiction | None] = {}

    def once(record: Record, *stated: Any) -> Contradiction | None:
        key = record.y_lgs.tobytes(), record.u.tobytes(), record.delay, stated
        known[key] = known[key] if key in known else contradiction(record, *stated)
        return known[key]

    monkeypatch.setattr(records, "contradiction", once)
    record = simulate(PRESETS["paper"]().replace({"run.duration": 5.0}))
    wrong = tmp_path / "wrong.npz"
    save_record(wrong, replace(record, u=-record.u))
    for words in (
        ["observe", "RECORD", "--json", "--observer", "zero"],
        ["identify", "RECORD"],
        ["loop", "--controller", "integrator", "--record", "RECORD"],
        ["live", "--headless", "--seconds", "0.2", "--observer", "zero", "--replay", "RECORD"],
    ):
        words = [str(wrong) if word == "RECORD" else word for word in words]
        done = CliRunner().invoke(main, words)
        assert done.exit_code != 0 and done.stdout == ""
        assert re.fullmatch(r"wfsobs: .*wrong.npz: command sign \+1 is excluded by the data, .*; --trust goes on\n", done.stderr)
        done = CliRunner().invoke(main, [*words, "--trust"])
        assert done.exit_code == 0, done.output
    with pytest.raises(RecordError, match="command sign"):
        load(wrong)
    assert load(wrong, trust=True).n_steps == record.n_steps
    found = preview(wrong.read_bytes(), "wrong.npz")
    assert isinstance(found, Preview) and "trust what is stated" in found.reading.missing
    assert found.reading.proposal == {"command_sign": -1} and found.reading.is_stated
