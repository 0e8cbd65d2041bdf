"""Ranks of a campaign, and its report."""

import re

import numpy as np
import pyarrow as pa
import pytest

from wfsobs.campaign.compare import Comparison, compare
from wfsobs.campaign.plan import parse_plan
from wfsobs.campaign.report import critical_difference, first_places, rank, write_report
from wfsobs.campaign.store import open_folder, read_results, schema, write_batch

NAMES = ["kf-lgs", "kf-multi", "multirate", "persistence"]


@pytest.mark.parametrize(("names", "q"), [(2, 1.960), (3, 2.343), (4, 2.569), (5, 2.728), (10, 3.164)])
def test_the_critical_difference_is_that_of_the_published_table(names, q):
    """Demsar 2006, table 5a, to its digits."""
    assert critical_difference(names, 14) == pytest.approx(q * np.sqrt(names * (names + 1) / (6 * 14)), abs=1e-3)


def one(cell, name, rms, best=False):
    return Comparison(cell, "s", "t", "m", name, 5, 0, rms, None if best else rms, 0.1, best)


def test_mean_ranks_and_bars_of_a_table_done_by_hand():
    cells = [(1.0, 2.0, 3.0), (1.0, 3.0, 2.0), (1.0, 2.0, 3.0), (2.0, 1.0, 3.0)]
    rows = [one(i, n, v, v == min(values)) for i, values in enumerate(cells) for n, v in zip("abc", values, strict=True)]
    (found,) = rank(rows)
    assert found.names == ("a", "b", "c") and found.mean_ranks == (1.25, 2.0, 2.75)
    # 2.343 sqrt(3 * 4 / 24) = 1.657: the largest distance is 1.5, so that all are on one bar
    assert found.critical == pytest.approx(1.657, abs=1e-3) and found.ties == ((0, 2),)


def results(cells, seeds, rng):
    level = {"kf-lgs": 12.0, "kf-multi": 10.0, "multirate": 10.0, "persistence": 20.0}
    return [
        {
            "key": f"{cell:06d}{seed:06d}{name}", "cell": cell, "scenario": "paper", "seed": seed, "name": name, "target": target,
            "mode": "tip", "rms_nm": level[name] + rng.normal(0, 1), "apart": False, "note": "",
        }
        for cell in range(cells) for seed in range(1, seeds + 1) for name in NAMES for target in ("turbulence", "vibration")
    ]  # fmt: skip


def test_first_places_are_shares_of_samples():
    table = pa.Table.from_pylist(results(1, 30, np.random.default_rng(3)), schema=schema())
    shares = first_places(table, np.random.default_rng(1))[0, "vibration", "tip"]
    best = next(c for c in compare(table) if c.is_best and c.target == "vibration")
    assert sum(shares.values()) == pytest.approx(1.0) and set(shares) == {"kf-multi", "multirate"}
    assert shares[best.name] > 0.5
    assert shares == first_places(table, np.random.default_rng(1))[0, "vibration", "tip"]


def test_the_maps_of_a_report_name_settings_with_their_units(tmp_path):
    grid = "[grid]\nturbulence.wind_speed = [5, 10]\nsensors.exposure_ratio = [2, 5]\n"
    plan = parse_plan(f'name = "Small"\nseeds = 2\nobservers = {NAMES}\n{grid}'.replace("'", '"'), tmp_path)
    open_folder(plan, tmp_path)
    write_batch(tmp_path, results(4, 2, np.random.default_rng(2)), {"host": "h", "process": 1, "written": 0.0})
    write_report(tmp_path, tmp_path / "report.html")
    maps, _, _ = (tmp_path / "report.html").read_text(encoding="utf-8").partition("<h2>Ranks")
    assert re.search(r'text-anchor="middle">Wind speed V₀ \[m/s\]<', maps) and ">Exposure ratio n<" in maps
    assert "Wind speed V₀ [m/s] = 5" in maps and "turbulence.wind_speed" not in maps


@pytest.mark.slow
def test_a_report_of_1e5_rows_is_one_file_below_ten_megabytes(tmp_path):
    grid = "[grid]\nturbulence.wind_speed = [5, 10, 15, 20, 25]\nsensors.exposure_ratio = [2, 5, 10, 20, 40]\n"
    plan = parse_plan(f'name = "<Big>"\nseeds = 500\nobservers = {NAMES}\n{grid}'.replace("'", '"'), tmp_path)
    open_folder(plan, tmp_path)
    rows = results(25, 500, np.random.default_rng(2))
    assert len(rows) == 100_000
    write_batch(tmp_path, rows, {"host": "h", "process": 1, "written": 0.0})
    write_report(tmp_path, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert len(text) < 10e6
    assert "&lt;Big&gt;" in text and "<Big>" not in text
    assert not re.search(r"https?://|src=|@import", text), "it opens without a network"
    compared = compare(read_results(tmp_path))
    for c in compared:
        if c.is_best:
            assert f"{c.rms:.1f} nm" in text
    assert text.count("<rect") == 2 * 25
