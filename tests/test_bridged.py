"""Frames that somebody has filled in are told from measured ones, causally; observers are then as good as if told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wfsobs import PRESETS
from wfsobs.execution import run_observer
from wfsobs.observers import OBSERVERS
from wfsobs.observers.missing import fill_missing
from wfsobs.priors_from.scenario import prior_and_settings
from wfsobs.record import Record, delay_signal, hold_last
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.bridged import LONGEST, WINDOW, find_bridged, without_bridged
from wfsobs.telemetry.records import load, save_record
from wfsobs.typing import Array

pytestmark = pytest.mark.slow

SCENARIO = PRESETS["laser-dropout"]().replace(
    {
        "run.duration": 2.8,
        "events": [
            {"kind": "laser", "start": 0.6, "duration": 0.6, "lasers": 1},
            {"kind": "laser", "start": 1.6, "duration": 1.0, "lasers": 2},
        ],
    }
)
"""The preset's outages in a shorter record."""
AFTER = slice(2600, 2800)
"""The first 0.2 s with a laser again."""
NAMES = ("kf-lgs", "kf-multi", "multirate", "multirate-optimal", "multirate-multi")


def held(record: Record) -> Array:
    return hold_last(record.y_lgs)


def held_of_the_disturbance(record: Record) -> Array:
    mirror = delay_signal(hold_last(record.u), record.delay)
    return hold_last(record.y_lgs - mirror) + mirror


def predicted(record: Record) -> Array:
    prior, _ = prior_and_settings(OBSERVERS["kf-multi"], record, SCENARIO)
    return fill_missing(record, prior).y_lgs


def test_observers_of_bridged_values_are_those_of_missing_ones(tmp_path: Path) -> None:
    """Within 10 % of the filter that is told which frames are missing, and of how many lasers the others are the mean, from the
    first frame after the gap; it was 5 to 12 times worse where a prediction was taken for measurements."""
    squares: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for seed in (1, 2):
        record = simulate(SCENARIO.replace({"run.seed": seed}))
        gone = np.isnan(record.y_lgs[:, 0])
        exact = {name: run_observer(name, record, SCENARIO) for name in NAMES}
        for bridge in (held, held_of_the_disturbance, predicted):
            save_record(tmp_path / "r.npz", replace(record, y_lgs=bridge(record), lgs_stars=None))
            found = load(tmp_path / "r.npz")
            told = np.isnan(found.y_lgs[:, 0])
            assert not (told & ~gone).any() and (gone & ~told).sum() < WINDOW
            assert f"{told.sum()} LGS frames" in found.origin
            for name in NAMES:
                ours = run_observer(name, found, SCENARIO)
                for target in OBSERVERS[name].targets:
                    truth = record.truth(target)
                    assert truth is not None
                    at = [float(np.mean((e[target] - truth)[AFTER] ** 2)) for e in (ours, exact[name])]
                    squares.setdefault((bridge.__name__, name, target), []).append((at[0], at[1]))
    for key, values in squares.items():
        ratio = np.sqrt(np.divide(*np.sum(values, axis=0)))
        assert 0.9 < ratio < 1.1, key


def noisy(n: int, seed: int, modes: int = 2) -> Array:
    """Turbulence-like walks with white noise."""
    rng = np.random.default_rng(seed)
    return np.cumsum(0.01 * rng.standard_normal((n, modes)), axis=0) + 0.02 * rng.standard_normal((n, modes))


@given(st.integers(0, 10_000), st.sampled_from([1, 2, 9]))
def test_what_is_measured_stays(seed: int, modes: int) -> None:
    """Of white noise one window in 10^9 is that quiet, by the quantile of chi-square with 19 degrees of freedom a mode."""
    z = noisy(3000, seed, modes)
    assert not find_bridged(z, z, 1e-3).any()


@given(st.integers(0, 10_000), st.integers(300, 2500))
def test_no_later_frame_decides(seed: int, cut: int) -> None:
    y = noisy(3000, seed)
    y[1000:1200] = y[999]
    y[2000:2100] = np.linspace(y[1999], y[2100], 100)
    whole = find_bridged(y, y, 1e-3)
    assert np.array_equal(find_bridged(y[:cut], y[:cut], 1e-3), whole[:cut])
    assert whole[1001:1200].all() and not whole[:1001].any()


