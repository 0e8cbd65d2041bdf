"""Comparisons over seeds: against scipy, and how often their intervals hold."""

import gc
import tracemalloc

import numpy as np
import pyarrow as pa
import pytest
from click.testing import CliRunner
from scipy.stats import binom, ttest_rel

from wfsobs.campaign.compare import LEVEL, Comparison, compare, mean_interval
from wfsobs.campaign.follow import CampaignFolder
from wfsobs.campaign.plan import Stop, looks, parse_plan
from wfsobs.campaign.report import write_report
from wfsobs.campaign.run import wanted_seeds
from wfsobs.campaign.store import ROWS, BatchIndex, open_folder, schema, write_batch
from wfsobs.cli import main
from wfsobs.evaluation.result import can_be_best
from wfsobs.observers import OBSERVERS


def rows(values, name, cell=0):
    return [
        {
            "cell": cell,
            "scenario": "s",
            "seed": i,
            "name": name,
            "target": "vibration",
            "mode": "tip",
            "rms_nm": v,
            "apart": False,
        }
        for i, v in enumerate(values)
    ]


def test_differences_are_those_of_the_paired_t_test():
    rng = np.random.default_rng(5)
    a, b = rng.normal(10, 1, (2, 12))
    ((mean,), (half,)) = mean_interval((a - b)[:, None])
    expected = ttest_rel(a, b).confidence_interval(LEVEL)
    assert mean == pytest.approx((expected.low + expected.high) / 2, rel=1e-12)
    assert half == pytest.approx((expected.high - expected.low) / 2, rel=1e-12)


def test_the_best_is_causal_and_has_every_seed():
    table = pa.Table.from_pylist(
        [
            *rows([4.0, 4.0, 4.0], "kf-lgs"),
            *rows([5.0, 3.0, 7.0], "kf-multi"),
            *rows([1.0, 1.0, None], "ridge"),  # failed once: smaller over the others is not better
            *rows([0.5, 0.5, 0.5], "bound"),
        ],
        schema=schema(),
    )
    found = {c.name: c for c in compare(table)}
    assert [name for name, c in found.items() if c.is_best] == ["kf-lgs"]
    assert found["kf-multi"].rms == pytest.approx(np.sqrt((25 + 9 + 49) / 3), rel=1e-12)
    assert found["kf-multi"].difference == pytest.approx(1.0) and found["kf-multi"].is_tie
    assert found["ridge"].failures == 1 and found["bound"].difference is None


def test_of_ten_equals_any_is_called_worse_in_at_most_five_per_cent():
    rng, n, worse = np.random.default_rng(4), 200, 0
    for _ in range(n):
        errors = rng.normal(10.0, 1.0, (8, 1)) + rng.normal(0.0, 0.5, (8, 10))
        names = [name for name in OBSERVERS if can_be_best(name, False)][:10]
        table = pa.Table.from_pylist([row for i, name in enumerate(names) for row in rows(errors[:, i], name)], schema=schema())
        worse += not all(c.is_best or c.is_tie for c in compare(table))
    assert worse <= binom.ppf(0.9999, n, 0.05)  # without a correction, 50 %


def test_quantiles_are_those_of_the_seeds_with_a_result():
    values = [float(v) for v in np.random.default_rng(6).permutation(101)]
    table = pa.Table.from_pylist([*rows([*values, None], "kf-lgs"), *rows([None], "ridge")], schema=schema())
    found = {c.name: c.quantiles for c in compare(table)}
    assert found == {"kf-lgs": (5.0, 50.0, 95.0), "ridge": ()}  # of 0, 1, ..., 100


def covers(differences, truth, level):
    ((mean,), (half,)) = mean_interval(differences[:, None], level)
    return abs(mean - truth) <= half


