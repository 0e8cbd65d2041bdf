"""The benchmark: every version computes the same, every row is complete. No time is asserted."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

from benchmarks.libraries import LIBRARIES
from tests.records import ON_PAPER
from wfsobs import cli
from wfsobs.bench import tasks, textbook
from wfsobs.bench.measure import OURS, Row, max_error, measure_time, row, with_ratios
from wfsobs.bench.tasks import Sizes
from wfsobs.cli.bench import bench
from wfsobs.observers.gpr.offline import train
from wfsobs.observers.gpr.online import predict_sliding
from wfsobs.observers.gpr.windows import SquaredExponential

pytestmark = pytest.mark.slow

TINY = Sizes(
    settings={
        "run.warm_up": 0.1,
        "gpr_online.training_size": 30,
        "gpr_online.depth": 12,
        "gpr_offline.training_size": 60,
        "gpr_offline.depth": 20,
        "adaptive.window": 0.2,
    },
    duration=0.4,
    filter_duration=1.0,
    repeats=1,
    textbook_steps=6,
    library_steps=2,
    exact_steps=3,
    more_online=((40, 5),),
    more_steps=50,
    order=1,
    layers=2,
    step_count=20,
    paced_duration=0.02,
    longest_duration=0.3,
)

KEYS = {
    "task",
    "size",
    "variant",
    "steps",
    "median_s",
    "per_step_us",
    "p99_us",
    "p999_us",
    "max_us",
    "ready_us",
    "ratio_to_ours",
    "max_error_over_std",
    "peak_memory_mb",
}
REQUIRED = {
    "step": {OURS, "reference"},
    "online-gpr-record": {OURS, "ours-two-modes", "gemm-cholesky"},
    "online-gpr-stream": {OURS, "gemm-cholesky"},
    "offline-gpr-train": {OURS, "gemm-cholesky"},
    "offline-gpr-predict": {OURS, "gemm-stored-weights"},
    "kalman-record": {OURS, "numpy-loop"},
    "multirate-record": {OURS, "numpy-loop"},
    "adaptive-record": {OURS},
    "observer": {OURS},
    "frozen-flow": {OURS, "ideal-sensors"},
    "whole-run": {OURS, "without-online-gpr", "without-learning"},
}


@pytest.fixture(scope="module")
def printed() -> list[Row]:
    """What the command prints, of every variant and library."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tasks, "QUICK", TINY)
        done = CliRunner().invoke(bench, ["--json"], obj=LIBRARIES)
    assert done.exit_code == 0
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def rows(printed: list[Row]) -> list[Row]:
    """Those that need no other library."""
    return [r for r in printed if r["variant"] not in LIBRARIES]


def test_every_task_has_its_variants(rows):
    found = {task: {r["variant"] for r in rows if r["task"] == task} for task in REQUIRED}
    assert found == REQUIRED
    assert {r["task"] for r in rows} == set(REQUIRED)


def test_rows_are_complete(rows):
    for r in rows:
        assert set(r) == KEYS
        assert r["median_s"] > 0 and r["ratio_to_ours"] > 0
        assert (r["per_step_us"] is None) == (r["steps"] is None) == (r["task"] == "offline-gpr-train")
        assert (r["ready_us"] is None) == (r["task"] != "online-gpr-stream")
        assert (r["max_error_over_std"] is None) == (
            r["task"] in ("adaptive-record", "observer", "step", "frozen-flow", "whole-run")
        )
        assert r["variant"] != OURS or r["ratio_to_ours"] == 1.0
    assert {r["size"] for r in rows if r["peak_memory_mb"] is not None} == {
        "0.3 s, 2 modes",
        "0.4 s, 2 modes, 1 layer",
        "0.4 s, 2 modes, 2 layers",
    }
    assert {r["size"] for r in rows if r["task"] == "observer"} == {f"{name}, 0.4 s, 2 modes" for name in ON_PAPER}
    assert {r["size"] for r in rows if r["task"] == "online-gpr-record"} == {"m=30 d=12", "m=40 d=5"}


def test_every_version_computes_the_same(rows):
    compared = [r for r in rows if r["max_error_over_std"] is not None]
    for r in compared:
        ill_conditioned = r["variant"].startswith("gemm")
        assert 0 <= r["max_error_over_std"] < (1e-5 if ill_conditioned else 1e-9), r
    assert compared


def test_stream_percentile_needs_enough_steps(rows):
    assert all(r["p999_us"] is None for r in rows)  # a percentile of 359 steps would be their largest
    longer = Sizes(settings={**TINY.settings, "gpr_online.training_size": 8}, duration=1.1, repeats=1, textbook_steps=3)
    ours, other = tasks.online_stream(longer)
    assert ours["p999_us"] >= ours["per_step_us"] > ours["ready_us"] > 0
    assert other["p999_us"] is None


