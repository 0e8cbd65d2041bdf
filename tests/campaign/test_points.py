"""The points of a campaign."""

import math

import numpy as np
import pytest
from scipy.stats import kstest

from wfsobs.campaign.sweep import conditions, grid, product, sample
from wfsobs.settings.values import SettingError


def test_a_grid_has_every_combination_once():
    points = grid({"a": [1, 2, 3], "b": ["x", "y"]})
    assert len(points) == 6
    assert {(p["a"], p["b"]) for p in points} == {(a, b) for a in (1, 2, 3) for b in "xy"}


def test_two_axes_may_not_set_the_same():
    with pytest.raises(SettingError, match="a: set by two of grid, sample and conditions"):
        list(product([[{"a": 1}], [{"a": 2}]]))


@pytest.mark.parametrize("method", ["sobol", "latin-hypercube"])
def test_samples_fill_their_ranges_evenly(method):
    points = sample({"method": method, "points": 64, "seed": 3, "between": {"a": [2.0, 4.0], "b": [0.01, 1.0]}, "log": ["b"]})
    a, b = (np.array([p[name] for p in points]) for name in "ab")
    # both methods put one of 64 points into each 64th of a range
    assert sorted(np.floor((a - 2.0) / 2.0 * 64).astype(int)) == list(range(64))
    assert sorted(np.floor(np.log(b / 0.01) / math.log(100.0) * 64).astype(int)) == list(range(64))
    assert kstest((a - 2) / 2, "uniform").pvalue > 0.5
    assert points == sample(
        {"method": method, "points": 64, "seed": 3, "between": {"a": [2.0, 4.0], "b": [0.01, 1.0]}, "log": ["b"]}
    )


def test_conditions_are_rows_with_all_their_numbers(tmp_path):
    (tmp_path / "night.csv").write_text("# a night\nseeing,wind\n0.8,10\n,12\n1.2,nan\n1.0,5\n", encoding="utf-8")
    columns = {"seeing": {"setting": "x.seeing", "factor": 2.0}, "wind": "x.wind"}
    assert conditions({"file": "night.csv", "columns": columns}, tmp_path) == [
        {"x.seeing": 1.6, "x.wind": 10.0},
        {"x.seeing": 2.0, "x.wind": 5.0},
    ]


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda p: grid({"a": 3}), "grid.a = 3: takes a list of values"),
        (lambda p: sample({"between": {"a": [2, 1]}}), r"sample.between.a = \[2, 1\]: takes \[low, high\], numbers"),
        (lambda p: sample({"between": {"a": [0, 1]}, "log": ["a"]}), "takes numbers above 0, for sample.log"),
        (lambda p: sample({"method": "best", "between": {"a": [0, 1]}}), "sample.method = 'best': takes one of sobol"),
        (lambda p: sample({"points": 0, "between": {"a": [0, 1]}}), "sample.points = 0: takes a whole number from 1"),
        (lambda p: sample({"points": 4}), "sample.between: takes"),
        (lambda p: sample({"between": 3}), "sample.between: takes"),
        (lambda p: sample({"between": {"a": [0, 1]}, "log": [[1]]}), r"sample.log = \[\[1\]\]: takes a list of settings"),
        (lambda p: conditions({"file": "none.csv", "columns": {"a": "b"}}, p), "none.csv: cannot be read: No such file"),
        (
            lambda p: conditions({"file": "one.csv", "columns": {"a": "b"}}, p),
            "conditions.columns.a: .*one.csv has the columns x",
        ),
        (lambda p: conditions({"file": "one.csv", "columns": {"x": 3}}, p), 'conditions.columns.x: takes "setting" or'),
        (lambda p: conditions({"file": "one.csv", "columns": {"x": "b"}}, p), "no row has a number in each of x"),
    ],
)
def test_what_cannot_be_used_is_one_line(tmp_path, call, line):
    (tmp_path / "one.csv").write_text("x\nword\n", encoding="utf-8")
    with pytest.raises(SettingError, match=line):
        call(tmp_path)
