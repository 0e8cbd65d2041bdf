"""The live loop: blocks without a seam, a ring, and numbers that are those of the recording."""

import errno
import itertools
import json
import os
import signal
import socket
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.signal import lfilter

import wfsobs
from wfsobs.cli import main
from wfsobs.live.follow import follow
from wfsobs.live.ring import CAPACITY, Ring
from wfsobs.live.simulated import Integrator, endless_blocks
from wfsobs.observers import OBSERVERS
from wfsobs.prior import Training
from wfsobs.scenario.presets import paper
from wfsobs.streams.follower import EDGES, Latencies
from wfsobs.telemetry.records import save_record

pytestmark = pytest.mark.slow


def frames(n, length, seed=1, **changes):
    scenario = paper().replace(changes)
    out = []
    for block in endless_blocks(scenario, np.random.default_rng(seed), length):
        out.append(block)
        if sum(map(len, out)) >= n:
            return dict(zip(("z", "ngs", "turbulence", "vibration"), np.hsplit(np.vstack(out)[:n], 4), strict=True))


def test_covariances_across_joints_are_those_of_a_record():
    """Covariance at lags of 1 to 40 ms around joints, over many joints, against that in the middle of blocks."""
    half, lags, n = 500, np.array([0, 1, 5, 20, 40]), 500 * 600
    z = frames(n, 2 * half / 1000, **{"vibration.peaks": [{"frequency": 45.0, "damping": 0.05, "rms": [0.02, 0.02]}]})[
        "vibration"
    ]
    start = np.arange(half, n - half, half)  # the joints, where all weight changes from one record to another

    def covariance(at):
        return np.array([np.mean([z[at + o] * z[at + o + lag] for o in range(-20, 20, 4)], axis=0).ravel() for lag in lags])

    joints, middles = covariance(start), covariance(start + half // 2)
    mean, scale = middles.mean(axis=1), joints.std(axis=1) + middles.std(axis=1)
    # independent joints and modes: the difference of two means of 1198 within 5 of its standard deviation
    assert np.all(np.abs(joints.mean(axis=1) - mean) < 5 * scale / np.sqrt(joints.shape[1]))
    assert mean[0] == pytest.approx(0.02**2, rel=0.05)


def test_weights_are_those_of_the_formula():
    """Of white noise the variance is that of the noise at every step of a block."""
    z = np.array([frames(100, 0.1, seed)["z"] for seed in range(200)])
    true = wfsobs.simulate(paper().replace({"run.duration": 40.0})).z.var(axis=0)
    ratio = (z / np.sqrt(true)).transpose(1, 0, 2).reshape(100, -1).var(axis=1)
    # turbulence is nearly constant over a tenth of a second: 200 records of two modes, the variance is within 7 % (1 sigma)
    assert np.all(np.abs(ratio - 1) < 0.35) and abs(ratio.mean() - 1) < 0.3


def test_frames_of_the_natural_guide_star_come_when_they_are_due():
    made = frames(3000, 0.73, **{"sensors.exposure_ratio": 5})
    there = ~np.isnan(made["ngs"][:, 0])
    assert np.array_equal(there, np.arange(3000) % 5 == 0)
    assert not np.isnan(made["z"]).any()


def test_the_integrator_frame_by_frame():
    z = np.random.default_rng(1).normal(size=(300, 2))
    scenario = paper()
    loop = Integrator(scenario)
    parts = np.vstack([loop.command(one) for one in z])
    g, leak = scenario.loop.gain, scenario.loop.leak
    assert parts == pytest.approx(lfilter([-g], [1, -leak, g], z, axis=0), rel=0, abs=1e-13)


def test_a_slow_reader_is_told_what_it_lost():
    ring = Ring(2)
    other = Ring(2, ring.name)
    for i in range(CAPACITY + 3):
        ring.write(np.arange(11.0) + i)
    assert other.read(1) is None and other.count == CAPACITY + 3
    frame = other.read(CAPACITY)
    assert frame is not None and frame.due == CAPACITY
    assert frame.vibration == pytest.approx([CAPACITY + 9, CAPACITY + 10])
    other.release()
    ring.release()


def test_quantiles_are_within_a_bin():
    latencies = Latencies()
    times = np.random.default_rng(2).lognormal(-9, 1, 5000)
    for time in times:
        latencies.add(time)
    for share in (0.5, 0.999):
        exact = np.sort(times)[int(np.ceil(share * 5000)) - 1]
        assert exact <= latencies.quantile(share) <= exact * EDGES[1] / EDGES[0] * (1 + 1e-12)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Run half a second of the loop, recorded, at a tenth of real time: a busy machine is no fault."""
    path = tmp_path_factory.mktemp("live") / "night.npz"
    command = [
        sys.executable,
        "-m",
        "wfsobs",
        "live",
        "--headless",
        "--json",
        "--seconds",
        "5",
        "--speed",
        "0.3",
        "--record",
        str(path),
    ]
    done = subprocess.run([*command, "--set", "run.warm_up=0.2"], capture_output=True, text=True, timeout=250)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout, parse_constant=pytest.fail), path


def test_every_frame_reaches_every_observer(session):
    result, path = session
    assert (result["frames"], result["lost"]) == (1500, 0)
    assert 0 <= result["late_share"] <= 1
    assert {"kf-lgs", "kf-multi", "multirate-optimal", "gpr-online"} <= result["observers"].keys()
    for row in result["observers"].values():
        assert 0 < row["p50_us"] <= row["p99_9_us"] and 0 <= row["late"] <= 1500
    assert wfsobs.load(path).n_steps == 1500


def test_live_numbers_are_those_of_the_recording(session):
    result, path = session
    record = wfsobs.load(path)
    scenario = paper().replace({"run.warm_up": 0.2})
    names = [n for n in result["observers"] if record.training is not None or Training not in OBSERVERS[n].prior]
    assert {"kf-lgs", "multirate-optimal", "gpr-online"} <= set(names)
    for name in names:
        for s in wfsobs.observe(record, scenario, observers=[name]).scores:
            live = result["observers"][name]["errors_nm"][s.target][s.mode]
            # frame by frame and at once are one algorithm; commands of the recording are summed in another order
            assert live == pytest.approx(s.rms * 1e3, rel=1e-6), s


def test_what_was_sent_is_saved_when_the_command_is_told_to_end(monkeypatch, tmp_path):
    def told(scenario, n_frames, observers, **options):
        follow(scenario, 50, observers, **options)
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr("wfsobs.cli.live.follow", told)
    before = signal.getsignal(signal.SIGTERM)
    options = ["--headless", "--observer", "kf-lgs", "--record", str(tmp_path / "night.npz")]
    assert CliRunner().invoke(main, ["live", *options]).exit_code == 128 + signal.SIGTERM
    assert wfsobs.load(tmp_path / "night.npz").n_steps == 50
    assert signal.getsignal(signal.SIGTERM) == before


def test_without_a_truth_the_table_has_the_error_of_the_next_measurement(monkeypatch, tmp_path):
    row = {"p50_us": 12.1, "p99_9_us": 41.0, "late": 0, "next_nm": {"tip": 30.0, "tilt": 40.0}}
    rows = {"kf-lgs": row | {"rms_nm": None}, "zero": row | {"rms_nm": 7.0, "next_nm": {"tip": None, "tilt": None}}}
    result = {"frames": 200, "lost": 0, "late_share": 0.0, "observers": rows}
    monkeypatch.setattr("wfsobs.cli.live.follow", lambda *_, **__: result)
    record = wfsobs.simulate(paper().replace({"run.duration": 2.0}))
    save_record(tmp_path / "whole.npz", record)
    save_record(tmp_path / "bare.npz", wfsobs.Record(record.y_lgs, record.u, record.dt))

    def table(name):
        done = CliRunner().invoke(main, ["live", "--headless", "--replay", str(tmp_path / name)])
        assert done.exit_code == 0, done.output
        return [[cell.strip() for cell in line.split("│")[1:3]] for line in done.stdout.splitlines() if "│" in line], done.stdout

    rows, text = table("bare.npz")
    assert rows == [["kf-lgs", f"{np.sqrt((30.0**2 + 40.0**2) / 2):.2f}"], ["zero", "-"]] and "next, nm" in text
    rows, text = table("whole.npz")
    assert rows == [["kf-lgs", "-"], ["zero", "7.00"]] and "rms, nm" in text


def test_ctrl_c_ends_it_with_the_numbers_of_what_ran(monkeypatch, tmp_path):
    def interrupted(*arguments, keep, **options):
        def keep_some(frame):
            keep(frame)
            if next(number) == 50:
                raise KeyboardInterrupt

        number = itertools.count(1)
        return follow(*arguments, keep=keep_some, **options)

    monkeypatch.setattr("wfsobs.cli.live.follow", interrupted)
    options = ["--headless", "--seconds", "600", "--observer", "kf-lgs", "--json", "--record", str(tmp_path / "night.npz")]
    done = CliRunner().invoke(main, ["live", *options])
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    assert result["frames"] >= 50 and result["lost"] == 0 and result["observers"]["kf-lgs"]["p50_us"] > 0
    assert wfsobs.load(tmp_path / "night.npz").n_steps == 50


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--replay", "a.npz", "--in", "b"], "live: --replay and --in are two sources, take one"),
        (["--headless", "--observer", "butterworth-ol"], "observer 'butterworth-ol': does not run frame by frame; there are"),
        (["--headless", "--observer", "kf"], "'kf': no such observer or controller; there are"),
        (
            ["--headless", "--preset", "wind-change", "--set", "turbulence.wind_speed=80"],
            "events: at 11 s turbulence.wind_speed = 160.0: takes a number from 0.1 to 100 m/s",
        ),
    ],
)
def test_what_cannot_run_is_one_line(arguments, line):
    done = CliRunner().invoke(main, ["live", "--seconds", "1", *arguments])
    assert done.exit_code == 2 and line in done.stderr and done.stderr.count("\n") == 1


def test_a_port_in_use_is_one_line_and_no_loop_begins():
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        command = [sys.executable, "-m", "wfsobs", "live", "--port", str(port)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    lines = done.stderr.splitlines()
    assert (done.returncode, lines[-1]) == (2, f"wfsobs: localhost:{port}: Address already in use")
    assert not [line for line in lines[:-1] if " INFO " not in line or "live" in line]


def test_a_log_that_cannot_be_written_is_said_once_and_the_loop_runs_on(monkeypatch, tmp_path):
    def append(path, *_):
        raise OSError(errno.ENOSPC, "No space left on device", path)

    monkeypatch.setattr("wfsobs.live.loop.append_line", append)
    record = wfsobs.simulate(paper().replace({"run.duration": 3.0}))
    record.y_lgs[500:1500] = np.nan
    save_record(tmp_path / "gap.npz", record)
    log, options = str(tmp_path / "night.log"), ["--headless", "--json", "--seconds", "3", "--observer", "kf-lgs"]
    done = CliRunner().invoke(main, ["live", *options, "--replay", str(tmp_path / "gap.npz"), "--log", log])
    assert done.stderr.splitlines()[1:] == [f"wfsobs: live: {log}: No space left on device: the log ends"]  # after the gap
    assert done.exit_code == 2 and json.loads(done.stdout)["frames"] == 3000


def test_without_a_page_what_happens_and_alarms_go_to_a_log(tmp_path):
    record = wfsobs.simulate(paper().replace({"run.duration": 6.0}))
    record.y_lgs[2000:4000] = np.nan
    save_record(tmp_path / "gap.npz", record)
    command = [sys.executable, "-m", "wfsobs", "live", "--headless", "--json", "--replay", "gap.npz", "--log", "night.log"]
    done = subprocess.run(
        [*command, "--seconds", "6", "--observer", "kf-lgs"], capture_output=True, text=True, timeout=200, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["frames"] == 6000
    lines = [line.split(" ", 2) for line in (tmp_path / "night.log").read_text(encoding="utf-8").splitlines()]
    when = {what: float(seconds) for _, seconds, what in lines}
    first = next(line for line in when if line.startswith("ALARM"))
    assert first.endswith("of LGS frames missing")
    # judged by the second, in which at least 1 % of the frames are missing from 2.01 s to 4.99 s
    assert 2.0 < when[first] < when["over: LGS frames missing"] <= 6.0