def _problem(m: int, depth: int, n: int) -> tuple[np.ndarray, np.ndarray, SquaredExponential]:
    rng = np.random.default_rng(4)
    return rng.normal(size=(n, 2)), rng.normal(size=n), SquaredExponential(2.0, 3.0 * np.sqrt(depth), 0.3)


def test_textbook_online_is_ours():
    m, depth, n = 20, 6, 90
    signals, targets, kernel = _problem(m, depth, n)
    ours = predict_sliding(signals, targets, depth, m, kernel)[0]
    X, f, rows = textbook.windows(signals, depth), targets[depth - 1 :], np.arange(m, n - depth + 1)
    for other in (textbook.predict_online, textbook.exact_online):
        np.testing.assert_allclose(other(X, f, rows, m, kernel), ours[depth + m - 1 :], rtol=1e-9, atol=1e-11)
    stream = textbook.OnlineStream(X, m, kernel)
    for r in rows[:5]:
        stream.prepare(r)
        assert stream.estimate(r, f[r - m : r]) == pytest.approx(ours[r + depth - 1], rel=1e-9)


def test_textbook_offline_is_ours():
    m, depth = 40, 6
    signals, targets, kernel = _problem(m, depth, m + depth)
    model = train(signals, targets, depth, m, kernel)
    X, f = textbook.windows(signals, depth)[:m], targets[depth - 1 : depth - 1 + m]
    weights, (exact, constant) = textbook.train_textbook(X, f, kernel), textbook.exact_weights(X, f, kernel)
    np.testing.assert_allclose(weights, exact, rtol=1e-8)
    np.testing.assert_allclose(model.weights, exact, rtol=1e-8)
    test = np.random.default_rng(5).normal(size=(400, 2))
    T, mean = textbook.windows(test, depth), model.predict(test)[depth - 1 :]
    np.testing.assert_allclose(textbook.predict_textbook(T, X, weights, kernel), mean, rtol=1e-8, atol=1e-11)
    np.testing.assert_allclose(textbook.exact_predict(T, X, exact, constant, kernel), mean, rtol=1e-8, atol=1e-11)


def test_windows_end_at_their_step():
    signals = np.arange(10.0).reshape(5, 2)
    assert sorted(textbook.windows(signals, 3)[1]) == [2.0, 3.0, 4.0, 5.0, 6.0, 7.0]


def test_error_sees_a_wrong_result():
    exact = np.array([0.0, 1.0, 2.0])
    assert max_error([0.0, 1.0, 3.0], exact) == pytest.approx(1.0 / exact.std())
    assert max_error([0.0, 1.0, 3.0], exact, 2.0) == 0.5


def test_ratios_are_per_step_and_per_size():
    measured = with_ratios(
        [
            row("a", "s", OURS, 2.0, 1000),
            row("a", "s", "slow", 1.0, 10),
            row("a", "t", OURS, 1.0),
            row("a", "t", "slow", 3.0),
        ]
    )
    assert [r["ratio_to_ours"] for r in measured] == [1.0, 50.0, 1.0, 3.0]


def test_timed_is_a_median_of_repeats():
    calls: list[int] = []
    seconds, last = measure_time(lambda: calls.append(1) or len(calls), 3)
    assert seconds >= 0 and last == len(calls) >= 3


def test_libraries_compute_the_same(printed):
    found = [r for r in printed if r["variant"] in LIBRARIES]
    assert {(r["task"], r["variant"]) for r in found} == {
        ("online-gpr-record", "scikit-learn"),
        ("offline-gpr-train", "scikit-learn"),
        ("offline-gpr-predict", "scikit-learn"),
        ("kalman-record", "filterpy"),
        ("kalman-record", "statsmodels"),
        ("multirate-record", "filterpy"),
    }
    assert all(math.isfinite(r["max_error_over_std"]) and r["max_error_over_std"] < 1e-5 for r in found)


def test_command_prints_rows(printed):
    assert all(set(r) == KEYS for r in printed)


def test_command_prints_a_table(monkeypatch, rows):
    asked = []
    monkeypatch.setattr(tasks, "measure_all", lambda sizes, progress: asked.append(sizes) or rows)
    done = CliRunner().invoke(cli.main, ["bench", "--full"])
    assert done.exit_code == 0 and asked == [tasks.FULL]
    assert done.stderr == (
        "wfsobs: bench: without scikit-learn, filterpy and statsmodels; python -m benchmarks, in the repository, has them\n"
    )
    assert sum(line.startswith("| ") for line in done.stdout.splitlines()) == len(rows) + 1
    assert all(text in done.stdout for text in (*REQUIRED, "us / step", "numpy", "cores"))
