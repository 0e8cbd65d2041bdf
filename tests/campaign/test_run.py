"""Campaigns as they are run: resumed, shared, disturbed; the table is that of an undisturbed run, byte by byte."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pyarrow as pa
import pytest
from click.testing import CliRunner

import wfsobs
from tests.patience import ENOUGH
from wfsobs.campaign.store import ROWS, batch_files, read_batches, read_results, row_key, scenario_digest, schema, write_batch
from wfsobs.cli import main

pytestmark = pytest.mark.slow

TINY = """
name = "Tiny"
seeds = {seeds}
observers = ["kf-lgs", "persistence"]
[settings]
run.duration = 0.3
run.warm_up = 0.1
[grid]
turbulence.wind_speed = [5, 10]
"""
SHORT_BATCHES = """
from wfsobs.campaign import run
from wfsobs.cli import main

run.MOST_RUNS = 2
if __name__ == "__main__":
    main()
"""
"""The command line with batches of two runs, so that there is something to disturb."""

SEEDS = 16
RUNS = 2 * SEEDS
BATCHES = RUNS // 2
"""Of the short ones."""

COMMAND = [sys.executable, "-m", "wfsobs"]
ENVIRONMENT = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    path = tmp_path_factory.mktemp("plan") / "tiny.toml"
    path.write_text(TINY.format(seeds=SEEDS), encoding="utf-8")
    return path


def campaign(*arguments, check=True):
    """Return what the command gives in this process; its workers are processes of their own."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        done = CliRunner().invoke(main, ["campaign", *map(str, arguments)], catch_exceptions=False)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    assert not check or done.exit_code == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def undisturbed(plan, tmp_path_factory):
    """The folder of a campaign that was left alone, run as a command."""
    out = tmp_path_factory.mktemp("undisturbed")
    command = [*COMMAND, "campaign", "run", str(plan), "--out", str(out), "--workers", "2"]
    done = subprocess.run(command, capture_output=True, text=True, env=ENVIRONMENT, timeout=250)
    assert done.returncode == 0 and f"{RUNS} of {RUNS} runs are done, {RUNS} of them now" in done.stderr, done.stderr
    return out


def test_rows_are_those_of_a_run_of_the_library(undisturbed):
    table = {(r["cell"], r["seed"], r["name"], r["target"], r["mode"]): r for r in read_results(undisturbed).to_pylist()}
    base = wfsobs.PRESETS["paper"]().replace({"run.duration": 0.3, "run.warm_up": 0.1})
    for cell, wind in enumerate((5, 10)):
        scenario = base.replace({"turbulence.wind_speed": wind, "run.seed": 3})
        for score in wfsobs.run(scenario, observers=["kf-lgs", "persistence"]).scores:
            row = table.pop((cell, 3, score.observer, score.target, score.mode))
            assert row["rms_nm"] == score.rms * 1e3
            assert row["key"] == row_key(scenario_digest(scenario), 3, score.observer)
    assert all(seed != 3 for _, seed, *_ in table)


def test_what_is_done_is_not_done_again(plan, undisturbed):
    assert f"{RUNS} of {RUNS} runs are done, 0 of them now" in campaign("run", plan, "--out", undisturbed).stderr


def test_shares_make_up_the_whole(plan, undisturbed, tmp_path):
    for k in (1, 2):
        campaign("run", plan, "--out", tmp_path, "--shard", f"{k}/2", "--workers", 1)
    assert campaign("table", tmp_path, "--csv").stdout == campaign("table", undisturbed, "--csv").stdout


def start_short(plan, out):
    """Start a campaign of many batches, and wait until it has written one more of them."""
    before = len(list(out.glob("rows/*.parquet")))
    command = [sys.executable, "-c", SHORT_BATCHES, "campaign", "run", str(plan), "--out", str(out), "--workers", "2"]
    process = subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE)
    while len(list(out.glob("rows/*.parquet"))) == before:
        assert process.poll() is None
        time.sleep(0.01)
    workers = [p for p in psutil.Process(process.pid).children() if "spawn_main" in " ".join(p.cmdline())]
    assert len(workers) == 2 and process.poll() is None
    return process, workers


