"""A campaign on a Dask scheduler as users start it, whose workers die."""

import subprocess
import sys
import time

import psutil
import pytest
from distributed import Client

from tests.campaign.test_run import COMMAND, ENVIRONMENT, SHORT_BATCHES, TINY


@pytest.fixture
def cluster(tmp_path):
    """Start a scheduler and two workers, each with a nanny that starts it again; yield the address and the nannies."""
    info = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    started = [
        subprocess.Popen([*dask, "--no-dashboard", "--scheduler-file", str(info)], env=ENVIRONMENT, stderr=subprocess.DEVNULL)
    ]
    while not info.exists():
        time.sleep(0.1)
    with Client(scheduler_file=str(info)) as client:
        address = client.scheduler.address
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"]
        started += [
            subprocess.Popen([*worker, "--local-directory", str(tmp_path)], env=ENVIRONMENT, stderr=subprocess.DEVNULL)
            for _ in range(2)
        ]
        client.wait_for_workers(2, timeout=60)
    yield address, started[1:]
    family = [p for one in started for p in psutil.Process(one.pid).children(recursive=True)]
    for one in reversed(started):
        one.kill()
        one.wait()
    for p in family:
        if p.is_running():
            p.kill()


def test_a_worker_that_dies_changes_nothing(cluster, tmp_path):
    address, nannies = cluster
    plan, out, alone = tmp_path / "plan.toml", tmp_path / "out", tmp_path / "alone"
    plan.write_text(TINY.format(seeds=40), encoding="utf-8")
    command = [sys.executable, "-c", SHORT_BATCHES, "campaign", "run", str(plan), "--out", str(out), "--scheduler", address]
    running = subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE)
    while not list(out.glob("rows/*.parquet")):
        assert running.poll() is None
        time.sleep(0.01)
    worker = max(psutil.Process(nannies[0].pid).children(recursive=True), key=lambda p: p.memory_info().rss)  # not its tracker
    worker.kill()
    assert running.poll() is None and len(list(out.glob("rows/*.parquet"))) < 40
    _, said = running.communicate(timeout=200)
    assert running.returncode == 0, said
    assert b"80 of 80 runs are done" in said
    subprocess.run([*COMMAND, "campaign", "run", str(plan), "--out", str(alone), "--workers", "1"], env=ENVIRONMENT, check=True)
    tables = [
        subprocess.run(
            [*COMMAND, "campaign", "table", str(folder), "--csv"], env=ENVIRONMENT, check=True, capture_output=True
        ).stdout
        for folder in (out, alone)
    ]
    assert tables[0] == tables[1]


def test_without_a_scheduler_there_is_one_line(tmp_path, monkeypatch):
    from wfsobs.campaign import pools
    from wfsobs.settings.errors import SettingError

    monkeypatch.setattr(pools, "DASK_TIMEOUT", 1.0)
    with pytest.raises(SettingError, match=r"--scheduler tcp://127.0.0.1:1: no scheduler answers"):
        pools.DaskCluster("tcp://127.0.0.1:1")
