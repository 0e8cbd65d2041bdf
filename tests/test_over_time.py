"""Error against time: running rms, recovery, and what the command line prints of them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from tests.records import ON_PAPER
from wfsobs import PRESETS, SettingError
from wfsobs.cli import main
from wfsobs.cli.show import OverTime
from wfsobs.evaluation.scores import PooledRms, recovery, running_rms, trailing_rms
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import VIBRATION
from wfsobs.pipeline import run
from wfsobs.record import Estimate, Record

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("n", [1, 2, 7, 100, 240])
def test_trailing_rms_is_that_of_the_last_n(n: int) -> None:
    """Against the definition; a huge transient leaves nothing behind, and NaN do not count."""
    rng = np.random.default_rng(1)
    x = rng.standard_normal((240, 2))
    x[40:60] *= 1e9
    x[100:130, 1] = np.nan
    expected = np.full(x.shape, np.nan)
    for k in range(n - 1, 240):
        for mode in (0, 1):
            known = [v for v in x[k - n + 1 : k + 1, mode] if not np.isnan(v)]
            if known:
                expected[k, mode] = np.sqrt(np.mean(np.square(known)))
    np.testing.assert_allclose(trailing_rms(x, n), expected, rtol=1e-13)


def test_running_rms_is_of_the_error() -> None:
    rng = np.random.default_rng(2)
    truth, values = rng.standard_normal((50, 2)), rng.standard_normal((50, 2))
    record = Record(truth, truth, 1e-2, vibration=truth)
    found = running_rms(record, Estimate("x", "vibration", values, 0.0), 0.1)
    np.testing.assert_array_equal(found, trailing_rms(values - truth, 10))
    with pytest.raises(ValueError, match="no true turbulence"):
        running_rms(record, Estimate("x", "turbulence", values, 0.0), 0.1)


def test_pooled_is_the_root_of_the_mean_of_squares() -> None:
    pool = PooledRms()
    for values in ([3.0, np.nan, np.nan], [4.0, 2.0, np.nan]):
        pool.add(np.array(values)[:, None])
    np.testing.assert_allclose(pool.rms[:, 0], [np.sqrt(12.5), 2.0, np.nan])


def test_recovery_is_read_off_a_curve() -> None:
    """1 until 5 s; thrown to 3, back at 7.5 s, thrown to 2 at 10 s for good, with a dip at 15 s that does not last."""
    dt, window = 0.01, 0.5
    t = np.arange(2000) * dt
    x = np.where(t < 0.5, np.nan, np.select([t < 5, t < 7.5, t < 10], [1.0, 3.0, 1.09], 2.0))
    x[1500:1600] = 1.0
    x[1100] = np.nan
    first, last = recovery(x, dt, [10.0, 5.0, 5.0], window, 1.0)
    assert first is not None and (first.start, first.before, first.worst) == (5.0, 1.0, 3.0)
    assert first.back == pytest.approx(2.5, abs=dt / 2)
    assert last is not None and last.before == pytest.approx(1.09) and last.worst == last.last == 2.0 and last.back is None
    unmoved, unknown = recovery(np.where(t < 12, 1.0, np.nan), dt, [5.0, 15.0], window, 1.0)
    assert unmoved is not None and unmoved.back == 0.0 and unknown is None


def test_the_command_prints_rows_of_every_window() -> None:
    settings = ["--set", "run.duration=2", "--set", "gpr_online.training_size=50"]
    result = CliRunner().invoke(main, ["run", "--over-time", "0.5", "--seeds", "2", "--json", *settings], catch_exceptions=False)
    rows = json.loads(result.stdout)
    assert set(rows[0]) == {"observer", "target", "mode", "time_s", "rms_um", "seed"}
    own = [r for r in rows if (r["observer"], r["target"], r["mode"]) == ("zero", "vibration", "tilt")]
    assert [(r["seed"], r["time_s"]) for r in own] == [(s, t) for s in (1, 2) for t in (0.5, 1.0, 1.5, 2.0)]
    assert all(0.005 < r["rms_um"] < 0.03 for r in own)
    online = [r["rms_um"] for r in rows if (r["observer"], r["mode"], r["seed"]) == ("gpr-online", "tip", 1)]
    assert len(online) == 4 and None not in online


def test_the_table_says_who_is_back() -> None:
    event = 'events=[{peak=14, start=1.5, strength=3.0}, {kind="wind", start=1.5}]'
    words = ["run", "--over-time", "0.25", "--set", "run.duration=2", "--set", "run.warm_up=0.5", "--set", event]
    result = CliRunner().invoke(main, words, catch_exceptions=False)
    lines = [[cell.strip() for cell in line.strip("│").split("│")] for line in result.stdout.splitlines() if line.startswith("│")]
    assert {line[2] for line in lines} == {"peak, wind at 1.5 s"}
    assert len(lines) == 2 * sum(len(OBSERVERS[name].targets) for name in ON_PAPER if "adaptive" not in name), (
        "their window is longer"
    )
    zero = next(line for line in lines if line[:2] == ["vibration", "tip"] and line[3] == "Zero")
    assert float(zero[5]) > 1.5 * float(zero[4])


def test_a_window_longer_than_the_run_is_refused() -> None:
    with pytest.raises(SettingError, match=r"--over-time 10: takes a number of seconds from 0\.001, one step, to below"):
        OverTime(PRESETS["paper"](), 10.0)


def test_after_a_jump_who_learns_is_back_and_who_is_fixed_is_not() -> None:
    """A line of 30 nm jumps by 3 Hz. Who learns from the last seconds is back within 10 % of what it had settled to once these
    seconds, and those of the running rms, are all after the jump, and stays; filters of the old line never are. The online GPR
    learns so soon that it may not be seen to leave.

    Four seeds, both modes, 3 s: 24 s of errors, whose rms is known to about 3 %; in the six groups of four seeds up to 24 the
    adaptive filter's is later at most 1.04 times what it was, the online GPR's 1.07.
    """
    window, start, training, depth = 3.0, 7.0, 256, 170
    s = PRESETS["peak-jump"]().replace(
        {
            "run.duration": 18.0,
            "events.0.start": start,
            "gpr_online.training_size": training,
            "gpr_online.depth": depth,
            "gpr_offline.training_size": 400,
        }
    )
    adapt = {"gpr-online": (training + depth) * s.dt, "kf-adaptive": s.adaptive.window + s.adaptive.interval}
    fixed = ("kf-lgs", "kf-multi", "gpr-offline")
    pools = {name: PooledRms() for name in (*fixed, *adapt)}
    for seed in range(1, 5):
        result = run(s.replace({"run.seed": seed}), observers=list(pools))
        for name, pool in pools.items():
            estimate = result.estimate(name, VIBRATION)
            assert estimate is not None
            pool.add(running_rms(result.record, estimate, window))
    for name, pool in pools.items():
        both = np.sqrt(np.mean(pool.rms**2, axis=1))
        [found] = recovery(both, s.dt, [start], window, s.run.warm_up)
        assert found is not None and found.before < 0.01, name
        if name in adapt:
            assert found.back is not None and found.back <= adapt[name] + window + 0.1, name
            assert name == "gpr-online" or found.worst > 1.5 * found.before
        else:
            assert found.back is None and found.last > 2 * found.before, name