def test_killed_workers_and_a_killed_campaign_change_nothing(plan, undisturbed, tmp_path):
    process, workers = start_short(plan, tmp_path)
    process.kill()
    process.communicate()
    _, alive = psutil.wait_procs(workers, timeout=ENOUGH)
    assert not alive, "workers do not outlive the campaign"
    assert 0 < len(list(tmp_path.glob("rows/*.parquet"))) < BATCHES
    for victim in (0, 1):
        process, workers = start_short(plan, tmp_path)
        workers[victim].kill()
        if victim == 0:
            time.sleep(0.2)
            process.kill()
        _, said = process.communicate(timeout=ENOUGH)
    assert (
        process.returncode == 0
        and f"{RUNS} of {RUNS} runs are done".encode() in said
        and b"workers or their scheduler were lost" in said
    )
    assert campaign("table", tmp_path, "--csv").stdout == campaign("table", undisturbed, "--csv").stdout


def test_a_stopped_campaign_finishes_its_batches_and_resumes(plan, undisturbed, tmp_path):
    process, _ = start_short(plan, tmp_path)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=ENOUGH)
    assert process.returncode == 143 and b"the same command resumes" in said
    assert f"{RUNS} of {RUNS} runs are done".encode() not in said
    campaign("run", plan, "--out", tmp_path, "--workers", 1)
    assert campaign("table", tmp_path, "--csv").stdout == campaign("table", undisturbed, "--csv").stdout


def test_a_second_interrupt_ends_a_campaign_whose_workers_do_not_answer(plan, tmp_path):
    process, workers = start_short(plan, tmp_path)
    for worker in workers:
        worker.suspend()
    process.send_signal(signal.SIGINT)
    ended = False
    while not ended:  # of two signals at once one is lost
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            process.wait(20)
            ended = True
    assert b"Aborted!" in process.communicate()[1]
    assert psutil.wait_procs(workers, timeout=ENOUGH)[1] == []


def test_scenarios_of_the_same_settings_are_all_told(tmp_path):
    text = TINY.format(seeds=2).partition("[grid]")[0]
    plan = tmp_path / "twins.toml"
    plan.write_text(text + '[[scenario]]\nname = "a"\n[[scenario]]\nname = "b"\n', encoding="utf-8")
    out = tmp_path / "out"
    campaign("run", plan, "--out", out, "--workers", 1)
    rows = [line.split(",") for line in campaign("table", out, "--csv").stdout.splitlines()[1:]]
    cells = [row[1] for row in rows]
    assert cells.count("0") == cells.count("1") == len(rows) // 2 > 0
    assert "kf-lgs" in campaign("table", out, "--only", "scenario=b").stdout


def test_more_seeds_continue_and_another_plan_is_refused(tmp_path):
    small, large, other = (tmp_path / f"{name}.toml" for name in ("small", "large", "other"))
    small.write_text(TINY.format(seeds=2), encoding="utf-8")
    large.write_text(TINY.format(seeds=3), encoding="utf-8")
    other.write_text(TINY.format(seeds=2).replace("10]", "11]"), encoding="utf-8")
    out = tmp_path / "out"
    campaign("run", small, "--out", out, "--workers", 1)
    assert "6 of 6 runs are done, 2 of them now" in campaign("run", large, "--out", out, "--workers", 1).stderr
    refused = campaign("run", other, "--out", out, check=False)
    assert refused.exit_code == 2 and "holds another campaign" in refused.stderr and refused.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--shard", "4/3"], "--shard 4/3: takes K/N"),
        (["--scheduler", "tcp://localhost:1", "--workers", "2"], "--workers: only for this machine"),
    ],
)
def test_what_cannot_be_used_is_one_line(plan, tmp_path, arguments, line):
    refused = campaign("run", plan, "--out", tmp_path / "out", *arguments, check=False)
    assert refused.exit_code == 2 and line in refused.stderr and refused.stderr.count("\n") == 1


