"""What a run leaves to take home: its data as CSV and NPZ, its scenario in both."""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from wfsobs.app.work import Shown
from wfsobs.observers.base import TARGETS
from wfsobs.scenario.configfile import to_toml
from wfsobs.telemetry.records import record_arrays

Array = NDArray[np.float64]

MOST = 4_000_000
"""Numbers in a download: about 100 s at 1 kHz."""


class TooLarge(ValueError):
    """More than a browser should be sent: one line saying so."""


def data_npz(shown: Shown) -> bytes:
    """The record as `wfsobs observe` takes it, every finished estimate as observer/target, the scenario. Raises TooLarge."""
    result = shown.result
    _check(shown)
    arrays = record_arrays(result.record, to_toml(shown.scenario))
    arrays |= {f"{e.observer}/{e.target}": e.values for e in result.estimates}
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    return file.getvalue()


def data_csv(shown: Shown) -> bytes:
    """Time, truth, measurements, commands and finished estimates, one row per step, the scenario as comments.

    Numbers have nine digits; NaN where there is none. Raises TooLarge.
    """
    _check(shown)
    names, columns = zip(*_columns(shown), strict=True)
    record = shown.result.record
    # comments of the TOML text too, and what a record is read by
    head = [f"# # dt: {record.dt!r}", *([f"# # ratio: {record.ratio}"] if record.ratio else [])]
    head += [f"# {line}".rstrip() for line in to_toml(shown.scenario).splitlines()]
    row = ",".join(["%.9g"] * len(names))
    lines = [row % tuple(values) for values in np.column_stack(columns).tolist()]
    return "\n".join([*head, ",".join(names), *lines, ""]).encode()


def _columns(shown: Shown) -> Iterator[tuple[str, Array]]:
    """(name with its unit, values) of every column."""
    result, record = shown.result, shown.result.record
    modes = [m.name for m in shown.scenario.modes][: record.n_modes]
    signals = {f"truth/{target}": record.truth(target) for target in TARGETS}
    signals |= {"y_lgs": record.y_lgs, "y_ngs": record.y_ngs, "u": record.u}
    signals |= {f"{e.observer}/{e.target}": e.values for e in result.estimates}
    yield "time_s", np.asarray(np.arange(record.n_steps) * record.dt, dtype=np.float64)
    for name, values in signals.items():
        if values is not None:
            yield from ((f"{name}/{mode}_um", values[:, i]) for i, mode in enumerate(modes))


def _check(shown: Shown) -> None:
    result = shown.result
    numbers = result.record.n_steps * (1 + result.record.n_modes * (5 + len(result.estimates)))
    if numbers > MOST:
        raise TooLarge(f"{numbers / 1e6:.0f} million numbers, at most {MOST // 1_000_000} million can be downloaded: "
                       "shorten the record, or use wfsobs run --save")
