"""What a report keeps of a run: points of lines, and how they are written."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.report.levels import read_levels
from wfsobs.app.report.data import Grid, bins_for, state_of, window_of
from wfsobs.app.report.page import DECADES, LEVELS, STEP, Pool, encode
from wfsobs.app.work import TRUTH
from wfsobs.evaluation.bound import NO_BOUND
from wfsobs.evaluation.exact_errors import cumulative_rms
from wfsobs.evaluation.result import Result, score_rows
from wfsobs.scenario.groups.events import Event
from wfsobs.signal.spectrum import psd


@given(st.integers(2, 30_000), st.integers(10, 800), st.sampled_from([1e-2, 1e-3, 2e-4]))
def test_points_keep_extremes_ends_and_the_window(n: int, bins: int, dt: float) -> None:
    grid = Grid(n, dt, bins)
    x = np.random.default_rng(n).normal(size=n)
    x[-1] = 50.0  # in the last, ragged bin
    x[n // 3] = -60.0
    times, points = grid.times(), grid.thin(x)
    assert times.size == points.size <= 2 * bins + grid.width or grid.whole
    assert points.min() == -60.0 or n // 3 == n - 1
    assert points.max() == 50.0
    assert np.all(np.diff(times) > 0) and times[0] >= 0 and times[-1] <= (n - 1) * dt * (1 + 1e-12)
    inside = (times > (grid.first - 0.5) * dt) & (times < (grid.last - 0.5) * dt)
    np.testing.assert_array_equal(points[inside], x[grid.first : grid.last].astype(np.float32))
    np.testing.assert_allclose(times[inside], dt * np.arange(grid.first, grid.last), rtol=1e-12)
    assert grid.width == min(round(0.5 / dt), n)
    if grid.whole:
        np.testing.assert_array_equal(points, x.astype(np.float32))


def test_more_states_leave_fewer_points() -> None:
    kept = [bins_for(n, 10, 2) for n in range(1, 61)]
    assert kept == sorted(kept, reverse=True) and kept[0] == 10_000 and kept[-1] == 200
    assert kept[11] > 400, "about a pair a pixel for twelve"


def levels_in(pool: Pool, index: float) -> NDArray[np.int64]:
    (raw,) = [content for content, number in pool.number.items() if number == index]
    return read_levels(raw)


@given(st.lists(st.floats(-1e6, 1e6) | st.just(float("nan")), min_size=1, max_size=50))
def test_a_line_is_written_to_half_a_step(line: list[float]) -> None:
    pool = Pool()
    index, low, step = encode(line, pool)
    levels = levels_in(pool, index)
    x = np.array(line)
    read = np.where(levels == LEVELS + 1, np.nan, low + step * levels)
    assert np.array_equal(np.isnan(read), np.isnan(x))
    known = ~np.isnan(x)
    if known.any():
        spread = np.subtract(*np.percentile(x[known], (75, 25)))
        assert step <= max(np.ptp(x[known]) / LEVELS, STEP * spread, 1.0 if step == 1.0 else 0.0) * (1 + 1e-9)
        assert np.abs(read - x)[known].max() <= 0.5 * step * (1 + 1e-6) + 1e-9


def test_a_transient_takes_no_digits_from_what_comes_after_it() -> None:
    line = np.random.default_rng(1).normal(size=2000)
    line[:20] = 40.0
    pool = Pool()
    index, low, step = encode(line, pool)
    # The middle half of a normal distribution is 1.35 standard deviations wide.
    assert step == pytest.approx(1.35 * STEP, rel=0.1)
    np.testing.assert_allclose(low + step * levels_in(pool, index), line, atol=0.51 * step)


def test_densities_are_written_as_logarithms_and_zero_is_none() -> None:
    pool = Pool()
    density = np.array([0.0, 1e-9, 1e-3, 10.0])
    index, low, step = encode(density, pool, logarithmic=True)
    levels = levels_in(pool, index)
    assert levels[0] == LEVELS + 1
    np.testing.assert_allclose(10 ** (low + step * levels[1:].astype(float)), density[1:], rtol=0.51 * DECADES * 2.31)


def test_what_two_states_share_is_there_once() -> None:
    pool = Pool()
    line = np.arange(5.0)
    assert encode(line, pool)[0] == encode(2 * line + 1, pool)[0] and len(pool.number) == 1, "the same levels"


def test_a_state_has_the_lines_of_the_result(result: Result) -> None:
    state = state_of(result)
    assert state.rows == score_rows(result.scores, 1) and state.reasons == () and state.grid.whole
    truth = result.record.vibration
    estimate = result.estimate("gpr-online", "vibration")
    assert truth is not None and estimate is not None
    np.testing.assert_array_equal(state.lines["signal/vibration/gpr-online/tilt"], estimate.values[:, 1].astype(np.float32))
    error = (estimate.values - truth)[:, 1]
    np.testing.assert_array_equal(state.lines["error/vibration/gpr-online/tilt"], error.astype(np.float32))
    frequency, density = psd(error[500:, None], result.record.dt)
    total = cumulative_rms(frequency[1:], density[1:, 0])
    kept, shown = state.lines["frequency"], state.lines["psd-error/vibration/gpr-online/tilt"]
    np.testing.assert_allclose(shown[:399], density[1:400, 0], rtol=1e-6)
    assert kept.size == shown.size and kept[0] == pytest.approx(frequency[1]) and shown.max() == pytest.approx(density[1:].max())
    summed = state.lines["cumulative-error/vibration/gpr-online/tilt"]
    assert state.lines["frequency-cumulative"].size == summed.size
    assert (summed[0], summed[-1]) == (pytest.approx(total[0]), pytest.approx(total[-1]))
    assert f"error/vibration/{TRUTH}/tip" not in state.lines and not any("/zero/" in name for name in state.lines)


def test_an_unfinished_observer_is_named(result: Result) -> None:
    done = {name: tuple(it for it in getattr(result, name) if it.observer != "gpr-online") for name in ("estimates", "scores")}
    part = replace(result, **done)
    assert state_of(part).reasons == ("Online GPR left out: not finished when the report was made",)


def test_that_there_is_no_bound_is_said(result: Result) -> None:
    events = result.scenario.replace({"events": [Event(start=1.0, wind_factor=2.0)]})
    assert state_of(replace(result, scenario=events)).reasons == (NO_BOUND,)


def test_the_window_is_told_where_all_states_share_it(result: Result) -> None:
    state = state_of(result)
    assert window_of([state]) is None
    cut = replace(state, grid=Grid(2000, 1e-3, 100))
    assert window_of([cut, cut]) == (0.75, pytest.approx(1.249))
    assert window_of([cut, replace(state, grid=Grid(1000, 1e-3, 100))]) is None