def test_an_observer_that_ends_in_an_error_is_a_failure_of_its_own(monkeypatch):
    from dataclasses import replace

    from wfsobs.campaign.plan import parse_plan
    from wfsobs.campaign.run import run_rows
    from wfsobs.observers import OBSERVERS

    def broken(*_):
        raise ZeroDivisionError("of a package")

    monkeypatch.setitem(OBSERVERS._entries, "persistence", replace(OBSERVERS["persistence"], run=broken))
    plan = parse_plan(TINY.format(seeds=1), Path())
    rows = run_rows(plan.cells[0], 1, plan.observers, ())
    failed = [r for r in rows if r["name"] == "persistence"]
    assert [(r["rms_nm"], r["note"]) for r in failed] == [(None, "persistence left out: ZeroDivisionError: of a package")]
    assert len([r for r in rows if r["name"] == "kf-lgs" and r["rms_nm"]]) == 6  # of either target and of both, two modes


def test_settings_that_no_observer_can_use_are_a_failure_of_each(monkeypatch):
    from wfsobs.campaign import run
    from wfsobs.campaign.plan import parse_plan
    from wfsobs.settings.values import SettingError

    calls = []

    def refuse(*_):
        calls.append(1)
        raise SettingError("a.b = 'x  y': is refused")

    monkeypatch.setattr(run, "record_bounds", refuse)
    monkeypatch.setattr(run, "_ready", run._ready.__wrapped__)  # no bounds that another test had computed
    plan = parse_plan(TINY.format(seeds=1), Path())
    rows = run.run_rows(plan.cells[0], 1, plan.observers, ())
    assert {r["name"]: r["note"] for r in rows} == dict.fromkeys(plan.observers, "a.b = 'x  y': is refused")
    assert len(calls) == 1  # the others are not run one by one: they would meet the same


def test_the_file_for_data_frames_has_the_settings(undisturbed, tmp_path):
    import pyarrow.parquet as pq

    campaign("table", undisturbed, "--parquet", tmp_path / "all.parquet")
    table = pq.read_table(tmp_path / "all.parquet")
    wind = dict(zip(table["cell"].to_pylist(), table["turbulence.wind_speed"].to_pylist(), strict=True))
    assert wind == {0: 5, 1: 10} and table.num_rows == len(read_results(undisturbed))


@pytest.mark.parametrize("size", [RUNS // 4, RUNS])
def test_the_bytes_of_a_plan_are_those_that_are_written(plan, undisturbed, tmp_path, size):
    """The same rows as undisturbed, in files of `size` runs: what a key and a row take scatters with their digits."""
    from wfsobs.campaign.plan import load_plan
    from wfsobs.cli.campaign import stored_bytes

    rows = (
        pa.concat_tables(read_batches(undisturbed, schema().names))
        .sort_by([("cell", "ascending"), ("seed", "ascending")])
        .to_pylist()
    )
    (tmp_path / ROWS).mkdir()
    of_run = len(rows) // RUNS
    for start in range(0, RUNS, size):
        write_batch(tmp_path, rows[start * of_run : (start + size) * of_run], {})
    files = batch_files(tmp_path)
    assert len(files) == RUNS // size
    written = sum(path.stat().st_size for path in files)
    assert 0.7 < stored_bytes(load_plan(plan), len(files)) / written < 1.4


def test_the_plan_says_how_much_it_is(plan):
    said = campaign("plan", plan).stdout
    assert f"Tiny: 2 scenarios x {SEEDS} seeds = {RUNS} runs" in said and "turbulence.wind_speed: 5, 10" in said
    # in each run 2 modes; turbulence, vibration and both of kf-lgs and two bounds, turbulence alone of persistence
    assert f"{RUNS * 2 * (3 * 3 + 1)} rows" in said


STOPPED_LATE = """
import signal
from wfsobs.campaign import run
from wfsobs.cli import main

class Batches(run._Batches):
    def learn(self, *of):
        super().learn(*of)
        signal.raise_signal(signal.SIGTERM)

run._Batches = Batches
if __name__ == "__main__":
    main()
"""


def test_a_campaign_that_is_stopped_in_its_last_batch_is_done(plan, tmp_path):
    command = [sys.executable, "-c", STOPPED_LATE, "campaign", "run", str(plan), "--out", str(tmp_path), "--workers", "1"]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, timeout=ENOUGH)
    assert done.returncode == 0 and f"{RUNS} of {RUNS} runs are done".encode() in done.stderr and b"resumes" not in done.stderr
