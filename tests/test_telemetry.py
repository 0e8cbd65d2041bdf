"""Record files: what is saved comes back, what is wrong is told in one line, nothing is unpickled."""

import dataclasses

import numpy as np
import pytest

from wfsobs.record import RecordError
from wfsobs.scenario.presets import paper
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.records import load_record, save_arrays, save_record


@pytest.fixture(scope="module")
def record():
    return simulate(paper().replace({"run.duration": 1.5}))


@pytest.fixture
def arrays(record):
    """A small valid record as plain arrays."""
    n = 40
    return {
        "y_lgs": record.y_lgs[:n],
        "u": record.u[:n],
        "dt": np.array(1e-3),
        "y_ngs": record.y_ngs[:n],
        "ratio": np.array(5),
    }


def test_a_record_comes_back_as_it_was(record, tmp_path):
    path = tmp_path / "r.npz"
    save_record(path, record, "[run]")
    again = load_record(path)
    for field in dataclasses.fields(record):
        if field.name not in ("training", "gate"):
            np.testing.assert_array_equal(getattr(again, field.name), getattr(record, field.name))
    for field in dataclasses.fields(record.training):
        np.testing.assert_array_equal(getattr(again.training, field.name), getattr(record.training, field.name))
    assert type(again.ratio) is int
    assert type(again.dt) is float
    with np.load(path, allow_pickle=False) as file:
        assert str(file["scenario"]) == "[run]"


def test_the_least_record(tmp_path):
    y = np.arange(9.0)[:, None]
    save_arrays(tmp_path / "r.npz", {"y_lgs": y, "u": np.zeros((9, 1), dtype=">f4"), "dt": np.float32(0.002)})
    record = load_record(tmp_path / "r.npz")
    assert (record.n_steps, record.n_modes, record.y_ngs, record.ratio, record.training) == (9, 1, None, None, None)
    assert record.u.dtype == np.float64
    assert record.u.dtype.isnative


def test_a_frame_at_step_zero_is_dropped(arrays, tmp_path):
    with_first = arrays["y_ngs"].copy()
    with_first[0] = 1.0
    save_arrays(tmp_path / "r.npz", arrays | {"y_ngs": with_first})
    np.testing.assert_array_equal(load_record(tmp_path / "r.npz").y_ngs, arrays["y_ngs"])


def changed(arrays, name, k, value):
    out = arrays[name].copy()
    out[k, 0] = value
    return arrays | {name: out}


WRONG = [
    (lambda a: {k: v for k, v in a.items() if k != "u"}, "has no u; a record needs y_lgs, u and dt"),
    (lambda a: a | {"u": a["u"][:-1]}, r"u has shape \(39, 2\); expected \(40, 2\)"),
    (lambda a: a | {"y_lgs": a["y_lgs"][:, 0]}, r"u has shape \(40, 2\); expected \(40, 1\)"),
    (lambda a: a | {"y_lgs": np.zeros((40, 3))}, r"y_lgs has shape \(40, 3\); it takes"),
    (lambda a: a | {"u": a["u"].astype(str)}, "u holds text, not numbers"),
    (lambda a: a | {"dt": np.array(-1.0)}, "dt takes one number above 0, not -1"),
    (lambda a: a | {"dt": np.array(np.nan)}, "dt takes one number above 0, not nan"),
    (lambda a: a | {"dt": np.array([1e-3, 2e-3])}, "dt holds 2 numbers that differ; it takes one"),
    (lambda a: a | {"ratio": np.array(2.5)}, "ratio takes a whole number, not 2.5"),
    (lambda a: a | {"ratio": np.array(4)}, r"y_ngs has a frame at step 5; with ratio = 4 frames are at"),
    (lambda a: changed(a, "y_ngs", 7, 0.0), "y_ngs has a frame at step 7; with ratio = 5"),
    (lambda a: changed(a, "u", 3, 1e300), r"u is 1e\+300 at step 3, mode 0; it takes finite numbers up to 1e\+12, NaN"),
    (lambda a: changed(a, "y_lgs", 3, -np.inf), "y_lgs is -inf at step 3, mode 0; it takes finite numbers"),
    (lambda a: changed(a, "y_lgs", slice(None), np.nan), "y_lgs holds no measurement of one of its modes"),
    (lambda a: changed(a, "u", slice(None), np.nan), "u holds no command of one of its modes"),
    (lambda a: a | {"training_y": changed(a, "u", 2, np.nan)["u"], "training_u": a["u"]}, "training_y is nan at step 2, mode 0"),
    (lambda a: changed(a, "u", 4, np.inf), "u is inf at step 4, mode 0"),
    (lambda a: a | {"training_y": a["u"]}, "training_y and training_u must come together"),
    (lambda a: a | {"training_y": a["u"], "training_u": a["u"][:-1]}, r"training_u has shape \(39, 2\); expected \(40, 2\)"),
    (lambda a: {k: v for k, v in a.items() if k != "ratio"} | {"y_ngs": a["y_lgs"]}, "y_ngs needs ratio"),
]


@pytest.mark.parametrize(("change", "message"), WRONG, ids=[m[:30] for _, m in WRONG])
def test_wrong_records_give_one_line(arrays, tmp_path, change, message):
    path = tmp_path / "r.npz"
    save_arrays(path, change(arrays))
    with pytest.raises(RecordError, match=message) as caught:
        load_record(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_files_that_are_no_records(tmp_path):
    with pytest.raises(RecordError, match="cannot be read: No such file"):
        load_record(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("hello")
    np.save(tmp_path / "single.npy", np.zeros(3))
    whole = tmp_path / "whole.npz"
    save_arrays(whole, {"y_lgs": np.random.default_rng(0).standard_normal((50, 2))})
    (tmp_path / "cut.npz").write_bytes(whole.read_bytes()[:150])
    with pytest.raises(RecordError, match=r"single.npy: has no y_lgs; .* It has array"):
        load_record(tmp_path / "single.npy")
    for name in ("text.npz", "cut.npz"):
        with pytest.raises(RecordError, match=r"not an \.npz file"):
            load_record(tmp_path / name)
    content = bytearray(whole.read_bytes())
    content[200:300] = bytes(100)
    (tmp_path / "damaged.npz").write_bytes(content)
    with pytest.raises(RecordError, match="damaged"):
        load_record(tmp_path / "damaged.npz")


def test_nothing_is_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("the file was unpickled",))

    np.savez(tmp_path / "trap.npz", y_lgs=np.array([Trap()], dtype=object), u=np.zeros(1), dt=np.array(1.0))
    with pytest.raises(RecordError, match="more than plain arrays"):
        load_record(tmp_path / "trap.npz")


def test_a_failed_write_leaves_the_old_file(tmp_path, record):
    path = tmp_path / "r.npz"
    save_record(path, record)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="Object arrays"):
        save_arrays(path, {"y": np.array([object()], dtype=object)})
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["r.npz"]