def test_intervals_at_a_fixed_number_of_seeds_cover_what_they_say():
    rng = np.random.default_rng(11)
    hits = sum(covers(rng.normal(1.0, 2.0, 12), 1.0, LEVEL) for _ in range(4000))
    assert binom.ppf(1e-4, 4000, LEVEL) <= hits <= binom.ppf(1 - 1e-4, 4000, LEVEL)
    assert 0.94 <= hits / 4000 <= 0.96


def test_intervals_where_it_is_stopped_cover_at_least_94_per_cent():
    """The worst for a rule that stops: the true difference is zero, and stopping asks for significance."""
    rng = np.random.default_rng(12)
    stop = Stop(0.02, looks(5, 80))
    hits, used = 0, []
    for _ in range(4000):
        d = rng.normal(0.0, 1.0, 80)
        for count in stop.looks:
            ((mean,), (half,)) = mean_interval(d[:count, None], stop.level)
            rival = Comparison(0, "s", "t", "m", "rival", count, 0, 10.0 + mean, mean, half, is_tie=abs(mean) <= half)
            best = Comparison(0, "s", "t", "m", "best", count, 0, 10.0, is_best=True)
            if stop.is_decided([best, rival]):
                break
        hits += abs(mean) <= half
        used.append(count)
    assert hits / 4000 >= 0.94
    assert np.mean(used) < 80  # some are stopped before the last look


def test_all_that_is_shown_of_looks_is_at_the_level_of_one(tmp_path):
    """Three looks share the 5 %: a difference of p = 0.033 is none, by scipy's paired t-test of single looks at 98.33 %."""
    better, worse = np.full(8, 10.0), 10.0 + np.array([1.9, -1.2, 2.4, 0.3, 1.1, -0.2, 2.0, 0.9]) + 0.25
    test, level = ttest_rel(worse, better), 1.0 - 0.05 / 3.0
    assert 0.05 / 3.0 < test.pvalue < 0.05
    low, high = test.confidence_interval(level)
    plan = parse_plan('seeds = 8\nobservers = ["kf-lgs", "kf-multi"]\n[stop]\nfirst = 2\n', tmp_path)
    assert plan.level == pytest.approx(level, rel=1e-12)
    open_folder(plan, tmp_path)
    both = [*rows(better, "kf-lgs"), *rows(worse, "kf-multi")]
    found = [{**r, "seed": r["seed"] + 1, "key": f"{r['seed']} {r['name']}"} for r in both]
    write_batch(tmp_path, found, {"host": "h", "process": 1, "written": 0.0})
    place = CampaignFolder(tmp_path).read().errors["vibration", "tip"].standings([0])[1]
    assert place.is_tie and 10.0 * place.low == pytest.approx(low, rel=1e-9)  # another order of sums
    said = CliRunner().invoke(main, ["campaign", "table", str(tmp_path)]).stdout
    assert f"~{(low + high) / 2:.2f} +- {(high - low) / 2:.2f}" in said and "interval of 98.3 %" in said
    assert "interval of 98.3 %" in CliRunner().invoke(main, ["campaign", "table", str(tmp_path), "--together"]).stdout
    write_report(tmp_path, tmp_path / "report.html")
    report = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert f"± {(high - low) / 2:.2f} <span" in report and "98.3 % (paired t)" in report
    assert all("a best of the same data" in " ".join(text.split()) for text in (said, report)), "of more rows fewer hold"