def test_a_value_twice_is_no_gap_and_a_mode_alone_is_none() -> None:
    y = noisy(2000, 1)
    y[700] = y[699]
    y[800:900, 0] = y[799, 0]
    assert not find_bridged(y, y, 1e-3).any()


@pytest.mark.parametrize("modes", [1, 2])
@pytest.mark.parametrize("step", [0.02, 0.05, 0.1])
def test_equal_values_of_a_coarse_sensor_are_measured(step: float, modes: int) -> None:
    """Of steps of 1, 2.5 and 5 times the noise up to half of the frames were taken for missing.

    A gap begins where a run is longer than one of 20 000 frames has by chance, q^run 20 000 < 0.1, after 150 frames at most for
    q < 0.92; of 5 times the noise nothing is left to tell.
    """
    rng = np.random.default_rng(1)
    z = np.cumsum(0.01 * rng.standard_normal((20_000, modes)), axis=0)
    y = step * np.round((z - z.mean(axis=0)) % 0.3 / step + 0.02 / step * rng.standard_normal(z.shape))  # drifts, and starts anew
    assert not find_bridged(y, y, 1e-3).any()
    y[12_000:13_000] = y[11_999]
    found = np.flatnonzero(find_bridged(y, y, 1e-3))
    if step < 0.1:
        assert found[0] <= 12_150 and np.array_equal(found, np.arange(found[0], found[-1] + 1)) and 12_999 <= found[-1] <= 13_002


def test_what_lasts_is_what_the_sensor_measures() -> None:
    y = noisy(30_000, 1)
    y[5000:] = y[5000]
    found = find_bridged(y, y, 1e-3)
    assert np.flatnonzero(found)[-1] - np.flatnonzero(found)[0] + 1 == round(LONGEST / 1e-3)
    quieter = noisy(30_000, 1)
    quieter[5000:] = quieter[4999] + 0.1 * (quieter[5000:] - quieter[4999])  # ten times less noise, from one frame to the next
    assert not find_bridged(quieter, quieter, 1e-3)[16_000:].any()


def test_a_file_that_tells_what_is_missing_is_taken_at_its_word(tmp_path: Path) -> None:
    y = noisy(2000, 1)
    y[1000:1100], y[1500] = y[999], np.nan
    save_record(tmp_path / "r.npz", Record(y, np.zeros_like(y), 1e-3))
    assert load(tmp_path / "r.npz").missing == 1
    y[1500] = 0.0
    save_record(tmp_path / "r.npz", Record(y, np.zeros_like(y), 1e-3))
    assert load(tmp_path / "r.npz").missing == 99
    u = np.zeros_like(y)
    u[1200:1300] = np.nan
    save_record(tmp_path / "r.npz", Record(noisy(2000, 1), u, 1e-3))
    assert load(tmp_path / "r.npz").missing == 0, "a lost command is no measurement that was filled in"


@pytest.mark.parametrize(("share", "size"), [(0.0, 0.0), (0.01, 0.8), (1.0 / 3000, 1e6)])
@pytest.mark.parametrize("offset", [0.0, 30.0, 200.0])
def test_outliers_and_an_offset_of_the_commands_make_no_gap_and_hide_none(share: float, size: float, offset: float) -> None:
    """A mean of squares was theirs: up to 5772 of 6000 frames were taken for missing."""
    rng = np.random.default_rng(1)
    y = noisy(3000, 1)
    y += size * (rng.random(3000) < share)[:, None] * rng.choice([-1, 1], (3000, 2))
    u = offset + 0.01 * np.cumsum(rng.standard_normal((3000, 2)), axis=0)
    record = Record(y, u, 1e-3)
    assert without_bridged(record).missing == 0
    y[2000:2100] = np.linspace(y[1999], y[2100], 100)
    assert 70 <= without_bridged(replace(record, y_lgs=y, u=np.full_like(u, offset))).missing <= 101
