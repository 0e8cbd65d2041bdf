"""Files of results."""

import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from wfsobs.campaign import store
from wfsobs.campaign.plan import parse_plan
from wfsobs.campaign.store import (
    PLAN,
    ROWS,
    BatchIndex,
    batch_files,
    finished_runs,
    folder_plan,
    present_rows,
    read_results,
    row_key,
    scenario_digest,
    schema,
    write_batch,
)
from wfsobs.settings.values import SettingError

HERE = {"host": "here", "process": 1, "written": 0.0}


def row(key, rms=1.0, **more):
    return {
        "key": key,
        "cell": 0,
        "scenario": "s",
        "seed": 1,
        "name": "kf-lgs",
        "target": "t",
        "mode": "tip",
        "rms_nm": rms,
        **more,
    }


@pytest.fixture
def folder(tmp_path):
    (tmp_path / ROWS).mkdir()
    return tmp_path


def test_rows_computed_twice_count_once_and_are_sorted(folder):
    write_batch(folder, [row("b", 2.0), row("a", 1.0)], HERE)
    write_batch(folder, [row("b", 2.0), row("c", 3.0)], HERE | {"host": "there"})
    table = read_results(folder)
    assert table["key"].to_pylist() == ["a", "b", "c"]
    assert table["rms_nm"].to_pylist() == [1.0, 2.0, 3.0]


def test_a_file_cut_off_is_left_out_and_nothing_is_half_written(folder, monkeypatch):
    write_batch(folder, [row("a")], HERE)
    write_batch(folder, [row("b")], HERE)
    cut = batch_files(folder)[0]
    kept = {"a", "b"} - set(read_results(folder).filter(np.array([True, False]))["key"].to_pylist())
    cut.write_bytes(cut.read_bytes()[:-20])
    assert len(read_results(folder)) == 1 and kept

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_batch(folder, [row("c")], HERE)
    assert len(list((folder / ROWS).iterdir())) == 2


@pytest.mark.parametrize("change", ["foreign", "no key", "no rms", "another type", "null cells"])
def test_a_file_of_other_columns_is_left_out(folder, change):
    write_batch(folder, [row("a")], HERE)
    table = pq.read_table(batch_files(folder)[0])
    other = {
        "foreign": pa.table({"a": [1, 2]}),
        "no key": table.drop_columns(["key"]),
        "no rms": table.drop_columns(["rms_nm"]),
        "another type": table.set_column(table.schema.get_field_index("cell"), "cell", pa.array(["first"])),
        "null cells": table.set_column(table.schema.get_field_index("cell"), "cell", pa.array([None], "int32")),
    }[change]
    pq.write_table(other, folder / ROWS / "other.parquet")
    assert read_results(folder)["key"].to_pylist() == ["a"]
    assert BatchIndex(folder).read(range(10))["key"].to_pylist() == ["a"]


@pytest.mark.parametrize(
    "damage", [{"scenarios": []}, {"scenarios": {"s": []}}, {"cells": [["s", []]]}, {"cells": [["t", {}]]}, {"seeds": "6"}]
)
def test_a_plan_that_was_damaged_is_said_to_be_none(folder, damage):
    values = {"name": "n", "first_seed": 1, "seeds": 2, "observers": [], "controllers": [], "stop": None}
    values |= {"scenarios": {"s": {}}, "cells": [["s", {}]]}
    (folder / PLAN).write_text(json.dumps(values))
    assert folder_plan(folder).n_runs == 2
    (folder / PLAN).write_text(json.dumps(values | damage))
    with pytest.raises(SettingError, match="is not the plan of a campaign"):
        folder_plan(folder)


def test_rows_of_another_version_or_of_other_seeds_are_not_those_of_a_plan(folder, monkeypatch):
    plan = replace(parse_plan('seeds = 2\nobservers = ["kf-lgs"]\n', folder), observers=("kf-lgs", "theirs"))

    def rows():
        digest = scenario_digest(plan.cells[0].scenario())
        return [
            row(row_key(digest, seed, name), float(store.PHYSICS_VERSION), seed=seed, name=name)
            for seed in (1, 2, 3)
            for name in ("kf-lgs", "theirs")
        ]

    with monkeypatch.context() as patched:
        patched.setattr(store, "PHYSICS_VERSION", 0)
        write_batch(folder, rows(), HERE)
    old = present_rows(plan, read_results(folder))
    assert sorted(old["seed"].to_pylist()) == [1, 1, 2, 2] and set(old["rms_nm"].to_pylist()) == {0.0}
    assert finished_runs(plan, folder).sum() == 0
    write_batch(folder, rows(), HERE)
    new = present_rows(plan, read_results(folder))
    assert sorted(new["seed"].to_pylist()) == [1, 1, 2, 2] and set(new["rms_nm"].to_pylist()) == {float(store.PHYSICS_VERSION)}
    assert finished_runs(plan, folder).all(), "an observer that is not installed has no version"


def test_an_empty_folder_has_an_empty_table(folder):
    assert len(read_results(folder)) == 0


def test_the_rows_as_text_are_those_of_the_table_in_chunks(monkeypatch, capsys, tmp_path):
    from wfsobs.campaign.plan import parse_plan
    from wfsobs.cli import campaign

    plan = parse_plan('seeds = 1\nobservers = ["kf-lgs"]\n[grid]\nturbulence.wind_speed = [5, 10]\n', tmp_path)
    rows = [row(str(i), 0.1 + i, cell=i % 2, truth_rms_nm=None, start_s=0.0, apart=False, note="") for i in range(5)]
    monkeypatch.setattr(campaign, "CHUNK", 2)
    campaign.print_csv(plan, pa.Table.from_pylist(rows, schema=schema()))
    head, *lines = (line.split(",") for line in capsys.readouterr().out.splitlines())
    assert head[-1] == "turbulence.wind_speed"
    assert [line[0] for line in lines] == ["0", "1", "2", "3", "4"]
    assert [float(line[head.index("rms_nm")]) for line in lines] == [0.1 + i for i in range(5)]
    assert [line[-1] for line in lines] == ["5", "10", "5", "10", "5"]


def test_a_process_asks_for_its_kernel_once(monkeypatch):
    from wfsobs.campaign import run

    asked = []
    monkeypatch.setattr(run, "threadpool_info", lambda: asked.append(1) or [{"user_api": "blas", "architecture": "Tape"}])
    run.blas_kernel.cache_clear()
    try:
        assert [run.blas_kernel() for _ in range(3)] == ["Tape"] * 3 and len(asked) == 1
    finally:
        run.blas_kernel.cache_clear()
