"""Scores against closed forms: ratios, their geometric mean, intervals that cover, ranks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom
from wfsobs_arena.scores import log_ratio, rank_entries


def test_a_score_is_the_geometric_mean_of_ratios_of_rms() -> None:
    reference = [np.array([1.0, 1.0]), np.array([4.0, 4.0])]
    one = rank_entries({"mine": [np.array([3.0, 5.0]), np.array([36.0, 36.0])]}, reference)[0]
    assert one.ratios == pytest.approx((2.0, 3.0), rel=1e-12)  # rms over the seeds: sqrt(4), sqrt(36 / 4)
    assert one.score == pytest.approx(np.sqrt(6.0), rel=1e-12)
    assert one.rank == 1 and not one.is_tie


def test_the_interval_of_one_scenario_is_students_of_the_influences() -> None:
    a = np.array([1.0, 2.0, 3.0])
    found = log_ratio([a], [np.ones(3)])
    mean, half = found.mean, found.half_width()
    # influences (a / 2 - 1) / 2 = -1/4, 0, 1/4: standard error sqrt((1/8) / (3 * 2)), t(0.975, 2 degrees of freedom) = 4.302653
    assert mean == pytest.approx(0.5 * np.log(2.0), rel=1e-12)
    assert half == pytest.approx(4.302653 * np.sqrt(1.0 / 48.0), rel=1e-6)


def test_intervals_cover() -> None:
    rng, n, inside = np.random.default_rng(5), 4000, 0
    scales = np.array([1.0, 5.0, 0.2])
    for _ in range(n):
        a = [s * rng.chisquare(60, 8) / 60 for s in scales]
        found = log_ratio(a, [np.full(8, s) for s in scales])
        half = found.half_width()
        assert half is not None
        inside += abs(found.mean) <= half
    # 0.95 with a standard deviation of 0.0034 over 4000 draws; the delta method is off by less at 60 degrees of freedom
    assert 0.935 < inside / n < 0.965


def test_entries_on_the_same_records_are_told_apart_where_intervals_overlap() -> None:
    rng = np.random.default_rng(1)
    hard = rng.uniform(0.5, 2.0, 8)  # what the records have in common
    squares = {"worse": [1.05 * hard], "best": [hard], "like-best": [hard * (1.0 + 0.01 * rng.standard_normal(8))]}
    first, second, third = rank_entries(squares, [np.ones(8)])
    assert third.entry == "worse" and third.rank == 3 and not third.is_tie
    assert (first.rank, second.rank) == (1, 1) and first.is_tie and second.is_tie
    assert first.interval is not None and third.interval is not None and first.interval[1] > third.interval[0]


@pytest.mark.slow
def test_of_ten_equal_entries_any_is_ranked_below_another_in_at_most_five_per_cent() -> None:
    """Without a correction for the 45 comparisons: in 66 %."""
    rng, n, unequal = np.random.default_rng(7), 150, 0
    for _ in range(n):
        hard = [rng.uniform(0.5, 2.0, 8) for _ in range(3)]
        squares = {f"{i}": [x * (0.7 + 0.3 * rng.chisquare(60, 8) / 60) for x in hard] for i in range(10)}
        unequal += any(one.rank > 1 for one in rank_entries(squares, hard))
    assert unequal <= binom.ppf(0.9999, n, 0.05)


def test_with_one_record_nothing_is_decided() -> None:
    found = rank_entries({"a": [np.array([1.0])], "b": [np.array([9.0])]}, [np.array([1.0])])
    assert [one.rank for one in found] == [1, 1] and found[0].interval is None
