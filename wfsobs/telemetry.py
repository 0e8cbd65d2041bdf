"""Records from and to `.npz` files. Loading never unpickles.

A record holds y_lgs (n_steps, n_modes) [um], u (same shape) and dt [s]; optionally y_ngs (same shape, NaN where there is no
frame) with ratio, the truth turbulence and vibration, open_loop_y, and for the offline GPR training_y, training_u
and training_open_loop_y (n, n_modes). A saved record also holds its scenario as TOML text, for information.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from wfsobs.arrays import Array
from wfsobs.files import write_whole
from wfsobs.record import Record, RecordError, Training
from wfsobs.scenario import Scenario

SAME_SHAPE = ("u", "y_ngs", "turbulence", "vibration", "open_loop_y")


def save_record(path: str | Path, record: Record, scenario_toml: str | None = None) -> None:
    """Write a record, its training record with it. Raises OSError."""
    save_arrays(path, record_arrays(record, scenario_toml))


def record_arrays(record: Record, scenario_toml: str | None = None) -> dict[str, Array]:
    """What the file of a record holds, by name."""
    arrays = {name: np.asarray(value) for name, value in vars(record).items() if name != "training" and value is not None}
    if record.training is not None:
        t = record.training
        arrays |= {"training_y": t.y_lgs, "training_u": t.u}
        if t.open_loop_y is not None:
            arrays["training_open_loop_y"] = t.open_loop_y
    if scenario_toml is not None:
        arrays["scenario"] = np.array(scenario_toml)
    return arrays


def save_arrays(path: str | Path, arrays: Mapping[str, Array]) -> None:
    """Write named arrays as a compressed `.npz`. Raises OSError."""
    write_whole(path, lambda file: np.savez_compressed(file, allow_pickle=False, **dict(arrays)))


def load_record(path: str | Path, scenario: Scenario | None = None) -> Record:
    """Read and check a record. Raises RecordError with one line saying what, where and what is expected."""
    arrays = _read(path)
    where = str(path)
    for name in ("y_lgs", "u", "dt"):
        if name not in arrays:
            raise RecordError(f"{where}: has no {name}; a record needs y_lgs, u and dt")
    y_lgs = _signal(arrays, "y_lgs", where)
    most = len((scenario or Scenario()).modes)
    if not 1 <= y_lgs.shape[1] <= most or y_lgs.shape[0] < 2:
        raise RecordError(f"{where}: y_lgs has shape {y_lgs.shape}; it takes (n_steps >= 2, 1 to {most} modes)")
    same = {name: _signal(arrays, name, where, y_lgs.shape, nan=name == "y_ngs") for name in SAME_SHAPE if name in arrays}
    ratio = None
    if "y_ngs" in same:
        ratio = _ratio(arrays, where)
        same["y_ngs"] = _frames(same["y_ngs"], ratio, where)
    training = None
    if "training_y" in arrays and "training_u" in arrays:
        y = _signal(arrays, "training_y", where, (None, y_lgs.shape[1]))
        u = _signal(arrays, "training_u", where, y.shape)
        twin = "training_open_loop_y"
        training = Training(y, u, _signal(arrays, twin, where, y.shape) if twin in arrays else None)
    elif "training_y" in arrays or "training_u" in arrays:
        raise RecordError(f"{where}: training_y and training_u must come together")
    return Record(y_lgs=y_lgs, dt=_number(arrays, "dt", where), ratio=ratio, training=training, **same)


def _read(path: str | Path) -> dict[str, Array]:
    try:
        with open(path, "rb") as file:
            if not zipfile.is_zipfile(file):
                raise RecordError(f"{path}: not an .npz file; a record is an .npz with y_lgs, u and dt")
            file.seek(0)
            with np.load(file, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
    except OSError as error:
        raise RecordError(f"{path}: cannot be read: {error.strerror or error}") from None
    except RecordError:
        raise
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error, KeyError):
        raise RecordError(f"{path}: damaged, or holds more than plain arrays") from None


def _signal(
    arrays: Mapping[str, Array], name: str, where: str, shape: tuple[int | None, ...] = (None, None), nan: bool = False
) -> Array:
    raw = arrays[name]
    if raw.dtype.kind not in "fiu":
        raise RecordError(f"{where}: {name} holds {raw.dtype}, not numbers")
    if raw.ndim != 2 or any(want is not None and want != have for want, have in zip(shape, raw.shape, strict=True)):
        wanted = ", ".join("any" if s is None else str(s) for s in shape)
        raise RecordError(f"{where}: {name} has shape {raw.shape}; expected ({wanted})")
    out = np.ascontiguousarray(raw, dtype=np.float64)
    bad = np.isinf(out) if nan else ~np.isfinite(out)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise RecordError(f"{where}: {name} is {out[row, column]} at step {row}, mode {column}; it takes finite numbers")
    return out


def _number(arrays: Mapping[str, Array], name: str, where: str) -> float:
    raw = arrays[name]
    if raw.ndim != 0 or raw.dtype.kind not in "fiu" or not np.isfinite(raw) or raw <= 0:
        raise RecordError(f"{where}: {name} takes one number above 0, not {np.array2string(raw, threshold=4)}")
    return float(raw)


def _ratio(arrays: Mapping[str, Array], where: str) -> int:
    if "ratio" not in arrays:
        raise RecordError(f"{where}: y_ngs needs ratio, the number of fast steps per NGS frame")
    value = _number(arrays, "ratio", where)
    if value != int(value):
        raise RecordError(f"{where}: ratio takes a whole number, not {value:g}")
    return int(value)


def _frames(y_ngs: Array, ratio: int, where: str) -> Array:
    """Check that frames are where the ratio says, at k = n, 2n, ...; a frame at k = 0 saw nothing and is dropped."""
    steps = np.arange(y_ngs.shape[0])
    due = (steps % ratio == 0) & (steps >= ratio)
    empty = np.isnan(y_ngs)
    wrong = np.where(due, empty.any(axis=1), ~empty.all(axis=1)) & (steps > 0)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise RecordError(f"{where}: y_ngs {'lacks the' if due[k] else 'has a'} frame at step {k}; with ratio = {ratio} "
                          f"frames are at steps {ratio}, {2 * ratio}, ... and NaN elsewhere")
    return np.where(due[:, None], y_ngs, np.nan)