def test_a_look_takes_the_first_seeds_whatever_has_arrived(tmp_path):
    plan = parse_plan(
        'seeds = 8\nobservers = ["kf-lgs", "kf-multi"]\n[grid]\nturbulence.wind_speed = [5, 10]\n[stop]\nfirst = 2\n', tmp_path
    )
    clear = [10.0, 10.001], [20.0, 20.002]  # by 10 +- 0.02 at the first look
    reverse = [90.0, 10.0] * 3, [20.0, 80.0] * 3  # of which nothing is clear
    noise = [10.0, 14.0] * 4, [14.0, 10.0] * 4  # the mean difference is zero
    table = [
        {**r, "seed": r["seed"] + 1, "key": f"{r['cell']} {r['seed']} {name}"}
        for name, first, then, other in zip(("kf-lgs", "kf-multi"), clear, reverse, noise, strict=True)
        for r in [*rows(first + then, name), *rows(other, name, cell=1)]
    ]
    shuffled = [table[i] for i in np.random.default_rng(3).permutation(len(table))]
    everything = np.ones((2, 8), dtype=bool)
    third_is_missing = everything & (np.arange(8) != 2)
    for arrived in (table, shuffled):
        index = written(tmp_path / str(len(list(tmp_path.iterdir()))), [arrived[:5], arrived[5:], arrived[:7]])
        assert wanted_seeds(plan, everything, index).tolist() == [2, 8]
        # the second look, at four seeds, waits for the third
        assert wanted_seeds(plan, third_is_missing, index).tolist() == [2, 4]
    early = written(tmp_path / "early", [[r for r in table if r["seed"] <= 2]])
    assert wanted_seeds(plan, np.arange(8) < [[2], [2]], early).tolist() == [2, 4]


def written(folder, batches):
    """Write batches, some rows perhaps twice, and return their index."""
    (folder / ROWS).mkdir(parents=True)
    for batch in batches:
        write_batch(folder, batch, {})
    return BatchIndex(folder)


class Counted:
    """An index that counts the rows that it hands out at a time."""

    def __init__(self, index):
        self.index, self.n_rows, self.held = index, index.n_rows, []

    def read(self, cells):
        table = self.index.read(cells)
        self.held.append(len(table))
        return table


@pytest.mark.slow
def test_as_many_rows_are_held_whatever_the_number_of_scenarios(tmp_path, monkeypatch):
    """Counted, and by tracemalloc, which sees numpy and Python; the memory of a process has libraries and freed pages in it."""
    seeds, held, peaks = 16, [], []
    monkeypatch.setattr("wfsobs.campaign.run.HELD", 10 * 2 * seeds)  # ten scenarios of two observers
    for n_cells in (20, 80):
        winds = ", ".join(str(5 + i / 10) for i in range(n_cells))
        text = f'observers = ["kf-lgs", "kf-multi"]\n[grid]\nturbulence.wind_speed = [{winds}]\n[stop]\nfirst = 4\n'
        plan, rng = parse_plan(f"seeds = {seeds}\n{text}", tmp_path), np.random.default_rng(4)
        batches = [
            [
                {**r, "seed": r["seed"] + 1, "key": f"{cell} {r['seed']} {name}"}
                for name in ("kf-lgs", "kf-multi")
                for r in rows(rng.normal(10, 1, seeds).tolist(), name, cell)
            ]
            for cell in range(n_cells)
        ]
        index = Counted(written(tmp_path / str(n_cells), batches))
        everything = np.ones((n_cells, seeds), dtype=bool)
        found, peak = traced(plan, everything, index)
        held.append(max(index.held))
        monkeypatch.setattr("wfsobs.campaign.run.HELD", 10**9)
        expected, at_once = traced(plan, everything, index)
        assert np.array_equal(found, expected)
        peaks.append((peak, at_once))
        monkeypatch.setattr("wfsobs.campaign.run.HELD", 10 * 2 * seeds)
    assert held == [10 * 2 * seeds] * 2
    # What is kept of a scenario, its masks and places, is a few hundred bytes; its rows are several thousand.
    (few, few_at_once), (many, many_at_once) = peaks
    assert many - few < 0.25 * (many_at_once - few_at_once)


def traced(plan, everything, index):
    """Return what is wanted, and the largest memory that finding it took."""
    wanted_seeds(plan, everything, index)  # what is imported and kept on the first call does not count
    gc.collect()
    tracemalloc.start()
    found = wanted_seeds(plan, everything, index)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return found, peak
