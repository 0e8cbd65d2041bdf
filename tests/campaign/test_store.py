"""Files of results."""

import numpy as np
import pytest

from wfsobs.campaign.store import ROWS, batch_files, read_results, write_batch

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


def test_an_empty_folder_has_an_empty_table(folder):
    assert len(read_results(folder)) == 0
