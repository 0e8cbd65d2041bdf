"""A campaign on a Dask scheduler as users start it, whose workers and schedulers die."""

import socket
import subprocess
import sys
import time

import psutil
import pytest
from distributed import Client

from tests.campaign.test_run import BATCHES, ENVIRONMENT, RUNS, SEEDS, SHORT_BATCHES, TINY, campaign
from tests.patience import ENOUGH

pytestmark = pytest.mark.slow


class Cluster:
    """A scheduler and its workers, each with a nanny that starts it again."""

    def __init__(self, folder, port):
        self.folder, self.port, self.address = folder, port, f"tcp://127.0.0.1:{port}"
        self.started = []

    def start(self, program, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.{program}", *arguments, "--no-dashboard"]
        self.started.append(subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.DEVNULL))
        return self.started[-1]

    def start_scheduler(self):
        return self.start("dask_scheduler", "--host", "127.0.0.1", "--port", str(self.port))

    def start_worker(self):
        return self.start("dask_worker", self.address, "--nthreads", "1", "--local-directory", str(self.folder))

    def end(self):
        family = [p for one in self.started if one.poll() is None for p in psutil.Process(one.pid).children(recursive=True)]
        for one in reversed(self.started):
            one.kill()
            one.wait()
        for p in family:
            if p.is_running():
                p.kill()


@pytest.fixture
def cluster(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    made = Cluster(tmp_path, port)
    yield made
    made.end()


def start_campaign(cluster, tmp_path, seeds=SEEDS):
    """Start a campaign of batches of two runs; return its process and its folder."""
    plan, out = tmp_path / "plan.toml", tmp_path / "out"
    plan.write_text(TINY.format(seeds=seeds), encoding="utf-8")
    command = [sys.executable, "-c", SHORT_BATCHES, "campaign", "run", str(plan), "--out", str(out)]
    command += ["--scheduler", cluster.address]
    return subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE), out


def wait_for_batch(running, out):
    while not list(out.glob("rows/*.parquet")):
        assert running.poll() is None
        time.sleep(0.01)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """The table of the same campaign on one process."""
    plan, out = tmp_path_factory.mktemp("plan") / "plan.toml", tmp_path_factory.mktemp("alone")
    plan.write_text(TINY.format(seeds=SEEDS), encoding="utf-8")
    campaign("run", plan, "--out", out, "--workers", 1)
    return campaign("table", out, "--csv").stdout


def test_a_worker_that_dies_changes_nothing(cluster, tmp_path, alone):
    cluster.start_scheduler()
    nannies = [cluster.start_worker() for _ in range(2)]
    with Client(cluster.address, timeout=ENOUGH) as client:
        client.wait_for_workers(2, timeout=ENOUGH)
    running, out = start_campaign(cluster, tmp_path)
    wait_for_batch(running, out)
    worker = max(psutil.Process(nannies[0].pid).children(recursive=True), key=lambda p: p.memory_info().rss)  # not its tracker
    worker.kill()
    assert running.poll() is None and len(list(out.glob("rows/*.parquet"))) < BATCHES
    _, said = running.communicate(timeout=ENOUGH)
    assert running.returncode == 0, said
    assert f"{RUNS} of {RUNS} runs are done".encode() in said
    assert campaign("table", out, "--csv").stdout == alone, "byte for byte"


def test_a_scheduler_that_is_started_again_changes_nothing(cluster, tmp_path, alone):
    scheduler = cluster.start_scheduler()
    cluster.start_worker()
    running, out = start_campaign(cluster, tmp_path)
    wait_for_batch(running, out)
    scheduler.kill()
    scheduler.wait()
    while b"is gone: waiting" not in (told := running.stderr.readline()):
        assert told
    cluster.start_scheduler()
    cluster.start_worker()  # the first one ended with its scheduler
    _, said = running.communicate(timeout=ENOUGH)
    assert running.returncode == 0, said
    assert f"{RUNS} of {RUNS} runs are done, {RUNS} of them now; workers or their scheduler were lost".encode() in said
    assert b"Traceback" not in said and b"ERROR" not in said
    assert campaign("table", out, "--csv").stdout == alone, "byte for byte"


def test_a_scheduler_without_workers_is_told_and_waited_for(cluster, tmp_path):
    cluster.start_scheduler()
    running, out = start_campaign(cluster, tmp_path, seeds=2)
    line = f"wfsobs: no worker at {cluster.address}: waiting; start one with: dask worker {cluster.address} --nthreads 1\n"
    assert running.stderr.readline().decode() == line
    running.terminate()  # it does not wait for ever
    _, said = running.communicate(timeout=ENOUGH)
    assert running.returncode == 143 and b"0 of 4 runs are done" in said
    running, out = start_campaign(cluster, tmp_path, seeds=2)
    assert running.stderr.readline().decode() == line
    cluster.start_worker()
    _, said = running.communicate(timeout=ENOUGH)
    assert running.returncode == 0 and said.count(b"\n") == 2
    assert b"going on" in said and b"4 of 4 runs are done" in said
    assert not list(out.glob("rows/.*"))


@pytest.mark.parametrize("address", ["localhost", "head:8786", "tcp://head", "smoke://head:8786", ""])
def test_an_address_that_is_none_is_refused_at_once(address, monkeypatch):
    from wfsobs.campaign import pools
    from wfsobs.settings.values import SettingError

    monkeypatch.setattr("distributed.Client", lambda *_, **__: pytest.fail("a client is made"))
    with pytest.raises(SettingError, match=f"^--scheduler {address}: takes an address with a port, such as tcp://head:8786$"):
        pools.DaskCluster(address)


def test_without_a_scheduler_there_is_one_line(tmp_path, monkeypatch):
    from wfsobs.campaign import pools
    from wfsobs.settings.values import SettingError

    monkeypatch.setattr(pools, "DASK_TIMEOUT", 1.0)
    with pytest.raises(SettingError, match=r"--scheduler tcp://127.0.0.1:1: no scheduler answers"):
        pools.DaskCluster("tcp://127.0.0.1:1")
